"""The posterior distribution of a material, cell by cell.

Slabs of little loss interfere with themselves: the loss of a reflection is a comb over the refractive index, with teeth
half a wavelength over the thickness apart. So the plane of index and conductivity is searched as a whole, on cells
finer than the teeth, before anything follows a slope. Cells that matter are divided until one can integrate over them.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sionna_partial.calibration.material_fit import (
    MaterialTarget,
    Point,
    Posterior,
    Report,
    descend,
    lossless_scale_s_m,
)
from sionna_partial.constants import SPEED_OF_LIGHT_M_S

INDEX_RANGE, FINE_INDEX = (1.01, 6.0), 3.4
"""Refractive indices that are searched, and the one up to which teeth are resolved."""

TEETH_PARTS, FINEST_PARTS, COARSE_PARTS = 14, 60, 29
"""Number of cells to a tooth when the search begins, and where it ends; number of cells where there are no teeth."""

SPLIT_SHARE, MOST_CELLS = 0.004, 600
"""Share of the posterior above which a cell is divided, and number of cells that division may add."""

MOST_TEETH, FEW_STEPS, FEW_TEETH = 8, 3, 2
"""Number of teeth whose bottoms are looked for, and of steps to each; number of teeth that are followed to the end."""

CELLS_A_REPORT = 64
"""Number of cells after which progress is reported."""


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
        loss = np.zeros(len(cells.index))
        for number, (index, log_conductivity) in enumerate(zip(cells.index, cells.log_conductivity, strict=True)):
            loss[number] = self._point(index, log_conductivity).loss
            if (number + 1) % CELLS_A_REPORT == 0 or number + 1 == len(loss):
                self._report(begin + (end - begin) * (number + 1) / len(loss), "searching for the material")
        return replace(cells, loss=loss)

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
