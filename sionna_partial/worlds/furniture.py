"""Furniture and pillars in the rooms of procedural homes, which leave room to walk; and tools for drawing plans."""

import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np
import shapely
from shapely import LineString, MultiPolygon, Polygon, affinity, box

GRID_M = 1e-5
"""Grid on which shapes are joined and cut [m]: almost equal corners cannot break it."""

NEAR_M = 0.01
"""Distance within which shapes touch [m]."""

Rng = np.random.Generator

_EMPTY_ROOM_M2 = 2.5
_PILLARED_ROOM_M2 = 20.0


def union_of(shapes: Iterable[shapely.Geometry]) -> shapely.Geometry:
    """Union of shapes on a grid of `GRID_M`."""
    return shapely.union_all(list(shapes), grid_size=GRID_M)


def parts_of(shape: shapely.Geometry) -> list[Polygon]:
    """Polygons of a shape, the largest first."""
    polygons = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"]
    return sorted(polygons, key=lambda part: -part.area)


def log_uniform(rng: Rng, between: tuple[float, float]) -> float:
    """Draw a number whose logarithm is uniform."""
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
    """Yield furniture and pillars (they may overlap each other and the walls) that leave a room and its doors passable.

    `room` is the outline through the middle of its walls, `walls` includes door leaves; `openings` are those of the
    whole home. `clutter` is the mean number of things that are tried for every 4 m2, `pillars` the probability that
    a large room has some.
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
    """Piece of furniture: along a wall, in a corner, or in the middle of a room."""
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
    """Put a thing somewhere into the bounds of a room."""
    x0, y0, x1, y1 = room.bounds
    return affinity.translate(thing, rng.uniform(x0, x1), rng.uniform(y0, y1))


def _block(rng: Rng, half_width: tuple[float, float], depth: tuple[float, float]) -> Polygon:
    """Rectangle whose middle is on a wall, deep enough on both sides of it; some have an arm."""
    half_width_m, depth_m = rng.uniform(*half_width), rng.uniform(*depth)
    thing = box(-half_width_m, -depth_m, half_width_m, depth_m)
    if rng.random() < 0.25:
        arm_m = rng.uniform(0.3, min(half_width_m, 0.9))
        side = rng.choice([-1.0, 1.0])
        arm = box(0, -2 * depth_m, arm_m, 2 * depth_m)
        thing = thing.union(affinity.translate(affinity.scale(arm, side, origin=(0, 0)), -side * half_width_m, 0))
    return thing


def _heap(rng: Rng) -> Polygon:
    """Irregular block: a star of random radii, as scans make of plants, chairs and piles."""
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
"""Drawing function of each kind, and the probability that it is placed at a wall."""

_FREQUENCIES = (0.3, 0.25, 0.15, 0.1, 0.2)
