import os
out = folder / "out"
out.mkdir()
(folder / "mine.nc").write_text("mine")
(out / "coverage.nc").symlink_to(folder / "mine.nc")
words = ("predict", valid("map.yaml", folder), "--tx", "1.1", "1.1", "--spacing", "1.0", "--predictor", "paper", "--out", out)
command(*words)
if not (out / "coverage.nc").is_symlink() or (folder / "mine.nc").read_bytes()[1:4] != b"HDF":
    raise Wrong("the link was replaced by a file")
(out / "coverage.nc").unlink()
os.mkfifo(out / "coverage.nc")
command(*words)
raise Wrong("a pipe was replaced")
