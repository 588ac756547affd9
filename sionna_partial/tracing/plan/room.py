"""Surfaces of a floor plan, and all that a path between two points meets.

Seen from above, a path is a sequence of straight legs between reflections at walls, which cross walls unless these are
opaque (`Limits.walls` is 0). The height changes linearly with the unfolded length in the plan, on which alone
reflections at floor and ceiling depend. Paths cross obstacles or run above them. The variant of a path is twice its
number of reflections at floor and ceiling, plus 1 if the first is at the ceiling.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.process import njit
from sionna_partial.scene.outlines import Plan
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import DIFFRACTION, REFLECTION, REFRACTION
from sionna_partial.tracing.line import Slabs, group_faces, is_far_inside, is_free_between, reflects_inside
from sionna_partial.tracing.paths import Candidates, Wedges
from sionna_partial.tracing.power import ISOTROPIC, Gains, Materials, gain_towards
from sionna_partial.tracing.select import Limits
from sionna_partial.tracing.walls import Interior

NOTHING, FLOOR, CEILING, EDGE, WALLS = range(5)
"""Surfaces: none, floor, ceiling, vertical edge; from `WALLS` on walls or entries of a trail."""

FACES = 40
"""Largest number of faces of walls that a leg may cross."""

_ENTRIES = 64
"""Largest number of interactions of a path in the plan."""

_REFLECTIONS = 16
"""Largest number of reflections of a path at walls."""


class Room(NamedTuple):
    """Surfaces around a transmitter (3,) and receivers (N, 3), in the local frame [m].

    The floor is at 0, the ceiling at `height_m`; `floor` and `ceiling` are True if they reflect. `wall_material` (S,)
    and `flat_material` are indices of materials, `top_m` (S,) the heights of the walls.
    """

    height_m: float
    floor: bool
    ceiling: bool
    tx_m: Floats
    rx_m: Floats
    wall_material: NDArray[np.int64]
    flat_material: int
    top_m: Floats
    gains: Gains

    @classmethod
    def of(
        cls,
        geometry: SceneGeometry,
        tx_m: Floats,
        rx_m: Floats,
        material_of_face: NDArray[np.int64],
        gains: Gains = ISOTROPIC,
    ) -> "Room":
        flats = geometry.floor_face >= 0, geometry.ceiling_face >= 0
        of_flats = int(material_of_face[geometry.floor_face]) if flats[0] else 0
        # Contiguous: numba compiles for each layout.
        of_walls = np.ascontiguousarray(material_of_face[: 2 * len(geometry.segments) : 2])
        ends_m = np.ascontiguousarray(tx_m), np.ascontiguousarray(rx_m)
        return cls(float(geometry.height_m), *flats, *ends_m, of_walls, of_flats, geometry.top_m, gains)


class Building(NamedTuple):
    """A floor plan, the materials (P,) of the pieces of its walls, and all else that decides paths."""

    plan: Plan
    interior: Interior
    room: Room
    materials: Materials
    material: NDArray[np.int64]
    limits: Limits

    @classmethod
    def of(cls, plan: Plan, interior: Interior, room: Room, materials: Materials, limits: Limits) -> "Building":
        return cls(plan, interior, room, materials, room.wall_material[plan.owner], limits)

    @classmethod
    def opaque(cls, plan: Plan, room: Room, materials: Materials, max_depth: int) -> "Building":
        nothing = np.zeros((1, 1), np.bool_)
        interior = Interior(nothing, np.zeros((2, 2), np.int64), nothing, 1.0, 0.0)
        return cls.of(plan, interior, room, materials, Limits(max_depth, max_depth, 0, 1.0, 0.0))


class Rise(NamedTuple):
    """Heights along an unfolded path [m]: `height_m` in all, `to_first_m` to its first reflection at floor or ceiling.

    `up` is 1 where the path rises at first and -1 where it falls, `bounces` the number of these reflections. The path
    begins at `start_m` in a room of the height `room_m`.
    """

    height_m: float
    to_first_m: float
    up: float
    bounces: int
    start_m: float
    room_m: float


@njit(cache=True, borrows=True)
def has_variant(variant, room):
    bounces, first = variant // 2, FLOOR + variant % 2
    if bounces == 0:
        return first == FLOOR
    if bounces == 1:
        return room.floor if first == FLOOR else room.ceiling
    return room.floor and room.ceiling


@njit(cache=True, borrows=True)
def rise_of(variant, room, target):
    bounces, first = variant // 2, FLOOR + variant % 2
    if bounces == 0:
        rise = target[2] - room.tx_m[2]
        return Rise(abs(rise), 0.0, 1.0 if rise >= 0.0 else -1.0, bounces, room.tx_m[2], room.height_m)
    to_first = room.tx_m[2] if first == FLOOR else room.height_m - room.tx_m[2]
    last_is_floor = (bounces % 2 == 1) == (first == FLOOR)
    from_last = target[2] if last_is_floor else room.height_m - target[2]
    height = to_first + (bounces - 1) * room.height_m + from_last
    return Rise(height, to_first, -1.0 if first == FLOOR else 1.0, bounces, room.tx_m[2], room.height_m)


@njit(cache=True, borrows=True)
def height_at(fraction, rise):
    travelled = fraction * rise.height_m
    if rise.bounces == 0 or travelled <= rise.to_first_m:
        return rise.start_m + rise.up * travelled
    legs = int((travelled - rise.to_first_m) // rise.room_m)
    rest = travelled - rise.to_first_m - legs * rise.room_m
    return rest if (legs % 2 == 0) == (rise.up < 0.0) else rise.room_m - rest


@njit(cache=True, borrows=True)
def fraction_at_turn(turn, rise):
    """Return the fraction of a path's length at reflection number `turn` at floor or ceiling; 2 if there is none."""
    return (rise.to_first_m + turn * rise.room_m) / rise.height_m if turn < rise.bounces else 2.0


