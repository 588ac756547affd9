import re
path = valid("cloud.pcd", folder)
path.write_bytes(re.sub(rb"(WIDTH|POINTS) \d+", rb"\1 4000000000", path.read_bytes()))
must_refuse(lambda: sp.load_map(path))
path = valid("cloud.las", folder)
content = bytearray(path.read_bytes())
content[107:111] = content[247:251] = b"\xff" * 4  # number of points, of LAS 1.2 and 1.4
path.write_bytes(content)
must_refuse(lambda: sp.load_map(path))
