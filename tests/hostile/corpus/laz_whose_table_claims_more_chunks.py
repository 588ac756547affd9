path = valid("cloud.laz", folder)
path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
must_refuse(lambda: sp.load_map(path))
