must_refuse(lambda: sp.lab.build_dataset(folder / "links", 5))
must_refuse(lambda: sp.lab.build_dataset(folder / "links", [1], scheduler=5))
must_refuse(lambda: sp.lab.read_dataset(None))
must_refuse(lambda: sp.make_home(1, kind=["house"]))
