"""Features of links: TracedLinks + PartialMap -> LinkFeatures; walls and space along the paths are the LinkContext."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, Indices, States, read_only
from sionna_partial.checks import number_of, require_type, shown
from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.display import Shown
from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap, require_map
from sionna_partial.prediction.space import MapSpace, possible_states
from sionna_partial.prediction.unobserved import (
    attenuation,
    is_enclosed,
    path_unobserved_m,
    unobserved_lengths_m,
    walled_lengths_m,
)
from sionna_partial.settings import FREQUENCIES_HZ, SceneSettings, TraceSettings
from sionna_partial.tracing.interactions import REFRACTION
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import LinkSums, LocatedPaths, SolvedPaths, path_gain_db
from sionna_partial.tracing.power import MOST_LOSS_DB, wall_loss_db

ATTENUATION_LENGTHS_M = (math.inf, 4.0, 1.0, 0.25, 0.0)
"""Attenuation lengths of unobserved space [m]: a path through u metres has the weight exp(-u / length)."""

_PATHS_AT_ONCE = 100_000


@read_only
@dataclass(frozen=True, eq=False)
class LinkContext(Shown):
    """Context of N links: walls along their paths, possible link states, and fields of the map.

    Parameters
    ----------
    tx_m, rx_m : (N, 3) float64 arrays
        Positions [m].
    tx_seen, rx_seen : (N,) bool arrays
        True in observed cells.
    complete : (N,) bool array
        The map is complete and one end is observed: the trace is the truth.
    walled_m : (N,) float64 array
        Length of the direct line in known wall cells [m]; traced outlines may have gaps there.
    wall_noise : (N,) float64 array
        Range noise of the walls near both ends, 0 (exact) to 1.
    exposure : (N, 2) float64 array
        Exposure of transmitter and receiver to unobserved space (`space`), 0 to 1.
    route : (N,) float64 array
        Length of the way around known walls (`space`).
    possible : (N, 3) bool array
        Possible LinkStates, at least one.
    indirect_gain_db : (N, len(ATTENUATION_LENGTHS_M)) float64 array
        Gain of the indirect paths, attenuated by unobserved space [dB], at least -150.
    strongest_unobserved_m : (N,) float64 array
        Unobserved length of the strongest indirect path [m]; the distance if there is none.
    straight_gain_db : (N,) float64 array
        Gain of the direct path through known walls [dB], at least -150.
    straight_walls : (N,) float64 array
        Number of these walls.
    wall_loss_db : (N,) float64 array
        From `mean_wall_loss_db` [dB].
    map_index : (N,) int array
        Map of each link in `spaces`.
    spaces : tuple of MapSpace
        Fields of the maps.
    """

    tx_m: Floats
    rx_m: Floats
    tx_seen: Bools
    rx_seen: Bools
    complete: Bools
    walled_m: Floats
    wall_noise: Floats
    exposure: Floats
    route: Floats
    possible: Bools
    indirect_gain_db: Floats
    strongest_unobserved_m: Floats
    straight_gain_db: Floats
    straight_walls: Floats
    wall_loss_db: Floats
    map_index: Indices
    spaces: tuple[MapSpace, ...]

    def __len__(self) -> int:
        return len(self.tx_m)

    @classmethod
    def on_maps(
        cls,
        maps: Sequence[PartialMap],
        map_index: NDArray[np.int64],
        *,
        tx_m: Floats,
        rx_m: Floats,
        link_state: States,
        unobserved_distance_m: Floats,
        **traced: Any,
    ) -> "LinkContext":
        """Compute the context of links on the maps `map_index` (N,)."""
        count = len(map_index)
        tx_seen, rx_seen, complete = (np.zeros(count, dtype=bool) for _ in range(3))
        walled_m, wall_noise, possible = np.zeros(count), np.zeros(count), np.ones((count, len(LinkState)), dtype=bool)
        exposure, route, spaces = np.zeros((count, 2)), np.zeros(count), tuple(map(MapSpace.of, maps))
        for number in np.unique(map_index):
            here, partial = map_index == number, maps[number]
            ends = tx_m[here], rx_m[here]
            tx_seen[here], rx_seen[here] = (partial.state_at(end_m) != CellState.UNKNOWN for end_m in ends)
            complete[here] = is_enclosed(partial, *ends)
            walled_m[here] = walled_lengths_m(partial, *ends)
            wall_noise[here] = 0.5 * sum(partial.noise_near(end_m) for end_m in ends)
            space = spaces[number]
            exposure[here] = np.stack([space.exposure_at(end_m) for end_m in ends], axis=1)
            route[here] = space.routes_of(*ends)
            lines = unobserved_distance_m[here] == 0.0, walled_m[here], wall_noise[here]
            possible[here] = possible_states(partial, ends, link_state[here], *lines)
        found = (tx_seen, rx_seen, complete, walled_m, wall_noise, exposure, route, possible)
        return cls(tx_m, rx_m, *found, map_index=map_index, spaces=spaces, **traced)

    def take(self, index: NDArray[np.generic] | slice) -> "LinkContext":
        """Select links; the fields of maps are shared."""
        return LinkContext(**{name: getattr(self, name)[index] for name in _COLUMNS}, spaces=self.spaces)

    @classmethod
    def concatenate(cls, parts: Sequence["LinkContext"]) -> "LinkContext":
        """Join links."""
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _COLUMNS}
        spaces = {id(space): space for part in parts for space in part.spaces}
        number = {key: index for index, key in enumerate(spaces)}
        of_part = [np.array([number[id(space)] for space in part.spaces], dtype=np.intp) for part in parts]
        columns["map_index"] = np.concatenate([own[part.map_index] for own, part in zip(of_part, parts, strict=True)])
        return cls(**columns, spaces=tuple(spaces.values()))


_COLUMNS = tuple(field.name for field in fields(LinkContext) if field.name != "spaces")


class IndirectPaths:
    """Running sums over the indirect paths from T transmitters to N receivers."""

    def __init__(self, partial: PartialMap, tx_m: Floats, rx_m: Floats, wall_loss_db: float) -> None:
        self.partial, self.tx_m, self.rx_m, self.wall_loss_db = partial, tx_m, rx_m, wall_loss_db
        count = len(tx_m) * len(rx_m)
        self._straight_power, self._straight_walls = np.zeros(count), np.zeros(count)
        self._power, self._strongest = np.zeros((len(ATTENUATION_LENGTHS_M), count)), np.zeros(count)
        self._strongest_m = np.linalg.norm(rx_m - tx_m[:, None], axis=2).ravel()

    def add(self, paths: TracedLinks | SolvedPaths) -> None:
        """Add paths in world coordinates."""
        for start in range(0, len(paths.a), _PATHS_AT_ONCE):
            block = slice(start, start + _PATHS_AT_ONCE)
            indirect = start + np.flatnonzero(np.any(paths.interactions[block] > 0, axis=1))
            tx, rx = paths.path_tx[indirect], paths.path_rx[indirect]
            if isinstance(paths, LocatedPaths):
                unobserved_m = paths.unobserved_m[indirect]
            else:
                interactions, vertices_m = paths.interactions[indirect], paths.vertices_m[indirect]
                unobserved_m = path_unobserved_m(self.partial, self.tx_m[tx], interactions, vertices_m, self.rx_m[rx])
            self._add(tx.astype(np.int64) * len(self.rx_m) + rx, np.abs(paths.a[indirect]) ** 2, unobserved_m)
        straight = np.isin(paths.interactions, (0, REFRACTION)).all(axis=1)
        link = paths.path_tx[straight].astype(np.int64) * len(self.rx_m) + paths.path_rx[straight]
        self._straight_power[link] += np.abs(paths.a[straight]) ** 2
        self._straight_walls[link] = np.count_nonzero(paths.interactions[straight], axis=1)

    def _add(self, link: NDArray[np.int64], power: Floats, unobserved_m: Floats) -> None:
        for total, length_m in zip(self._power, ATTENUATION_LENGTHS_M, strict=True):
            np.add.at(total, link, power * attenuation(unobserved_m, length_m))
        order = np.argsort(power, kind="stable")
        strongest = np.full(len(self._strongest), -1)
        strongest[link[order]] = order
        links = np.flatnonzero(strongest >= 0)
        links = links[power[strongest[links]] >= self._strongest[links]]
        self._strongest[links], self._strongest_m[links] = power[strongest[links]], unobserved_m[strongest[links]]

    def context(self, link_state: States, unobserved_distance_m: Floats) -> LinkContext:
        """Return the context of all T N links."""
        tx_m, rx_m = np.repeat(self.tx_m, len(self.rx_m), axis=0), np.tile(self.rx_m, (len(self.tx_m), 1))
        return LinkContext.on_maps(
            (self.partial,),
            np.zeros(len(tx_m), dtype=np.int64),
            tx_m=tx_m,
            rx_m=rx_m,
            link_state=link_state,
            unobserved_distance_m=unobserved_distance_m,
            indirect_gain_db=np.stack([path_gain_db(total) for total in self._power], axis=1),
            strongest_unobserved_m=self._strongest_m,
            straight_gain_db=path_gain_db(self._straight_power),
            straight_walls=self._straight_walls,
            wall_loss_db=np.full(len(tx_m), self.wall_loss_db),
        )


def mean_wall_loss_db(partial: PartialMap, trace_settings: TraceSettings, scene_settings: SceneSettings) -> float:
    """Return the mean loss of the known walls [dB]; `MOST_LOSS_DB` if no path is traced through walls."""
    if not trace_settings.through_walls:
        return MOST_LOSS_DB
    default, frequency_hz = scene_settings.traced_material, trace_settings.frequency_hz
    fractions = partial.wall_fractions.items()
    return sum(fraction * wall_loss_db(material or default, frequency_hz) for material, fraction in fractions)


@read_only
@dataclass(frozen=True, eq=False)
class LinkFeatures(Shown):
    """Features of N or T N links: the features of the paper (eq. 8), and further inputs of the other predictors.

    Parameters
    ----------
    link_state : (N,) or (T, N) uint8 array of LinkState
        Link state traced on the partial map.
    unobserved_distance_m : (N,) or (T, N) float64 array
        Length of the direct segment in unknown cells [m].
    distance_m : (N,) or (T, N) float64 array
        Distance from transmitter to receiver [m].
    gain_db : (N,) or (T, N) float64 array
        Omnidirectional path gain traced on the partial map [dB], at least -150.
    context : LinkContext, optional
        Walls and space around the links in flat order; unused by the paper's predictor.
    frequency_hz : float, optional
        Carrier frequency of the trace [Hz]; by default the predictor's.
    path_power : (N, C + 1, ..., R + 1) float64 array, optional
        Power by crossings of walls of unknown material, of one class or two, and reflections at them (`LinkSums`).

    Raises
    ------
    PredictorError
        For wrong shapes, or values that no link has.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> phi = sp.LinkFeatures([1, 0], unobserved_distance_m=[0.0, 2.5], distance_m=[3.0, 6.0], gain_db=[-71.0, -150.0])
    >>> len(phi)
    2
    """

    link_state: States
    unobserved_distance_m: Floats
    distance_m: Floats
    gain_db: Floats
    context: LinkContext | None = None
    frequency_hz: float | None = None
    path_power: Floats | None = None

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
        low_hz, high_hz = FREQUENCIES_HZ
        if self.frequency_hz is not None and not low_hz <= number_of(self.frequency_hz) <= high_hz:
            what = f"frequency_hz = {shown(self.frequency_hz)} is not allowed"
            raise PredictorError(f"{what}: give a frequency in Hz, or None for that of the predictor.")
        if self.context is not None and len(self.context) != count:
            raise PredictorError(f"context has {len(self.context)} links: give one of the same {count} links.")

    def __len__(self) -> int:
        return self.distance_m.size

    @property
    def shape(self) -> tuple[int, ...]:
        """(N,) or (T, N)."""
        return self.distance_m.shape

    def flat(self) -> "LinkFeatures":
        """Return the links as (T N,), transmitter by transmitter."""
        return self if self.distance_m.ndim == 1 else self.take(slice(None))

    def take(self, index: NDArray[np.generic] | slice) -> "LinkFeatures":
        """Select links by an index array, mask or slice of the flat order, transmitter by transmitter."""
        context = None if self.context is None else self.context.take(index)
        columns = {name: getattr(self, name).ravel()[index] for name in _PAPER}
        path_power = None if self.path_power is None else self.path_power[index]
        return LinkFeatures(**columns, context=context, frequency_hz=self.frequency_hz, path_power=path_power)

    def free_space_shift_db(self, frequency_hz: float) -> float:
        """Return the difference of free-space gains: at `frequency_hz` minus at the frequency of the links [dB]."""
        return 0.0 if self.frequency_hz is None else 20.0 * math.log10(self.frequency_hz / frequency_hz)

    @classmethod
    def concatenate(cls, parts: Sequence["LinkFeatures"]) -> "LinkFeatures":
        """Join links."""
        if not parts:
            raise PredictorError("parts is empty: give at least one LinkFeatures.")
        frequencies_hz = {part.frequency_hz for part in parts}
        if len(frequencies_hz) > 1:
            given = ", ".join(sorted(f"{each:g}" if each else "None" for each in frequencies_hz))
            raise PredictorError(f"parts have frequency_hz = {given}: give links of one frequency together.")
        contexts = [part.context for part in parts if part.context is not None]
        context = LinkContext.concatenate(contexts) if len(contexts) == len(parts) else None
        columns = {name: np.concatenate([getattr(part, name).ravel() for part in parts]) for name in _PAPER}
        powers = [part.path_power for part in parts if part.path_power is not None]
        path_power = np.concatenate(powers) if len(powers) == len(parts) else None
        return cls(**columns, context=context, frequency_hz=frequencies_hz.pop(), path_power=path_power)


_OPTIONAL = ("context", "frequency_hz", "path_power")
_PAPER = tuple(field.name for field in fields(LinkFeatures) if field.name not in _OPTIONAL)


def context_of(phi: LinkFeatures) -> LinkContext:
    assert phi.context is not None
    return phi.context


def shifted_gain_db(gain_db: Any, shift_db: Any, ops: ModuleType = np) -> Any:
    """Shift gains by some dB, except the gains of outages."""
    return ops.where(gain_db > GAIN_FLOOR_DB, gain_db + shift_db, gain_db)


def link_numbers(name: str, values: ArrayLike, shape: tuple[int, ...]) -> Floats:
    count = " x ".join(map(str, shape))
    try:
        numbers = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PredictorError(f"{name} = {values!r} is not numeric: give an array of {count} numbers.") from error
    if numbers.shape != shape:
        raise PredictorError(f"{name} has shape {numbers.shape}: give one number for each of the {count} links.")
    require_each(np.isfinite(numbers), name, numbers, "give finite numbers.")
    return numbers


def link_states(name: str, values: ArrayLike, shape: tuple[int, ...]) -> States:
    states = link_numbers(name, values, shape)
    known = ", ".join(f"{state.name} {state.value}" for state in LinkState)
    require_each(np.isin(states, [*LinkState]), name, states, f"use LinkState: {known}.")
    return states.astype(np.uint8)


def link_features(partial: PartialMap, links: TracedLinks) -> LinkFeatures:
    """Extract the features of traced links (paper, eq. 8).

    Parameters
    ----------
    partial : PartialMap
        The map on which the links were traced.
    links : TracedLinks
        Links on this map.

    Returns
    -------
    LinkFeatures
        In the shape of `links`.

    Raises
    ------
    MapError
        If `partial` is no PartialMap.
    SettingsError
        If `links` are no TracedLinks.
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
    if not links.valid.all():
        count = int((~links.valid).sum())
        raise PredictorError(f"links has {count} that were not traced: trace rx[links.valid], those that can be.")
    loss_db = mean_wall_loss_db(partial, links.trace_settings, links.scene_settings)
    paths = IndirectPaths(partial, links.tx.reshape(-1, 3), links.rx, loss_db)
    paths.add(links)
    frequency_hz = links.trace_settings.frequency_hz
    phi = _features(paths, links.link_state.ravel(), links.gain_db.ravel(), frequency_hz)
    return replace(phi, **{name: getattr(phi, name).reshape(links.gain_db.shape) for name in _PAPER})


