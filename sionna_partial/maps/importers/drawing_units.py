"""Unit of a drawing: that of its header, or the one with which extent, doors, walls and texts have usual sizes."""

import math
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sionna_partial.arrays import Bools, Floats
from sionna_partial.errors import MapError
from sionna_partial.maps.environment import MapWarning
from sionna_partial.maps.import_report import rooms_of
from sionna_partial.maps.mesh.cells import crossed_cells

UNITS_M = {
    "millimetres": 0.001,
    "centimetres": 0.01,
    "metres": 1.0,
    "decimetres": 0.1,
    "inches": 0.0254,
    "feet": 0.3048,
}

RARE = {"decimetres": 8.0, "inches": 3.0, "feet": 3.0}
"""Additional misfit of rare units that the header does not have."""

POSSIBLE_M = (1.0, 2000.0)
"""Plausible longer sides of a building [m]."""

MARGIN, DOUBT, UNIQUE_MARGIN = 5.0, 2.5, 1.0
"""Differences of misfits from which the header's unit is rejected; from which it gives a warning, or is rejected if it
is inches or feet in a metric drawing; and from which one unit is better than all others."""

RASTER_CELLS = 1000
"""Number of cells along the longer side of the plan in which openings are found."""

MOST_LINES = 1500
"""Number of longest lines whose distances are computed."""


class _Scale(NamedTuple):
    """Usual value of a length [m]; a factor from it is a misfit of 1, limited to `limit`."""

    usual_m: float
    factor: float
    limit: float


SCALES = {
    "an extent": _Scale(20.0, 5.0, 20.0),
    "openings": _Scale(0.9, 1.7, 3.0),
    "gaps in walls": _Scale(0.9, 1.7, 3.0),
    "walls": _Scale(0.2, 3.0, 3.0),
    "texts": _Scale(0.2, 4.0, 3.0),
}


def unit_of(path: Path, code: int, is_metric: bool, segments: Floats, texts: Floats) -> tuple[float, str]:
    """Return the length of a unit of a drawing [m] and its source, or raise a MapError if none fits best.

    `code` is `$INSUNITS`, `is_metric` is `$MEASUREMENT`, `segments` (N, 2, 2) are the lines of the walls, `texts` (T,)
    the heights of texts. The header's unit is used unless one other fits the lengths much better.
    """
    lengths, header_m = lengths_of(segments, texts), _header_unit(code)
    misfits = {name: misfit(lengths, unit_m) + RARE.get(name, 0.0) for name, unit_m in UNITS_M.items()}
    best, second, *_ = sorted(misfits, key=misfits.__getitem__)
    unit_m, is_clear = UNITS_M[best], misfits[second] - misfits[best] >= UNIQUE_MARGIN
    extent, source = lengths["an extent"], f"$INSUNITS = {code} of the header"
    what = f"path = '{path}' has no unit ($INSUNITS = {code}), and walls of {extent:g} units"
    if header_m is not None:
        what = f"path = '{path}' has the unit {header_m:g} m ({source}), and with it {_described(lengths, header_m)}"
        excess = misfit(lengths, header_m) - misfits[best]
        is_possible = POSSIBLE_M[0] <= extent * header_m <= POSSIBLE_M[1]
        if is_possible and (excess < DOUBT or len(lengths) == 1):
            return header_m, source
        needed = DOUBT if is_metric and header_m in (0.0254, 0.3048) else MARGIN
        if is_possible and (excess < needed or not is_clear):
            message = f"{what}; in {best} it would have {_described(lengths, unit_m)}"
            warnings.warn(f"{message}: give unit_m, {header_m:g} or {unit_m:g}.", MapWarning, stacklevel=4)
            return header_m, source
    if not is_clear:
        remedy = "give unit_m, 0.001 if they are millimetres, 0.01 for centimetres, 1 for metres, 0.0254 for inches."
        raise MapError(f"{what}: {remedy}")
    which = "which are read as" if header_m is None else "so it is read in"
    message = f"{what}, {which} {best}, with {_described(lengths, unit_m)}: give unit_m, {unit_m:g} if that is right"
    message += "." if header_m is None else f", {header_m:g} for the unit of the header."
    warnings.warn(message, MapWarning, stacklevel=4)
    return unit_m, f"guess by {', '.join(lengths)}{'' if header_m is None else f', not {source}'}"


