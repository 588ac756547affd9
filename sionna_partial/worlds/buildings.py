"""Layouts of large buildings (office floors, halls, warehouses), and furniture of rooms."""

import math
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
import shapely
from shapely import LineString, MultiPolygon, Polygon, affinity, box
from shapely.ops import split

GRID_M = 1e-5
"""Grid on which shapes are joined and cut [m], against almost equal corners."""

NEAR_M = 0.01
"""Distance within which shapes touch [m]."""

Rng = np.random.Generator

_EMPTY_ROOM_M2 = 2.5
_PILLARED_ROOM_M2 = 20.0

_FREQUENCIES = (0.3, 0.25, 0.15, 0.1, 0.2)

LARGEST_M = (100.0, 60.0)
"""Length and width of the largest building [m]."""

_BAND_M = (4.5, 10.5)

_CORRIDOR_M = (1.6, 4.5)

_BROAD_M = 11.0

_MODULE_M = (2.4, 4.0)

_HALL_M2 = (60.0, 1200.0)

_SERVICE_M2 = 20.0

_COLUMNED_ROOM_M2 = 120.0

_BAY_M = 2.4

_FAR_M = 1e3

Fill = Callable[[Rng, Polygon], Iterator[Polygon]]


def union_of(shapes: Iterable[shapely.Geometry]) -> shapely.Geometry:
    return shapely.union_all(list(shapes), grid_size=GRID_M)


def parts_of(shape: shapely.Geometry) -> list[Polygon]:
    """Return the polygons of a shape, the largest first."""
    polygons = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"]
    return sorted(polygons, key=lambda part: -part.area)


def log_uniform(rng: Rng, between: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(between))))


def furnish(
    rng: Rng,
    room: Polygon,
    walls: shapely.Geometry,
    openings: list[LineString],
    *,
    walk_m: float,
    clutter: float,
    pillars: float,
) -> Iterator[Polygon]:
    """Yield furniture and pillars (they may overlap) that leave a room and its doors passable.

    `room` is the outline through the middle of its walls, `walls` includes door leaves. `clutter` is the mean number
    of trials for every 4 m2, `pillars` the probability of pillars in a large room.
    """
    near = [opening for opening in openings if opening.distance(room) < NEAR_M]
    doorsteps = union_of([opening.buffer(walk_m, cap_style="flat") for opening in near])
    passages = [opening.buffer(1.5 * walk_m, cap_style="flat") for opening in near]
    left = MultiPolygon(parts_of(union_of([room, *passages]).difference(walls, grid_size=GRID_M)))
    count = rng.poisson(clutter * room.area / 4) if room.area > _EMPTY_ROOM_M2 else 0
    things = [_furniture(rng, room) for _ in range(count)]
    if room.area > _PILLARED_ROOM_M2 and rng.random() < pillars:
        things += [_place(rng, room, box(-s, -s, s, s)) for s in rng.uniform(0.12, 0.3, int(room.area / 15))]
    for thing in things:
        thing = MultiPolygon(parts_of(thing.intersection(room.difference(doorsteps), grid_size=GRID_M)))
        now = MultiPolygon(parts_of(left.difference(thing, grid_size=GRID_M)))
        walkable = now.buffer(-walk_m / 2)
        if walkable.geom_type == "Polygon" and not walkable.is_empty:
            left = now
            yield thing


def _furniture(rng: Rng, room: Polygon) -> Polygon:
    make, at_wall = _KINDS[int(rng.choice(len(_KINDS), p=_FREQUENCIES))]
    thing = make(rng)
    if rng.random() < 0.3:
        spots = [thing.exterior.interpolate(where, normalized=True) for where in rng.random(rng.integers(2, 6))]
        thing = union_of([thing, *(spot.buffer(rng.uniform(0.12, 0.35), quad_segs=2) for spot in spots)])
    if rng.random() >= at_wall:
        return _place(rng, room, affinity.rotate(thing, rng.choice([0, 90, rng.uniform(0, 180)], p=[0.4, 0.4, 0.2])))
    side = np.array(room.exterior.coords)[:, :2]
    lengths_m = np.linalg.norm(np.diff(side, axis=0), axis=1)
    k = int(rng.choice(len(lengths_m), p=lengths_m / lengths_m.sum()))
    half_m = min(thing.bounds[2], lengths_m[k] / 2)
    along_m = rng.choice([half_m, lengths_m[k] - half_m, rng.uniform(0, lengths_m[k])])
    (x, y), (dx, dy) = side[k], (side[k + 1] - side[k]) / lengths_m[k]
    turned = affinity.rotate(thing, math.atan2(dy, dx), origin=(0, 0), use_radians=True)
    return affinity.translate(turned, x + along_m * dx, y + along_m * dy)


