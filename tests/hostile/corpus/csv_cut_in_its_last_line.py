path = valid("measurements.csv", folder)
path.write_text(path.read_text()[:-3])
must_refuse(lambda: sp.calibrate_materials(room(), path))
