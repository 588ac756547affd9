path = folder / "scheduler.json"
for text in ("", "{}", "[]", "null", '{"address": 5}', "[" * 100_000, '{"address": "tcp://127.0.0.1:x"}'):
    path.write_text(text)
    must_refuse(lambda: sp.lab.build_dataset(folder / "links", [1], scheduler=str(path)))
