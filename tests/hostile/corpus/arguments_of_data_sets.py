must_refuse(lambda: sp.build_dataset(folder / "links", 5))
must_refuse(lambda: sp.build_dataset(folder / "links", [1], scheduler=5))
must_refuse(lambda: sp.read_dataset(None))
must_refuse(lambda: sp.make_home(1, kind=["house"]))
