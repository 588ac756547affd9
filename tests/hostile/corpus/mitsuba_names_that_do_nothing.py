path = valid("scene.xml", folder)
(path.parent / "map.yaml").unlink()
text = path.read_text()
for old, new in (('name="relative_permittivity"', 'name="relativePermittivity"'), ('name="filename"', 'name="file_name"')):
    path.write_text(text.replace(old, new))
    must_refuse(lambda: sp.load_map(path, resolution_m=0.2))
