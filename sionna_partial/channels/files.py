"""Channel files: NetCDF, HDF5 and Zarr, in the layouts that link simulators read."""

import math
import os
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, get_args

import dask
import dask.array as da
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.checks import Progress, number_of, require, require_choice, require_type
from sionna_partial.constants import MEMORY_GB
from sionna_partial.display import reporting
from sionna_partial.errors import OutputError, SettingsError
from sionna_partial.files import (
    atomic_files,
    atomic_path,
    input_path,
    open_regular,
    output_path,
    require_plain_folder,
    require_plain_hdf5,
    write_netcdf,
)
from sionna_partial.resources import optional_packages
from sionna_partial.tracing.array_paths import ArrayPaths
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.responses import require_memory

Layout = Literal["sionna", "deepmimo"]

SUFFIXES = (".zarr", ".nc", ".h5")

_CHANNELS = "give links with paths, or what their cir, cfr or taps returned."

_OF_ANTENNAS = ("tx_ant_m", "rx_ant_m")
_OF_LINKS, _OF_PATHS = ("tx", "rx", "tx_m", "rx_m", *_OF_ANTENNAS), ("a", "delay_s", "paths")
_LINK, _POINT, _PAIR = ("link",), ("link", "axis"), ("link", "rx_ant", "tx_ant")
_AXES: dict[str, tuple[str, tuple[tuple[str, ...], ...]]] = {
    **dict.fromkeys(("tx", "rx", "paths"), ("iu", (_LINK,))),
    **dict.fromkeys(("tx_m", "rx_m"), ("f", (_POINT,))),
    **{name: ("f", ((name[:6], "axis"),)) for name in _OF_ANTENNAS},
    **{"a": ("c", ((*_PAIR, "path"),)), "delay_s": ("f", (("link", "path"), (*_PAIR, "path")))},
    "h": ("c", ((*_PAIR, "frequency"), (*_PAIR, "tap"))),
}

_ATTRIBUTES = ("frequency_hz", "power_tolerance_db", "synthetic_array", "normalize_delays", "bandwidth_hz")

CHUNK_BYTES = 50_000_000
"""Size of coefficients that are written together [bytes]."""

MAX_BYTES = 2**44
"""Largest file that is opened [bytes]; only used parts are read."""


def save_channels(
    channels: TracedLinks | xr.Dataset,
    path: str | os.PathLike[str],
    *,
    layout: Layout = "sionna",
    memory_gb: float = MEMORY_GB,
    progress: Progress | bool | None = None,
    **options: Any,
) -> None:
    """Write channels of links to a file, some links at a time.

    ============ =================================================================================================
    `"sionna"`   `a` (rx, rx_ant, tx, tx_ant, path, time) and `tau` (rx, tx, path) [s], or with the antennas as `a`, -1
                 where there is no path: as from a generator of Sionna's `CIRDataset`. Responses have `h` (rx,
                 rx_ant, tx, tx_ant, time, frequency or tap).
    `"deepmimo"` `channel` (rx, rx_ant, tx_ant, path, frequency or tap) and `delay` (rx, path) [s], NaN where there is
                 no path, of one transmitter. Antennas are numbered row by row from the lowest, along y.
    ============ =================================================================================================

    Files include the positions of both ends and of their antennas. A `.nc` or `.h5` file is NetCDF 4, which any HDF5
    library reads.

    Parameters
    ----------
    channels : TracedLinks or xarray.Dataset
        Links, whose responses are computed block by block, or the result of `cir`, `cfr` or `taps`.
    path : path-like
        A new `.zarr` folder, or a `.nc` or `.h5` file.
    layout : {"sionna", "deepmimo"}
    memory_gb : float
        Memory limit for the coefficients of a link [GB].
    progress : bool or callable, optional
        As in `predict_map`.
    **options
        For links: arguments of `TracedLinks.cir`.

    Raises
    ------
    SettingsError
        As `TracedLinks.cir`; for another Dataset, or several transmitters in the layout of DeepMIMO.
    OutputError
        For another suffix, an existing folder, or if writing fails; no partial file remains.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> links = sp.trace_links(sp.make_home(3), (2.0, 3.0, 1.5), [(2.5, 3.0, 1.5), (3.0, 3.0, 1.5)])
    >>> sp.channels.save_channels(links, "channels.nc", normalize_delays=False)
    """
    target = checked_target(path, layout)
    with reporting(progress) as report, dask.config.set(scheduler="synchronous"):
        if isinstance(channels, xr.Dataset):
            table = _unstacked(channels, options)
        else:
            require_type("channels", channels, TracedLinks, _CHANNELS)
            arrays = channels.array_paths(**options)
            require(arrays.most > 0, "channels", f"{arrays.links} links", "none has a path: there is nothing to save.")
            what = f"{arrays.antennas} x {arrays.most} paths at a time"
            require_memory(arrays, 0, what, memory_gb, arrays.work_bytes)
            table = _computed_later(arrays, report)
        table = _laid_out(table, layout)
        if target.suffix == ".zarr":
            with atomic_files(target) as folder:
                table.to_zarr(folder, mode="w", consolidated=False)
        else:
            of_receiver = {name: (1, *each.shape[1:]) for name, each in table.items() if each.ndim > 3}
            packed: dict[Any, Any] = {
                name: {"zlib": True, "complevel": 1, "chunksizes": sizes} for name, sizes in of_receiver.items()
            }
            with atomic_path(target) as file, file.open("w+b", buffering=0) as stream:
                write_netcdf(table, packed, stream)
        report(1.0, f"wrote {target.name}")


