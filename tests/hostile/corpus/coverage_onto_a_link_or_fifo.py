import os, xarray as xr
coverage = xr.load_dataset(valid("coverage.nc", folder))
target = folder / "target.csv"
target.write_text("mine")
(folder / "link.csv").symlink_to(target)
os.mkfifo(folder / "fifo.csv")
must_refuse(lambda: sp.save_coverage(coverage, folder / "fifo.csv"))
sp.save_coverage(coverage, folder / "link.csv")
if not (folder / "link.csv").is_symlink():
    raise Wrong("the link was replaced by a file")
