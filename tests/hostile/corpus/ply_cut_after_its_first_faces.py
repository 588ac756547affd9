path = valid("mesh.ply", folder)
path.write_text("\n".join(path.read_text().splitlines()[:-4]) + "\n")
must_refuse(lambda: sp.load_map(path, resolution_m=0.2))
