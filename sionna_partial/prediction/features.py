"""Features of links: TracedLinks + PartialMap -> LinkFeatures."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.checks import require_bool, require_type
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.display import Shown
from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.prediction.link_context import IndirectPaths, LinkContext
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.trace import link_summary


@dataclass(frozen=True, eq=False)
class LinkFeatures(Shown):
    """Features of N links, or T N: those of the paper (eq. 8), and what the other predictors need beside them.

    Parameters
    ----------
    link_state : (N,) or (T, N) uint8 array of LinkState
        Link state traced on the partial map.
    unobserved_distance_m : (N,) or (T, N) float64 array
        Length of the segment from transmitter to receiver inside unknown cells [m].
    distance_m : (N,) or (T, N) float64 array
        Distance from transmitter to receiver [m].
    gain_db : (N,) or (T, N) float64 array
        Omnidirectional path gain traced on the partial map [dB], at least -150.
    context : LinkContext, optional
        What the map shows along and around the links, as arrays, from `link_features`; one link after the other. The
        paper's predictor does not use it.

    Raises
    ------
    PredictorError
        For arrays of other shapes, or with values that no link has.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> phi = sp.LinkFeatures([1, 0], unobserved_distance_m=[0.0, 2.5], distance_m=[3.0, 6.0], gain_db=[-71.0, -150.0])
    >>> len(phi)
    2
    """

    link_state: NDArray[np.uint8]
    unobserved_distance_m: Floats
    distance_m: Floats
    gain_db: Floats
    context: LinkContext | None = None

    def __post_init__(self) -> None:
        count, shape = np.size(self.distance_m), np.shape(self.distance_m)
        shape = shape if len(shape) == 2 else (count,)
        object.__setattr__(self, "link_state", link_states("link_state", self.link_state, shape))
        for name in ("distance_m", "unobserved_distance_m", "gain_db"):
            object.__setattr__(self, name, link_numbers(name, getattr(self, name), shape))
        require_each(self.distance_m >= 0.0, "distance_m", self.distance_m, "a distance is not negative.")
        inside = (self.unobserved_distance_m >= 0.0) & (self.unobserved_distance_m <= self.distance_m)
        require_each(inside, "unobserved_distance_m", self.unobserved_distance_m, "it lies between 0 and distance_m.")
        remedy = f"clip gains at {GAIN_FLOOR_DB:g} dB, the gain of an outage."
        require_each(self.gain_db >= GAIN_FLOOR_DB, "gain_db", self.gain_db, remedy)
        if self.context is not None and len(self.context) != count:
            raise PredictorError(f"context has {len(self.context)} links: give one of the same {count} links.")

    def __len__(self) -> int:
        """Return the number of links, N or T N."""
        return self.distance_m.size

    @property
    def shape(self) -> tuple[int, ...]:
        """(N,) or (T, N)."""
        return self.distance_m.shape

    def flat(self) -> "LinkFeatures":
        """Return the links one after the other, transmitter by transmitter."""
        return self if self.distance_m.ndim == 1 else self.take(slice(None))

    def take(self, index: NDArray[np.generic] | slice) -> "LinkFeatures":
        """Return the links that an index array, a mask or a slice selects, one after the other."""
        context = None if self.context is None else self.context.take(index)
        return LinkFeatures(**{name: getattr(self, name).ravel()[index] for name in _PAPER}, context=context)

    @classmethod
    def concatenate(cls, parts: Sequence["LinkFeatures"]) -> "LinkFeatures":
        """Return the links of all `parts`, one after the other."""
        if not parts:
            raise PredictorError("parts is empty: give at least one LinkFeatures.")
        contexts = [part.context for part in parts if part.context is not None]
        context = LinkContext.concatenate(contexts) if len(contexts) == len(parts) else None
        columns = {name: np.concatenate([getattr(part, name).ravel() for part in parts]) for name in _PAPER}
        return cls(**columns, context=context)

    def with_windows(self, maps: Sequence[PartialMap], map_index: NDArray[np.int64]) -> "LinkFeatures":
        """Return the features with what map networks read of the maps; `map_index` (N,) is the map of each link."""
        if self.context is None or self.context.windows is not None:
            return self
        return replace(self, context=self.context.with_windows(maps, map_index))


_PAPER = tuple(field.name for field in fields(LinkFeatures) if field.name != "context")


def link_numbers(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Return numbers of links as an array of a shape; a PredictorError for another shape, or what is not finite."""
    count = " x ".join(map(str, shape))
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PredictorError(f"{name} = {values!r} is not numeric: give an array of {count} numbers.") from error
    if numbers.shape != shape:
        raise PredictorError(f"{name} has shape {numbers.shape}: give one number for each of the {count} links.")
    require_each(np.isfinite(numbers), name, numbers, "give finite numbers.")
    return numbers


