must_refuse(lambda: sp.save_map(room(), folder / "map.npz", extra={"score": 1}))
