"""States, gains and paths of links in draws of a building: traced paths, and analogues of those not traced."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.special import ndtri

from sionna_partial.arrays import Bools, Floats, Indices, States
from sionna_partial.channels.joint import JointLatents, drawn_gains, drawn_states, evenly_within
from sionna_partial.constants import GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S, LinkState
from sionna_partial.link_model import LinkModel
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.path_model import LinkGeometry, PathModel, survival_inputs, wrapped
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.prediction.unobserved import traced_unobserved_m
from sionna_partial.prediction.wall_materials import RESIDUAL_DB
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import SEEN_M, SolvedPaths, path_gain_db, path_order, unnamed_counts

UNSEEN = 255
"""Interaction of paths through unseen space, an extension of Sionna RT's `InteractionType`."""

RANGE_DB = 30.0
"""Traced paths this much weaker than the strongest of an uncertain link are omitted [dB]."""

PATHS_OF_DRAW = 20
"""Usual number of paths of an uncertain link."""

_PATHS_AT_ONCE = 100_000
_COLUMNS = tuple(name for name in SolvedPaths.__dataclass_fields__ if name != "vertices_m")
_NO_VERTICES = np.zeros((0, 1, 3))
_STATE, _GAIN, _SURVIVAL, _ANALOGUE, _REST, _RESIDUAL, _MATERIAL, _EVEN = range(8)
"""Parts of seeds."""


class Buildings(NamedTuple):
    """Candidate for the material of walls in each draw (n,), and distributions of the links for the K candidates.

    Each candidate adds `loss_db` (K, C) [dB] for the `counts` (P, C) of crossings and reflections of a path.
    """

    of_draw: Indices
    parts: tuple[LinkPrediction, ...]
    loss_db: Floats
    counts: Floats

    @classmethod
    def drawn(
        cls, model: LinkModel, traced: TracedLinks, prediction: LinkPrediction, count: int, seed: int
    ) -> Buildings:
        """Draw candidates as often as they are probable."""
        (parts, weights), rng = prediction.materials, np.random.default_rng([seed, _MATERIAL])
        quantile = (rng.permutation(count) + rng.random(count)) / count
        of_draw = np.minimum(np.searchsorted(np.cumsum(weights), quantile, side="right"), len(parts) - 1)
        if not model.simulation.material_unknown:
            return cls(of_draw, parts, np.zeros((len(parts), 0)), np.zeros((len(traced.path_rx), 0)))
        materials, classes = model.wall_materials, model.partial.wall_classes(traced.vertices_m)
        loss_db = np.column_stack([materials.crossing_db, materials.reflection_db])
        counts = np.stack(unnamed_counts(traced.interactions, classes), axis=1)
        return cls(of_draw, parts, loss_db, counts.astype(np.float64))

    def kept(self, candidates: Indices, paths: Indices) -> Floats:
        """Return the powers (D, Q) of paths (Q,) relative to the trace for candidates (D,)."""
        kept: Floats = 10.0 ** (-0.1 * self.loss_db[candidates] @ self.counts[paths].T)
        return kept

    def states_and_gains(
        self, of_state: Floats, of_gain: Floats, of_residual: Floats | None, seed: list[int]
    ) -> tuple[States, Floats, Floats]:
        """Return states, gains without residual and residuals (n, L) [dB].

        Quantiles are spread evenly for each candidate and state.
        """
        rng, group = np.random.default_rng(seed), np.broadcast_to(self.of_draw[:, None], of_state.shape)
        of_state = evenly_within(group, of_state, rng)
        state, gain_db = np.zeros(of_state.shape, np.uint8), np.zeros(of_state.shape)
        rows = [(self.of_draw == number, part) for number, part in enumerate(self.parts)]
        for here, part in rows:
            state[here] = drawn_states(part, of_state[here])
        group = len(LinkState) * group + state
        of_gain = evenly_within(group, of_gain, rng)
        for here, part in rows:
            gain_db[here] = drawn_gains(part, state[here], of_gain[here])
        if of_residual is None:
            return state, gain_db, np.zeros(state.shape)
        return state, gain_db, RESIDUAL_DB * ndtri(evenly_within(group, of_residual, rng))


