"""Procedural homes: complete floor plans from a seed.

A plan consists of polygons in metres: outline, rooms, openings along a spanning tree of the rooms and a few more, and
furniture that leaves room to walk. It is rotated and put onto cells, where walls and furniture swell, as on robots'
maps. `docs/worlds.md` compares the plans with real homes.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from shapely import LineString, Polygon, affinity, box
from shapely.ops import split, substring

from sionna_partial.arrays import Bools, Floats, States, largest_part
from sionna_partial.checks import is_whole, require, require_bool, require_choice, require_number
from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.resources import optional_packages
from sionna_partial.settings import HomeKind
from sionna_partial.worlds.buildings import (
    GRID_M,
    NEAR_M,
    LayoutMaker,
    Rng,
    floor_layout,
    furnish,
    hall_layout,
    log_uniform,
    parts_of,
    union_of,
    warehouse_layout,
)

RESOLUTION_M = 0.05

LARGE_RESOLUTION_M = 0.1

WALK_M = 0.5
"""Width that walls and furniture leave to walk through [m]."""

DOOR_M = (0.8, 1.0)

WIDE_M = (1.2, 2.5)

LOCKED_FRACTION = 0.25
"""Mean fraction of dead-end rooms that are locked."""

SHUT_FRACTION = 0.9
"""Fraction of homes whose locked rooms are free, without a door, as on scans."""

SHUT_AREA = 0.2
"""Largest area of locked free rooms, relative to the reachable area."""

LEAF_FRACTION = 0.2
"""Fraction of the doors whose leaf is open into a room."""

CLOSED_DOORS = (0.3, 0.5, 0.2)
"""Fractions of office floors with no, some, and all doors closed, as on real plans."""

_MARGIN_M = 0.3
_JAMB_M = 0.05
_CORRIDOR_SHAPE = 25
_SLIVER_M = 0.1
_WALKED_FRACTION = 0.97
_SMALLEST_ROOM_M2 = 1.0
_SMALLEST_M2 = 3.0
_WAVES = 12
_AISLE_M = (1.6, 4.5)
_WAVE_PER_M = 0.5


@dataclass(frozen=True)
class _Style:
    """Ranges and probabilities of a kind of home, or values of one home [m, m2]."""

    frequency: float
    area: tuple[float, float]
    room_area: tuple[float, float]
    closet: float
    corridor: float
    corridor_width: tuple[float, float]
    openness: float
    more_doors: float
    pillars: float
    locked: float = LOCKED_FRACTION
    wall: float = 0.1
    clutter: float = 1.0
    swelling: float = 0.0
    raggedness: float = 0.0
    layout: LayoutMaker | None = None
    closed_doors: bool = False

    @property
    def walk(self) -> float:
        return WALK_M + 2 * self.swelling


STYLES: dict[str, _Style] = {
    "apartment": _Style(0.5, (30, 150), (7, 20), 0.35, 0.5, (0.9, 1.4), 0.4, 0.15, 0.1),
    "house": _Style(0.35, (40, 230), (9, 26), 0.35, 0.5, (1.0, 1.6), 0.4, 0.25, 0.15),
    "office": _Style(0.15, (90, 600), (10, 40), 0.1, 0.95, (1.4, 2.4), 0.2, 0.15, 0.5, 0.1, clutter=0.5),
    "floor": _Style(
        *(0, (600, 6000), (30, 100), 0, 1, _AISLE_M, 0.1, 0.05, 0, 0.1, 0.1, 0.03),
        layout=floor_layout,
        closed_doors=True,
    ),
    "hall": _Style(0, (200, 6000), (12, 40), 0, 0, _AISLE_M, 0.2, 0.3, 0, 0.1, 0.1, 0.02, layout=hall_layout),
    "warehouse": _Style(0, (300, 6000), (12, 40), 0, 0, _AISLE_M, 0.2, 0.3, 0, 0.1, 0.1, 0.01, layout=warehouse_layout),
}
"""Kinds of homes; areas are areas of the outline. `frequency` is the probability with kind=None."""


def make_home(
    seed: int, kind: HomeKind | None = None, *, resolution_m: float | None = None, locked_rooms: bool = True
) -> PartialMap:
    """Make a complete floor plan.

    Parameters
    ----------
    seed : int
        Seed, at least 0. Equal seeds give equal homes.
    kind : {"apartment", "house", "office", "floor", "hall", "warehouse"} or None
        None draws one of the first three. The others are large, up to 100 x 60 m: an office floor, a production hall
        with machines, a warehouse with shelves.
    resolution_m : float or None
        Edge of a cell [m], 0.01 to 0.2; by default 0.05, or 0.1 for the large kinds.
    locked_rooms : bool
        Allow free rooms that cannot be reached, also behind closed doors.

    Returns
    -------
    PartialMap
        Complete (`is_complete`): free inside, with walls around, unknown outside and in furniture. Free cells are
        connected, except in locked rooms. Walls are at least one cell thick and meet at least at corners.

    Raises
    ------
    SettingsError
        For another kind, or a seed or resolution out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(3, "apartment")
    >>> home.is_complete, home.resolution_m
    (True, 0.05)
    """
    require(is_whole(seed), "seed", seed, "give a whole number of 0 or more.")
    require_bool("locked_rooms", locked_rooms)
    if kind is not None:
        require_choice("kind", kind, STYLES)
    if resolution_m is not None:
        require_number("resolution_m", resolution_m, 0.01, 0.2)
    rng = np.random.default_rng(seed)
    style = STYLES[kind or str(rng.choice(list(STYLES), p=[style.frequency for style in STYLES.values()]))]
    resolution_m = resolution_m or (LARGE_RESOLUTION_M if style.layout else RESOLUTION_M)
    while (plan := _draw(rng, style, locked_rooms=locked_rooms)) is None:
        pass
    thickness_m = rng.choice([0.0, rng.uniform(0.13, 0.25)], p=[0.85, 0.15])
    corners = bool(thickness_m > 0 or rng.random() < 0.3)
    angle_deg = float(rng.choice([0.0, rng.uniform(-45, 45)], p=[0.3, 0.7]))
    names = ("free", "shut", "lines", "doors")
    shapes = {name: affinity.rotate(getattr(plan, name), angle_deg, (0, 0)) for name in names}
    plan = replace(plan, **shapes)
    state = _cells(plan, resolution_m, max(1, round(thickness_m / resolution_m)), corners)
    return PartialMap(state, resolution_m, interior_cells=int((state == CellState.FREE).sum()))


@dataclass(frozen=True)
class _Plan:
    """Free area, locked rooms, wall lines, closed doors, swelling [m] and waves of a home."""

    free: Polygon
    shut: shapely.GeometryCollection
    lines: shapely.Geometry
    doors: shapely.Geometry
    swelling_m: float
    raggedness: float
    waves: Floats


def _draw(rng: Rng, kind: _Style, *, locked_rooms: bool) -> _Plan | None:
    style = _varied(rng, kind)
    area_m2 = log_uniform(rng, style.area)
    fixtures: list[Polygon] = []
    if style.layout is None:
        pieces: Iterable[Polygon] = _rooms(rng, _outline(rng, area_m2), style)
    else:
        pieces, fixtures = style.layout(rng, area_m2, log_uniform(rng, style.room_area))
    rooms = [core for piece in pieces for core in _cores(piece)]
    rooms, openings, locked = _connected(rng, rooms, style)
    leaves = []
    for opening in openings:
        if opening.length <= DOOR_M[1] and rng.random() < LEAF_FRACTION:
            hinge = opening.coords[int(rng.integers(2))]
            leaves.append(affinity.rotate(opening, rng.choice([-1, 1]) * rng.uniform(75, 110), origin=hinge))
    gaps = union_of([opening.buffer(0.05, cap_style="flat") for opening in openings])
    lines = union_of([room.boundary for room in rooms]).difference(gaps, grid_size=GRID_M)
    walls = lines.buffer(style.wall / 2, cap_style="flat", join_style="mitre")
    lines, walls = union_of([lines, *leaves]), union_of([walls, *shapely.buffer(leaves, NEAR_M)])
    doorsteps = union_of([opening.buffer(2 * style.walk, cap_style="flat") for opening in openings])
    fixtures = parts_of(union_of(fixtures).difference(doorsteps, grid_size=GRID_M))
    fill = {"walk_m": style.walk, "clutter": style.clutter, "pillars": style.pillars}
    taken = union_of([walls, *fixtures])
    things = [thing for room in rooms for thing in furnish(rng, room, taken, openings, **fill)] + fixtures
    gaps = union_of([opening.buffer(style.wall, cap_style="flat") for opening in openings])
    free = union_of([*rooms, gaps]).difference(union_of([walls, *things]), grid_size=GRID_M)
    free = free.buffer(-_SLIVER_M, join_style="mitre").buffer(_SLIVER_M, join_style="mitre")
    walked = parts_of(free.buffer(-style.walk / 2))
    if not walked or walked[0].area < max(_SMALLEST_M2, _WALKED_FRACTION * sum(part.area for part in walked)):
        return None
    free = next(part for part in parts_of(free) if part.intersects(walked[0]))
    waves = rng.normal(size=(_WAVES, 3))
    shut = _shut(locked if locked_rooms and rng.spawn(1)[0].random() < SHUT_FRACTION else [], free, style.wall)
    closed = _closed(rng.spawn(1)[0], openings) if locked_rooms and style.closed_doors else []
    return _Plan(free, shut, lines, shapely.MultiLineString(closed), style.swelling, style.raggedness, waves)


def _closed(rng: Rng, openings: list[LineString]) -> list[LineString]:
    fraction = rng.choice([0.0, rng.random(), 1.0], p=CLOSED_DOORS)
    return [opening for opening in openings if opening.length <= DOOR_M[1] and rng.random() < fraction]


def _shut(locked: list[Polygon], free: Polygon, wall_m: float) -> shapely.GeometryCollection:
    apart = free.buffer(wall_m, join_style="mitre")
    parts = [part for room in locked for part in parts_of(room.difference(apart, grid_size=GRID_M))]
    parts.sort(key=shapely.area)
    few = np.cumsum(shapely.area(parts)) <= SHUT_AREA * free.area
    return shapely.GeometryCollection([part for part, fits in zip(parts, few, strict=True) if fits])


def _varied(rng: Rng, style: _Style) -> _Style:
    scale = log_uniform(rng, (0.45, 3.5))
    return replace(
        style,
        room_area=(scale * style.room_area[0], scale * style.room_area[1]),
        openness=style.openness * 3 * rng.random() ** 2,
        more_doors=style.more_doors * rng.uniform(0, 2),
        locked=style.locked * rng.uniform(0, 2),
        wall=rng.choice([rng.uniform(0.05, 0.2), rng.uniform(0.2, 0.4)], p=[0.7, 0.3]),
        clutter=style.clutter * rng.choice([rng.uniform(0, 0.5), rng.uniform(0.5, 6.0)], p=[0.25, 0.75]),
        swelling=rng.choice([0.0, rng.uniform(0.04, 0.14)], p=[0.15, 0.85]),
        raggedness=rng.choice([0.0, rng.uniform(0.0, 0.7)], p=[0.3, 0.7]),
    )


def _outline(rng: Rng, area: float) -> Polygon:
    """Draw a rectangle with corners cut out (L, T, U, Z, chamfers), a turned wing, and bays."""
    width, height = rng.uniform(1.0, 2.0), 1.0
    outline = box(0, 0, width, height)
    corners = [(0, 0), (width, 0), (width, height), (0, height), (width / 2, 0)]
    cut_count = rng.choice([0, 1, 2, 3], p=[0.2, 0.4, 0.25, 0.15])
    for x, y in rng.permutation(corners)[:cut_count]:
        across, along = rng.uniform(0.2, 0.5, 2) * (width, height)
        notch = box(x - across, y - along, x + across, y + along)
        if x == width / 2:
            notch = affinity.scale(notch, 0.6, 1.0)
        elif rng.random() < 0.2:
            notch = affinity.rotate(notch, rng.uniform(20, 70))
        outline = outline.difference(notch)
    if rng.random() < 0.3:
        wing = box(0, 0, rng.uniform(0.5, 1.0), rng.uniform(0.2, 0.6))
        wing = affinity.rotate(wing, rng.choice([0, 90, rng.uniform(-50, 50)]), origin=(0, 0))
        outline = outline.union(affinity.translate(wing, 0.8 * width, 0.3 * height))
    outline = parts_of(outline)[0]
    outline = affinity.scale(outline, *[math.sqrt(area / outline.area)] * 2, origin=(0, 0))
    for _ in range(rng.poisson(2.0)):
        spot = outline.exterior.interpolate(rng.random(), normalized=True)
        bay = affinity.translate(box(-0.5, -0.5, 0.5, 0.5), spot.x, spot.y)
        outline = outline.union(affinity.scale(bay, *rng.uniform(0.9, 2.5, 2)))
    return Polygon(outline.exterior)


def _rooms(rng: Rng, outline: Polygon, style: _Style) -> Iterator[Polygon]:
    rest: shapely.Geometry = outline
    if rng.random() < style.corridor:
        x0, y0, x1, y1 = outline.bounds
        x, y = np.array([x0, y0]) + rng.uniform(0.35, 0.65, 2) * (x1 - x0, y1 - y0)
        half = (rng.uniform(*style.corridor_width) + style.wall) / 2
        fraction = rng.choice([1.0, rng.uniform(0.5, 0.9)])
        along_x = box(x0, y - half, x0 + fraction * (x1 - x0), y + half)
        along_y = box(x - half, y0, x + half, y0 + fraction * (y1 - y0))
        strip, other = (along_y, along_x) if y1 - y0 > x1 - x0 else (along_x, along_y)
        corridor = strip.union(other) if rng.random() < 0.3 else strip
        yield from parts_of(outline.intersection(corridor))
        rest = outline.difference(corridor)
    for part in parts_of(rest):
        yield from _divide(rng, part, style)


def _divide(rng: Rng, part: Polygon, style: _Style) -> Iterator[Polygon]:
    """Halve an area across its longer side to sizes of rooms; carve closets from some."""
    x0, y0, x1, y1 = part.bounds
    long, short = max(x1 - x0, y1 - y0), min(x1 - x0, y1 - y0)
    big = part.area > 1.6 * log_uniform(rng, style.room_area) or long > 3.5 * short
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
    for piece in parts_of(split(part, cut)):
        if big:
            yield from _divide(rng, piece, style)
        else:
            yield piece


def _cores(piece: Polygon) -> list[Polygon]:
    half_m = DOOR_M[0] / 2
    wide = piece.buffer(-half_m, join_style="mitre").buffer(half_m, join_style="mitre")
    return [core for core in parts_of(wide.intersection(piece)) if core.area >= _SMALLEST_ROOM_M2]


def _connected(rng: Rng, rooms: list[Polygon], style: _Style) -> tuple[list[Polygon], list[LineString], list[Polygon]]:
    """Return connected rooms, their openings, and locked rooms.

    Openings follow a random spanning tree, preferably through corridors, with some more.
    """
    jamb_m = _JAMB_M + style.wall / 2
    pairs = [(i, j) for i in range(len(rooms)) for j in range(i)]
    walls = [_common_wall(rooms[i], rooms[j]) for i, j in pairs]
    wide = [k for k, wall in enumerate(walls) if wall.length >= DOOR_M[0] + 2 * jamb_m]
    corridor = np.array([room.length**2 > _CORRIDOR_SHAPE * room.area for room in rooms])
    rows, columns = np.array([pairs[k] for k in wide], dtype=int).reshape(-1, 2).T
    weights = rng.uniform(1, 2, len(wide)) + 2.0 * ~(corridor[rows] | corridor[columns])
    tree = minimum_spanning_tree(coo_array((weights, (rows, columns)), shape=(len(rooms),) * 2)).tocoo()
    linked = set(zip(tree.row.tolist(), tree.col.tolist(), strict=True))
    doors = [k for k in wide if pairs[k] in linked or rng.random() < style.more_doors]
    degree = np.bincount([room for k in doors for room in pairs[k]], minlength=len(rooms))
    locked = (degree == 0) | ((degree == 1) & (rng.random(len(rooms)) < style.locked))
    if locked.all():
        return rooms[:1], [], rooms[1:]
    openings = [_opening(rng, walls[k], style, jamb_m) for k in doors if not locked[list(pairs[k])].any()]
    open_rooms, locked_rooms = ([rooms[k] for k in np.flatnonzero(locked == shut)] for shut in (False, True))
    return open_rooms, openings, locked_rooms


def _common_wall(room: Polygon, other: Polygon) -> LineString:
    if room.distance(other) > NEAR_M:
        return LineString()
    shared = shapely.line_merge(room.boundary.intersection(other.buffer(NEAR_M)))
    lines = [line.coords for line in shapely.get_parts(shared) if line.geom_type == "LineString"]
    sides = [LineString(ends) for line in lines for ends in pairwise(line)]
    return max(sides, key=lambda side: side.length, default=LineString())


def _opening(rng: Rng, wall: LineString, style: _Style, jamb_m: float) -> LineString:
    room = wall.length - 2 * jamb_m
    if rng.random() < style.openness and room > WIDE_M[0]:
        width = room if rng.random() < 0.4 else rng.uniform(WIDE_M[0], min(room, WIDE_M[1]))
    else:
        width = rng.uniform(DOOR_M[0], min(room, DOOR_M[1]))
    start = jamb_m + rng.choice([0.0, rng.random(), 1.0]) * (room - width)
    return substring(wall, start, start + width)


def _cells(plan: _Plan, resolution_m: float, wall_cells: int, corners: bool) -> States:
    """Rasterise a plan: cells are free with centres in the free area, away from wall lines."""
    with optional_packages():
        from rasterio.features import rasterize
        from rasterio.transform import Affine
    x0, y0, x1, y1 = shapely.total_bounds([plan.free, plan.shut])
    margin = _MARGIN_M + wall_cells * resolution_m
    x, y = x0 - margin, y0 - margin
    shape = math.ceil((y1 + margin - y) / resolution_m), math.ceil((x1 + margin - x) / resolution_m)
    grid = {"out_shape": shape, "transform": Affine(resolution_m, 0, x, 0, resolution_m, y), "dtype": np.uint8}
    lines = rasterize([plan.lines], all_touched=True, **grid).astype(bool)
    inside = rasterize([plan.free], **grid).astype(bool) & ~lines
    inside = largest_part(inside & ~_swollen(inside, resolution_m, plan))
    if not plan.doors.is_empty:
        inside &= ~rasterize([plan.doors], all_touched=True, **grid).astype(bool)
    around = ndimage.generate_binary_structure(2, 1 + corners)
    if not plan.shut.is_empty:
        walls = rasterize([room.boundary for room in plan.shut.geoms], all_touched=True, **grid).astype(bool)
        shut = rasterize(plan.shut.geoms, **grid).astype(bool) & ~lines & ~walls
        inside |= shut & ~_swollen(shut, resolution_m, plan) & ~ndimage.binary_dilation(inside, around)
    beside = ndimage.binary_dilation(inside, around, iterations=wall_cells)
    return np.where(inside, CellState.FREE, np.where(beside, CellState.WALL, CellState.UNKNOWN)).astype(np.uint8)


def _swollen(inside: Bools, resolution_m: float, plan: _Plan) -> Bools:
    y, x = np.indices(inside.shape) * resolution_m
    wave = np.zeros(inside.shape)
    for per_x, per_y, turns in plan.waves:
        wave += np.sin(2 * math.pi * (_WAVE_PER_M * (per_x * x + per_y * y) + turns))
    fraction = 1 - plan.raggedness * (0.5 + 0.5 * np.clip(wave / math.sqrt(2 * _WAVES), -1, 1))
    distance_m = (ndimage.distance_transform_edt(inside) - 0.5) * resolution_m
    return distance_m < plan.swelling_m * fraction
