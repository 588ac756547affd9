"""Paths in unobserved space: survival of traced paths, and analogues of missing ones.

Missing paths are taken from similar links in procedural homes: their paths that a partial map did not show, turned to
the direct line (method of analogues; Lorenz, Atmospheric Predictability as Revealed by Naturally Occurring Analogues,
1969).
"""

import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.constants import CellState, LinkState
from sionna_partial.files import atomic_write
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.prediction.predictor_files import shipped_bytes
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.process import core_count
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.tracing.antennas import Antenna
from sionna_partial.tracing.interactions import DIFFRACTION
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import SolvedPaths, path_gain_db, zenith_azimuth

STATES = (LinkState.LOS, LinkState.NLOS)

ANALOGUES = 8

_SCALE = np.array([[1.5, 0.5, 0.7, 8.0, 1.0, 1.0], [6.0, 0.5, 0.7, 8.0, 1.0, 1.0]])
"""Units of search keys for LOS and NLOS: gain above free space [dB], logarithms of distance and unobserved length, gain
of surviving paths relative to the link's [dB], observed ends.
"""

_NEARLY = 0.3
"""Largest relative excess of an analogue's distance over the nearest link's."""

_TURN_DEG = (6, 3)
"""Bins of zenith and azimuth for directions of departure [degree]."""

_RARE = 1e-4
"""Fraction of the power below which a direction is left out."""

_WEAKEST_DB, _TINY = -30.0, 1e-12
_MAX_BYTES = 20_000_000


@dataclass(frozen=True, eq=False)
class LinkGeometry:
    """Direct lines of L links on a map: lengths [m], observed ends, zenith and azimuth [rad], each (L,)."""

    distance_m: Floats
    unobserved_m: Floats
    tx_seen: Bools
    rx_seen: Bools
    departure_rad: Floats
    free_space_db: Floats

    @classmethod
    def of(cls, partial: PartialMap, tx_m: Floats, rx_m: Floats, frequency_hz: float) -> "LinkGeometry":
        distance_m = np.linalg.norm(rx_m - tx_m, axis=1)
        tx_seen, rx_seen = (partial.state_at(end_m) != CellState.UNKNOWN for end_m in (tx_m, rx_m))
        free_space_db = free_space_gain_db(distance_m, frequency_hz)
        unobserved_m = unobserved_lengths_m(partial, tx_m, rx_m)
        return cls(distance_m, unobserved_m, tx_seen, rx_seen, zenith_azimuth(rx_m - tx_m), free_space_db)

    @cached_property
    def arrival_rad(self) -> Floats:
        zenith_rad, azimuth_rad = self.departure_rad.T
        return np.stack([np.pi - zenith_rad, wrapped(azimuth_rad + np.pi)], axis=1)

    def take(self, index: Indices | Bools) -> "LinkGeometry":
        return LinkGeometry(*(getattr(self, column.name)[index] for column in fields(self)))

    def keys(self, state: LinkState, gain_db: Floats, survivors_db: Floats) -> Floats:
        """Return the (L, 6) search keys for analogues of links of one state."""
        columns = (
            gain_db - self.free_space_db,
            np.log(self.distance_m),
            np.log1p(self.unobserved_m),
            np.clip(survivors_db - gain_db, _WEAKEST_DB, 0.0),
            self.tx_seen,
            self.rx_seen,
        )
        return np.stack(columns, axis=1) / _SCALE[STATES.index(state)]


def survival_inputs(links: TracedLinks, paths: Indices, unobserved_m: Floats, geometry: LinkGeometry) -> Floats:
    """Return the inputs (P, 8) of the network for selected traced paths (P,)."""
    link, interactions = links.path_link[paths], links.interactions[paths]
    columns = (
        np.log1p(4.0 * unobserved_m),
        unobserved_m > 1e-3,
        (interactions > 0).sum(axis=1),
        (interactions == DIFFRACTION).any(axis=1),
        np.log10(np.maximum(np.abs(links.a[paths]), 1e-12)) + 4.0,
        geometry.distance_m[link] / 5.0,
        geometry.tx_seen[link],
        geometry.rx_seen[link],
    )
    return np.stack([np.asarray(column, dtype=np.float64) for column in columns], axis=1)