def checked_target(path: str | os.PathLike[str], layout: str) -> Path:
    require_choice("layout", layout, get_args(Layout))
    target = output_path(path)
    if target.suffix not in SUFFIXES:
        raise OutputError(f"path = '{target}' has the suffix '{target.suffix}': choose one of {', '.join(SUFFIXES)}.")
    _require_zarr(target)
    if target.suffix == ".zarr" and os.path.lexists(target):
        raise OutputError(f"path = '{target}' is there already: remove it, or choose another name.")
    return target


def _require_zarr(path: Path) -> None:
    if path.suffix == ".zarr":
        with optional_packages():
            import_module("zarr")


def load_channels(path: str | os.PathLike[str]) -> xr.Dataset:
    """Open channels that `save_channels` wrote; arrays are read when they are used.

    Parameters
    ----------
    path : path-like
        A `.zarr` folder, or a `.nc` or `.h5` file, from a trusted source.

    Returns
    -------
    xarray.Dataset
        Arrays of its layout, which is an attribute.

    Raises
    ------
    SettingsError
        If it cannot be read, or contains other data.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> channels = sp.channels.load_channels("channels.nc")  # that save_channels wrote
    >>> channels.a.dims
    ('rx', 'rx_ant', 'tx', 'tx_ant', 'path', 'time')
    """
    remedy = "give a file of save_channels."
    source = input_path(path, "path", SettingsError, remedy)
    require(source.suffix in SUFFIXES, "path", str(path), remedy)
    _require_zarr(source)
    try:
        if source.suffix == ".zarr":
            if not source.is_dir():
                raise NotADirectoryError("no folder")
            require_plain_folder(source)
            table = xr.open_zarr(source, chunks=None, consolidated=False)
        else:
            open_regular(source, "path", SettingsError, MAX_BYTES).close()
            require_plain_hdf5(source, MAX_BYTES)
            table = xr.open_dataset(source, engine="h5netcdf")
    except SettingsError:
        raise
    except Exception as error:
        raise SettingsError(f"path = '{path}' cannot be read ({error}): {remedy}") from error
    require(table.attrs.get("layout") in get_args(Layout), "path", str(path), f"it holds no channels; {remedy}")
    return table


