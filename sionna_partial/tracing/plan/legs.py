"""The walls that the straight legs of a path meet in a floor plan."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.process import njit
from sionna_partial.scene.floor_plan import Plan
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import DIFFRACTION, REFLECTION, REFRACTION
from sionna_partial.tracing.plan.specular import EDGE, WALLS, faces_of
from sionna_partial.tracing.walls import group_faces, is_free_between

FACES = 40
"""Most faces of walls that a leg may cross."""

_ENTRIES = 64
"""Most interactions of a path in the plan."""

SHORTEST_LEG_M = 0.0101
"""Sionna RT drops paths with legs of 1 cm or less."""


class Leg(NamedTuple):
    """A straight leg from one point of a path to another [m], which are fractions of the path's length.

    `own` and `other` are the pieces of walls that reflect it there, -1 if none does.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    own: np.int64
    other: np.int64
    done: float
    stop: float


class Trail(NamedTuple):
    """Scratch of one path in the plan: its reflections, and all it meets, in order from the transmitter.

    `walls` are pieces that reflect it, `bounce` the points (x, y, fraction of the length) and the cosine of incidence
    there. `surface` are pieces of walls, `kind` Sionna RT's number of each interaction, `same_wall` whether it is at a
    further face of a wall that has been crossed, which costs nothing, and `cosine` the cosine of incidence there;
    `points` are (x, y, fraction of the length).
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


def trail_of(plan: Plan) -> Trail:
    """Make scratch for paths in a plan."""
    return Trail(
        np.empty(16, np.int64),
        np.empty((16, 4)),
        np.empty(_ENTRIES, np.int64),
        np.empty(_ENTRIES, np.int64),
        np.empty(_ENTRIES, np.bool_),
        np.empty(_ENTRIES),
        np.empty((_ENTRIES, 3)),
        np.empty(_ENTRIES),
        np.empty(_ENTRIES, np.int64),
        np.full(len(plan.pieces_m) + 1, -1, np.int64),
    )


@njit(cache=True)
def cross_leg(plan, interior, leg, count, trail):  # type: ignore[no-untyped-def]
    """Add the faces that a leg crosses to `count` entries; return the number of entries, and of walls crossed.

    The first is -1 if there are too many, or if a wall reflects a leg that came through another face of it.
    """
    dx, dy = leg.end[0] - leg.start[0], leg.end[1] - leg.start[1]
    length = np.hypot(dx, dy)
    if length < 1e-9:
        return count, 0
    n = _faces_on(plan, leg, dx, dy, length, trail)
    if n < 0 or count + n >= len(trail.surface) - 1:
        return -1, 0
    if n > 0 and interior.depth_m > 0.0 and _is_reflected_inside(plan, interior, leg, n, trail):
        return -1, 0
    for j in range(n):
        t, i, entry = trail.found[j], trail.wall[j], count + j
        trail.surface[entry], trail.kind[entry], trail.cosine[entry] = i, REFRACTION, _cosine(plan, i, dx, dy, length)
        trail.points[entry, 0], trail.points[entry, 1] = leg.start[0] + t * dx, leg.start[1] + t * dy
        trail.points[entry, 2] = leg.done + t * (leg.stop - leg.done)
    cosine, same_wall = trail.cosine[count : count + n], trail.same_wall[count : count + n]
    return count + n, group_faces(interior, leg.start, leg.end, trail.found[:n], cosine, same_wall)


@njit(cache=True)
def _faces_on(plan, leg, dx, dy, length, trail):  # type: ignore[no-untyped-def]
    """Write the pieces that a leg crosses, in their order, and at which fractions of it; their number, -1 if many."""
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


@njit(cache=True)
def _crossed_at(piece, ax, ay, dx, dy, length):  # type: ignore[no-untyped-def]
    """At which fraction of a leg it crosses a piece of a wall; -1 if it does not.

    A point on the leg's line counts as left of it, so that a line through a shared corner crosses one of its walls.
    """
    px, py, qx, qy = piece[0, 0], piece[0, 1], piece[1, 0], piece[1, 1]
    side_p, side_q = dx * (py - ay) - dy * (px - ax), dx * (qy - ay) - dy * (qx - ax)
    if (side_p >= 0.0) == (side_q >= 0.0):
        return -1.0
    u = side_p / (side_p - side_q)
    return ((px + u * (qx - px) - ax) * dx + (py + u * (qy - py) - ay) * dy) / (length * length)


@njit(cache=True)
def _cosine(plan, piece, dx, dy, length):  # type: ignore[no-untyped-def]
    """Cosine of the angle of incidence of a leg, seen from above."""
    wx = plan.pieces_m[piece, 1, 0] - plan.pieces_m[piece, 0, 0]
    wy = plan.pieces_m[piece, 1, 1] - plan.pieces_m[piece, 0, 1]
    return abs(wx * dy - wy * dx) / (length * np.hypot(wx, wy))


@njit(cache=True)
def _is_reflected_inside(plan, interior, leg, n, trail):  # type: ignore[no-untyped-def]
    """Return whether the first or the last of the faces on a leg and the wall that reflects it there are one wall."""
    dx, dy = leg.end[0] - leg.start[0], leg.end[1] - leg.start[1]
    length = np.hypot(dx, dy)
    for wall, face, t in ((leg.own, 0, 0.0), (leg.other, n - 1, 1.0)):
        if wall < 0 or plan.low[trail.wall[face]]:
            continue
        first, last = min(t, trail.found[face]), max(t, trail.found[face])
        cosine = min(_cosine(plan, wall, dx, dy, length), _cosine(plan, trail.wall[face], dx, dy, length))
        if (last - first) * length * cosine <= interior.depth_m and not is_free_between(
            interior, leg.start, leg.end, first, last
        ):
            return True
    return False


@njit(cache=True)
def has_long_legs(trail, count, length):  # type: ignore[no-untyped-def]
    """Return whether no leg of a path of some length in the plan is so short that Sionna RT drops the path."""
    previous = 0.0
    for k in range(count):
        if (trail.points[k, 2] - previous) * length < SHORTEST_LEG_M:
            return False
        previous = trail.points[k, 2]
    return (1.0 - previous) * length >= SHORTEST_LEG_M


@njit(cache=True)
def empty_paths(count, trail):  # type: ignore[no-untyped-def]
    """Surfaces, kinds, vertices and `same_wall` of paths, without any interaction."""
    shape = count, len(trail.surface) + 2
    vertices, same_wall = np.zeros((*shape, 3)), np.zeros(shape, np.bool_)
    return np.zeros(shape, np.int32), np.zeros(shape, np.uint8), vertices, same_wall


@njit(cache=True)
def write_kinds(trail, plan, count, surface, kind, same_wall):  # type: ignore[no-untyped-def]
    """Put surfaces in place of the entries of a trail, which are numbered as walls, and write the kinds of all."""
    for d in range(count):
        entry = surface[d] - WALLS
        if entry < 0:
            kind[d] = REFLECTION
            continue
        kind[d], same_wall[d] = trail.kind[entry], trail.same_wall[entry]
        surface[d] = EDGE if kind[d] == DIFFRACTION else WALLS + plan.owner[trail.surface[entry]]


def columns_of(
    geometry: SceneGeometry, surface: NDArray[np.int32], kind: NDArray[np.uint8], vertices_m: Floats, same_wall: Bools
) -> dict[str, Any]:
    """Return columns of `Candidates` (C, D), of which the first have all that is used."""
    used = max(1, int((kind > 0).sum(axis=1).max(initial=0)))
    columns = (
        ("kind", kind),
        ("face", faces_of(surface, geometry)),
        ("vertices_m", vertices_m),
        ("same_wall", same_wall),
    )
    return {name: column[:, :used] for name, column in columns}