@njit(cache=True, borrows=True)
def merge_heights(points, count, tx_m, target, rise, surface, vertices, row):
    """Write one row in path order: the `count` points of a trail, and the reflections at floor and ceiling."""
    entry = turn = 0
    px, py, done = tx_m[0], tx_m[1], 0.0
    for depth in range(count + rise.bounces):
        fraction = fraction_at_turn(turn, rise)
        if entry < count and points[entry, 2] <= fraction:
            px, py, done = points[entry, 0], points[entry, 1], points[entry, 2]
            surface[row, depth] = WALLS + entry
            vertices[row, depth, 0], vertices[row, depth, 1] = px, py
            vertices[row, depth, 2] = height_at(done, rise)
            entry += 1
            continue
        nx, ny, stop = target[0], target[1], 1.0
        if entry < count:
            nx, ny, stop = points[entry, 0], points[entry, 1], points[entry, 2]
        part = (fraction - done) / (stop - done) if stop > done else 0.0
        is_floor = (turn % 2 == 0) == (rise.up < 0.0)
        surface[row, depth] = FLOOR if is_floor else CEILING
        vertices[row, depth, 0], vertices[row, depth, 1] = px + part * (nx - px), py + part * (ny - py)
        vertices[row, depth, 2] = 0.0 if is_floor else rise.room_m
        turn += 1


@njit(cache=True, borrows=True)
def gain_of_departure(room, x, y, rise, length):
    if len(room.gains.table) == 1:
        return 1.0
    return gain_towards(room.gains, x, y, rise.up * rise.height_m / max(length, 1e-9) * np.hypot(x, y))