def wrapped(angle_rad: Floats) -> Floats:
    """Return angles in [-pi, pi)."""
    return (angle_rad + np.pi) % (2.0 * np.pi) - np.pi


@dataclass(frozen=True, eq=False)
class PathModel:
    """Survival network, and B analogues with Q paths, those with LOS first.

    Parameters
    ----------
    weights : tuple of 6 arrays
        Kernel and bias of each layer; the last input is 1 for LOS, else 0.
    keys : (B, 6) float32 array
        Search keys.
    los_count : () int array
        Number of analogues with LOS.
    first : (B + 1,) int64 array
        First path of each analogue.
    spread_ns : (B,) float32 array
        Delay spread of each analogue [ns].
    fraction : (Q,) float16 array
        Fraction of the power of the analogue.
    excess_ns : (Q,) float16 array
        Excess delay over the direct line [ns].
    departure_rad, arrival_rad : (Q, 2) float16 arrays
        Zenith and azimuth relative to the direct line [rad].
    """

    weights: tuple[Floats, ...]
    keys: NDArray[np.float32]
    los_count: NDArray[np.int64]
    first: NDArray[np.int64]
    spread_ns: NDArray[np.float32]
    fraction: NDArray[np.float16]
    excess_ns: NDArray[np.float16]
    departure_rad: NDArray[np.float16]
    arrival_rad: NDArray[np.float16]

    def survival(self, inputs: Floats, state: LinkState) -> Floats:
        """Return the probability (P,) that indirect paths exist, given the state of their links."""
        values = np.column_stack([inputs, np.full(len(inputs), float(state == LinkState.LOS))])
        for layer in (0, 2):
            values = np.maximum(values @ self.weights[layer] + self.weights[layer + 1], 0.0)
        return np.asarray(expit((values @ self.weights[4] + self.weights[5])[:, 0]))

    def analogues(self, state: LinkState, keys: Floats, quantile: Floats) -> Indices:
        """Return the numbers (L,) of analogues: the similar link at a quantile (L,) of delay spread."""
        tree, start = self._trees[STATES.index(state)]
        ranks = np.arange(1, min(ANALOGUES, tree.n) + 1)
        similar = tree.query(keys, k=ranks, eps=_NEARLY, workers=core_count())[1] + start
        order = np.take_along_axis(similar, np.argsort(self.spread_ns[similar], axis=1), axis=1)
        chosen = (quantile * order.shape[1]).astype(np.intp)
        return np.take_along_axis(order, chosen[:, None], axis=1)[:, 0]

    def departures_deg(self, state: LinkState) -> tuple[Indices, Floats]:
        """Return directions (K, 2) of unseen paths from the direct line [degree], and their mean power (K,)."""
        first = self.first[: self.los_count + 1] if state == LinkState.LOS else self.first[self.los_count :]
        here, counts = slice(first[0], first[-1]), np.diff(first)
        total = np.add.reduceat(np.append(self.fraction[here], 0.0).astype(np.float64), first[:-1] - first[0])
        weight = self.fraction[here] / np.repeat(total, counts)
        turned_deg = np.degrees(self.departure_rad[here].astype(np.float64))
        both_deg = np.concatenate([turned_deg, turned_deg * [1.0, -1.0]])
        bins, index = np.unique(np.round(both_deg / _TURN_DEG).astype(np.intp), axis=0, return_inverse=True)
        power = np.bincount(index.ravel(), np.tile(weight, 2))
        kept = power > _RARE * power.sum()
        return bins[kept] * _TURN_DEG, power[kept] / power[kept].sum()

    @cached_property
    def _trees(self) -> tuple[tuple[cKDTree, int], ...]:
        los_count = int(self.los_count)
        return (cKDTree(self.keys[:los_count]), 0), (cKDTree(self.keys[los_count:]), los_count)

    def save(self, path: Path) -> None:
        arrays = {column.name: getattr(self, column.name) for column in fields(self)[1:]}
        arrays |= {f"weights{number}": values.astype(np.float32) for number, values in enumerate(self.weights)}
        packed = io.BytesIO()
        np.savez_compressed(packed, **arrays)
        with atomic_write(path) as stream:
            stream.write(packed.getvalue())

    @classmethod
    @cache
    def load(cls) -> "PathModel":
        content = shipped_bytes(PREDICTORS_FOLDER / "paths.npz", _MAX_BYTES)
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            weights = tuple(stored[f"weights{number}"].astype(np.float64) for number in range(6))
            return cls(weights, **{column.name: stored[column.name] for column in fields(cls)[1:]})


