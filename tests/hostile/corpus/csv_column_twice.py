path = valid("measurements.csv", folder)
lines = path.read_text().splitlines()
path.write_text("\n".join([lines[0] + ",gain_db", *(line + ",-50" for line in lines[1:])]) + "\n")
must_refuse(lambda: sp.calibrate_materials(room(), path))
