"""Procedural homes: complete floor plans from a seed.

A plan is drawn as polygons in metres: an outline, its division into rooms by corridors and walls, openings along a
spanning tree of the rooms (so that every room can be reached) and a few more, then furniture where it leaves room to
walk. Only at the end is it turned and put onto cells.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import shapely
from numpy.typing import NDArray
from rasterio.features import rasterize
from rasterio.transform import Affine
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from shapely import LineString, MultiPolygon, Polygon, affinity, box
from shapely.ops import split, substring

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import require, require_number

HomeKind = Literal["apartment", "house", "office"]

WALK_M = 0.5
"""Width that furniture leaves to walk through [m]."""

DOOR_M = (0.8, 1.0)
"""Width of doors [m]."""

WIDE_M = (1.2, 2.5)
"""Width of wide openings [m]."""

LOCKED_SHARE = 0.15
"""Share of the rooms at dead ends that stay locked."""

LEAF_SHARE = 0.2
"""Share of the doors whose leaf stands open into a room."""

_MARGIN_M = 0.3
_JAMB_M = 0.05
_CORRIDOR_SHAPE = 25
_NEAR_M = 0.01
_GRID_M = 1e-5
_SLIVER_M = 0.1
_WALKED_SHARE = 0.97
_SMALLEST_ROOM_M2 = 1.0


@dataclass(frozen=True)
class _Style:
    """Ranges and probabilities of a kind of home; lengths in metres, areas in square metres."""

    share: float
    area: tuple[float, float]
    room_area: tuple[float, float]
    closet: float
    corridor: float
    corridor_width: tuple[float, float]
    openness: float
    more_doors: float
    pillars: float
    wall: float = 0.1
    clutter: float = 1.0


STYLES: dict[str, _Style] = {
    "apartment": _Style(0.45, (40, 120), (7, 20), 0.35, 0.6, (0.9, 1.4), 0.35, 0.15, 0.1),
    "house": _Style(0.40, (60, 300), (9, 26), 0.35, 0.55, (1.0, 1.6), 0.35, 0.25, 0.15),
    "office": _Style(0.15, (90, 600), (10, 40), 0.1, 0.95, (1.4, 2.4), 0.2, 0.15, 0.5),
}
"""The kinds of homes that can be made."""


def make_home(seed: int, kind: HomeKind | None = None, *, resolution_m: float = 0.05) -> PartialMap:
    """Make a complete floor plan.

    Parameters
    ----------
    seed : int
        Seed, at least 0. Equal seeds give equal homes.
    kind : {"apartment", "house", "office"} or None
        Kind of home; None draws one.
    resolution_m : float
        Edge of a cell [m], 0.01 to 0.2.

    Returns
    -------
    PartialMap
        Free inside, walls one or more cells thick around everything free, unknown elsewhere. All free cells are
        connected, and nothing is missing (`is_complete`).

    Raises
    ------
    SettingsError
        For a seed, kind or resolution that is not allowed.
    """
    whole = isinstance(seed, (int, np.integer)) and not isinstance(seed, bool) and seed >= 0
    require(whole, "seed", seed, "give a whole number of 0 or more.")
    require(kind is None or kind in STYLES, "kind", kind, f"choose one of {get_args(HomeKind)} or None.")
    require_number("resolution_m", resolution_m, 0.01, 0.2)
    rng = np.random.default_rng(seed)
    style = STYLES[kind or str(rng.choice(list(STYLES), p=[each.share for each in STYLES.values()]))]
    plan = _draw(rng, style)
    while plan is None:
        plan = _draw(rng, style)
    thickness_m = rng.choice([0.0, rng.uniform(0.05, 0.2)])
    angle_deg = float(rng.choice([0.0, rng.uniform(-45, 45)], p=[0.3, 0.7]))
    free, lines = (affinity.rotate(shape, angle_deg, origin=(0, 0)) for shape in plan)
    state = _cells(free, lines, resolution_m, max(1, round(thickness_m / resolution_m)))
    return PartialMap(state, resolution_m, interior_cells=int((state == CellState.FREE).sum()))


def _draw(rng: np.random.Generator, kind: _Style) -> tuple[Polygon, shapely.Geometry] | None:
    """Free area and wall lines of one home; None if too much of it cannot be reached."""
    style = _varied(rng, kind)
    outline = _outline(rng, _log_uniform(rng, style.area))
    rooms = [core for piece in _rooms(rng, outline, style) for core in _cores(piece)]
    rooms, openings = _connected(rng, rooms, style)
    leaves = [_leaf(rng, opening) for opening in openings if opening.length <= DOOR_M[1] and rng.random() < LEAF_SHARE]
    gaps = _union([opening.buffer(0.05, cap_style="flat") for opening in openings])
    lines = _union([room.boundary for room in rooms]).difference(gaps, grid_size=_GRID_M)
    walls = lines.buffer(style.wall / 2, cap_style="flat", join_style="mitre")
    lines, walls = _union([lines, *leaves]), _union([walls, *shapely.buffer(leaves, _NEAR_M)])
    things = [thing for room in rooms for thing in _things(rng, room, walls, openings, style)]
    gaps = _union([opening.buffer(style.wall, cap_style="flat") for opening in openings])
    free = _union([*rooms, gaps]).difference(_union([walls, *things]), grid_size=_GRID_M)
    free = free.buffer(-_SLIVER_M, join_style="mitre").buffer(_SLIVER_M, join_style="mitre")
    walked = _parts(free.buffer(-WALK_M / 2))
    if not walked or walked[0].area < _WALKED_SHARE * sum(part.area for part in walked):
        return None
    return next(part for part in _parts(free) if part.intersects(walked[0])), lines


def _varied(rng: np.random.Generator, style: _Style) -> _Style:
    """Style of one home: larger or smaller rooms, more open, fuller, thicker walls than its kind has on average."""
    scale = float(rng.uniform(0.6, 1.6))
    return replace(
        style,
        room_area=(scale * style.room_area[0], scale * style.room_area[1]),
        openness=style.openness * rng.uniform(0, 2),
        wall=rng.choice([rng.uniform(0.05, 0.2), rng.uniform(0.2, 0.45)]),
        clutter=rng.choice([0.15, rng.uniform(0.3, 2.5)], p=[0.25, 0.75]),
    )


def _union(shapes: Iterable[shapely.Geometry]) -> shapely.Geometry:
    """Union of shapes on a fine grid, where almost equal corners cannot break it."""
    return shapely.union_all(list(shapes), grid_size=_GRID_M)


def _parts(shape: shapely.Geometry) -> list[Polygon]:
    """Polygons of a shape, the largest first."""
    polygons = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"]
    return sorted(polygons, key=lambda part: -part.area)


def _log_uniform(rng: np.random.Generator, between: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(between))))


def _outline(rng: np.random.Generator, area: float) -> Polygon:
    """Outline of a home: a rectangle with corners cut out (L, T, U, Z, chamfers), a turned wing, and bays."""
    width, height = rng.uniform(1.0, 2.0), 1.0
    outline = box(0, 0, width, height)
    corners = [(0, 0), (width, 0), (width, height), (0, height), (width / 2, 0)]
    cut_count = rng.choice([0, 1, 2], p=[0.3, 0.5, 0.2])
    for x, y in rng.permutation(corners)[:cut_count]:
        across, along = rng.uniform(0.2, 0.5, 2) * (width, height)
        notch = box(x - across, y - along, x + across, y + along)
        if x == width / 2:
            notch = affinity.scale(notch, 0.6, 1.0)
        elif rng.random() < 0.2:
            notch = affinity.rotate(notch, rng.uniform(20, 70))
        outline = outline.difference(notch)
    if rng.random() < 0.12:
        wing = box(0, 0, rng.uniform(0.6, 1.0), rng.uniform(0.4, 0.6))
        wing = affinity.rotate(wing, rng.uniform(-50, 50), origin=(0, 0))
        outline = outline.union(affinity.translate(wing, 0.8 * width, 0.3 * height))
    outline = _parts(outline)[0]
    outline = affinity.scale(outline, *[math.sqrt(area / outline.area)] * 2, origin=(0, 0))
    for _ in range(rng.poisson(1.0)):
        place = outline.exterior.interpolate(rng.random(), normalized=True)
        bay = affinity.translate(box(-0.5, -0.5, 0.5, 0.5), place.x, place.y)
        outline = outline.union(affinity.scale(bay, *rng.uniform(0.9, 2.5, 2)))
    return Polygon(outline.exterior)


def _rooms(rng: np.random.Generator, outline: Polygon, style: _Style) -> Iterator[Polygon]:
    """Divide the outline into rooms, often along a corridor, which comes first."""
    rest: shapely.Geometry = outline
    if rng.random() < style.corridor:
        x0, y0, x1, y1 = outline.bounds
        x, y = np.array([x0, y0]) + rng.uniform(0.35, 0.65, 2) * (x1 - x0, y1 - y0)
        half = (rng.uniform(*style.corridor_width) + style.wall) / 2
        reach = rng.choice([1.0, rng.uniform(0.5, 0.9)])
        strips = [
            box(x0, y - half, x0 + reach * (x1 - x0), y + half),
            box(x - half, y0, x + half, y0 + reach * (y1 - y0)),
        ]
        first = int(y1 - y0 > x1 - x0)
        corridor = strips[first].union(strips[1 - first]) if rng.random() < 0.3 else strips[first]
        yield from _parts(outline.intersection(corridor))
        rest = outline.difference(corridor)
    for part in _parts(rest):
        yield from _divide(rng, part, style)


def _divide(rng: np.random.Generator, part: Polygon, style: _Style) -> Iterator[Polygon]:
    """Halve an area across its longer side until its parts are of the size of rooms; carve closets from some."""
    x0, y0, x1, y1 = part.bounds
    long, short = max(x1 - x0, y1 - y0), min(x1 - x0, y1 - y0)
    big = part.area > 1.6 * _log_uniform(rng, style.room_area) or long > 3.5 * short
    if big:
        at = rng.uniform(0.35, 0.65)
    elif part.area > 6 and rng.random() < style.closet:
        at = float(rng.choice([-1, 1]) * rng.uniform(1.0, 1.8) / long) % 1.0
    else:
        yield part
        return
    x, y = x0 + at * (x1 - x0), y0 + at * (y1 - y0)
    cut = LineString([(x, y0 - 99), (x, y1 + 99)] if x1 - x0 > y1 - y0 else [(x0 - 99, y), (x1 + 99, y)])
    if big and rng.random() < 0.12:
        cut = affinity.rotate(cut, rng.uniform(-35, 35), origin=(x, y))
    for piece in _parts(split(part, cut)):
        if big:
            yield from _divide(rng, piece, style)
        else:
            yield piece


def _cores(piece: Polygon) -> list[Polygon]:
    """Parts of a piece that are wide enough for a room; the rest is solid."""
    half_m = DOOR_M[0] / 2
    wide = piece.buffer(-half_m, join_style="mitre").buffer(half_m, join_style="mitre")
    return [core for core in _parts(wide.intersection(piece)) if core.area >= _SMALLEST_ROOM_M2]


def _connected(rng: np.random.Generator, rooms: list[Polygon], style: _Style) -> tuple[list[Polygon], list[LineString]]:
    """Rooms that can be reached, and their openings: those of a random spanning tree, and some more."""
    jamb_m = _JAMB_M + style.wall / 2
    pairs = [(i, j) for i in range(len(rooms)) for j in range(i)]
    walls = [_common_wall(rooms[i], rooms[j]) for i, j in pairs]
    wide = [k for k, wall in enumerate(walls) if wall.length >= DOOR_M[0] + 2 * jamb_m]
    tree = _tree(rng, rooms, [pairs[k] for k in wide])
    doors = [k for k in wide if pairs[k] in tree or rng.random() < style.more_doors]
    degree = np.bincount([room for k in doors for room in pairs[k]], minlength=len(rooms))
    locked = (degree == 0) | ((degree == 1) & (rng.random(len(rooms)) < LOCKED_SHARE))
    if locked.all():
        return rooms[:1], []
    openings = [_opening(rng, walls[k], style, jamb_m) for k in doors if not locked[list(pairs[k])].any()]
    return [room for room, shut in zip(rooms, locked, strict=True) if not shut], openings


def _tree(rng: np.random.Generator, rooms: list[Polygon], pairs: list[tuple[int, int]]) -> set[tuple[int, int]]:
    """Pairs of a random spanning tree of the rooms that goes through corridors where it can."""
    corridor = np.array([room.length**2 > _CORRIDOR_SHAPE * room.area for room in rooms])
    rows, columns = np.array(pairs, dtype=int).reshape(-1, 2).T
    weights = rng.uniform(1, 2, len(pairs)) + 2.0 * ~(corridor[rows] | corridor[columns])
    tree = minimum_spanning_tree(coo_array((weights, (rows, columns)), shape=(len(rooms),) * 2)).tocoo()
    return set(zip(tree.row.tolist(), tree.col.tolist(), strict=True))


def _common_wall(room: Polygon, other: Polygon) -> LineString:
    """Longest straight wall between two rooms; empty if there is none."""
    if room.distance(other) > _NEAR_M:
        return LineString()
    shared = shapely.line_merge(room.boundary.intersection(other.buffer(_NEAR_M)))
    sides = [
        LineString(ends)
        for line in shapely.get_parts(shared)
        if line.geom_type == "LineString"
        for ends in zip(line.coords, line.coords[1:], strict=False)
    ]
    return max(sides, key=lambda side: side.length, default=LineString())


def _opening(rng: np.random.Generator, wall: LineString, style: _Style, jamb_m: float) -> LineString:
    """Part of a wall that is a door, a wide opening, or all of it."""
    room = wall.length - 2 * jamb_m
    if rng.random() < style.openness and room > WIDE_M[0]:
        width = room if rng.random() < 0.4 else rng.uniform(WIDE_M[0], min(room, WIDE_M[1]))
    else:
        width = rng.uniform(DOOR_M[0], min(room, DOOR_M[1]))
    start = jamb_m + rng.choice([0.0, rng.random(), 1.0]) * (room - width)
    return substring(wall, start, start + width)


def _leaf(rng: np.random.Generator, opening: LineString) -> LineString:
    """Door leaf that stands open."""
    hinge = opening.coords[int(rng.integers(2))]
    return affinity.rotate(opening, rng.choice([-1, 1]) * rng.uniform(75, 110), origin=hinge)


def _things(
    rng: np.random.Generator, room: Polygon, walls: Polygon, openings: list[LineString], style: _Style
) -> Iterator[Polygon]:
    """Furniture and pillars of a room that leave a way through it and to its openings."""
    near = [opening for opening in openings if opening.distance(room) < _NEAR_M]
    doorsteps = _union([opening.buffer(WALK_M, cap_style="flat") for opening in near])
    ways = [opening.buffer(1.5 * WALK_M, cap_style="flat") for opening in near]
    left = MultiPolygon(_parts(_union([room, *ways]).difference(walls, grid_size=_GRID_M)))
    things = [_furniture(rng, room) for _ in range(rng.poisson(style.clutter * room.area / 4) if room.area > 4 else 0)]
    if room.area > 20 and rng.random() < style.pillars:
        things += [_place(rng, room, box(-s, -s, s, s)) for s in rng.uniform(0.12, 0.3, int(room.area / 15))]
    for thing in things:
        thing = MultiPolygon(_parts(thing.intersection(room.difference(doorsteps), grid_size=_GRID_M)))
        now = MultiPolygon(_parts(left.difference(thing, grid_size=_GRID_M)))
        walkable = now.buffer(-WALK_M / 2)
        if walkable.geom_type == "Polygon" and not walkable.is_empty:
            left = now
            yield thing


def _place(rng: np.random.Generator, room: Polygon, thing: Polygon) -> Polygon:
    """Put a thing somewhere into the bounds of a room."""
    x0, y0, x1, y1 = room.bounds
    return affinity.translate(thing, rng.uniform(x0, x1), rng.uniform(y0, y1))


def _furniture(rng: np.random.Generator, room: Polygon) -> Polygon:
    """Piece of furniture beside a wall or in the middle of a room, plain, round or with chairs around it."""
    half_width, half_depth = rng.uniform(0.2, 1.0), rng.uniform(0.2, 0.6)
    thing = box(-half_width, -half_depth, half_width, half_depth)
    if rng.random() < 0.2:
        thing = affinity.scale(shapely.Point(0, 0).buffer(1.0), half_width, half_depth)
    if rng.random() < 0.5:
        spots = [thing.exterior.interpolate(where, normalized=True) for where in rng.random(rng.integers(2, 6))]
        thing = _union([thing, *(spot.buffer(rng.uniform(0.12, 0.3), quad_segs=2) for spot in spots)])
    if rng.random() < 0.35:
        return _place(rng, room, affinity.rotate(thing, rng.choice([0, 90, rng.uniform(0, 180)], p=[0.4, 0.4, 0.2])))
    along = rng.uniform(0, room.exterior.length)
    here, there = (room.exterior.interpolate(at % room.exterior.length) for at in (along, along + 0.05))
    angle = math.atan2(there.y - here.y, there.x - here.x)
    return affinity.translate(affinity.rotate(thing, angle, use_radians=True), here.x, here.y)


def _cells(free: Polygon, lines: shapely.Geometry, resolution_m: float, wall_cells: int) -> NDArray[np.uint8]:
    """Put a plan onto cells: free where their centres are in the free area and no wall line touches them."""
    x0, y0, x1, y1 = free.bounds
    margin = _MARGIN_M + wall_cells * resolution_m
    x, y = x0 - margin, y0 - margin
    shape = math.ceil((y1 + margin - y) / resolution_m), math.ceil((x1 + margin - x) / resolution_m)
    grid = {"out_shape": shape, "transform": Affine(resolution_m, 0, x, 0, resolution_m, y), "dtype": np.uint8}
    inside = rasterize([free], **grid).astype(bool)
    inside &= ~rasterize([lines], all_touched=True, **grid).astype(bool)
    labels, _ = ndimage.label(inside)
    inside = labels == np.argmax(np.bincount(labels[inside]))
    beside = ndimage.binary_dilation(inside, np.ones((3, 3)), iterations=wall_cells)
    return np.where(inside, CellState.FREE, np.where(beside, CellState.WALL, CellState.UNKNOWN)).astype(np.uint8)
