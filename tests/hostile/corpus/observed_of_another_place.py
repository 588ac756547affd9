other = sp.PartialMap(room().state, 0.2, origin_m=(100.0, 100.0))
path = valid("mesh.obj", folder)
must_refuse(lambda: sp.load_map(path, resolution_m=0.2, observed=other))
