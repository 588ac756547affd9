import os, shutil
package = folder / "site" / "sionna_partial"
shutil.copytree(Path(sp.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
for each in [package, *(path for path in package.rglob("*") if path.is_dir())]:
    (each / "__pycache__").touch()  # no folder can be made there, not even by root
result = python("import sionna_partial as sp; assert 'site' in sp.__file__; sp.TraceSettings; import sionna_partial.arrays, sionna_partial.worlds.robot",
    PYTHONPATH=str(folder / "site"), PYTHONDONTWRITEBYTECODE="1", HOME="/proc/nowhere", XDG_CACHE_HOME="/proc/nowhere", TMPDIR=str(folder))
must_end_in_one_line(result, 0)
shutil.rmtree(folder / f"sionna-partial-numba-{os.getuid()}", ignore_errors=True)
