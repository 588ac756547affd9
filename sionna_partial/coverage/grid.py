"""Receivers on a grid over a map, and the Dataset of their predictions."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter

import sionna_partial.coverage.radio  # noqa: F401 - registers coverage.radio  # noqa: F401 - registers coverage.radio
from sionna_partial.arrays import Bools, Floats, Indices, States
from sionna_partial.checks import float_array, require, require_number
from sionna_partial.constants import GAIN_FLOOR_DB, CellState
from sionna_partial.coverage.dataset import (
    ANTENNA,
    ATTRIBUTES,
    COMPONENTS,
    DISTRIBUTION,
    OFFSET,
    ROOM,
    TX_COORDINATES,
    WALL_PARTS,
    WALLS,
    flags,
    require_coverage,
)
from sionna_partial.errors import MemoryLimitError, PositionError, SettingsError
from sionna_partial.maps.partial_map import PartialMap, require_height
from sionna_partial.measurements.localisation import TransmitterPosterior
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.predictor import AnyPredictor
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.tracing.positions import SHORTEST_M, clear_of_walls, nearest_m
from sionna_partial.tracing.simulation import Simulation

_OF_ALL = ("observed", "cell_state", "wall_parts", ROOM)

LIBRARIES_GB, CELL_BYTES, RECEIVER_BYTES, WORK_BYTES = 1.0, 40, 400, 120_000
"""Memory of the libraries [GB], of a map cell, a receiver and a receiver in a block [bytes], from
`benchmarks/scale.py`."""

BLOCK_RECEIVERS = (500, 8_000)
"""Smallest and largest size of a block."""

RECEIVERS = ("indoor", "anywhere", "inside", "near")

NEAR_M, NEAR_SPACINGS = 1.0, 2
"""Distance from free cells up to which receivers are "near" [m], and at least, in spacings."""

Area: TypeAlias = tuple[float, float, float, float]

MAX_RECEIVERS = 2_000_000

_WHOSE = {"indoor": "given that the receiver is indoors", "anywhere": "of a receiver that may be outdoors, in outage"}


@dataclass(frozen=True)
class GridArea:
    """Height, spacing and bounds of receivers [m], and which they are."""

    rx_height_m: float
    spacing_m: float
    bounds_m: Area | None = None
    receivers: str = RECEIVERS[0]


@dataclass(frozen=True)
class Receivers:
    """Receivers on a grid: (ny, nx) arrays, and the (N, 3) positions of the valid ones."""

    x_m: Floats
    y_m: Floats
    cell_state: States
    valid: Bools
    rx_m: Floats


def grid_receivers(simulation: Simulation, tx_m: Floats, area: GridArea) -> Receivers:
    """Return the receivers; those near a wall or transmitter (T, 3) [m] are masked."""
    partial, frequency_hz = simulation.partial, simulation.trace_settings.frequency_hz
    require_height(partial, "rx_height_m", area.rx_height_m)
    x_m, y_m = grid_axes(partial, area.spacing_m, area.bounds_m)
    points = np.stack([*np.meshgrid(x_m, y_m), np.full((len(y_m), len(x_m)), area.rx_height_m)], axis=-1)
    limit_m = nearest_m(frequency_hz)
    cell_state = partial.state_at(points)
    far = np.ones(cell_state.shape, dtype=bool)
    for each_m in tx_m:
        far &= np.linalg.norm(points - each_m, axis=-1) >= limit_m
    valid = far & clear_of_walls(partial, points)
    if area.receivers == "inside" and partial.is_complete:
        valid &= cell_state != CellState.UNKNOWN
    elif area.receivers == "near":
        valid &= _near_free_cells(partial, points, max(NEAR_M, NEAR_SPACINGS * area.spacing_m))
    if not far.any() and limit_m > SHORTEST_M:
        raise PositionError(
            f"every receiver is within {limit_m:.3g} m of the transmitter, where Friis' formula does not hold at "
            f"frequency_hz = {frequency_hz:g}: give a higher frequency, or a larger map."
        )
    if not valid.any():
        raise PositionError(
            "no receiver can stand anywhere, all are inside walls or at the transmitter: "
            f"spacing_m = {area.spacing_m:g}, give a smaller one."
        )
    return Receivers(x_m, y_m, cell_state, valid, points[valid])


def _near_free_cells(partial: PartialMap, points_m: Floats, limit_m: float) -> Bools:
    """Return which points are within a distance of free cells along x and y; all, if there are none."""
    free, cells = partial.state == CellState.FREE, math.ceil(limit_m / partial.resolution_m)
    near = maximum_filter(free, size=2 * cells + 1) | ~free.any()
    return np.asarray(near[partial.cell_index(points_m)])


def checked_area(partial: PartialMap, area_m: ArrayLike | None) -> Area | None:
    if area_m is None:
        return None
    x0, y0, x1, y1 = partial.bounds_m
    remedy = f"give x and y of two corners on the map, which spans x {x0:g} to {x1:g} m and y {y0:g} to {y1:g} m."
    corners = float_array("area_m", area_m, SettingsError, remedy)
    require(corners.shape == (4,), "area_m", area_m, remedy)
    low, high, slack_m = corners[:2], corners[2:], partial.resolution_m / 2
    inside = (low >= np.array([x0, y0]) - slack_m) & (high <= np.array([x1, y1]) + slack_m)
    require(bool((inside & (low < high)).all()), "area_m", area_m, remedy)
    return tuple(corners.tolist())  # type: ignore[return-value]


def grid_axes(partial: PartialMap, spacing_m: float, area_m: Area | None = None) -> tuple[Floats, Floats]:
    low = partial.resolution_m / 10
    require_number("spacing_m", spacing_m, low, 1e6)
    x0, y0, x1, y1 = partial.bounds_m if area_m is None else area_m
    nx, ny = (math.ceil(length / spacing_m - 0.5 - 1e-9) for length in (x1 - x0, y1 - y0))
    size = f"the {'map' if area_m is None else 'area'} is {x1 - x0:g} x {y1 - y0:g} m"
    require(min(nx, ny) > 0, "spacing_m", spacing_m, f"{size}; give {min(x1 - x0, y1 - y0):g} or less.")
    enough = 1.1 * math.sqrt((x1 - x0) * (y1 - y0) / MAX_RECEIVERS)
    remedy = f"{size}, which makes {nx * ny:,} receivers, more than {MAX_RECEIVERS:,}; give {enough:.2g} or more."
    require(nx * ny <= MAX_RECEIVERS, "spacing_m", spacing_m, remedy)
    x_cells, y_cells = (np.arange(count, dtype=np.float64) + 0.5 for count in (nx, ny))
    return x0 + spacing_m * x_cells, y0 + spacing_m * y_cells


def receivers_at_once(partial: PartialMap, receivers: Receivers, memory_gb: float) -> int:
    count, (fewest, most) = len(receivers.rx_m), BLOCK_RECEIVERS
    kept_gb = LIBRARIES_GB + (CELL_BYTES * partial.state.size + RECEIVER_BYTES * receivers.valid.size) / 1e9
    needed_gb = kept_gb + WORK_BYTES * min(count, fewest) / 1e9
    if needed_gb > memory_gb:
        raise MemoryLimitError(
            f"memory_gb = {memory_gb:g} is too little: {count:,} receivers on a map of {partial.state.size:,} cells "
            f"take about {needed_gb:.2g} GB. Give more memory_gb, a larger spacing_m, or a part of the map."
        )
    fitting = (memory_gb - kept_gb) / WORK_BYTES * 1e9
    return int(min(max(fitting, fewest), most))


def coverage_map(
    partial: PartialMap, receivers: Receivers, columns: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any]
) -> xr.Dataset:
    layers: dict[str, NDArray[Any]] = {
        "observed": receivers.cell_state != CellState.UNKNOWN,
        "valid": receivers.valid,
        "cell_state": receivers.cell_state,
        "wall_parts": _wall_parts(partial, receivers, attributes["spacing_m"]),
    }
    for name, values in columns.items():
        layers[name] = np.full(receivers.valid.shape, np.float32(np.nan))
        layers[name][receivers.valid] = values
    axes = {
        name: xr.IndexVariable(
            name,
            pd.Index(values),
            {"standard_name": f"projection_{name}_coordinate", "long_name": name, "units": "m", "axis": name.upper()},
            {"_FillValue": None},
        )
        for name, values in (("x", receivers.x_m), ("y", receivers.y_m))
    }
    variables: dict[str, Any] = {name: (("y", "x"), layers[name], dict(ATTRIBUTES[name])) for name in ATTRIBUTES}
    if partial.room is not None:
        row, column = partial.cell_index(np.stack(np.meshgrid(receivers.x_m, receivers.y_m), axis=-1))
        names = {"none": 0}
        for number, name in enumerate(partial.room_names, 1):
            word = "_".join(name.split())
            names[word if word and word not in names else f"{word}_{number}"] = number
        variables[ROOM] = ("y", "x"), partial.room[row, column], {"long_name": "room of the map", **flags(names)}
    for name in (*DISTRIBUTION, "link_state"):
        variables[name][2]["long_name"] += f", {_WHOSE[attributes['receivers']]}"
    # fastpath: xarray would first import Dask, which takes a second, to see that these are no arrays of Dask
    arrays = {
        name: xr.Variable(axes_of, values, about, fastpath=True) for name, (axes_of, values, about) in variables.items()
    }
    return xr.Dataset(arrays, coords=axes, attrs=dict(attributes))


def _wall_parts(partial: PartialMap, receivers: Receivers, spacing_m: float) -> NDArray[np.int64]:
    """Return (ny, nx) bits: the parts of the cell that contain a wall."""
    walls = np.pad(partial.state == CellState.WALL, ((1, 0), (1, 0))).cumsum(axis=0, dtype=np.int32)
    walls = walls.cumsum(axis=1, dtype=np.int32)
    ny, nx = partial.shape
    columns = _part_spans(receivers.x_m, partial.origin_m[0], partial.resolution_m, nx, spacing_m)
    bits = np.zeros(receivers.valid.shape, dtype=np.int64)
    rows = _part_spans(receivers.y_m, partial.origin_m[1], partial.resolution_m, ny, spacing_m)
    for row, (bottom, top) in enumerate(rows):
        strip = walls[top] - walls[bottom]
        for column, (left, right) in enumerate(columns):
            bits |= (strip[:, right] > strip[:, left]).astype(np.int64) << (WALL_PARTS * row + column)
    return bits


def _part_spans(
    centre_m: Floats, origin_m: float, resolution_m: float, count: int, spacing_m: float
) -> list[tuple[Indices, Indices]]:
    """Return the first map cell, and one after the last, of each part of the receivers' cells."""
    edge = (centre_m - origin_m - spacing_m / 2) / resolution_m
    step = spacing_m / resolution_m / WALL_PARTS
    return [
        (
            np.clip(np.floor(edge + part * step + 1e-6), 0, count).astype(np.intp),
            np.clip(np.ceil(edge + (part + 1) * step - 1e-6), 0, count).astype(np.intp),
        )
        for part in range(WALL_PARTS)
    ]


