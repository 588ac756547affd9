"""What the predictor sees of a link: TracedLinks + PartialMap -> LinkFeatures."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.errors import PositionError, PredictorError
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.tracing.trace import TracedLinks

_FREE, _UNKNOWN = int(CellState.FREE), int(CellState.UNKNOWN)

_BORDER_CELLS = 1e-6
"""Distance within which a segment runs along the border of cells [cells]."""


@dataclass(frozen=True, eq=False)
class LinkFeatures:
    """Features of N links (paper, eq. 8).

    Parameters
    ----------
    link_state : (N,) uint8 array of LinkState
        Link state traced on the partial map.
    unobserved_distance_m : (N,) float64 array
        Length of the segment from transmitter to receiver inside unknown cells [m].
    distance_m : (N,) float64 array
        Distance from transmitter to receiver [m].
    gain_db : (N,) float64 array
        Omnidirectional path gain traced on the partial map [dB], at least -150.

    Raises
    ------
    PredictorError
        For arrays of other shapes, or with values that no link has.
    """

    link_state: NDArray[np.uint8]
    unobserved_distance_m: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    gain_db: NDArray[np.float64]

    def __post_init__(self) -> None:
        count = np.size(self.distance_m)
        object.__setattr__(self, "link_state", link_states("link_state", self.link_state, count))
        for name in ("distance_m", "unobserved_distance_m", "gain_db"):
            object.__setattr__(self, name, link_numbers(name, getattr(self, name), count))
        _require(self.distance_m >= 0.0, "distance_m", self.distance_m, "a distance is not negative.")
        inside = (self.unobserved_distance_m >= 0.0) & (self.unobserved_distance_m <= self.distance_m)
        _require(inside, "unobserved_distance_m", self.unobserved_distance_m, "it lies between 0 and distance_m.")
        remedy = f"clip gains at {GAIN_FLOOR_DB:g} dB, the gain of an outage."
        _require(self.gain_db >= GAIN_FLOOR_DB, "gain_db", self.gain_db, remedy)

    def __len__(self) -> int:
        """Return the number of links N."""
        return len(self.distance_m)

    def take(self, index: NDArray[np.generic] | slice) -> "LinkFeatures":
        """Return the links that an index array, a mask (N,) or a slice selects."""
        return LinkFeatures(*(getattr(self, field.name)[index] for field in fields(self)))

    @classmethod
    def concatenate(cls, parts: Sequence["LinkFeatures"]) -> "LinkFeatures":
        """Return the links of all `parts`, one part after the other."""
        if not parts:
            raise PredictorError("parts is empty: give at least one LinkFeatures.")
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))


def link_numbers(name: str, values: ArrayLike, count: int) -> NDArray[np.float64]:
    """Check numbers of links and return them as an array.

    Parameters
    ----------
    name : str
        What they are, for the message.
    values : (count,) array-like
    count : int
        Number of links.

    Returns
    -------
    (count,) float64 array

    Raises
    ------
    PredictorError
        For another shape, or a value that is not a finite number.
    """
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PredictorError(f"{name} = {values!r} is not numeric: give an array of {count} numbers.") from error
    if numbers.shape != (count,):
        raise PredictorError(f"{name} has shape {numbers.shape}: give one number for each of the {count} links.")
    _require(np.isfinite(numbers), name, numbers, "give finite numbers.")
    return numbers


def link_states(name: str, values: ArrayLike, count: int) -> NDArray[np.uint8]:
    """Check link states and return them as a (count,) uint8 array; arguments and errors as for `link_numbers`."""
    states = link_numbers(name, values, count)
    known = ", ".join(f"{state.name} {state.value}" for state in LinkState)
    _require(np.isin(states, [*LinkState]), name, states, f"use LinkState: {known}.")
    return states.astype(np.uint8)


def link_features(partial: PartialMap, links: TracedLinks) -> LinkFeatures:
    """Extract the features of traced links (paper, eq. 8).

    Parameters
    ----------
    partial : PartialMap
        The map on which the links were traced.
    links : TracedLinks
        From one or T transmitters to N receivers.

    Returns
    -------
    LinkFeatures
        Of N or T N links, transmitter by transmitter.

    Raises
    ------
    MapError
        If `partial` is no PartialMap.
    """
    require_map("partial", partial)
    transmitters = links.tx.reshape(-1, 3)
    return LinkFeatures(
        link_state=links.link_state.ravel(),
        unobserved_distance_m=np.concatenate([unobserved_distance_m(partial, tx, links.rx) for tx in transmitters]),
        distance_m=_distance_m(transmitters[:, None], links.rx).ravel(),
        gain_db=links.gain_db.ravel(),
    )


def unobserved_distance_m(partial: PartialMap, tx: ArrayLike, rx: ArrayLike) -> NDArray[np.float64]:
    """Measure how much of the direct line has not been observed: d_unobs of the paper (Section III-C).

    This is the length of the segment from transmitter to receiver inside unknown cells, exact to rounding. Everything
    outside the grid is unknown. On a complete map nothing unknown can be reached, and the length is 0 by definition.
    A segment along the border of cells is in the freest of them, as in `PartialMap.state_at`.

    Parameters
    ----------
    partial : PartialMap
    tx : (3,) array-like
        Transmitter position [m].
    rx : (N, 3) array-like
        Receiver positions [m]; N may be 0.

    Returns
    -------
    (N,) float64 array
        Between 0 and the distance of transmitter and receiver [m].

    Raises
    ------
    PositionError
        For another shape, or a position that is not finite.
    """
    tx_m, rx_m = np.asarray(tx, dtype=np.float64), np.asarray(rx, dtype=np.float64)
    for name, points, shape in (("tx", tx_m, "(3,)"), ("rx", rx_m, "(N, 3)")):
        if points.shape[-1:] != (3,) or points.ndim != (1 if name == "tx" else 2):
            raise PositionError(f"{name} has shape {points.shape}: give x, y, z in metres, {shape}.")
        if not np.isfinite(points).all():
            raise PositionError(f"{name} holds a position that is not finite: give finite numbers in metres.")
    if partial.is_complete:
        return np.zeros(len(rx_m))
    cells = ((points[..., :2] - partial.origin_m) / partial.resolution_m for points in (tx_m, rx_m))
    start, ends = (np.round(places, 6) for places in cells)
    return _unknown_shares(partial.state, start, ends) * _distance_m(tx_m, rx_m)


def _distance_m(tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(rx_m - tx_m, axis=-1)


def _require(good: NDArray[np.bool_], name: str, values: NDArray[np.float64], remedy: str) -> None:
    if not good.all():
        index = int(np.argmin(good))
        raise PredictorError(f"{name}[{index}] = {values[index]:g} is not allowed: {remedy}")


@njit(cache=True)
def _unknown_shares(
    state: NDArray[np.uint8], start: NDArray[np.float64], ends: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shares (N,), in [0, 1], of the segments from `start` (2,) to `ends` (N, 2) [cells] that are unknown.

    The grid is walked from line to line (Amanatides and Woo 1987). The distance to each line is computed afresh and the
    cell is looked up in the middle between two lines, so that rounding neither adds up nor picks a wrong cell.
    """
    ny, nx = state.shape
    shares = np.empty(len(ends))
    for i in range(len(ends)):
        step_x, step_y = ends[i, 0] - start[0], ends[i, 1] - start[1]
        enter_x, leave_x = _inside(start[0], step_x, nx)
        enter_y, leave_y = _inside(start[1], step_y, ny)
        here, leave = max(enter_x, enter_y), min(leave_x, leave_y)
        shares[i] = 1.0 - max(0.0, leave - here)
        line_x = _first_line(start[0] + here * step_x, step_x)
        line_y = _first_line(start[1] + here * step_y, step_y)
        reach_x, reach_y = _reach(start[0], step_x, line_x), _reach(start[1], step_y, line_y)
        while here < leave:
            there = min(max(here, min(reach_x, reach_y)), leave)
            middle = 0.5 * (here + there)
            if _is_unknown(state, start[0] + middle * step_x, start[1] + middle * step_y):
                shares[i] += there - here
            if reach_x <= there:
                line_x += np.sign(step_x)
                reach_x = _reach(start[0], step_x, line_x)
            if reach_y <= there:
                line_y += np.sign(step_y)
                reach_y = _reach(start[1], step_y, line_y)
            here = there
        shares[i] = min(max(shares[i], 0.0), 1.0)
    return shares


