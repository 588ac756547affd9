path = valid("mesh.ply", folder)
path.write_text(path.read_text().replace("element face 12", "element face 14"))
must_refuse(lambda: sp.load_map(path, resolution_m=0.2))