def link_columns(
    phi: LinkFeatures, prediction: LinkPrediction, p_indoor: Floats, *, anywhere: bool
) -> dict[str, NDArray[Any]]:
    if anywhere:
        prediction = prediction.anywhere(p_indoor)
    columns = {name: getattr(prediction, name) for name in (*DISTRIBUTION, *COMPONENTS)} | {
        "p_indoor": p_indoor,
        "partial_gain_db": phi.gain_db,
        "unobserved_distance_m": phi.unobserved_distance_m,
        "distance_m": phi.distance_m,
    }
    columns = {name: values.astype(np.float32) for name, values in columns.items()}
    return columns | {"link_state": prediction.link_state, "partial_link_state": phi.link_state}


@cache
def _versions() -> str:
    """Return names and versions of the packages; reading them takes memory, hence the cache."""
    versions = {}
    for package in ("sionna-partial", "sionna-rt", "mitsuba", "drjit", "keras", "numpy", "xarray"):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return ", ".join(f"{package} {number}" for package, number in versions.items())


def provenance(simulation: Simulation, model: AnyPredictor | None) -> dict[str, Any]:
    """Return the global attributes; no time of day, so that equal input gives equal files."""
    partial, (trace_settings, scene_settings) = simulation.partial, simulation.resolved
    return {
        "Conventions": "CF-1.11",
        "title": "Predicted radio coverage of a partially observed environment",
        "source": _versions(),
        "history": "sionna_partial.predict_map",
        "references": "Yin et al., Wireless Channel Prediction in Partially Observed Environments",
        "frequency_hz": float(trace_settings.frequency_hz),
        "gain_floor_db": GAIN_FLOOR_DB,
        "walls": "through walls" if trace_settings.through_walls else "opaque walls",
        "map_resolution_m": partial.resolution_m,
        "map_wall_height_m": partial.wall_height_m,
        "map_observed_fraction": partial.observed_fraction,
        "map_complete": int(model is None),
        "scene_settings": json.dumps(asdict(scene_settings), sort_keys=True),
        "trace_settings": json.dumps(asdict(trace_settings), sort_keys=True),
        "predictor": "none: the map is complete, the trace is the prediction" if model is None else model.name,
        "predictor_sha256": "" if model is None else model.fingerprint,
    }


