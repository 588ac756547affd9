"""Posterior of materials, given measured gains: errors of gains, prior, search and descent.

Links deviate by normal noise [dB]; an exponential is added for NLOS links with unmapped paths or obstacles. Slabs of
low loss interfere with themselves: the plane of index and conductivity is searched on cells finer than the fringes
before a descent.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import log_ndtr

from sionna_partial.arrays import Bools, Floats
from sionna_partial.calibration.link_paths import LinkPaths, link_gains_db
from sionna_partial.checks import Progress
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.display import Shown
from sionna_partial.tracing.power import reflection_loss_db

NOISES_DB = np.geomspace(0.7, 15.0, 24)
MISSED_FRACTIONS, BLOCKED_FRACTIONS = (0.0, 0.1, 0.25, 0.5, 0.75), (0.0, 0.05, 0.2)

MISSED_DB, BLOCKED_DB = 8.0, 12.0
"""Mean excess of links with missed paths, mean loss of links with blocked paths [dB]."""

STRAY_FRACTION = 0.01
"""Fraction of LOS links that deviate either way; smallest fraction of other links."""

EXPECTED_NOISE_DB, NOISE_SPREAD, MEAN_FRACTION = 3.0, 0.7, 0.5
"""Prior: median noise [dB], standard deviation of its logarithm, mean of the fractions."""

LOSSLESS = np.array([[1.0], [0.0]])
"""Relative permittivity and conductivity [S/m] of the vacuum; the excess over it has a logarithm."""

INCOMPLETE_WEIGHT = 0.35
"""Power of the likelihood on incomplete maps, where errors of links are correlated."""

PRIOR_MEDIAN, PRIOR_SPREAD = np.array([[2.5], [0.15]]), np.array([[0.9], [1.8]])
"""Prior: median of permittivity less 1 and of conductivity [S/m], and standard deviation of their logarithms: 95 %
between 1.4 and 16, and 0.004 and 5 S/m, around the building materials of ITU-R P.2040-3 at 28 GHz."""

IMPEDANCE_OHM = 376.73

LOWEST_GAIN_DB = -300.0
"""Predicted gain of a link whose paths all vanish [dB]."""

TYPICAL_DEG, TYPICAL_LOSS_DB = np.arange(0.0, 80.0, 2.5), 30.0
"""Angles at which reflections are compared [degrees], and largest relevant loss [dB]."""

INDEX_RANGE, FINE_INDEX = (1.01, 6.0), 3.4
"""Range of searched refractive indices, and largest index with resolved fringes."""

FRINGE_CELLS, FINEST_FRINGE_CELLS, COARSE_CELLS = 14, 60, 29
"""Cells per fringe at the begin and end of the search, and without fringes."""

SPLIT_FRACTION, HEAVY_FRACTION, MOST_CELLS = 0.004, 0.02, 600
"""Fractions of the posterior above which a cell is divided until small, and in any case; number of added cells."""

MOST_FRINGES, FEW_STEPS, FEW_FRINGES = 8, 3, 2
"""Number of fringes that are searched, of steps in each, and of fringes that are descended to the end."""

CELLS_A_REPORT = 64


@dataclass(frozen=True)
class GainErrors:
    """Density of measured less predicted gains; fractions are of NLOS links.

    Parameters
    ----------
    noise_db : standard deviation of the noise
    missed_fraction, blocked_fraction : links that are stronger, and weaker, than predicted
    """

    noise_db: float
    missed_fraction: float
    blocked_fraction: float

    def penalty(self) -> float:
        """Return the negative logarithm of the prior, up to a constant."""
        spread = math.log(self.noise_db / EXPECTED_NOISE_DB) / NOISE_SPREAD
        return 0.5 * spread**2 + (self.missed_fraction + self.blocked_fraction) / MEAN_FRACTION

    def curve(self, error_db: Floats, is_direct: Bools, variance: ArrayLike = 0.0) -> tuple[Floats, Floats, Floats]:
        """Return the negative log density of errors (N,) [dB], and its first and second derivatives."""
        noise_db = np.sqrt(self.noise_db**2 + np.asarray(variance))
        parts = _log_densities(error_db, noise_db)
        fraction = _fractions(is_direct, self.missed_fraction, self.blocked_fraction)
        top = np.max(parts, axis=0)
        normal, missed, blocked = fraction * np.exp(parts - top)
        bell = np.exp(parts[0] - top)
        density = normal + missed + blocked
        variance = noise_db**2
        missed_slope = (fraction[1] * bell - missed) / MISSED_DB
        blocked_slope = (fraction[2] * bell - blocked) / BLOCKED_DB
        slope = -error_db / variance * normal + missed_slope - blocked_slope
        bell_slope = -error_db / variance * bell
        bend = normal * (error_db**2 / variance - 1.0) / variance
        bend += (fraction[1] * bell_slope - missed_slope) / MISSED_DB
        bend -= (fraction[2] * bell_slope + blocked_slope) / BLOCKED_DB
        first = -slope / density
        return -np.log(density) - top, first, first**2 - bend / density


_ALL_FRACTIONS = list(itertools.product(MISSED_FRACTIONS, BLOCKED_FRACTIONS))
_ALL_ERRORS = [GainErrors(float(noise_db), *fractions) for fractions in _ALL_FRACTIONS for noise_db in NOISES_DB]
_PENALTIES = np.array([each.penalty() for each in _ALL_ERRORS])


def fit_errors(error_db: Floats, is_direct: Bools, variance: ArrayLike = 0.0) -> tuple[GainErrors, float]:
    """Return the most probable density of errors (N,) [dB], and its negative log posterior.

    `variance` [dB^2], of means of repeated measurements, is in addition to the noise of the link.
    """
    noise_db = np.sqrt(NOISES_DB[:, None] ** 2 + np.asarray(variance))
    densities = np.exp(np.maximum(_log_densities(error_db, noise_db), -700.0))
    parts = densities[:, :, is_direct], densities[:, :, ~is_direct]
    direct, indirect = (
        -np.log(np.maximum(np.tensordot(fractions, part, 1), 1e-300)).sum(axis=-1)
        for fractions, part in zip(_MIXTURES, parts, strict=True)
    )
    total = (direct + indirect).ravel() + _PENALTIES
    best = int(np.argmin(total))
    return _ALL_ERRORS[best], float(total[best])


def _fractions(is_direct: Bools, missed: float, blocked: float) -> Floats:
    """Return the fractions (3, N) of noise alone, missed and blocked paths; none is 0."""
    stray = STRAY_FRACTION / 2.0
    off = np.where(is_direct, stray, np.maximum([[missed], [blocked]], stray))
    return np.stack([1.0 - off.sum(axis=0), *off])


_MIXTURES = [
    np.stack([_fractions(np.array([direct]), *fractions)[:, 0] for fractions in chosen])
    for direct, chosen in ((True, _ALL_FRACTIONS[:1]), (False, _ALL_FRACTIONS))
]
"""Fractions of noise, missed and blocked paths: LOS (1, 3), NLOS (15, 3)."""


def _log_densities(error_db: Floats, noise_db: float | Floats) -> Floats:
    """Return the log densities (3, ..., N) of noise, and with an exponential added either way."""
    parts = [-0.5 * (error_db / noise_db) ** 2 - np.log(noise_db * math.sqrt(2.0 * math.pi))]
    for error, mean_db in ((error_db, MISSED_DB), (-error_db, BLOCKED_DB)):
        ratio = noise_db / mean_db
        tail = log_ndtr(error / noise_db - ratio)
        parts.append(0.5 * ratio**2 - error / mean_db - math.log(mean_db) + tail)
    return np.stack(parts)


@dataclass(frozen=True)
class Point:
    """Materials and their misfit.

    Parameters
    ----------
    values : (2, M), permittivity and conductivity [S/m]
    loss : negative logarithm of the posterior density of their logarithms, up to a constant
    """

    values: Floats
    loss: float
    errors: GainErrors

    @property
    def logs(self) -> Floats:
        return np.log(self.values - LOSSLESS)


@dataclass(frozen=True)
class Posterior(Shown):
    """Posterior of one material: K values with weights that sum to 1."""

    permittivity: Floats
    conductivity_s_m: Floats
    weight: Floats

    @property
    def values(self) -> Floats:
        """Permittivity and conductivity (2, K)."""
        return np.stack([self.permittivity, self.conductivity_s_m])

    def deviation(self, values: Floats, best: float) -> float:
        """Return the root mean square deviation of values (K,) from the best one."""
        return float(np.sqrt(self.weight @ (values - best) ** 2))

    def typical(self, thickness_m: float, frequency_hz: float) -> Floats:
        """Return the values (2,) whose reflection losses are nearest to the posterior mean."""
        loss_db = reflection_loss_db(
            self.permittivity[:, None], self.conductivity_s_m[:, None], thickness_m, frequency_hz, TYPICAL_DEG
        )
        limited_db = np.minimum(loss_db, TYPICAL_LOSS_DB)
        return self.values[:, int(np.argmin(((limited_db - self.weight @ limited_db) ** 2).sum(axis=1)))]

    def interval(self, values: Floats, fraction: float = 0.95) -> tuple[float, float]:
        """Return the limits of the central fraction of values (K,)."""
        order = np.argsort(values, kind="stable")
        rank = np.cumsum(self.weight[order]) - 0.5 * self.weight[order]
        low, high = np.interp((0.5 - 0.5 * fraction, 0.5 + 0.5 * fraction), rank, values[order])
        return float(low), float(high)


class MaterialTarget:
    """Misfit of materials to measured gains (N,) [dB]; `weight` is the power of the likelihood.

    With `has_offset` all gains have an unknown offset, estimated from LOS links.
    """

    has_offset = False

    def __init__(self, paths: LinkPaths, gain_db: Floats, variance: Floats, weight: float = 1.0) -> None:
        self.paths, self.gain_db, self.variance, self.weight = paths, gain_db, variance, weight
        self.is_direct = np.zeros(len(gain_db), dtype=bool)
        self.is_direct[paths.link[paths.is_direct]] = True

    def at(self, values: Floats) -> Point:
        error_db = self.errors_db(self.paths.power(*values))
        errors, loss = fit_errors(error_db, self.is_direct, self.variance)
        return Point(values, self.weight * loss + prior_loss(values), errors)

    def offset_db(self, power: Floats) -> float:
        """Return the median excess of measured over predicted gains of LOS links [dB]."""
        return float(np.median((self.gain_db - self.gains_db(power))[self.is_direct]))

    def errors_db(self, power: Floats) -> Floats:
        return self.gain_db - self.gains_db(power) - (self.offset_db(power) if self.has_offset else 0.0)

    def gains_db(self, power: Floats) -> Floats:
        return np.maximum(link_gains_db(power, self.paths.link, len(self.gain_db)), LOWEST_GAIN_DB)

    def slopes(self, point: Point) -> tuple[Floats, Floats]:
        """Return gradient (2 M,) and curvature (2 M, 2 M) over the logarithms."""
        link, count = self.paths.link, len(self.gain_db)
        power, slopes = self.paths.slopes(*point.values)
        total = np.maximum(np.bincount(link, weights=power, minlength=count), 1e-30)
        of_links = np.stack([np.bincount(link, weights=column, minlength=count) for column in slopes.T], axis=1)
        scale = (point.values - LOSSLESS).ravel()
        jacobian: Floats = of_links * (10.0 / math.log(10.0) * scale / total[:, None])
        error_db = self.errors_db(power)
        _, first, second = point.errors.curve(error_db, self.is_direct, self.variance)
        information = np.broadcast_to(PRIOR_SPREAD**-2.0, point.values.shape)
        prior_slope = (information * (point.logs - np.log(PRIOR_MEDIAN))).ravel()
        curvature: Floats = self.weight * (jacobian.T * np.maximum(second, 0.0)) @ jacobian
        return prior_slope - self.weight * jacobian.T @ first, curvature + np.diag(information.ravel())


def descend(target: MaterialTarget, start: Point, report: Progress, most_steps: int = 30) -> tuple[list[Point], Floats]:
    """Minimise the loss by damped Newton steps (Levenberg and Marquardt).

    Return the start and all steps that reduced the loss, and the last curvature (2 M, 2 M).
    """
    steps, damping = [start], 1e-3
    gradient, curvature = target.slopes(start)
    for number in range(most_steps):
        move = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -gradient)
        move /= max(1.0, float(np.abs(move).max()))
        trial = target.at(LOSSLESS + np.exp(steps[-1].logs + move.reshape(2, -1)))
        report((number + 1) / most_steps, "following the slopes")
        if trial.loss < steps[-1].loss:
            gained = steps[-1].loss - trial.loss
            steps.append(trial)
            gradient, curvature = target.slopes(trial)
            damping = max(damping / 5.0, 1e-6)
            if gained < 1e-3:
                break
        elif damping > 1e4 or np.abs(move).max() < 1e-6:
            break
        else:
            damping *= 8.0
    return steps, curvature


def prior_loss(values: Floats) -> float:
    return 0.5 * float(((np.log((values - LOSSLESS) / PRIOR_MEDIAN) / PRIOR_SPREAD) ** 2).sum())


def prior_posterior() -> Posterior:
    spread = np.linspace(-3.0, 3.0, 31)
    values = LOSSLESS + PRIOR_MEDIAN * np.exp(PRIOR_SPREAD * np.reshape(np.meshgrid(spread, spread), (2, -1)))
    weight = np.outer(np.exp(-0.5 * spread**2), np.exp(-0.5 * spread**2)).ravel()
    return Posterior(values[0], values[1], weight / weight.sum())


def lossless_scale_s_m(index: float, thickness_m: float) -> float:
    """Return the conductivity that attenuates by 8.7 dB through a slab and back [S/m]."""
    return index / (IMPEDANCE_OHM * thickness_m)


class _Plane:
    """The plane of one material, the others fixed; evaluated points are kept.

    Cells are (4, K) arrays: refractive index and log conductivity at the centre, and the widths in both.
    """

    def __init__(self, target: MaterialTarget, start: Point, which: int, report: Progress) -> None:
        self._target, self._start, self._which, self._report = target, start, which, report
        self._points: dict[tuple[float, float], Point] = {}

    def evaluate(self, cells: Floats, begin: float, end: float) -> Floats:
        values = np.repeat(self._start.values[None], cells.shape[1], axis=0)
        values[:, 0, self._which], values[:, 1, self._which] = cells[0] ** 2, np.exp(cells[1])
        for first in range(0, len(values), CELLS_A_REPORT):
            rows = slice(first, first + CELLS_A_REPORT)
            self._points |= zip(map(tuple, cells[:2, rows].T), map(self._target.at, values[rows]), strict=True)
            part = min(1.0, (first + CELLS_A_REPORT) / len(values))
            self._report(begin + (end - begin) * part, "searching for the material")
        return cells

    def points(self, cells: Floats) -> list[Point]:
        return [self._points[centre] for centre in map(tuple, cells[:2].T)]

    def losses(self, cells: Floats) -> Floats:
        return np.array([each.loss for each in self.points(cells)])

    def fractions(self, cells: Floats) -> Floats:
        loss = self.losses(cells)
        area = cells[2] * cells[3] * 2.0 * cells[0] / (cells[0] ** 2 - 1.0)
        mass: Floats = np.exp(loss.min() - loss) * area
        return mass / mass.sum()

    def best(self, cells: Floats, fringe: float, most: int) -> list[Point]:
        """Return at most `most` best points, each in a different fringe."""
        found: list[int] = []
        for number in np.argsort(self.losses(cells), kind="stable"):
            if all(abs(cells[0, number] - cells[0, other]) > 0.5 * fringe for other in found):
                found.append(int(number))
            if len(found) == most:
                break
        return self.points(cells[:, found])


def search(
    target: MaterialTarget, start: Point, which: int, thickness_m: float, frequency_hz: float, report: Progress
) -> tuple[list[Point], Posterior]:
    """Search the plane of one material: its best points in different fringes, and its posterior."""
    fringe = SPEED_OF_LIGHT_M_S / (2.0 * frequency_hz * thickness_m)
    plane = _Plane(target, start, which, report)
    cells = plane.evaluate(_first_cells(thickness_m, fringe), 0.0, 0.7)
    held = np.zeros(cells.shape[1], dtype=bool)
    for point in plane.best(cells, fringe, MOST_FRINGES):
        permittivity, conductivity_s_m = descend(target, point, report, FEW_STEPS)[0][-1].values[:, which]
        beside = np.abs(cells[0] - math.sqrt(permittivity)) <= 0.5 * cells[2]
        held |= beside & (np.abs(cells[1] - math.log(conductivity_s_m)) <= 0.5 * cells[3])
    cells = np.hstack([cells[:, ~held], plane.evaluate(_divided(cells[:, held], 9, 2), 0.7, 0.8)])
    added = 0
    while added < MOST_CELLS:
        fractions = plane.fractions(cells)
        heavy = fractions > HEAVY_FRACTION
        wide, high = (cells[2] > max(fringe / FINEST_FRINGE_CELLS, 0.002)) | heavy, (cells[3] > 0.2) | heavy
        matters = fractions > SPLIT_FRACTION
        wide_neighbour, high_neighbour = _coarser_neighbours(cells, matters)
        wide, high = (wide & matters) | wide_neighbour, (high & matters) | high_neighbour
        split = wide | high
        if not split.any():
            break
        cuts = ((wide & high, (2, 2)), (wide & ~high, (3, 1)), (~wide & high, (1, 2)))
        parts = [_divided(cells[:, chosen], *counts) for chosen, counts in cuts]
        parts = [plane.evaluate(part, 0.8, 1.0) for part in parts if part.size]
        cells = np.hstack([cells[:, ~split], *parts])
        added += sum(part.shape[1] for part in parts)
    fraction = plane.fractions(cells)
    order = np.argsort(-fraction, kind="stable")
    kept = order[: int(np.searchsorted(np.cumsum(fraction[order]), 0.999)) + 1]
    posterior = Posterior(cells[0, kept] ** 2, np.exp(cells[1, kept]), fraction[kept] / fraction[kept].sum())
    return plane.best(cells, fringe, FEW_FRINGES), posterior


def _coarser_neighbours(cells: Floats, chosen: Bools) -> Bools:
    """Return which cells (K,) beside a chosen one are wider, and higher: a ridge may continue there."""
    distance = np.abs(cells[:2, :, None] - cells[:2, None, chosen])
    own, other = cells[2:, :, None], cells[2:, None, chosen]
    near = (distance < 0.51 * (own + other)).all(axis=0)
    return np.any(near & (own > 1.5 * other), axis=-1)


def _divided(cells: Floats, index_parts: int, log_parts: int) -> Floats:
    along, across = (np.arange(parts) - 0.5 * (parts - 1) for parts in (index_parts, log_parts))
    index, log, width, height = cells[:, :, None, None] / np.array([1, 1, index_parts, log_parts])[:, None, None, None]
    parts = np.broadcast_arrays(index + width * along[:, None], log + height * across, width, height)
    return np.reshape(parts, (4, -1))


def _first_cells(thickness_m: float, fringe: float) -> Floats:
    """Return cells of the plane: fine in the index where slabs interfere, coarse where they absorb."""
    scale = lossless_scale_s_m(2.0, thickness_m)
    levels = np.log(scale * np.array([0.03, 0.5, 1.4, 3.0, 6.0, 15.0, 50.0, 300.0, 1e4, 1e7]))
    edges = np.concatenate([levels[:1] - 2.0, 0.5 * (levels[1:] + levels[:-1]), levels[-1:] + 2.0])
    coarse = np.geomspace(*INDEX_RANGE, COARSE_CELLS + 1)
    rows = []
    for level, low, high in zip(levels, edges[:-1], edges[1:], strict=True):
        absorption = math.exp(level) / scale
        width = min(fringe / FRINGE_CELLS * (1.0 if absorption < 1.0 else 2.0), 0.1)
        fine = np.linspace(INDEX_RANGE[0], FINE_INDEX, math.ceil((FINE_INDEX - INDEX_RANGE[0]) / width) + 1)
        borders = np.concatenate([fine, coarse[coarse > FINE_INDEX * 1.03]]) if absorption < 2.0 else coarse
        centre = 0.5 * (borders[1:] + borders[:-1])
        rows.append(np.stack(np.broadcast_arrays(centre, 0.5 * (low + high), np.diff(borders), high - low)))
    return np.hstack(rows)