def _place(rng: Rng, room: Polygon, thing: Polygon) -> Polygon:
    x0, y0, x1, y1 = room.bounds
    return affinity.translate(thing, rng.uniform(x0, x1), rng.uniform(y0, y1))


def _block(rng: Rng, half_width: tuple[float, float], depth: tuple[float, float]) -> Polygon:
    half_width_m, depth_m = rng.uniform(*half_width), rng.uniform(*depth)
    thing = box(-half_width_m, -depth_m, half_width_m, depth_m)
    if rng.random() < 0.25:
        arm_m = rng.uniform(0.3, min(half_width_m, 0.9))
        side = rng.choice([-1.0, 1.0])
        arm = box(0, -2 * depth_m, arm_m, 2 * depth_m)
        thing = thing.union(affinity.translate(affinity.scale(arm, side, origin=(0, 0)), -side * half_width_m, 0))
    return thing


def _heap(rng: Rng) -> Polygon:
    """Return an irregular star, as plants, chairs and piles in scans."""
    count = int(rng.integers(5, 9))
    angle = np.sort(rng.uniform(0, 1 / count, count) + np.arange(count) / count) * 2 * math.pi
    radius = rng.uniform(0.2, 0.5) * rng.uniform(0.6, 1.8, count)
    return Polygon(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))


_KINDS: tuple[tuple[Callable[[Rng], Polygon], float], ...] = (
    (lambda rng: _block(rng, (0.6, 2.0), (0.35, 0.7)), 1.0),  # shelves, kitchens, wardrobes
    (lambda rng: _block(rng, (0.4, 1.0), (0.8, 2.0)), 1.0),  # beds, sofas, desks
    (lambda rng: _block(rng, (0.3, 1.0), (0.2, 0.5)), 0.2),  # tables
    (lambda rng: affinity.scale(shapely.Point(0, 0).buffer(1.0, quad_segs=4), *rng.uniform(0.25, 0.8, 2)), 0.3),
    (_heap, 0.6),
)
"""Drawing functions, and the probability of a place at a wall."""


class Layout(NamedTuple):
    """Rooms, through the middle of their walls, and columns, machines and shelves in them [m]."""

    rooms: list[Polygon]
    fixtures: list[Polygon]


LayoutMaker = Callable[[Rng, float, float], Layout]
"""Draws a layout from the area of the building and of a typical small room [m2]."""


def floor_layout(rng: Rng, area_m2: float, room_m2: float) -> Layout:
    """Draw an office floor: rooms along one or several corridors, with large rooms and services."""
    length_m, width_m = _sides(rng, area_m2, (1.4, 4.0))
    outline = _notched(rng, box(0, 0, length_m, width_m))
    across, services = _corridors(rng, length_m, width_m)
    corridor = union_of(across).intersection(outline)
    rest = outline.difference(corridor)
    rooms = _sections(rng, corridor)
    for service in services:
        small = [room for part in parts_of(rest.intersection(service)) for room in _halved(rng, part, _SERVICE_M2)]
        rooms += [room for room in small if rng.random() < 0.8]  # the others are shafts
        rest = rest.difference(service)
    west, _, east, _ = corridor.bounds
    slabs = [box(x0, -_FAR_M, x1, _FAR_M) for x0, x1 in ((-_FAR_M, west), (west, east), (east, _FAR_M))]
    for part in [part for slab in slabs for part in parts_of(rest.intersection(slab))]:
        x0, y0, x1, y1 = part.bounds
        if min(x1 - x0, y1 - y0) > _BROAD_M:
            rooms += _halved(rng, part, log_uniform(rng, _HALL_M2))
        else:
            rooms += _row(rng, part, room_m2)
    return Layout(rooms, _columns(rng, rooms, 0.5))


def _hall_layout(
    rng: Rng, area_m2: float, room_m2: float, *, hall_fraction: tuple[float, float], fill: Fill, columned: float
) -> Layout:
    length_m, width_m = _sides(rng, area_m2, (1.0, 3.0))
    halls, offices = _hall_and_offices(rng, _notched(rng, box(0, 0, length_m, width_m)), room_m2)
    halls = [room for hall in halls for room in _halved(rng, hall, area_m2 * log_uniform(rng, hall_fraction))]
    things = [thing for hall in halls for thing in fill(rng, hall)]
    return Layout(halls + offices, _columns(rng, halls, columned) + things)


