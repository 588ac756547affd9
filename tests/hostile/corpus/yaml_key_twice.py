path = valid("map.yaml", folder)
path.write_text(path.read_text() + "resolution: 0.4\n")
must_refuse(lambda: sp.load_map(path))