def with_path_power(phi: LinkFeatures, partial: PartialMap, links: TracedLinks) -> LinkFeatures:
    """Return the features (T N,) of traced links with their power by walls of unknown material."""
    sums = LinkSums(len(phi) // max(1, len(links.rx)), len(links.rx), *_limits(partial, links.trace_settings))
    sums.add(links.solved, partial.wall_classes(links.vertices_m))
    return replace(phi, path_power=sums.path_power)


def features_of_paths(
    partial: PartialMap,
    tx_m: Floats,
    rx_m: Floats,
    blocks: Iterable[SolvedPaths],
    settings: tuple[TraceSettings, SceneSettings],
    *,
    material_unknown: bool = False,
) -> LinkFeatures:
    """Extract the features of links from (3,) to (N, 3) [m] during the trace, without keeping paths.

    `blocks` are from `Simulation.blocks`.
    """
    sums = LinkSums(1, len(rx_m), *(_limits(partial, settings[0]) if material_unknown else ()))
    indirect = IndirectPaths(partial, tx_m[None], rx_m, mean_wall_loss_db(partial, *settings))
    for paths in blocks:
        sums.add(paths, partial.wall_classes(paths.vertices_m) if material_unknown else None)
        indirect.add(paths)
    link_state, gain_db = sums.states_and_gains()
    phi = _features(indirect, link_state[0], gain_db[0], settings[0].frequency_hz)
    return replace(phi, path_power=sums.path_power) if material_unknown else phi


def _limits(partial: PartialMap, settings: TraceSettings) -> tuple[int, ...]:
    """Return the largest numbers of crossed walls of each class and of reflections."""
    return (*(settings.max_walls,) * partial.wall_class_count, settings.max_depth)


def _features(paths: IndirectPaths, link_state: States, gain_db: Floats, frequency_hz: float) -> LinkFeatures:
    unobserved_m = np.concatenate([unobserved_lengths_m(paths.partial, tx_m, paths.rx_m) for tx_m in paths.tx_m])
    distance_m = np.linalg.norm(paths.rx_m - paths.tx_m[:, None], axis=-1).ravel()
    context = paths.context(link_state, unobserved_m)
    return LinkFeatures(link_state, unobserved_m, distance_m, gain_db, context, frequency_hz)


def require_each(good: Bools, name: str, values: Floats, remedy: str) -> None:
    if not good.all():
        index = np.unravel_index(int(np.argmin(good)), np.shape(values))
        where = ", ".join(map(str, index))
        raise PredictorError(f"{name}[{where}] = {values[index]:g} is not allowed: {remedy}")