def _sides(rng: Rng, area_m2: float, aspect: tuple[float, float]) -> tuple[float, float]:
    length_m = min(LARGEST_M[0], math.sqrt(area_m2 * log_uniform(rng, aspect)))
    return length_m, min(LARGEST_M[1], area_m2 / length_m)


def _notched(rng: Rng, outline: Polygon) -> Polygon:
    _, _, x1, y1 = outline.bounds
    for x, y in rng.permutation([(0, 0), (x1, 0), (x1, y1), (0, y1)])[: rng.choice(3, p=[0.6, 0.3, 0.1])]:
        across_m, along_m = rng.uniform(0.1, 0.4, 2) * (x1, y1)
        outline = outline.difference(box(x - across_m, y - along_m, x + across_m, y + along_m))
    return parts_of(outline)[0]


def _corridors(rng: Rng, length_m: float, width_m: float) -> tuple[list[Polygon], list[Polygon]]:
    wide_m = log_uniform(rng, _CORRIDOR_M)
    ends = [rng.choice([0.0, rng.uniform(3.0, 8.0)]) for _ in range(2)]
    if width_m > 2 * (_BAND_M[0] + wide_m) + _BROAD_M:
        deep_m = [rng.uniform(_BAND_M[0], min(_BAND_M[1], (width_m - _BROAD_M) / 2 - wide_m)) for _ in range(2)]
        low, high = deep_m[0], width_m - deep_m[1] - wide_m
    elif width_m > wide_m + 2 * _BAND_M[0]:
        low = high = rng.uniform(max(0.35 * (width_m - wide_m), _BAND_M[0]), 0.5 * (width_m - wide_m))
    else:
        low = high = 0.0
    along = [box(ends[0], y, length_m - ends[1], y + wide_m) for y in {low, high}]
    across, services = [], []
    for x in rng.uniform(0.1, 0.9, rng.poisson(length_m / 40) + (low < high)) * length_m:
        reach = (low, high) if low < high else [(0, high), (low, width_m)][int(rng.integers(2))]
        narrow_m = rng.uniform(min(1.6, wide_m), wide_m)
        across.append(box(x, reach[0], x + narrow_m, reach[1] + wide_m))
        if rng.random() < 0.5:
            services.append(box(x + narrow_m, reach[0], x + narrow_m + rng.uniform(3.0, 12.0), reach[1] + wide_m))
    return along + across, services


def _sections(rng: Rng, corridor: shapely.Geometry) -> list[Polygon]:
    x0, y0, x1, y1 = corridor.bounds
    for x in rng.uniform(x0, x1, rng.choice(3, p=[0.6, 0.25, 0.15])):
        cut = LineString([(x, y0 - 1), (x, y1 + 1)])
        pieces = [piece for part in parts_of(corridor) for piece in parts_of(split(part, cut))]
        corridor = shapely.GeometryCollection(pieces)
    return parts_of(corridor)


def _row(rng: Rng, part: Polygon, room_m2: float) -> Iterator[Polygon]:
    """Divide a band into rooms, of multiples of one module in width; some have an anteroom."""
    x0, y0, x1, y1 = part.bounds
    upright = y1 - y0 > x1 - x0
    start, end, deep_m = (y0, y1, x1 - x0) if upright else (x0, x1, y1 - y0)
    module_m = rng.uniform(*_MODULE_M)
    while start < end:
        room_m = module_m * max(1, round(room_m2 / deep_m * rng.lognormal(0.0, 0.5) / module_m))
        stop = start + room_m if end - start - room_m >= module_m else end
        slab = box(-_FAR_M, start, _FAR_M, stop) if upright else box(start, -_FAR_M, stop, _FAR_M)
        for room in parts_of(part.intersection(slab)):
            yield from _halved(rng, room, room.area / 2) if deep_m > 6 and rng.random() < 0.1 else [room]
        start = stop


def _halved(rng: Rng, part: Polygon, largest_m2: float) -> Iterator[Polygon]:
    if part.area <= largest_m2:
        yield part
        return
    x0, y0, x1, y1 = part.bounds
    x, y = x0 + rng.uniform(0.3, 0.7) * (x1 - x0), y0 + rng.uniform(0.3, 0.7) * (y1 - y0)
    half = box(-_FAR_M, -_FAR_M, x, _FAR_M) if x1 - x0 > y1 - y0 else box(-_FAR_M, -_FAR_M, _FAR_M, y)
    for piece in (*parts_of(part.intersection(half)), *parts_of(part.difference(half))):
        yield from _halved(rng, piece, largest_m2)


