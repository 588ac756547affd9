path = valid("scene.xml", folder)
text = path.read_text()
moved = '<transform name="toWorld"><translate x="1.0"/></transform></shape>'
path.write_text(text.replace("</shape>", moved, 1))
(path.parent / "map.yaml").unlink()
must_refuse(lambda: sp.load_map(path, resolution_m=0.2))