def _is_certain(links: LinkPrediction) -> Bools:
    probabilities, _, stds_db = links.by_state
    return np.asarray((probabilities.max(axis=0) == 1.0) & (probabilities * stds_db == 0.0).all(axis=0))


class Draws:
    """Draws of states, gains and paths; all paths of a link share the residual of its gain about the trace."""

    def __init__(
        self, partial: PartialMap, traced: TracedLinks, prediction: LinkPrediction, buildings: Buildings, seed: int
    ) -> None:
        tx_m, rx_m, count = traced.tx.reshape(-1, 3), traced.rx, len(buildings.of_draw)
        self.traced, self._buildings, self._seed, self._rx_count = traced, buildings, seed, len(rx_m)
        self._link = traced.path_link
        ends = np.repeat(tx_m, len(rx_m), axis=0), np.tile(rx_m, (len(tx_m), 1))
        self._geometry = LinkGeometry.of(partial, *ends, traced.trace_settings.frequency_hz)
        certain = np.logical_and.reduce([_is_certain(part) for part in buildings.parts])
        self._certain_paths, self._uncertain = np.flatnonzero(certain[self._link]), np.flatnonzero(~certain)
        deviates = prediction.by_material is not None
        seeds = [[seed, each] for each in (_STATE, _GAIN, _SURVIVAL, _ANALOGUE, *[_RESIDUAL] * deviates)]
        of_state, of_gain, of_survival, of_analogue, *others = JointLatents(partial).quantiles(*ends, count, seeds)
        self._survival_latent = ndtri(of_survival[:, self._uncertain])
        self._analogue_quantile = of_analogue[:, self._uncertain]
        self._model = PathModel.load()
        self._paths, self._of_link, power = self._indirect()
        shape = len(self._paths), len(self._uncertain)
        self._power = csr_array((power, (np.arange(len(power)), self._of_link)), shape=shape)
        unobserved_m = traced_unobserved_m(partial, traced, self._paths)
        seen = unobserved_m < SEEN_M
        quantiles = of_state, of_gain, others[0] if deviates else None
        self.state, within_db, residual_db = buildings.states_and_gains(*quantiles, [seed, _EVEN])
        has_path = self.state != LinkState.OUTAGE
        self.gain_db = np.where(has_path, np.clip(within_db + residual_db, GAIN_FLOOR_DB, 0.0), GAIN_FLOOR_DB)
        # with LOS there are the direct path and all paths in observed space, at least
        least = np.tile(10.0 ** (self._geometry.free_space_db / 10.0), (len(buildings.parts), 1))
        seen_power = buildings.kept(np.arange(len(least)), self._paths) * seen
        least[:, self._uncertain] += seen_power @ self._power
        raised_db = np.maximum(within_db, path_gain_db(least)[buildings.of_draw])
        self._path_gain_db = np.where((self.state == LinkState.LOS) & ~certain, raised_db, within_db)
        self._crosses = np.zeros(len(self._link), dtype=bool)
        self._crosses[self._paths] = unobserved_m > 0.0
        inputs = survival_inputs(traced, self._paths, unobserved_m, self._geometry)
        self._survives_below = [
            np.where(seen, math.inf, math.sqrt(2.0) * ndtri(self._model.survival(inputs, each)))
            for each in (LinkState.LOS, LinkState.NLOS)
        ]

        paths = count * (len(self._link) + PATHS_OF_DRAW * len(self._uncertain))
        self._blocks = np.array_split(np.arange(count), min(count, 1 + paths // _PATHS_AT_ONCE))
        self._block_of_draw = np.repeat(np.arange(len(self._blocks)), [len(block) for block in self._blocks])
        self._latest: tuple[int, dict[str, NDArray[Any]]] = -1, {}

    def all_paths(self) -> dict[str, NDArray[Any]]:
        """Return the columns of the paths of all draws."""
        ordered = [self._ordered(block) for block in self._blocks]
        return self._with_vertices({name: np.concatenate([each.pop(name) for each in ordered]) for name in _COLUMNS})

    def paths_of(self, draw: int) -> dict[str, NDArray[Any]]:
        """Return the columns of the paths of one draw."""
        number = int(self._block_of_draw[draw])
        if self._latest[0] != number:
            self._latest = number, self._ordered(self._blocks[number])
        columns = self._latest[1]
        first = draw * self._tx_count
        start, stop = np.searchsorted(columns["path_tx"], [first, first + self._tx_count])
        here = {name: values[start:stop] for name, values in columns.items()}
        return self._with_vertices({**here, "path_tx": here["path_tx"] - np.int32(first)})

    @staticmethod
    def _with_vertices(columns: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        return {**columns, "vertices_m": np.broadcast_to(math.nan, (*columns["interactions"].shape, 3))}

    def _ordered(self, draws: Indices) -> dict[str, NDArray[Any]]:
        parts = [*self._parts(draws, np.random.default_rng([self._seed, _REST, draws[0]]))]
        order = path_order(parts)
        return {name: np.concatenate([getattr(part, name) for part in parts]).take(order, axis=0) for name in _COLUMNS}

    def _parts(self, draws: Indices, rng: np.random.Generator) -> Iterator[SolvedPaths]:
        certain, links, of_link = self._certain_paths, self._uncertain, self._of_link
        factor = 10.0 ** ((self.gain_db[draws] - self._path_gain_db[draws]) / 10.0)
        candidates = self._buildings.of_draw[draws]
        scale = self._buildings.kept(candidates, certain) * factor[:, self._link[certain]]
        row, path = np.nonzero(self.state[draws][:, self._link[certain]] != LinkState.OUTAGE)
        yield self._copies(draws[row], certain[path], np.sqrt(scale[row, path]), None)
        factor, kept = factor[:, links], self._buildings.kept(candidates, self._paths)
        state, gain_db = self.state[draws][:, links], self._path_gain_db[draws][:, links]
        is_los, free_space = state == LinkState.LOS, 10.0 ** (self._geometry.free_space_db[links] / 10.0)
        rest = np.maximum(10.0 ** (gain_db / 10.0) - is_los * free_space, 0.0)
        latent = self._survival_latent[draws][:, of_link]
        latent += rng.standard_normal(latent.shape)
        survives = latent < np.where(is_los[:, of_link], *self._survives_below)
        survives &= (state != LinkState.OUTAGE)[:, of_link]
        survivors = (survives * kept) @ self._power
        analogue = self._analogues(draws, state, gain_db, survivors)
        has_paths = (np.diff(self._model.first)[analogue] > 0) & (analogue >= 0)
        # without an analogue's paths the survivors have all of the power
        scale = np.where((survivors > rest) | ~has_paths, rest / np.maximum(survivors, 1e-30), 1.0)
        row, path = np.nonzero(survives & (scale > 0.0)[:, of_link])
        amplitude = np.sqrt((scale * factor)[row, of_link[path]] * kept[row, path])
        yield self._copies(draws[row], self._paths[path], amplitude, rng)
        alone = ~has_paths & (survivors == 0.0) & (state == LinkState.NLOS)
        row, link = np.nonzero(is_los | alone)
        kind = np.where(is_los[row, link], 0, UNSEEN)
        direct = factor[row, link] * np.where(kind == 0, free_space[link], rest[row, link])
        nothing = np.zeros((len(row), 2))
        yield self._made(draws[row], links[link], direct, np.zeros(len(row)), nothing, nothing, kind, rng)
        left = factor * np.where(has_paths, np.maximum(rest - survivors, 0.0), 0.0)
        yield self._of_analogues(draws, analogue, left, rng)

    def _indirect(self) -> tuple[Indices, Indices, Floats]:
        """Return indirect traced paths of uncertain links within `RANGE_DB`, their link numbers and powers."""
        links = self._uncertain
        index = np.full(len(self._geometry.distance_m), -1)
        index[links] = np.arange(len(links))
        paths = np.flatnonzero((index[self._link] >= 0) & (self.traced.interactions > 0).any(axis=1))
        power, at = np.abs(self.traced.a[paths]) ** 2, index[self._link[paths]]
        strongest = np.zeros(len(links))
        np.maximum.at(strongest, at, power)
        kept = power >= strongest[at] * 10.0 ** (-RANGE_DB / 10.0)
        return paths[kept], at[kept], power[kept]

    def _analogues(self, draws: Indices, state: States, gain_db: Floats, survivors: Floats) -> Indices:
        analogue = np.full(survivors.shape, -1)
        for each in (LinkState.LOS, LinkState.NLOS):
            row, link = np.nonzero(state == each)
            geometry, survivors_db = self._geometry.take(self._uncertain[link]), path_gain_db(survivors[row, link])
            keys = geometry.keys(each, gain_db[row, link], survivors_db)
            analogue[row, link] = self._model.analogues(each, keys, self._analogue_quantile[draws[row], link])
        return analogue

    def _of_analogues(self, draws: Indices, analogue: Indices, power: Floats, rng: np.random.Generator) -> SolvedPaths:
        row, link = np.nonzero(power > 0.0)
        chosen, mirror = analogue[row, link], rng.choice([-1.0, 1.0], len(row))
        first, count = self._model.first[chosen], np.diff(self._model.first)[chosen]
        each = np.repeat(np.arange(len(row)), count)
        path = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
        fraction = self._model.fraction[path].astype(np.float64)
        total = np.bincount(each, weights=fraction, minlength=len(row))
        turned = np.column_stack([np.ones(len(path)), mirror[each]])
        return self._made(
            draws[row[each]],
            self._uncertain[link[each]],
            power[row, link][each] * fraction / total[each],
            1e-9 * np.maximum(self._model.excess_ns[path].astype(np.float64), 0.0),
            turned * self._model.departure_rad[path],
            turned * self._model.arrival_rad[path],
            np.full(len(path), UNSEEN),
            rng,
        )

    def _copies(self, draw: Indices, paths: Indices, amplitude: Floats, rng: np.random.Generator | None) -> SolvedPaths:
        columns = {name: getattr(self.traced, name).take(paths, axis=0) for name in _COLUMNS}
        columns["transfer"] *= amplitude[:, None, None]
        if rng is not None:
            turn = np.where(self._crosses[paths], rng.uniform(0.0, 2.0 * np.pi, len(paths)), 0.0)
            columns["transfer"] *= np.exp(1j * turn)[:, None, None]
        columns["path_tx"] += (draw * self._tx_count).astype(np.int32)
        return SolvedPaths(**columns, vertices_m=_NO_VERTICES)

    def _made(
        self,
        draw: Indices,
        link: Indices,
        power: Floats,
        excess_s: Floats,
        departure_rad: Floats,
        arrival_rad: Floats,
        kind: Indices,
        rng: np.random.Generator,
    ) -> SolvedPaths:
        """Return paths that were not traced, with angles from the direct line and unchanged polarisation."""
        geometry, depth = self._geometry, max(1, self.traced.interactions.shape[1])
        seen = (kind == 0) & (geometry.unobserved_m[link] == 0.0)
        amplitude = np.sqrt(power) * np.exp(2j * np.pi * np.where(seen, 0.0, rng.random(len(link))))
        transfer, interactions = np.zeros((len(link), 2, 2), complex), np.zeros((len(link), depth), np.uint8)
        transfer[:, 0, 0], transfer[:, 1, 1], interactions[:, 0] = amplitude, -amplitude, kind
        angles = []
        for direct_rad, turned_rad in ((geometry.departure_rad, departure_rad), (geometry.arrival_rad, arrival_rad)):
            angle_rad = direct_rad.take(link, axis=0) + turned_rad
            np.clip(angle_rad[:, 0], 0.0, np.pi, out=angle_rad[:, 0])
            angle_rad[:, 1] = wrapped(angle_rad[:, 1])
            angles.append(angle_rad)
        return SolvedPaths(
            path_tx=(draw * self._tx_count + link // self._rx_count).astype(np.int32),
            path_rx=(link % self._rx_count).astype(np.int32),
            transfer=transfer,
            delay_s=geometry.distance_m[link] / SPEED_OF_LIGHT_M_S + excess_s,
            departure_rad=angles[0],
            arrival_rad=angles[1],
            interactions=interactions,
            vertices_m=_NO_VERTICES,
        )

    @property
    def _tx_count(self) -> int:
        return len(self.traced.tx.reshape(-1, 3))
