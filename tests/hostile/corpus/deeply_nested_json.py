path = valid("predictor.json", folder)
path.write_text("[" * 100_000)
must_refuse(lambda: sp.Predictor.load(path.with_suffix(".keras")))