def _computed_later(arrays: ArrayPaths, report: Progress) -> xr.Dataset:
    receivers = len(arrays.rx_m)
    path_bytes = 8 * len(arrays.rx) * len(arrays.tx) * (1 if arrays.synthetic_array else 2)
    at_once = max(1, CHUNK_BYTES // max(1, arrays.most * path_bytes))

    def computed(start: int, stop: int) -> tuple[NDArray[Any], NDArray[Any]]:
        report(start / max(1, arrays.links), "writing channels")
        rows = slice(int(arrays.first[start]), int(arrays.first[stop]))
        a, delay_s = arrays.empty(stop - start)
        arrays.block(slice(start, stop), rows, arrays.first[start : stop + 1] - rows.start).fill(a, delay_s)
        return np.moveaxis(a, 1, 3), delay_s if delay_s.ndim == 2 else np.moveaxis(delay_s, 1, 3)

    kinds = [array.dtype for array in computed(0, 0)]
    shapes = [array.shape[1:] for array in computed(0, 0)]
    of_tx: list[list[Any]] = [[], []]
    for first in range(0, arrays.links, max(1, receivers)):
        starts = range(first, first + receivers, at_once)
        parts = [(start, min(start + at_once, first + receivers)) for start in starts]
        made = [dask.delayed(computed, pure=False, nout=2)(*part) for part in parts]
        for which, (kind, shape) in enumerate(zip(kinds, shapes, strict=True)):
            blocks = [
                da.from_delayed(both[which], (stop - start, *shape), kind)
                for both, (start, stop) in zip(made, parts, strict=True)
            ]
            of_tx[which].append(da.concatenate(blocks))
    every = ("tx", "rx", "rx_ant", "tx_ant", "path")
    delays = ("tx", "rx", "path") if arrays.synthetic_array else every
    paths = np.diff(arrays.first).reshape(-1, receivers)
    return xr.Dataset(
        {"a": (every, da.stack(of_tx[0])), "delay_s": (delays, da.stack(of_tx[1])), "paths": (("tx", "rx"), paths)},
        attrs={name: getattr(arrays.trace_settings, name) for name in ("frequency_hz", "power_tolerance_db")},
    ).assign(tx_m=(("tx", "axis"), arrays.tx_m), rx_m=(("rx", "axis"), arrays.rx_m), **arrays.antenna_positions())


def _unstacked(channels: xr.Dataset, options: dict[str, Any]) -> xr.Dataset:
    require(not options, "options", ", ".join(options), "these channels are computed: give them to cir, cfr or taps.")
    axes = _checked_axes(channels)
    tx, rx = (np.unique(channels[name]) for name in ("tx", "rx"))
    links = channels.isel(link=np.lexsort((channels["rx"], channels["tx"])))
    full = links.sizes["link"] == len(tx) * len(rx) > 0 and bool(
        (links["tx"] == np.repeat(tx, len(rx))).all() and (links["rx"] == np.tile(rx, len(tx))).all()
    )
    remedy = "give all links from some transmitters to some receivers, such as those of one."
    require(full, "links", f"{len(tx)} transmitters, {len(rx)} receivers, {links.sizes['link']} links", remedy)
    found: dict[str, Any] = {}
    for name, dims in axes.items():
        if name in ("tx", "rx"):
            continue
        values = links[name].transpose(*dims).to_numpy()
        if name in _OF_ANTENNAS:
            found[name] = dims, values
            continue
        values = values.reshape(len(tx), len(rx), *values.shape[1:])
        if name in ("tx_m", "rx_m"):
            found[name] = (name[:2], "axis"), values[:, 0] if name == "tx_m" else values[0]
        else:
            found[name] = ("tx", "rx", *dims[1:]), values
    along = {str(name): each.variable for name, each in links.coords.items() if name in ("frequency", "tap")}
    for name, each in along.items():
        require(each.dtype.kind in "iuf", f"channels.{name}", each.dtype, _CHANNELS)
    kept = {name: number_of(links.attrs.get(name)) for name in _ATTRIBUTES}
    kept = {name: value for name, value in kept.items() if math.isfinite(value)}
    return xr.Dataset(found, coords=along, attrs=kept | {"transmitters": len(tx), "receivers": len(rx)})


def _checked_axes(channels: xr.Dataset) -> dict[str, tuple[str, ...]]:
    axes = {}
    for name in (*_OF_LINKS, *(_OF_PATHS if "a" in channels else ("h",))):
        kinds, choices = _AXES[name]
        found = channels[name] if name in channels else xr.DataArray("missing")
        fits = [dims for dims in choices if found.dtype.kind in kinds and found.size and {*dims} == {*found.dims}]
        what = f"{found.dtype} {dict(found.sizes)}" if name in channels else "missing"
        require(bool(fits), f"channels.{name}", what, _CHANNELS)
        axes[name] = fits[0]
    return axes


def _by_rows(positions_m: Floats) -> Indices:
    """Return DeepMIMO's order of antennas at (A, 3): y before z, both ascending; each polarisation by itself.

    Sionna numbers column by column, from the top.
    """
    cells = np.round(positions_m / max(np.ptp(positions_m, axis=0).max(), 1e-9), 6)
    polarisation = [int((cells[:at] == cell).all(axis=1).sum()) for at, cell in enumerate(cells)]
    return np.lexsort((*cells.T, polarisation))


def _laid_out(table: xr.Dataset, layout: Layout) -> xr.Dataset:
    table = table.assign_attrs(layout=layout)
    last = next(name for name in ("path", "frequency", "tap") if name in table.dims)
    if layout == "deepmimo":
        remedy = "this layout has one: save the links of each transmitter to a file of their own."
        require(table.sizes["tx"] == 1, "transmitters", table.sizes["tx"], remedy)
        names = {"a": "channel", "h": "channel", "delay_s": "delay"}
        table = table.rename({name: new for name, new in names.items() if name in table})
        orders = {name[:6]: _by_rows(table[name].to_numpy()) for name in _OF_ANTENNAS}
        return table.assign(tx_m=("axis", table.tx_m.to_numpy()[0])).squeeze("tx").isel(orders)
    ends = ("rx", "rx_ant", "tx", "tx_ant")
    if last != "path":
        return table.assign(h=table.h.expand_dims("time").transpose(*ends, "time", last))
    tau = table.delay_s.fillna(-1.0)
    return table.drop_vars("delay_s").assign(
        a=table.a.expand_dims("time").transpose(*ends, "path", "time"),
        tau=tau.transpose(*(name for name in (*ends, "path") if name in tau.dims)),
    )