def misfit(lengths: dict[str, float], unit_m: float) -> float:
    found = 0.0
    for name, length in lengths.items():
        usual_m, factor, limit = SCALES[name]
        found += min((math.log(length * unit_m / usual_m) / math.log(factor)) ** 2, limit)
    return found


def lengths_of(segments: Floats, texts: Floats) -> dict[str, float]:
    low = segments.min(axis=(0, 1))
    extent = float(np.ptp(segments.reshape(-1, 2), axis=0).max())
    found = {"an extent": extent}
    if not extent > 0:
        return {"an extent": 1e-9}
    openings = rooms_of(*_raster((segments - low) / extent)).openings_m
    if len(openings):
        found["openings"] = float(np.median(openings)) * extent
    thickness = wall_thickness(segments)
    if thickness:
        found["walls"] = thickness
    gap = _usual_gap(segments, extent, 1.5 * thickness)
    if gap:
        found["gaps in walls"] = gap
    texts = texts[texts > 0]
    if len(texts):
        found["texts"] = float(np.median(texts))
    return found


def _header_unit(code: int) -> float | None:
    from ezdxf import units
    from ezdxf.enums import InsertUnits

    known = code in range(1, 25)
    return float(f"{units.conversion_factor(InsertUnits(code), InsertUnits.Meters):.9g}") if known else None


def _described(lengths: dict[str, float], unit_m: float) -> str:
    return ", ".join(f"{name} of {length * unit_m:.3g} m" for name, length in lengths.items())


def _raster(segments: Floats) -> tuple[Bools, float]:
    """Return the cells without lines (ny, nx), with a margin, and their size; the longer side of the plan is 1."""
    cell, margin = 1.0 / RASTER_CELLS, RASTER_CELLS // 10
    lines = segments / cell + margin
    nx, ny = (int(size) for size in np.ceil(lines.max(axis=(0, 1))) + margin)
    return ~crossed_cells(lines, (ny, nx), 1e-6), cell


def _longest(segments: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return direction (radians, in a half turn), offset and two ends along it of the longest lines, (N,)."""
    along = segments[:, 1] - segments[:, 0]
    chosen = np.argsort(-np.hypot(*along.T), kind="stable")[:MOST_LINES]
    along, start = along[chosen], segments[chosen, 0] - segments.mean(axis=(0, 1))
    angle = np.arctan2(along[:, 1], along[:, 0]) % np.pi
    angle[angle > np.pi - 1e-3] -= np.pi
    cosine, sine = np.cos(angle), np.sin(angle)
    offset = start[:, 1] * cosine - start[:, 0] * sine
    first = start[:, 0] * cosine + start[:, 1] * sine
    last = first + along[:, 0] * cosine + along[:, 1] * sine
    return angle, offset, np.minimum(first, last), np.maximum(first, last)


def wall_thickness(segments: Floats) -> float:
    """Return the usual distance between parallel neighbours, 0 for walls of single lines."""
    angle, offset, first, last = _longest(segments)
    length = last - first
    beside = np.minimum.outer(last, last) - np.maximum.outer(first, first) > 0.5 * np.minimum.outer(length, length)
    apart = np.abs(np.subtract.outer(offset, offset))
    parallel = np.abs(np.subtract.outer(angle, angle)) < 0.01
    apart[~(beside & parallel) | (apart < 1e-4 * np.ptp(segments))] = np.inf
    found = float(np.quantile(apart.min(axis=1), 0.4, method="lower"))
    return found if found < np.ptp(segments.reshape(-1, 2), axis=0).max() / 40 else 0.0


def _usual_gap(segments: Floats, extent: float, least: float) -> float:
    """Return the most frequent gap between collinear lines, 0 if there is none."""
    angle, offset, first, last = _longest(segments)
    line = np.stack([np.rint(angle / 0.01), np.rint(offset / (2e-4 * extent))], axis=1)
    _, group = np.unique(line, axis=0, return_inverse=True)
    order = np.lexsort((first, group.ravel()))
    shift = 10.0 * extent * group.ravel()[order]  # keeps the groups apart in the running maximum
    reached = np.maximum.accumulate(last[order] + shift)
    gaps = (first[order] + shift)[1:] - reached[:-1]
    gaps = gaps[(np.diff(shift) == 0) & (gaps > max(least, 1e-3 * extent)) & (gaps < extent / 5)]
    if not len(gaps):
        return 0.0
    near = np.abs(np.log(np.divide.outer(gaps, gaps))) < math.log(1.15)
    return float(np.median(gaps[near[np.argmax(near.sum(axis=1))]]))