def link_states(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return link states as a uint8 array of a shape; a PredictorError for another shape, or what is none."""
    states = link_numbers(name, values, shape)
    known = ", ".join(f"{state.name} {state.value}" for state in LinkState)
    require_each(np.isin(states, [*LinkState]), name, states, f"use LinkState: {known}.")
    return states.astype(np.uint8)


def link_features(partial: PartialMap, links: TracedLinks, *, windows: bool = True) -> LinkFeatures:
    """Extract the features of traced links (paper, eq. 8).

    Parameters
    ----------
    partial : PartialMap
        The map on which the links were traced.
    links : TracedLinks
        From one or T transmitters to N receivers.
    windows : bool
        Whether to draw the map around the transmitters, which only the predictor "map" needs (20 ms each).

    Returns
    -------
    LinkFeatures
        Of shape (N,) or (T, N), as `links`.

    Raises
    ------
    MapError
        If `partial` is no PartialMap.
    SettingsError
        If `links` are no TracedLinks, or `windows` is no bool.
    PredictorError
        For links that were not traced (``invalid="nan"``).

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> links = sp.trace_links(partial, (1.5, 1.5, 1.5), [(4.5, 1.5, 1.5)])
    >>> phi = sp.link_features(partial, links)
    >>> phi.distance_m.tolist(), phi.unobserved_distance_m.round(3).tolist()
    ([3.0], [0.5])
    """
    require_map("partial", partial)
    require_type("links", links, TracedLinks, "give what trace_links returned.")
    require_bool("windows", windows)
    if not links.valid.all():
        count = int((~links.valid).sum())
        raise PredictorError(f"links has {count} that were not traced: trace rx[links.valid], those that can be.")
    paths = IndirectPaths(partial, links.tx.reshape(-1, 3), links.rx)
    paths.add(links)
    phi = _features(paths, links.link_state.ravel(), links.gain_db.ravel(), windows=windows)
    return replace(phi, **{name: getattr(phi, name).reshape(links.gain_db.shape) for name in _PAPER})


def features_of_paths(
    partial: PartialMap, tx_m: Floats, rx_m: Floats, blocks: Iterable[SolvedPaths], *, context: bool = True
) -> LinkFeatures:
    """Extract the features of links from (3,) to (N, 3) [m] while their paths are traced, without keeping any path.

    `blocks` are all paths between them, from `Tracer.paths`. The paper's predictor needs no context.
    """
    power, is_direct = np.zeros(len(rx_m)), np.zeros(len(rx_m), dtype=bool)
    indirect = IndirectPaths(partial, tx_m[None], rx_m)
    for paths in blocks:
        np.add.at(power, paths.path_rx, np.abs(paths.a) ** 2)
        is_direct[paths.path_rx[paths.is_direct]] = True
        if context:
            indirect.add(paths)
    return _features(indirect, *link_summary(power, is_direct), context=context)


def _features(
    paths: IndirectPaths, link_state: NDArray[np.uint8], gain_db: Floats, *, context: bool = True, windows: bool = True
) -> LinkFeatures:
    """Return the features of all links of `paths`, whose states and gains (N,) are given."""
    unobserved_m = np.concatenate([unobserved_lengths_m(paths.partial, tx_m, paths.rx_m) for tx_m in paths.tx_m])
    distance_m = np.linalg.norm(paths.rx_m - paths.tx_m[:, None], axis=-1).ravel()
    found = paths.context(link_state, unobserved_m) if context else None
    phi = LinkFeatures(link_state, unobserved_m, distance_m, gain_db, found)
    return phi.with_windows((paths.partial,), np.zeros(len(phi), dtype=np.int64)) if windows else phi


def require_each(good: Bools, name: str, values: Floats, remedy: str) -> None:
    """Raise a PredictorError that names the first value that is not good."""
    if not good.all():
        index = np.unravel_index(int(np.argmin(good)), np.shape(values))
        where = ", ".join(map(str, index))
        raise PredictorError(f"{name}[{where}] = {values[index]:g} is not allowed: {remedy}")