def _hall_and_offices(rng: Rng, outline: Polygon, room_m2: float) -> tuple[list[Polygon], list[Polygon]]:
    x0, y0, x1, y1 = outline.bounds
    if rng.random() < 0.3:
        return [outline], []
    deep_m = rng.uniform(3.0, 7.0)
    strip = box(x0, y0, x1, y0 + deep_m) if rng.random() < 0.5 else box(x0, y0, x0 + deep_m, y1)
    strip = affinity.scale(strip, *rng.choice([1.0, rng.uniform(0.3, 0.9)], 2), origin=(x0, y0))
    offices = [room for part in parts_of(outline.intersection(strip)) for room in _row(rng, part, room_m2)]
    return parts_of(outline.difference(strip)), offices


def _columns(rng: Rng, rooms: list[Polygon], probability: float) -> list[Polygon]:
    if rng.random() >= probability:
        return []
    large = union_of([room.buffer(-1.0) for room in rooms if room.area > _COLUMNED_ROOM_M2])
    half_m, apart_m, start_m = rng.uniform(0.12, 0.4), rng.uniform(4.0, 12.0, 2), rng.uniform(0.0, 12.0, 2)
    x, y = np.meshgrid(*map(np.arange, start_m, LARGEST_M, apart_m))
    inside = shapely.contains_xy(large, x, y)
    return list(shapely.box(x - half_m, y - half_m, x + half_m, y + half_m)[inside])


def _machines(rng: Rng, hall: Polygon) -> Iterator[Polygon]:
    clear_m = rng.uniform(0.9, 2.5)
    placed: list[Polygon] = []
    x0, y0, x1, y1 = hall.bounds
    for _ in range(rng.poisson(hall.area / log_uniform(rng, (15.0, 300.0)))):
        x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
        if rng.random() < 0.15:
            thing = shapely.Point(x, y).buffer(rng.uniform(0.3, 2.0), quad_segs=4)
        else:
            long_m, deep_m = log_uniform(rng, (0.3, 3.5)), log_uniform(rng, (0.3, 1.5))
            thing = affinity.rotate(box(x - long_m, y - deep_m, x + long_m, y + deep_m), rng.choice([0, 90]))
        if rng.random() < 0.3:
            thing = affinity.rotate(thing, rng.uniform(0, 90))
        wall_m = hall.boundary.distance(thing)
        if (wall_m == 0 or wall_m > clear_m) and (not placed or shapely.distance(placed, thing).min() > clear_m):
            placed.append(thing)
            yield thing


def _shelves(rng: Rng, hall: Polygon) -> Iterator[Polygon]:
    """Yield shelves with aisles between; for some, only legs and goods are as low as a robot."""
    inner = hall.buffer(-rng.uniform(1.5, 4.0), join_style="mitre")
    if inner.is_empty:
        return
    x0, y0, x1, y1 = inner.bounds
    upright, on_legs = bool(rng.random() < 0.5), rng.random() < 0.4
    deep_m, aisle_m, long_m, gap_m = rng.uniform((0.8, 1.5, 5.0, 2.0), (2.8, 4.0, 25.0, 4.5))
    full, half_leg_m = rng.uniform(0.75, 1.0), rng.uniform(0.05, 0.12)
    reach_m = max(x1 - x0, y1 - y0)
    for across in np.arange(0.0, reach_m, deep_m + aisle_m):
        for along in np.arange(0.0, reach_m, long_m + gap_m):
            low = np.add((across, along) if upright else (along, across), (x0, y0))
            high = low + ((deep_m, long_m) if upright else (long_m, deep_m))
            block = box(*low, *high).intersection(inner)
            if block.area > 0.4 * deep_m * long_m and rng.random() < full:
                yield from _legs(rng, block, half_leg_m) if on_legs else [block]


def _legs(rng: Rng, block: Polygon, half_leg_m: float) -> Iterator[Polygon]:
    x0, y0, x1, y1 = block.bounds
    xs, ys = (np.linspace(low, high, max(2, round((high - low) / _BAY_M) + 1)) for low, high in ((x0, x1), (y0, y1)))
    for x in xs:
        for y in ys:
            yield box(x - half_leg_m, y - half_leg_m, x + half_leg_m, y + half_leg_m)
            if rng.random() < 0.4 and x < x1 and y < y1:
                yield box(x + 0.2, y + 0.2, min(x + rng.uniform(0.8, 2.2), x1), min(y + rng.uniform(0.8, 2.2), y1))


hall_layout = partial(_hall_layout, hall_fraction=(0.15, 3.0), fill=_machines, columned=0.7)

warehouse_layout = partial(_hall_layout, hall_fraction=(0.5, 3.0), fill=_shelves, columned=0.4)