@njit(cache=True)
def _inside(start: float, step: float, size: int) -> tuple[float, float]:
    """Return the shares of a segment at which it enters and leaves [0, size] along one axis; enter > leave if never."""
    if step == 0.0:
        return (0.0, 1.0) if 0.0 <= start <= size else (1.0, 0.0)
    low, high = -start / step, (size - start) / step
    return max(0.0, min(low, high)), min(1.0, max(low, high))


@njit(cache=True)
def _first_line(place: float, step: float) -> float:
    """Return the first grid line that is met from `place` in the direction of `step`."""
    return np.floor(place) + 1.0 if step > 0.0 else np.ceil(place) - 1.0


@njit(cache=True)
def _reach(start: float, step: float, line: float) -> float:
    """Return the share of a segment at which it meets a grid line."""
    return (line - start) / step if step != 0.0 else np.inf


@njit(cache=True)
def _is_unknown(state: NDArray[np.uint8], x: float, y: float) -> bool:
    """Whether the freest cell within 1e-6 cells of a point [cells] is unknown."""
    ny, nx = state.shape
    row, column = int(np.floor(y)), int(np.floor(x))
    deep_x = _BORDER_CELLS < x - column < 1.0 - _BORDER_CELLS
    deep_y = _BORDER_CELLS < y - row < 1.0 - _BORDER_CELLS
    if deep_x and deep_y and 0 <= row < ny and 0 <= column < nx:
        return state[row, column] == _UNKNOWN
    found = False
    for row in range(int(np.floor(y - _BORDER_CELLS)), int(np.floor(y + _BORDER_CELLS)) + 1):
        for column in range(int(np.floor(x - _BORDER_CELLS)), int(np.floor(x + _BORDER_CELLS)) + 1):
            outside = row < 0 or row >= ny or column < 0 or column >= nx
            cell = _UNKNOWN if outside else state[row, column]
            if cell == _FREE:
                return False
            found |= cell == _UNKNOWN
    return found
