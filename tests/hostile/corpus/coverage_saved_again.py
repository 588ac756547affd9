import xarray as xr
path = valid("coverage.nc", folder)
sp.save_coverage(xr.load_dataset(path), folder / "again.nc")
if path.read_bytes() != (folder / "again.nc").read_bytes():
    raise Wrong("other bytes")
