"""Gaussian latents of links, correlated where links cross the same unknown cells.

A latent is a weighted sum of a Gaussian field along the direct line, as in the network shadowing model of Agrawal and
Patwari (Correlated Link Shadow Fading in Multi-Hop Wireless Networks, IEEE Trans. Wireless Communications, 2009).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtri

from sionna_partial.arrays import Floats, States
from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.rule import LinkPrediction

DECORRELATION_M = 1.0
"""Decorrelation length d0 of the field [m], with the correlation exp(-(d / d0)^2 / 2)."""

KNOWN_WEIGHT = 0.1
"""Weight of a known cell; unknown cells have weight 1."""

OWN_VARIANCE = 0.1
"""Fraction of a latent's variance that is not shared; like the other constants, fitted to procedural homes."""

_CELL_M, _MOST_CELLS = 0.35, 4096
_POINTS = 48
_FEWEST_DRAWS, _LINKS_AT_ONCE = 64, 1000


@dataclass(frozen=True, eq=False)
class JointLatents:
    """Standard normal latents of links."""

    partial: PartialMap

    def correlation(self, tx_m: Floats, rx_m: Floats) -> Floats:
        smooth = np.concatenate([*self._smoothed(tx_m, rx_m)])
        return (1.0 - OWN_VARIANCE) * (smooth @ smooth.T) + OWN_VARIANCE * np.eye(len(smooth))

    def quantiles(self, tx_m: Floats, rx_m: Floats, count: int, seeds: list[list[int]]) -> Floats:
        """Draw `count` evenly spread quantiles (F, count, L) in (0, 1) from F fields."""
        if not len(tx_m):
            return np.zeros((len(seeds), count, 0))
        draws = max(count, _FEWEST_DRAWS)
        sources = [np.random.default_rng(seed) for seed in seeds]
        fields = [rng.standard_normal((math.prod(self._shape), draws), np.float32) for rng in sources]
        shared = [
            np.concatenate(parts)
            for parts in zip(*([rows @ each for each in fields] for rows in self._smoothed(tx_m, rx_m)), strict=True)
        ]
        return np.stack([_evenly_spread(*each, count) for each in zip(shared, sources, strict=True)])

    def draw(
        self, links: LinkPrediction, tx_m: Floats, rx_m: Floats, count: int, seed: list[int]
    ) -> tuple[States, Floats]:
        """Draw states and gains (count, T, N) [dB] of predicted links (T, N)."""
        ends = np.repeat(tx_m, len(rx_m), axis=0), np.tile(rx_m, (len(tx_m), 1))
        quantiles = self.quantiles(*ends, count, [[*seed, 0], [*seed, 1]])
        return states_and_gains(links, *quantiles.reshape(2, count, len(tx_m), len(rx_m)))

    @cached_property
    def _step(self) -> int:
        edge_m = max(_CELL_M, math.sqrt(self.partial.state.size / _MOST_CELLS) * self.partial.resolution_m)
        return max(1, math.ceil(edge_m / self.partial.resolution_m))

    @property
    def _shape(self) -> tuple[int, int]:
        ny, nx = self.partial.shape
        return -(-ny // self._step), -(-nx // self._step)

    @cached_property
    def _weight(self) -> Floats:
        (ny, nx), step = self._shape, self._step
        padding = [(0, -count % step) for count in self.partial.shape]
        unknown = np.pad(self.partial.state == CellState.UNKNOWN, padding, constant_values=True)
        return KNOWN_WEIGHT + unknown.reshape(ny, step, nx, step).mean(axis=(1, 3)).ravel()

    def _smoothed(self, tx_m: Floats, rx_m: Floats) -> Iterator[Floats]:
        """Return weights of unit norm on white noise in the cells of the field, some links at a time."""
        edge_m = self._step * self.partial.resolution_m
        along = (np.arange(_POINTS)[:, None] + 0.5) / _POINTS
        limit = np.array(self._shape)[::-1] - 1
        for start in range(0, len(tx_m), _LINKS_AT_ONCE):
            ends_m = tx_m[start : start + _LINKS_AT_ONCE, None, :2], rx_m[start : start + _LINKS_AT_ONCE, None, :2]
            points_m = ends_m[0] * (1.0 - along) + ends_m[1] * along
            column, row = np.moveaxis((points_m - self.partial.origin_m) / edge_m, 2, 0)
            cell = np.clip(np.floor(row), 0, limit[1]) * self._shape[1] + np.clip(np.floor(column), 0, limit[0])
            index = cell.astype(np.intp)
            rows = np.zeros((len(index), len(self._weight)), np.float32)
            np.add.at(rows, (np.arange(len(index))[:, None], index), self._weight[index])
            smooth = ndimage.gaussian_filter(
                rows.reshape(-1, *self._shape),
                (0.0, *2 * (DECORRELATION_M / math.sqrt(2.0) / edge_m,)),
                mode="constant",
            ).reshape(rows.shape)
            yield smooth / np.linalg.norm(smooth, axis=1, keepdims=True)


def states_and_gains(links: LinkPrediction, of_state: Floats, of_gain: Floats) -> tuple[States, Floats]:
    """Return states and gains (n, ...) [dB] of predicted links (...) at quantiles of both."""
    state = drawn_states(links, of_state)
    return state, drawn_gains(links, state, of_gain)


def drawn_states(links: LinkPrediction, quantile: Floats) -> States:
    """Return states (n, ...) of predicted links (...): the lowest quantiles are outages, the highest LOS."""
    state = np.where(quantile < links.p_outage + links.p_nlos, LinkState.NLOS, LinkState.LOS)
    return np.where(quantile < links.p_outage, LinkState.OUTAGE, state).astype(np.uint8)


def drawn_gains(links: LinkPrediction, state: States, quantile: Floats) -> Floats:
    """Return gains (n, ...) [dB] of predicted links (...) at quantiles given their states."""
    _, means_db, stds_db = links.by_state
    mean_db, std_db = (np.take_along_axis(each, state.astype(np.intp), axis=0) for each in (means_db, stds_db))
    gain_db = np.clip(mean_db + std_db * ndtri(quantile), GAIN_FLOOR_DB, 0.0)
    return np.where(state == LinkState.OUTAGE, GAIN_FLOOR_DB, gain_db)


def evenly_within(groups: NDArray[np.integer], quantile: Floats, rng: np.random.Generator) -> Floats:
    """Spread quantiles (n, L) evenly over (0, 1) within the draws of each group (n, L), in their order."""
    index, order = np.arange(len(groups))[:, None], np.lexsort((quantile, groups), axis=0)
    ordered = np.take_along_axis(groups, order, axis=0)
    differs = np.diff(ordered, axis=0, prepend=ordered[:1] - 1, append=ordered[-1:] + 1) != 0
    first = np.maximum.accumulate(np.where(differs[:-1], index, 0), axis=0)
    last = np.minimum.accumulate(np.where(differs[1:], index + 1, len(groups))[::-1], axis=0)[::-1]
    spread = np.empty(quantile.shape)
    np.put_along_axis(spread, order, (index - first + rng.random(first.shape)) / (last - first), axis=0)
    return spread


def _evenly_spread(shared: Floats, rng: np.random.Generator, count: int) -> Floats:
    latent = math.sqrt(1.0 - OWN_VARIANCE) * shared
    latent += math.sqrt(OWN_VARIANCE) * rng.standard_normal(latent.shape, np.float32)
    rank = latent.argsort(axis=1).argsort(axis=1)[:, :count]
    return ((rank + rng.random(rank.shape)) / latent.shape[1]).T
