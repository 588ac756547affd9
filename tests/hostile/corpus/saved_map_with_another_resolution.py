must_refuse(lambda: sp.save_map(room(), folder / "map.yaml", extra={"resolution": 0.5}))