class Leg(NamedTuple):
    """A straight leg of a path [m], at fractions `done` and `stop` of its length.

    `own` and `other` are the pieces of walls that reflect it at its ends, -1 for none.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    own: np.int64
    other: np.int64
    done: float
    stop: float


class Trail(NamedTuple):
    """Scratch of one path in the plan: its reflections, and all interactions in order from the transmitter.

    `walls` are reflecting pieces, `bounce` the points (x, y, fraction of the length) and the cosine of incidence. Of
    all interactions, `surface` are pieces of walls, `points` (x, y, fraction of the length), `kind` and `same_wall` as
    in `Candidates`.
    """

    walls: NDArray[np.int64]
    bounce: Floats
    surface: NDArray[np.int64]
    kind: NDArray[np.int64]
    same_wall: Bools
    cosine: Floats
    points: Floats
    found: Floats
    wall: NDArray[np.int64]
    visit: NDArray[np.int64]
    slabs: Slabs


def trail_of(plan: Plan) -> Trail:
    return Trail(
        np.empty(_REFLECTIONS, np.int64),
        np.empty((_REFLECTIONS, 4)),
        np.empty(_ENTRIES, np.int64),
        np.empty(_ENTRIES, np.int64),
        np.empty(_ENTRIES, np.bool_),
        np.empty(_ENTRIES),
        np.empty((_ENTRIES, 3)),
        np.empty(_ENTRIES),
        np.empty(_ENTRIES, np.int64),
        np.full(len(plan.pieces_m) + 1, -1, np.int64),
        Slabs.empty(2 * _ENTRIES),
    )


@njit(cache=True, borrows=True)
def cross_leg(plan, interior, leg, count, trail):
    """Add the faces that a leg crosses to `count` entries; return their number, -1 if too many, and walls crossed."""
    dx, dy = leg.end[0] - leg.start[0], leg.end[1] - leg.start[1]
    length = np.hypot(dx, dy)
    if length < 1e-9:
        return count, 0
    n = _faces_on(plan, leg, dx, dy, length, trail)
    if n < 0 or count + n >= len(trail.surface) - 1:
        return -1, 0
    for j in range(n):
        t, i, entry = trail.found[j], trail.wall[j], count + j
        trail.surface[entry], trail.kind[entry], trail.cosine[entry] = i, REFRACTION, _cosine(plan, i, dx, dy, length)
        trail.points[entry, 0], trail.points[entry, 1] = leg.start[0] + t * dx, leg.start[1] + t * dy
        trail.points[entry, 2] = leg.done + t * (leg.stop - leg.done)
        trail.same_wall[entry] = False
    line, order = (leg.start, leg.end, length), (dx < 0.0 or (dx == 0.0 and dy < 0.0), False)
    cosine, same_wall = trail.cosine[count : count + n], trail.same_wall[count : count + n]
    return count + n, group_faces(interior, line, trail.found[:n], cosine, same_wall, order)


@njit(cache=True, borrows=True)
def _faces_on(plan, leg, dx, dy, length, trail):
    """Write the pieces that a leg crosses in order, with fractions; return their number, -1 if too many."""
    (ax, ay), (bx, by) = leg.start, leg.end
    x0, y0, edge, columns, rows = plan.cells.grid
    columns, rows, n = int(columns), int(rows), 0
    trail.visit[-1] += 1
    stamp = trail.visit[-1]
    low, high = min(ay, by) - 1e-6, max(ay, by) + 1e-6
    for row in range(max(0, int(np.floor((low - y0) / edge))), min(rows, int(np.floor((high - y0) / edge)) + 1)):
        left, right = min(ax, bx), max(ax, bx)
        if abs(dy) > 1e-12:
            first = ax + dx * ((y0 + row * edge - 1e-6) - ay) / dy
            last = ax + dx * ((y0 + (row + 1) * edge + 1e-6) - ay) / dy
            left, right = max(left, min(first, last)), min(right, max(first, last))
        begin = max(0, int(np.floor((left - 1e-6 - x0) / edge)))
        end = min(columns - 1, int(np.floor((right + 1e-6 - x0) / edge)))
        if begin > end:
            continue
        for entry in range(plan.cells.start[row * columns + begin], plan.cells.start[row * columns + end + 1]):
            i = plan.cells.piece[entry]
            if trail.visit[i] == stamp:
                continue
            trail.visit[i] = stamp
            if leg.own >= 0 and plan.line[i] == plan.line[leg.own]:
                continue
            if leg.other >= 0 and plan.line[i] == plan.line[leg.other]:
                continue
            t = _crossed_at(plan.pieces_m[i], ax, ay, dx, dy, length)
            if t <= 0.0 or t >= 1.0:
                continue
            if n >= FACES:
                return -1
            at = n
            while at > 0 and trail.found[at - 1] > t:
                trail.found[at], trail.wall[at] = trail.found[at - 1], trail.wall[at - 1]
                at -= 1
            trail.found[at], trail.wall[at] = t, i
            n += 1
    return n


@njit(cache=True, borrows=True)
def _crossed_at(piece, ax, ay, dx, dy, length):
    """Return the fraction of a leg at which it crosses a piece of a wall, or -1.

    Points on the leg's line count as left of it.
    """
    px, py, qx, qy = piece[0, 0], piece[0, 1], piece[1, 0], piece[1, 1]
    side_p, side_q = dx * (py - ay) - dy * (px - ax), dx * (qy - ay) - dy * (qx - ax)
    if (side_p >= 0.0) == (side_q >= 0.0):
        return -1.0
    u = side_p / (side_p - side_q)
    return ((px + u * (qx - px) - ax) * dx + (py + u * (qy - py) - ay) * dy) / (length * length)


@njit(cache=True, borrows=True)
def _cosine(plan, piece, dx, dy, length):
    wx = plan.pieces_m[piece, 1, 0] - plan.pieces_m[piece, 0, 0]
    wy = plan.pieces_m[piece, 1, 1] - plan.pieces_m[piece, 0, 1]
    return abs(wx * dy - wy * dx) / (length * np.hypot(wx, wy))


@njit(cache=True, borrows=True)
def is_reflected_inside(plan, interior, count, trail):
    """Return whether a wall reflects a path in it or in another wall."""
    before, after = (False, False), (False, False)
    for i in range(count):
        before, after = after, (False, False)
        if i + 1 < count and trail.kind[i] != trail.kind[i + 1]:
            after = _is_inside(plan, interior, i, trail)
        if trail.kind[i] == REFLECTION and reflects_inside(before, after):
            return True
    return False


@njit(cache=True, borrows=True)
def _is_inside(plan, interior, i, trail):
    """Return whether a path is in one wall between entry i and the next, and as `is_far_inside`."""
    first, second = trail.surface[i], trail.surface[i + 1]
    crossed = second if trail.kind[i] == REFLECTION else first
    if plan.low[crossed]:
        return False, False
    (ax, ay, _), (bx, by, _) = trail.points[i], trail.points[i + 1]
    dx, dy, length = bx - ax, by - ay, max(np.hypot(bx - ax, by - ay), 1e-12)
    wx = plan.pieces_m[first, 1, 0] - plan.pieces_m[first, 0, 0]
    wy = plan.pieces_m[first, 1, 1] - plan.pieces_m[first, 0, 1]
    cosine = min(_cosine(plan, first, dx, dy, length), _cosine(plan, second, dx, dy, length))
    inside = length * cosine <= interior.depth_m and not is_free_between(interior, (ax, ay), (bx, by), 0.0, 1.0)
    turn = _cosine(plan, second, -wy, wx, np.hypot(wx, wy))
    return inside, is_far_inside(interior, turn, length * _cosine(plan, crossed, dx, dy, length))


@njit(cache=True, borrows=True)
def add_entry(trail, count, piece, kind, x, y, fraction):
    trail.surface[count], trail.kind[count], trail.same_wall[count] = piece, kind, False
    trail.points[count, 0], trail.points[count, 1], trail.points[count, 2] = x, y, fraction
    return count + 1


class WrittenPaths(NamedTuple):
    """C paths with up to S interactions: `surface`, `kind`, `same_wall` (C, S) and `vertices_m` (C, S, 3)."""

    surface: NDArray[np.int32]
    kind: NDArray[np.uint8]
    vertices_m: Floats
    same_wall: Bools

    @classmethod
    def empty(cls, count: int, size: int) -> "WrittenPaths":
        surface, kind = np.zeros((count, size), np.int32), np.zeros((count, size), np.uint8)
        return cls(surface, kind, np.zeros((count, size, 3)), np.zeros((count, size), np.bool_))


@njit(cache=True, borrows=True, forceinline=True)  # copying the arguments would take as long as the function
def write_path(trail, count, room, owner, target, variant, paths, row):
    """Write the `count` entries of a trail, with the reflections at floor and ceiling of a variant, as one row."""
    surface, kind, vertices, same_wall = paths
    rise = rise_of(variant, room, target)
    merge_heights(trail.points, count, room.tx_m, target, rise, surface, vertices, row)
    for d in range(count + rise.bounces):
        entry = surface[row, d] - WALLS
        if entry < 0:
            kind[row, d] = REFLECTION
            continue
        kind[row, d], same_wall[row, d] = trail.kind[entry], trail.same_wall[entry]
        is_edge = trail.kind[entry] == DIFFRACTION
        surface[row, d] = EDGE if is_edge else WALLS + owner[trail.surface[entry]]


def candidates_of(
    geometry: SceneGeometry,
    rx: NDArray[np.integer],
    paths: WrittenPaths,
    *,
    opaque: bool,
    wedge: NDArray[np.int32] | None = None,
    wedges: Wedges | None = None,
) -> Candidates:
    """Return paths of `write_path` as candidates, with as many columns as needed."""
    surface, kind, vertices_m, same_wall = paths
    walls = 2 * np.arange(len(geometry.segments))
    of_surface = np.concatenate([[-1, geometry.floor_face, geometry.ceiling_face, -1], walls]).astype(np.int32)
    face = of_surface[surface]
    if wedges is not None and wedge is not None:
        face = np.where(kind == DIFFRACTION, wedges.face[wedge, :1], face)
    candidates = Candidates(rx.astype(np.int32), kind, face, vertices_m, wedge, wedges, None if opaque else same_wall)
    return candidates if opaque else candidates.narrowed()
