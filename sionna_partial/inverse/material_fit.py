"""Which materials explain measured gains: the posterior distribution, cell by cell, and its peak by Newton's method.

Slabs of little loss interfere with themselves: the loss of a reflection is a comb over the refractive index, with teeth
half a wavelength over the thickness apart. So the plane of index and conductivity is searched as a whole, on cells
finer than the teeth, before anything follows a slope. Cells that matter are divided until one can integrate over them.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.inverse.gain_errors import GainErrors, fit_errors
from sionna_partial.inverse.material_paths import MaterialPaths, link_gains_db
from sionna_partial.inverse.slab import reflection_loss_db

PRIOR_SUSCEPTIBILITY, SUSCEPTIBILITY_SPREAD = 2.5, 0.9
"""Median of the relative permittivity less 1 before anything is measured, and standard deviation of its logarithm: 95 %
of materials are between 1.4 and 16. The building materials of ITU-R P.2040-3 at 28 GHz are between 1.5 and 7.1."""

PRIOR_CONDUCTIVITY_S_M, CONDUCTIVITY_SPREAD = 0.15, 1.8
"""Median of the conductivity before anything is measured [S/m], and standard deviation of its logarithm: 95 % are
between 0.004 and 5 S/m. The building materials of ITU-R P.2040-3 at 28 GHz are between 0.04 and 0.63."""

IMPEDANCE_OHM = 376.73
"""Impedance of the vacuum."""

LOWEST_GAIN_DB = -300.0
"""Predicted gain of a link whose paths all vanish [dB]."""

INDEX_RANGE, FINE_INDEX = (1.01, 6.0), 3.4
"""Refractive indices that are searched, and the one up to which teeth are resolved."""

TEETH_PARTS, FINEST_PARTS, COARSE_PARTS = 14, 60, 29
"""Number of cells to a tooth when the search begins, and where it ends; number of cells where there are no teeth."""

SPLIT_SHARE, MOST_CELLS = 0.004, 600
"""Share of the posterior above which a cell is divided, and number of cells that division may add."""

TYPICAL_DEG, TYPICAL_LOSS_DB = np.arange(0.0, 80.0, 2.5), 30.0
"""Angles of incidence at which reflections are compared [degrees], and the largest loss that counts [dB]."""

MOST_TEETH, FEW_STEPS, FEW_TEETH = 8, 3, 2
"""Number of teeth whose bottoms are looked for, and of steps to each; number of teeth that are followed to the end."""

CELLS_AT_ONCE = 64
"""Number of cells after which progress is told."""

Report = Callable[[float, str], None]


@dataclass(frozen=True)
class Point:
    """Materials, and how well they explain the measurements.

    Parameters
    ----------
    permittivity, conductivity_s_m : (M,) float64 arrays
    loss : float
        Negative logarithm of the posterior density of the logarithms, but for a constant.
    errors : GainErrors
    """

    permittivity: NDArray[np.float64]
    conductivity_s_m: NDArray[np.float64]
    loss: float
    errors: GainErrors

    @property
    def logs(self) -> NDArray[np.float64]:
        """Logarithms (2 M,) of permittivity less 1, and of conductivity [S/m]."""
        return np.log(np.concatenate([self.permittivity - 1.0, self.conductivity_s_m]))


@dataclass(frozen=True)
class Posterior:
    """What measurements leave open about one material: K values with weights that sum to 1.

    Parameters
    ----------
    permittivity, conductivity_s_m, weight : (K,) float64 arrays
    """

    permittivity: NDArray[np.float64]
    conductivity_s_m: NDArray[np.float64]
    weight: NDArray[np.float64]

    def deviation(self, values: NDArray[np.float64], best: float) -> float:
        """Root mean square of how far values (K,) are from the best one."""
        return float(np.sqrt(self.weight @ (values - best) ** 2))

    def typical(self, thickness_m: float, frequency_hz: float) -> int:
        """Return the value whose reflection losses are nearest to their mean: the likeliest one may be an odd one."""
        loss_db = reflection_loss_db(
            self.permittivity[:, None], self.conductivity_s_m[:, None], thickness_m, frequency_hz, TYPICAL_DEG
        )
        shown = np.minimum(loss_db, TYPICAL_LOSS_DB)
        return int(np.argmin(((shown - self.weight @ shown) ** 2).sum(axis=1)))

    def interval(self, values: NDArray[np.float64]) -> tuple[float, float]:
        """Central 95 % of values (K,)."""
        order = np.argsort(values, kind="stable")
        place = np.cumsum(self.weight[order]) - 0.5 * self.weight[order]
        low, high = np.interp((0.025, 0.975), place, values[order])
        return float(low), float(high)


class MaterialTarget:
    """How well materials explain measured gains.

    Parameters
    ----------
    paths : MaterialPaths
        Of N links, each with a path.
    gain_db : (N,) float64 array
        Measured gains [dB].

    Attributes
    ----------
    known : dict of str to list of float
        What has been found, by place; what is there is not evaluated again.
    on_progress : callable
        Called when something has been found.
    """

    def __init__(self, paths: MaterialPaths, gain_db: NDArray[np.float64]) -> None:
        self.paths, self.gain_db = paths, gain_db
        self.known: dict[str, list[float]] = {}
        self.is_direct = np.zeros(len(gain_db), dtype=bool)
        self.is_direct[paths.link[paths.is_direct]] = True
        self.on_progress: Callable[[], None] = lambda: None

    def gains_db(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predicted gains (N,) for (M,) materials [dB]."""
        return self._gains_db(self.paths.power(permittivity, conductivity_s_m))

    def at(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> Point:
        """Judge materials (M,)."""
        key = _key(permittivity, conductivity_s_m)
        if key not in self.known:
            self._learn(key, self.gains_db(permittivity, conductivity_s_m))
            self.on_progress()
        loss, *errors_found = self.known[key]
        loss += _prior_loss(permittivity, conductivity_s_m)
        return Point(permittivity, conductivity_s_m, loss, GainErrors(*errors_found))

    def prepare(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> None:
        """Judge many materials (K, M) together, which is quicker than one by one with `at`."""
        keys = [_key(*pair) for pair in zip(permittivity, conductivity_s_m, strict=True)]
        new = np.flatnonzero([key not in self.known for key in keys])
        for start in range(0, len(new), self.paths.at_once):
            rows = new[start : start + self.paths.at_once]
            powers = self.paths.powers(permittivity[rows], conductivity_s_m[rows])
            for row, power in zip(rows, powers, strict=True):
                self._learn(keys[row], self._gains_db(power))
            self.on_progress()

    def _gains_db(self, power: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.maximum(link_gains_db(power, self.paths.link, len(self.gain_db)), LOWEST_GAIN_DB)

    def _learn(self, key: str, gains_db: NDArray[np.float64]) -> None:
        errors, loss = fit_errors(self.gain_db - gains_db, self.is_direct)
        self.known[key] = [loss, errors.noise_db, errors.missed_share, errors.blocked_share]

    def slopes(self, point: Point) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Gradient (2 M,) and curvature (2 M, 2 M) of the loss over the logarithms, by Sionna RT and Dr.Jit."""
        key = f"slopes {_key(point.permittivity, point.conductivity_s_m)}"
        size = 2 * len(point.permittivity)
        if key not in self.known:
            gradient, curvature = self._slopes(point)
            self.known[key] = [*gradient.tolist(), *curvature.ravel().tolist()]
            self.on_progress()
        numbers = np.array(self.known[key])
        return numbers[:size], numbers[size:].reshape(size, size)

    def _slopes(self, point: Point) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        link, count = self.paths.link, len(self.gain_db)
        power, slopes = self.paths.slopes(point.permittivity, point.conductivity_s_m)
        total = np.maximum(np.bincount(link, weights=power, minlength=count), 1e-30)
        scale = np.concatenate([point.permittivity - 1.0, point.conductivity_s_m])
        sums = [np.bincount(link, weights=column, minlength=count) for column in slopes.T]
        jacobian: NDArray[np.float64] = np.stack(sums, axis=1) * (10.0 / math.log(10.0) * scale / total[:, None])
        error_db = self.gain_db - np.maximum(10.0 * np.log10(total), LOWEST_GAIN_DB)
        _, first, second = point.errors.curve(error_db, self.is_direct)
        off, information = _prior_slopes(point)
        curvature: NDArray[np.float64] = (jacobian.T * np.maximum(second, 0.0)) @ jacobian + np.diag(information)
        return -jacobian.T @ first + off, curvature


@dataclass(frozen=True)
class _Cells:
    """Rectangles in refractive index and logarithm of the conductivity: centres, whole widths, and losses (K,)."""

    index: NDArray[np.float64]
    log_conductivity: NDArray[np.float64]
    index_width: NDArray[np.float64]
    log_width: NDArray[np.float64]
    loss: NDArray[np.float64]

    def take(self, chosen: NDArray[np.generic]) -> "_Cells":
        return _Cells(*(column[chosen] for column in self._columns()))

    def joined(self, other: "_Cells") -> "_Cells":
        return _Cells(*(np.concatenate(pair) for pair in zip(self._columns(), other._columns(), strict=True)))

    def divided(self, index_parts: int, log_parts: int) -> "_Cells":
        """Cut each cell, without losses."""
        along, across = (np.arange(parts) - 0.5 * (parts - 1) for parts in (index_parts, log_parts))
        width, height = self.index_width / index_parts, self.log_width / log_parts
        index = (self.index[:, None, None] + width[:, None, None] * along[:, None]) + 0.0 * across
        logs = (self.log_conductivity[:, None, None] + height[:, None, None] * across) + 0.0 * along[:, None]
        parts = index_parts * log_parts
        return _Cells(
            index.ravel(), logs.ravel(), np.repeat(width, parts), np.repeat(height, parts), np.zeros(index.size)
        )

    def holding(self, places: list[tuple[float, float]]) -> NDArray[np.bool_]:
        """Find the cells (K,) that hold some of the refractive indices and conductivities [S/m]."""
        held = np.zeros(len(self.index), dtype=bool)
        for index, conductivity_s_m in places:
            beside = np.abs(self.index - index) <= 0.5 * self.index_width
            held |= beside & (np.abs(self.log_conductivity - math.log(conductivity_s_m)) <= 0.5 * self.log_width)
        return held

    def shares(self) -> NDArray[np.float64]:
        """Share of the posterior in each cell; the measure is that of the logarithm of the permittivity less 1."""
        area = self.index_width * self.log_width * 2.0 * self.index / (self.index**2 - 1.0)
        mass: NDArray[np.float64] = np.exp(self.loss.min() - self.loss) * area
        return mass / mass.sum()

    def _columns(self) -> tuple[NDArray[np.float64], ...]:
        return self.index, self.log_conductivity, self.index_width, self.log_width, self.loss


def search(
    target: MaterialTarget, start: Point, which: int, thickness_m: float, frequency_hz: float, report: Report
) -> tuple[list[Point], Posterior]:
    """Search the plane of one material, the others staying as they are.

    Parameters
    ----------
    target : MaterialTarget
    start : Point
        What the other materials are.
    which : int
        The material.
    thickness_m, frequency_hz : float
        Its thickness [m], and the carrier frequency [Hz].
    report : callable
        Called as ``report(share_done, message)``.

    Returns
    -------
    list of Point
        The best ones, each in a tooth of its own, the best first.
    Posterior
    """
    tooth = SPEED_OF_LIGHT_M_S / (2.0 * frequency_hz * thickness_m)
    evaluate = _Evaluation(target, start, which, report)
    cells = evaluate(_first_cells(thickness_m, tooth), 0.0, 0.7)
    bottoms = [descend(target, each, report, FEW_STEPS)[0][-1] for each in evaluate.best(cells, tooth, MOST_TEETH)]
    first = cells.holding([(math.sqrt(each.permittivity[which]), each.conductivity_s_m[which]) for each in bottoms])
    cells = cells.take(~first).joined(evaluate(cells.take(first).divided(9, 2), 0.7, 0.8))
    added, finest = 0, tooth / FINEST_PARTS
    while added < MOST_CELLS:
        wide, high = cells.index_width > max(finest, 0.002), cells.log_width > 0.2
        split = (cells.shares() > SPLIT_SHARE) & (wide | high)
        if not split.any():
            break
        kinds = [(split & wide & high, (2, 2)), (split & wide & ~high, (3, 1)), (split & ~wide & high, (1, 2))]
        parts = [cells.take(chosen).divided(*counts) for chosen, counts in kinds if chosen.any()]
        cells = cells.take(~split)
        for part in parts:
            cells = cells.joined(evaluate(part, 0.8, 1.0))
            added += len(part.loss)
    return evaluate.best(cells, tooth, FEW_TEETH), _posterior(cells)


class _Evaluation:
    """Gives cells of one material's plane their losses."""

    def __init__(self, target: MaterialTarget, start: Point, which: int, report: Report) -> None:
        self._target, self._start, self._which, self._report = target, start, which, report

    def __call__(self, cells: _Cells, begin: float, end: float) -> _Cells:
        places = [*zip(cells.index, cells.log_conductivity, strict=True)]
        for first in range(0, len(places), CELLS_AT_ONCE):
            pairs = [self._materials(*place) for place in places[first : first + CELLS_AT_ONCE]]
            self._target.prepare(*(np.array(values) for values in zip(*pairs, strict=True)))
            share = min(1.0, (first + CELLS_AT_ONCE) / len(places))
            self._report(begin + (end - begin) * share, "searching for the material")
        return replace(cells, loss=np.array([self._point(*place).loss for place in places]))

    def best(self, cells: _Cells, tooth: float, most: int) -> list[Point]:
        """Return the best points of the best teeth, at most so many."""
        found: list[int] = []
        for number in np.argsort(cells.loss, kind="stable"):
            if all(abs(cells.index[number] - cells.index[other]) > 0.5 * tooth for other in found):
                found.append(int(number))
            if len(found) == most:
                break
        return [self._point(cells.index[number], cells.log_conductivity[number]) for number in found]

    def _point(self, index: float, log_conductivity: float) -> Point:
        return self._target.at(*self._materials(index, log_conductivity))

    def _materials(self, index: float, log_conductivity: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        permittivity, conductivity_s_m = self._start.permittivity.copy(), self._start.conductivity_s_m.copy()
        permittivity[self._which], conductivity_s_m[self._which] = index**2, math.exp(log_conductivity)
        return permittivity, conductivity_s_m


def descend(
    target: MaterialTarget, start: Point, report: Report, most_steps: int = 30
) -> tuple[list[Point], NDArray[np.float64]]:
    """Follow the slopes to a minimum of the loss, by Newton's method with damping (Levenberg and Marquardt).

    Parameters
    ----------
    target : MaterialTarget
    start : Point
    report : callable
        Called as ``report(share_done, message)``.
    most_steps : int
        Largest number of steps.

    Returns
    -------
    list of Point
        The start, and each step that made the loss smaller.
    (2 M, 2 M) float64 array
        Curvature at the last.
    """
    steps, damping = [start], 1e-3
    gradient, curvature = target.slopes(start)
    for number in range(most_steps):
        move = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -gradient)
        move /= max(1.0, float(np.abs(move).max()))
        size = len(move) // 2
        values = np.exp(steps[-1].logs + move)
        trial = target.at(1.0 + values[:size], values[size:])
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


def prior_posterior() -> Posterior:
    """Return what is assumed about a material before anything is measured."""
    spread = np.linspace(-3.0, 3.0, 31)
    weight = np.exp(-0.5 * spread**2)
    first, second = (axis.ravel() for axis in np.meshgrid(spread, spread))
    weights = np.outer(weight, weight).ravel()
    return Posterior(
        1.0 + PRIOR_SUSCEPTIBILITY * np.exp(SUSCEPTIBILITY_SPREAD * first),
        PRIOR_CONDUCTIVITY_S_M * np.exp(CONDUCTIVITY_SPREAD * second),
        weights / weights.sum(),
    )


def lossless_scale_s_m(index: float, thickness_m: float) -> float:
    """Conductivity that takes 8.7 dB on the way through a slab and back [S/m]."""
    return index / (IMPEDANCE_OHM * thickness_m)


def _first_cells(thickness_m: float, tooth: float) -> _Cells:
    """Cover the plane: fine in the index where slabs interfere with themselves, coarse where they swallow the wave."""
    scale = lossless_scale_s_m(2.0, thickness_m)
    levels = np.log(scale * np.array([0.03, 0.5, 1.4, 3.0, 6.0, 15.0, 50.0, 300.0, 1e4, 1e7]))
    edges = np.concatenate([levels[:1] - 2.0, 0.5 * (levels[1:] + levels[:-1]), levels[-1:] + 2.0])
    coarse = np.geomspace(*INDEX_RANGE, COARSE_PARTS + 1)
    columns = []
    for number, level in enumerate(levels):
        swallowed = math.exp(level) / scale
        width = tooth / TEETH_PARTS * (1.0 if swallowed < 1.0 else 2.0)
        fine = np.linspace(INDEX_RANGE[0], FINE_INDEX, math.ceil((FINE_INDEX - INDEX_RANGE[0]) / min(width, 0.1)) + 1)
        borders = np.concatenate([fine, coarse[coarse > FINE_INDEX * 1.03]]) if swallowed < 2.0 else coarse
        centre, spread = 0.5 * (borders[1:] + borders[:-1]), np.diff(borders)
        low, high = edges[number], edges[number + 1]
        columns.append((centre, np.full_like(centre, 0.5 * (low + high)), spread, np.full_like(centre, high - low)))
    index, logs, widths, heights = (np.concatenate(column) for column in zip(*columns, strict=True))
    return _Cells(index, logs, widths, heights, np.zeros(len(index)))


def _posterior(cells: _Cells) -> Posterior:
    """Keep the cells that have all but a thousandth of the posterior."""
    share = cells.shares()
    order = np.argsort(-share, kind="stable")
    kept = order[: int(np.searchsorted(np.cumsum(share[order]), 0.999)) + 1]
    weight = share[kept] / share[kept].sum()
    return Posterior(cells.index[kept] ** 2, np.exp(cells.log_conductivity[kept]), weight)


def _key(permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> str:
    return " ".join(float(value).hex() for value in (*permittivity, *conductivity_s_m))


def _prior_loss(permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> float:
    first = np.log((permittivity - 1.0) / PRIOR_SUSCEPTIBILITY) / SUSCEPTIBILITY_SPREAD
    second = np.log(conductivity_s_m / PRIOR_CONDUCTIVITY_S_M) / CONDUCTIVITY_SPREAD
    return 0.5 * float((first**2).sum() + (second**2).sum())


def _prior_slopes(point: Point) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradient (2 M,) and information (2 M,) of what is assumed."""
    count = len(point.permittivity)
    centre = np.log(np.repeat([PRIOR_SUSCEPTIBILITY, PRIOR_CONDUCTIVITY_S_M], count))
    information = np.repeat([SUSCEPTIBILITY_SPREAD**-2.0, CONDUCTIVITY_SPREAD**-2.0], count)
    return information * (point.logs - centre), information
