import os
os.mkfifo(folder / "fifo")
for suffix in ("yaml", "npz", "ply", "obj", "xml", "keras", "csv"):
    for source in (folder / "fifo", "/dev/zero", "/dev/full"):
        path = folder / f"input.{suffix}"
        path.unlink(missing_ok=True)
        path.symlink_to(source)
        if suffix == "keras":
            must_refuse(lambda: sp.Predictor.load(path))
        elif suffix == "csv":
            must_refuse(lambda: sp.calibrate_materials(room(), path))
        else:
            must_refuse(lambda: sp.load_map(path))
