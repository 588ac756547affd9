"""Coverage maps to files: NetCDF, GeoTIFF, CSV, PNG, HTML, ROS map."""

import io
import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import yaml
from numpy.typing import ArrayLike

import sionna_partial.coverage.radio  # noqa: F401 - registers coverage.radio
from sionna_partial.arrays import Floats
from sionna_partial.constants import COST_THRESHOLD_DB, MAX_COST, NO_RECEIVER, CellState
from sionna_partial.coverage.dataset import (
    ANTENNA,
    ATTRIBUTES,
    TX_COORDINATES,
    cost_grid,
    probability_above,
    transmitters_of,
)
from sionna_partial.coverage.network import VARIABLES, require_network
from sionna_partial.errors import OutputError, SettingsError
from sionna_partial.files import atomic_write, output_path, read_bytes, require_plain_hdf5, write_netcdf
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.maps.ros_map_writer import ros_sheet, write_ros_files
from sionna_partial.plots.coverage_plot import plot_coverage, plot_network
from sionna_partial.plots.coverage_viewer import coverage_page
from sionna_partial.plots.style import figure_png
from sionna_partial.resources import optional_packages

TABLE_VARIABLES = tuple(name for name in ATTRIBUTES if name != "wall_parts")
"""Variables in CSV and GeoTIFF; only pictures need `wall_parts`."""

MAX_BYTES, MAX_ARRAY_BYTES = 500_000_000, 4_000_000_000
"""Largest file that is read, and its largest arrays [bytes]."""

LINK_STATES = ("link_state", "partial_link_state")


def save_coverage(
    coverage: xr.Dataset,
    path: str | os.PathLike[str],
    *,
    scene: PartialMap | None = None,
    threshold_db: ArrayLike = COST_THRESHOLD_DB,
) -> None:
    """Write a coverage map in the format of the suffix. Equal maps give equal files.

    ======== ==========================================================================================
    `.nc`    NetCDF 4 (CF conventions) of the whole Dataset.
    `.tif`   GeoTIFF, one float32 band for each variable, named by its description, NaN without receiver; local
             metres, no coordinate reference system; settings as tags. Bands of several transmitters are
             "transmitter:variable".
    `.csv`   One row for each receiver, columns x_m, y_m and the variables; empty without receiver. Several
             transmitters have a first column tx.
    `.png`   The picture of `plot_coverage`.
    `.html`  A page for the browser, without network access: layers, values under the pointer, P(gain > threshold),
             and the best server of several transmitters.
    `.yaml`  Costs for a planner: ROS map_server map in `raw` mode with a `.pgm`, as `LiveCoverage` publishes them
             (`docs/live.md`). Free cells have P(path gain <= threshold) in percent, at most 98, of several transmitters
             the smallest (an upper bound on the probability for all); walls and unknown cells are -1.
    ======== ==========================================================================================

    Parameters
    ----------
    coverage : xarray.Dataset
        From `predict_map`.
    path : path-like
        Path of the file, which is replaced if it exists.
    scene : PartialMap, optional
        Map whose cells the costs of a `.yaml` are for; without it they are for the receivers, as a picture.
    threshold_db : float or (T,) array-like
        Of a `.yaml`: path gain that a receiver needs [dB], from all or each of the T transmitters.

    Raises
    ------
    SettingsError
        For anything but a coverage map, or another threshold than -150 to 0 dB.
    MapError
        For anything but a PartialMap as `scene`.
    OutputError
        For another suffix, or if writing fails; no partial file remains.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> coverage = sp.predict_map(sp.make_home(3), (2.0, 3.0, 1.5), spacing_m=0.5)
    >>> sp.save_coverage(coverage, "coverage.nc")
    >>> sp.save_coverage(coverage, "coverage.csv")
    """
    target, suffix = _target(path, FORMATS)
    maps = transmitters_of(coverage)
    if scene is not None:
        require_map("scene", scene)
    if suffix == ".yaml":
        thresholds_db = np.broadcast_to(threshold_db, len(maps)).tolist()
        p_below = [1.0 - probability_above(*each) for each in zip(maps.values(), thresholds_db, strict=True)]
        event = f"path gain up to {' or '.join(f'{each:g}' for each in dict.fromkeys(thresholds_db))} dB"
        _write_ros_map(coverage, np.fmin.reduce(p_below), event, scene, target)
    else:
        one = coverage if "tx" in coverage.dims else maps[""]
        content = _ENCODERS[suffix](one)  # complete before the disk is touched
        with atomic_write(target) as stream:
            stream.write(content)


