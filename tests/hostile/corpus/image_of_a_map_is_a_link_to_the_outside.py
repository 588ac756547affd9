path = valid("scene folder", folder)
outside = folder / "outside.pgm"
image = path.parent / "map.pgm"
outside.write_bytes(image.read_bytes())
image.unlink()
image.symlink_to(outside)
must_refuse(lambda: sp.load_map(path.parent))