def with_posterior(coverage: xr.Dataset, posterior: TransmitterPosterior) -> xr.Dataset:
    axes = {
        f"tx_{name}": (f"tx_{name}", values, {"long_name": f"{name} of the transmitter", "units": "m"})
        for name, values in (("x", posterior.x_m), ("y", posterior.y_m))
    }
    attributes = {"long_name": "probability of the transmitter's position", "units": "1"}
    coverage = coverage.assign_coords(axes)
    coverage["p_transmitter"] = ("tx_y", "tx_x"), posterior.probability, attributes
    return coverage.assign_attrs(transmitter_std_m=posterior.std_m)


def join_transmitters(maps: list[xr.Dataset], names: list[str]) -> xr.Dataset:
    positions_m = np.array([each.attrs.pop("transmitter_m") for each in maps])
    antennas = "tx", [each.attrs.pop(ANTENNA) for each in maps]
    coordinates: dict[str, Any] = {
        name: ("tx", column, {"units": "m"}) for name, column in zip(TX_COORDINATES, positions_m.T, strict=True)
    }
    of_all = [name for name in _OF_ALL if name in maps[0]]
    measured = [each.attrs.pop("measured_links", 0) for each in maps]
    offsets_db = "tx", [each.attrs.pop(OFFSET, np.nan) for each in maps], {"units": "dB"}
    # for a transmitter that nothing unknown can reach, the map is complete
    predicted = next((each.attrs for each in maps if not each.attrs["map_complete"]), maps[0].attrs)
    of_any = {name: predicted[name] for name in ("map_complete", "predictor", "predictor_sha256")}
    walls = [*dict.fromkeys(each.attrs[WALLS] for each in maps if WALLS in each.attrs)]
    of_any |= {WALLS: "; ".join(walls)} if walls else {}
    joined = xr.concat([each.drop_vars(of_all) for each in maps], "tx", combine_attrs="drop_conflicts")
    joined = joined.assign_attrs(of_any)
    if any(measured):
        joined, coordinates = joined.assign_attrs(measured_links=sum(measured)), coordinates | {OFFSET: offsets_db}
    return joined.assign({name: maps[0][name] for name in of_all}).assign_coords(
        {"tx": names, ANTENNA: antennas, **coordinates}
    )


def named_transmitter(coverage: xr.Dataset, name: str) -> xr.Dataset:
    """Return the coverage of one transmitter as that of several, with one name."""
    bare = require_coverage(coverage).copy()
    return join_transmitters([bare.drop_dims([each for each in ("tx_x", "tx_y") if each in bare.dims])], [name])
