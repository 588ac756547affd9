for extra in ({"mesh": {}}, {1: 2}, 5, {"a": object()}, {"a": "x" * 2_000_000}):
    must_refuse(lambda: sp.save_map(room(), folder / "map.yaml", extra=extra))
