"""Variables of the coverage maps of `predict_map`, and the accessor ``coverage.radio``."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from sionna_partial.arrays import Floats
from sionna_partial.checks import float_array, require, require_names, require_number
from sionna_partial.constants import GAIN_FLOOR_DB, MAX_COST, NO_RECEIVER, CellState, LinkState
from sionna_partial.errors import SettingsError
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.tracing.antennas import MAX_GAIN_DBI

COMPONENTS = ("gain_los_mean_db", "gain_los_std_db", "gain_nlos_mean_db", "gain_nlos_std_db")

WALL_PARTS = 6
"""Parts of a cell along each axis: pictures show walls thinner than a cell."""

DISTRIBUTION = ("p_los", "p_nlos", "p_outage", "gain_mean_db", "gain_std_db")

TX_COORDINATES = ("tx_x", "tx_y", "tx_z")
"""Positions [m] along the dimension "tx"."""

ROOM = "room"
"""Variable with the room of each receiver: flags, 0 for none."""

WALLS = "wall_material"
"""Attribute: probabilities of unknown materials."""

ANTENNA, OFFSET = "tx_antenna", "measured_offset_db"
"""Antenna, offset of measured powers [dB]: attributes for one transmitter, coordinates along "tx" for several."""


_LOWEST = {"spacing_m": 0.0, "frequency_hz": 0.0, "rx_height_m": -1e15}
"""Required attributes and their lower limits."""

_RANGES = {"1": (0.0, 1.0), "dB": (GAIN_FLOOR_DB, 10.0 + MAX_GAIN_DBI), "std": (0.0, 1e3), "m": (0.0, 1e15)}
"""Ranges of probabilities, gains (near the transmitter above 0 dB), standard deviations and lengths."""


def flags(meanings: Mapping[str, int], kind: type[np.integer[Any]] = np.uint8) -> dict[str, Any]:
    return {"flag_values": np.array([*meanings.values()], dtype=kind), "flag_meanings": " ".join(meanings)}


_LINK_FLAGS = flags({**{state.name.lower(): state for state in LinkState}, "no_receiver": NO_RECEIVER})
_CELL_FLAGS = flags({state.name.lower(): state for state in CellState})
_YES_NO = flags({"no": 0, "yes": 1}, np.int8)

ATTRIBUTES: Mapping[str, Mapping[str, Any]] = {
    "p_los": {"long_name": "probability of line of sight", "units": "1"},
    "p_nlos": {"long_name": "probability of paths without line of sight", "units": "1"},
    "p_outage": {"long_name": "probability of outage", "units": "1"},
    "link_state": {"long_name": "most probable link state", **_LINK_FLAGS},
    "gain_mean_db": {"long_name": "mean omnidirectional path gain, an outage counting -150 dB", "units": "dB"},
    "gain_std_db": {"long_name": "standard deviation of the omnidirectional path gain", "units": "dB"},
    "gain_los_mean_db": {"long_name": "mean path gain given line of sight", "units": "dB"},
    "gain_los_std_db": {"long_name": "standard deviation of the path gain given line of sight", "units": "dB"},
    "gain_nlos_mean_db": {"long_name": "mean path gain given no line of sight", "units": "dB"},
    "gain_nlos_std_db": {"long_name": "standard deviation of the path gain given no line of sight", "units": "dB"},
    "p_indoor": {"long_name": "probability that the receiver is indoors", "units": "1"},
    "partial_link_state": {"long_name": "link state traced on the known part of the map", **_LINK_FLAGS},
    "partial_gain_db": {"long_name": "path gain traced on the known part of the map", "units": "dB"},
    "unobserved_distance_m": {"long_name": "length of the direct line in unknown cells", "units": "m"},
    "distance_m": {"long_name": "distance from the transmitter", "units": "m"},
    "observed": {"long_name": "whether this cell was observed", **_YES_NO},
    "valid": {"long_name": "whether a receiver can stand here", **_YES_NO},
    "cell_state": {"long_name": "state of the map at the receiver", **_CELL_FLAGS},
    "wall_parts": {
        "long_name": "walls within the cell",
        "comment": f"Bit {WALL_PARTS} * row + column is set where that one of {WALL_PARTS} x {WALL_PARTS} parts of "
        "the cell holds a wall; row 0 has the smallest y, column 0 the smallest x.",
    },
}
"""Variables on (y, x) and their CF attributes."""


def require_coverage(coverage: xr.Dataset) -> xr.Dataset:
    """Return the coverage of one transmitter with `transmitter_m` in its attributes, or raise a SettingsError."""
    remedy = "give the xarray.Dataset that predict_map returned, or load it from its .nc file."
    kind = type(coverage).__name__
    if not isinstance(coverage, xr.Dataset):
        raise SettingsError(f"coverage is of type {kind}: {remedy}")
    if "tx" in coverage.dims:
        names = ", ".join(map(str, coverage["tx"].to_numpy()))
        raise SettingsError(f"coverage has the transmitters {names}: choose one, as by coverage.isel(tx=0).")
    if {"tx", *TX_COORDINATES} <= coverage.coords.keys():
        position_m = np.array([float(coverage[name]) for name in TX_COORDINATES])
        if ANTENNA in coverage.coords:
            coverage = coverage.assign_attrs({ANTENNA: str(coverage[ANTENNA].to_numpy())}).drop_vars(ANTENNA)
        coverage = coverage.drop_vars(("tx", *TX_COORDINATES)).assign_attrs(transmitter_m=position_m)
    missing = [name for name in ATTRIBUTES if name not in coverage or coverage[name].dims != ("y", "x")]
    missing += [name for name in ("x", "y") if name not in coverage.coords]
    missing += [name for name in ("transmitter_m", *_LOWEST) if name not in coverage.attrs]
    if missing or not coverage["valid"].size:
        raise SettingsError(f"coverage lacks {', '.join(missing) or 'receivers'}: {remedy}")
    for name, attributes in ATTRIBUTES.items():
        kinds = "f" if "units" in attributes else "biuf" if name.endswith("link_state") else "biu"
        require(coverage[name].dtype.kind in kinds, f"coverage.{name}", coverage[name].dtype, remedy)
    for name, lowest in _LOWEST.items():
        require_number(f"coverage.{name}", coverage.attrs[name], lowest, 1e15, open_low=True)
    position_m = float_array("coverage.transmitter_m", coverage.attrs["transmitter_m"], SettingsError, remedy)
    known = position_m.shape == (3,) and bool(np.isfinite(position_m).all())
    require(known, "coverage.transmitter_m", coverage.attrs["transmitter_m"], remedy)
    _require_values(coverage)
    return coverage


def _require_values(coverage: xr.Dataset) -> None:
    for name in ("x", "y"):
        steps_m = np.diff(np.asarray(coverage[name], dtype=np.float64))
        regular = bool((np.abs(steps_m - coverage.attrs["spacing_m"]) < 1e-3 * coverage.attrs["spacing_m"]).all())
        remedy = f"its step is spacing_m, ascending, as after coverage.sortby('{name}')."
        require(regular and bool(np.isfinite(coverage[name]).all()), f"coverage.{name}", steps_m, remedy)
    valid = coverage["valid"].to_numpy() == 1
    for name, attributes in ATTRIBUTES.items():
        values = coverage[name].to_numpy()
        if "flag_values" in attributes:
            good = np.isin(values, attributes["flag_values"]) | np.isnan(values)
            remedy = f"it is one of {[*attributes['flag_values']]}."
        elif "units" in attributes:
            low, high = _RANGES["std" if "_std_" in name else attributes["units"]]
            good = ~valid | ((values >= low) & (values <= high))
            remedy = f"it lies between {low:g} and {high:g} where a receiver can stand."
        else:
            continue
        require(bool(good.all()), f"coverage.{name}", values[~good][:1], remedy)
    total = sum(coverage[name].to_numpy()[valid] for name in ("p_los", "p_nlos", "p_outage"))
    wrong = np.abs(total - 1.0) > 1e-3
    require(not wrong.any(), "p_los + p_nlos + p_outage", total[wrong][:1], "probabilities of coverage sum to 1.")


def transmitters_of(coverage: xr.Dataset) -> dict[str, xr.Dataset]:
    if not isinstance(coverage, xr.Dataset) or "tx" not in coverage.dims:
        return {"": require_coverage(coverage)}
    names = [str(name) for name in coverage["tx"].to_numpy()]
    require_names("coverage.tx", names)
    return {name: require_coverage(coverage.isel(tx=at)) for at, name in enumerate(names)}


def probability_above(coverage: xr.Dataset, threshold_db: float) -> Floats:
    """Return P(path gain > threshold) (..., ny, nx), NaN without receiver; threshold in [-150, 0] dB."""
    require_number("threshold_db", threshold_db, GAIN_FLOOR_DB, 0.0)
    return LinkPrediction.of_columns(lambda name: coverage[name].to_numpy()).probability_above(threshold_db)


def transmitter_text(maps: Mapping[str, xr.Dataset]) -> str:
    if len(maps) > 1:
        return f"{len(maps)} transmitters"
    (coverage,) = maps.values()
    position = ", ".join(f"{each:z.2f}" for each in coverage.attrs["transmitter_m"])
    antenna = str(coverage.attrs.get(ANTENNA, "iso"))
    if "p_transmitter" in coverage:
        position = f"near ({position}) m, ± {coverage.attrs['transmitter_std_m']:.1f} m"
    else:
        position = f"at ({position}) m"
    return f"transmitter {position}" + (f", {antenna}" if antenna != "iso" else "")


def cost_grid(
    axes_m: tuple[Floats, Floats], spacing_m: float, p_below: Floats, points_m: Floats, max_cost: int = MAX_COST
) -> NDArray[np.int8]:
    """Return costs (...) of points (..., 2) [m] for a planner: the probability at the nearest receiver in percent.

    `p_below` (ny, nx) is the probability of too small a gain at receivers with `axes_m` y (ny,) and x (nx,) [m]; NaN
    without receiver. Costs are at most `max_cost`, and -1 where no receiver is within two spacings.
    """
    percent = np.minimum(np.rint(100.0 * p_below), max_cost)
    valid = np.isfinite(percent)
    apart, nearest = distance_transform_edt(~valid, return_indices=True)
    known = np.where(valid.any() & (apart < 2.0), np.nan_to_num(percent)[tuple(nearest)], -1.0)
    cells, inside = [], np.ones(points_m.shape[:-1], dtype=bool)
    for axis_m, each_m in zip(axes_m, (points_m[..., 1], points_m[..., 0]), strict=True):
        index = np.rint((each_m - axis_m[0]) / spacing_m).astype(np.intp)
        cells.append(np.clip(index, 0, len(axis_m) - 1))
        inside &= np.abs(index - cells[-1]) < 2
    return np.where(inside, known[tuple(cells)], -1.0).astype(np.int8)