def load_coverage(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a coverage map that `save_coverage` wrote as NetCDF.

    Parameters
    ----------
    path : path-like
        A `.nc` file.

    Returns
    -------
    xarray.Dataset
        Equal to the saved one.

    Raises
    ------
    SettingsError
        If the file cannot be read, or contains other data.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> coverage = sp.load_coverage("coverage.nc")  # that save_coverage wrote
    >>> float(coverage.attrs["spacing_m"])
    0.5
    """
    content = read_bytes(path, "path", SettingsError, MAX_BYTES)
    try:
        require_plain_hdf5(io.BytesIO(content), MAX_ARRAY_BYTES)
        coverage = xr.load_dataset(io.BytesIO(content), engine="h5netcdf")
    except Exception as error:
        raise SettingsError(f"path = '{path}' is no NetCDF file ({error}): give one of save_coverage.") from error
    transmitters_of(coverage)
    return coverage


def save_network(network: xr.Dataset, path: str | os.PathLike[str], *, scene: PartialMap | None = None) -> None:
    """Write a network map as `.nc` (everything), `.tif`, `.csv` (both without `p_best`), `.png` or `.yaml`.

    The `.yaml` has costs, as `save_coverage` writes them, of the probability that all transmitters are in outage.

    Parameters
    ----------
    network : xarray.Dataset
        From `predict_network`.
    path : path-like
        Path of the file.
    scene : PartialMap, optional
        As of `save_coverage`.

    Raises
    ------
    SettingsError
        For anything but a network map.
    OutputError
        For another suffix, or if writing fails; no partial file remains.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(7)
    >>> coverage = sp.predict_map(home, [(3.0, 4.0, 2.2), (6.0, 3.0, 1.0)], spacing_m=0.5)
    >>> sp.save_network(sp.predict_network(coverage), "network.nc")
    """
    require_network(network)
    names = [name for name in VARIABLES if network[name].dims == ("y", "x")]
    encoders: dict[str, Callable[[], bytes]] = {
        ".nc": lambda: _encode_netcdf(network),
        ".tif": lambda: _encode_geotiff(network, names),
        ".csv": lambda: _encode_table(network[names].to_dataframe(dim_order=["y", "x"]).reset_index()),
        ".png": lambda: figure_png(plot_network(network)),
    }
    target, suffix = _target(path, (*encoders, ".yaml"))
    if suffix == ".yaml":
        _write_ros_map(network, network["p_all_outage"].to_numpy(), "outage of all links", scene, target)
        return
    content = encoders[suffix]()
    with atomic_write(target) as stream:
        stream.write(content)


def _target(path: str | os.PathLike[str], formats: Collection[str]) -> tuple[Path, str]:
    target = output_path(path)
    if target.suffix.lower() not in formats:
        raise OutputError(f"path = '{target}' has the suffix '{target.suffix}': choose one of {', '.join(formats)}.")
    return target, target.suffix.lower()


def _encode_netcdf(coverage: xr.Dataset) -> bytes:
    encoding: dict[str, dict[str, Any]] = {name: {"_FillValue": None} for name in ("x", "y")}
    encoding |= {str(name): {"zlib": True, "complevel": 4, "shuffle": True} for name in coverage.data_vars}
    for name in LINK_STATES:
        if name in coverage:
            encoding[name] |= {"dtype": "uint8", "_FillValue": NO_RECEIVER}
    stream = io.BytesIO()
    write_netcdf(coverage.compute(), encoding, stream)
    return stream.getvalue()


def _encode_geotiff(coverage: xr.Dataset, names: Sequence[str] = TABLE_VARIABLES) -> bytes:
    with optional_packages():
        from rasterio import Affine
        from rasterio.io import MemoryFile
    bands = _bands(coverage, names)
    step = float(coverage.attrs["spacing_m"])
    left, top = float(coverage["x"][0]) - step / 2, float(coverage["y"][-1]) + step / 2
    profile = {
        "driver": "GTiff",
        "dtype": "float32",
        "count": len(bands),
        "height": coverage.sizes["y"],
        "width": coverage.sizes["x"],
        "nodata": np.nan,
        "transform": Affine(step, 0.0, left, 0.0, -step, top),
        "compress": "deflate",
        "predictor": 3,
    }
    with MemoryFile() as memory:
        with memory.open(**profile) as image:
            image.update_tags(units="m", **{name: str(value) for name, value in coverage.attrs.items()})
            for band, (name, layer) in enumerate(bands.items(), start=1):
                image.write(np.flipud(layer.to_numpy()), band)
                image.set_band_description(band, name)
                image.set_band_unit(band, layer.attrs.get("units", ""))
                image.update_tags(band, **{key: str(value) for key, value in layer.attrs.items()})
        return bytes(memory.read())


def _bands(coverage: xr.Dataset, names: Sequence[str]) -> dict[str, xr.DataArray]:
    """Return variables by name and transmitter; link states are NaN without receiver."""
    bands = {}
    for name in names:
        layer = coverage[name].astype(np.float32)
        if name in LINK_STATES:
            layer = layer.where(coverage["valid"])
        if "tx" in layer.dims:
            for at, tx in enumerate(coverage["tx"].to_numpy()):
                one = layer.isel(tx=at)
                position_m = [float(one[axis]) for axis in TX_COORDINATES if axis in one.coords]
                bands[f"{tx}:{name}"] = one.assign_attrs(transmitter_m=position_m)
        else:
            bands[name] = layer
    return bands


def _encode_csv(coverage: xr.Dataset) -> bytes:
    dimensions = [name for name in ("tx", "y", "x") if name in coverage.dims]
    variables = coverage[list(TABLE_VARIABLES)].drop_vars((ANTENNA, *TX_COORDINATES), errors="ignore")
    table = variables.to_dataframe(dim_order=dimensions).reset_index()
    for name in LINK_STATES:
        table[name] = table[name].astype("UInt8").where(table["valid"])
    for name in ("observed", "valid"):
        table[name] = table[name].astype(np.uint8)
    return _encode_table(table)


def _encode_table(table: Any) -> bytes:
    for name in ("y", "x"):
        table.insert(0, f"{name}_m", table.pop(name).round(6))
    if "tx" in table:
        table.insert(0, "tx", table.pop("tx"))
    return bytes(table.to_csv(index=False, lineterminator="\n"), "utf-8")


def _write_ros_map(coverage: xr.Dataset, p_below: Floats, event: str, scene: PartialMap | None, path: Path) -> None:
    if scene is None:
        step_m, state = float(coverage.attrs["spacing_m"]), coverage["cell_state"].to_numpy().astype(np.uint8)
        x_m, y_m = (float(coverage[name][0]) - step_m / 2 for name in ("x", "y"))
        scene = PartialMap(state, step_m, (x_m, y_m))
    rows, columns = np.indices(scene.shape)
    axes_m, points_m = (coverage["y"].to_numpy(), coverage["x"].to_numpy()), np.stack([rows, columns], axis=-1)
    cost = cost_grid(axes_m, float(coverage.attrs["spacing_m"]), p_below, cell_centres_m(scene, points_m))
    percent = np.where((scene.state == CellState.FREE) & (cost >= 0), cost, NO_RECEIVER).astype(np.uint8)
    quantity = {"quantity": f"probability of {event} in percent, at most {MAX_COST}; 255 is unknown"}
    sheet = ros_sheet(path, "raw", scene.resolution_m, scene.origin_m) | quantity
    write_ros_files(
        path, yaml.safe_dump(sheet, sort_keys=False, default_flow_style=None), {path.with_suffix(".pgm"): percent}
    )


_ENCODERS: dict[str, Callable[[xr.Dataset], bytes]] = {
    ".nc": _encode_netcdf,
    ".tif": _encode_geotiff,
    ".csv": _encode_csv,
    ".png": lambda coverage: figure_png(plot_coverage(coverage)),
    ".html": coverage_page,
}

FORMATS = (*_ENCODERS, ".yaml")