class AntennaLinks:
    """Links from (3,) to (N, 3) [m] with an antenna at the transmitter, or at the receivers (`at_rx`).

    The direct and traced paths have the antenna's gain in their direction, all else the mean over the directions of
    analogues.
    """

    def __init__(self, antenna: Antenna, frequency_hz: float, tx_m: Floats, rx_m: Floats, *, at_rx: bool) -> None:
        self.antenna, self.frequency_hz, self._at_rx = antenna, frequency_hz, at_rx
        self._direct_rad = zenith_azimuth(tx_m - rx_m if at_rx else rx_m - tx_m)
        self._power, self._indirect, self._indirect_alone = np.zeros((3, len(rx_m)))

    def added(self, blocks: Iterable[SolvedPaths]) -> Iterator[SolvedPaths]:
        for paths in blocks:
            power, indirect = self.antenna.power(paths, self.frequency_hz, at_rx=self._at_rx), ~paths.is_direct
            np.add.at(self._power, paths.path_rx, power)
            np.add.at(self._indirect, paths.path_rx[indirect], power[indirect])
            np.add.at(self._indirect_alone, paths.path_rx[indirect], paths.power[indirect])
            yield paths

    def predict(
        self, phi: LinkFeatures, prediction: LinkPrediction, complete: Bools
    ) -> tuple[LinkFeatures, LinkPrediction, Floats]:
        """Return features with the antenna, the prediction without its mean gain, and this mean gain (N,) [dB]."""
        traced_db, phi = phi.gain_db, replace(phi, gain_db=path_gain_db(self._power))
        antenna_db = phi.gain_db - traced_db
        if complete.all():
            return phi, prediction, antenna_db
        free_space = 10.0 ** (free_space_gain_db(phi.distance_m, self.frequency_hz) / 10.0)
        direct, table = self.antenna.gain(self._direct_rad, self.frequency_hz), self._table()
        spread = {state: self._spread(state, table) for state in STATES}

        def change(links: LinkPrediction) -> tuple[Floats, Floats]:
            probabilities, means_db, _ = links.by_state
            change_db = np.zeros_like(means_db)
            for state in STATES:
                sight = free_space * (state == LinkState.LOS)
                alone, known = sight + self._indirect_alone, sight * direct + self._indirect
                whole = np.maximum(10.0 ** (means_db[state] / 10.0), alone)
                change_db[state] = path_gain_db((known + (whole - alone) * spread[state]) / whole)
            return change_db, np.where(np.arange(3)[:, None] == LinkState.OUTAGE, 0.0, probabilities + _TINY)

        change_db, weights = change(prediction)
        mean_db = (weights * change_db).sum(axis=0) / weights.sum(axis=0)

        def relative(links: LinkPrediction) -> LinkPrediction:
            (change_db, weights), (probabilities, means_db, stds_db) = change(links), links.by_state
            means_db += np.where(weights > 0.0, change_db - mean_db, 0.0)
            return LinkPrediction.of_parts(probabilities, means_db, stds_db).where(complete, links)

        return phi, prediction.mapped(relative), np.where(complete, antenna_db, mean_db)

    def _table(self) -> Floats:
        angles_deg = np.stack(np.meshgrid(np.arange(181.0), np.arange(360.0), indexing="ij"), axis=-1)
        return self.antenna.gain(np.radians(angles_deg.reshape(-1, 2)), self.frequency_hz).reshape(181, 360)

    def _spread(self, state: LinkState, table: Floats) -> Floats:
        zenith_deg, azimuth_deg = np.round(np.degrees(self._direct_rad)).astype(np.intp).T
        mean = np.zeros(len(zenith_deg))
        for (down, left), power in zip(*PathModel.load().departures_deg(state), strict=True):
            mean += power * table[np.clip(zenith_deg + down, 0, 180), (azimuth_deg + left) % 360]
        return mean
