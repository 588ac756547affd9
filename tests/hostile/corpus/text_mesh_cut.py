path = folder / "room.stl"
path.write_text("solid room\n" + "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 2\nendloop\nendfacet\n" * 3)
must_refuse(lambda: sp.load_map(path, resolution_m=0.2))
path = valid("mesh.ply", folder)
path.write_text(path.read_text().replace("element face 12", "element face 10"))
must_refuse(lambda: sp.load_map(path, resolution_m=0.2))
