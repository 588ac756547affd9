"""What the predictor sees of a link: TracedLinks + PartialMap -> LinkFeatures."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.errors import PositionError, PredictorError
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.prediction.link_context import ContextSums, LinkContext
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.trace import TracedLinks, link_summary


@dataclass(frozen=True, eq=False)
class LinkFeatures:
    """Features of N links: those of the paper (eq. 8), and where the links run.

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
    context : LinkContext, optional
        What the map shows along and around the links; `link_features` gives it. The paper's predictor does not use it.

    Raises
    ------
    PredictorError
        For arrays of other shapes, or with values that no link has.
    """

    link_state: NDArray[np.uint8]
    unobserved_distance_m: NDArray[np.float64]
    distance_m: NDArray[np.float64]
    gain_db: NDArray[np.float64]
    context: LinkContext | None = None

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
        if self.context is not None and len(self.context) != count:
            raise PredictorError(f"context has {len(self.context)} links: give one of the same {count} links.")

    def __len__(self) -> int:
        """Return the number of links N."""
        return len(self.distance_m)

    def take(self, index: NDArray[np.generic] | slice) -> "LinkFeatures":
        """Return the links that an index array, a mask (N,) or a slice selects."""
        context = None if self.context is None else self.context.take(index)
        return LinkFeatures(**{name: getattr(self, name)[index] for name in _PAPER}, context=context)

    @classmethod
    def concatenate(cls, parts: Sequence["LinkFeatures"]) -> "LinkFeatures":
        """Return the links of all `parts`, one part after the other."""
        if not parts:
            raise PredictorError("parts is empty: give at least one LinkFeatures.")
        contexts = [part.context for part in parts if part.context is not None]
        context = LinkContext.concatenate(contexts) if len(contexts) == len(parts) else None
        return cls(
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in _PAPER}, context=context
        )


_PAPER = tuple(field.name for field in fields(LinkFeatures) if field.name != "context")


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
    sums = ContextSums(partial, transmitters, links.rx)
    sums.add(links)
    return LinkFeatures(
        link_state=links.link_state.ravel(),
        unobserved_distance_m=np.concatenate([unobserved_distance_m(partial, tx, links.rx) for tx in transmitters]),
        distance_m=_distance_m(transmitters[:, None], links.rx).ravel(),
        gain_db=links.gain_db.ravel(),
        context=sums.context(),
    )


def features_of_paths(
    partial: PartialMap, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], blocks: Iterable[SolvedPaths]
) -> LinkFeatures:
    """Extract the features of N links while their paths are traced, without keeping any path.

    Parameters
    ----------
    partial : PartialMap
        The map on which the links are traced.
    tx_m, rx_m : (3,) and (N, 3) float64 arrays
        Transmitter and receivers [m].
    blocks : iterable of SolvedPaths
        All paths between them, from `Tracer.paths`.
    """
    power, is_direct, sums = np.zeros(len(rx_m)), np.zeros(len(rx_m), bool), ContextSums(partial, tx_m[None], rx_m)
    for paths in blocks:
        np.add.at(power, paths.path_rx, np.abs(paths.a) ** 2)
        is_direct[paths.path_rx[paths.is_direct]] = True
        sums.add(paths)
    link_state, gain_db = link_summary(power, is_direct)
    unobserved_m = unobserved_distance_m(partial, tx_m, rx_m)
    return LinkFeatures(link_state, unobserved_m, _distance_m(tx_m, rx_m), gain_db, sums.context())


def unobserved_distance_m(partial: PartialMap, tx: ArrayLike, rx: ArrayLike) -> NDArray[np.float64]:
    """Measure how much of the direct line has not been observed: d_unobs of the paper (Section III-C).

    This is the length of the segment from transmitter to receiver inside unknown cells, exact to rounding. Everything
    outside the grid is unknown. On a complete map nothing unknown can be reached from a known cell, and the length
    is 0 by definition where an end is in one.
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
    return unobserved_lengths_m(partial, tx_m, rx_m)


def _distance_m(tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(rx_m - tx_m, axis=-1)


def _require(good: NDArray[np.bool_], name: str, values: NDArray[np.float64], remedy: str) -> None:
    if not good.all():
        index = int(np.argmin(good))
        raise PredictorError(f"{name}[{index}] = {values[index]:g} is not allowed: {remedy}")
