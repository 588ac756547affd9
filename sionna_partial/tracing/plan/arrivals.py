r"""Paths of a floor plan from the transmitter to vertical edges.

\  n-face
tx         \
      \  from_0 \
       \_________E________ 0-face     An edge E, seen from above: angles are from the 0-face, up to the exterior
angle = 0           angle of the wedge; `lit` is True where a path arrives in front of the 0-face.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.process import njit
from sionna_partial.tracing.paths import Wedges
from sionna_partial.tracing.plan.beams import BeamTree
from sionna_partial.tracing.plan.reflections import unfold
from sionna_partial.tracing.plan.room import Building, Leg, Trail, cross_leg
from sionna_partial.tracing.power import gain_at_azimuth, power_near, wedge_angle, wedge_constants

NEAR_M = 1e-3
"""Shortest leg next to an edge [m]: walls that meet there do not reflect it."""

FLAT_RAD = 1e-3
"""Smallest angle between walls and a straight line at an edge [rad]."""

_EXTERIOR_M = 1e-5
"""Distance from a face [m] at which the path solver counts a point as outside a wedge."""

_ASIDE_M = 1e-3
"""Distance from an edge at which a leg through walls ends [m]: walls that meet there are not crossed."""


class Edges(NamedTuple):
    """Edges in the plan: positions (E, 2) [m], direction of the 0-face and exterior angle [rad], normals (E, 4).

    `utd` (E, 5) are the `wedge_constants`, `material` (E, 2) is for a lit and for an unlit 0-face: for Sionna RT an
    edge has one shape.
    """

    position_m: Floats
    face_rad: Floats
    exterior_rad: Floats
    normals: Floats
    utd: Floats
    material: NDArray[np.int64]

    @classmethod
    def of(cls, wedges: Wedges, wall_material: NDArray[np.int64]) -> "Edges":
        normals, count = wedges.normal[: len(wedges.edge_m)], len(wedges.edge_m)
        face_rad = np.arctan2(-normals[:, 0, 0], normals[:, 0, 1])
        exterior_rad = (np.arctan2(normals[:, 1, 0], -normals[:, 1, 1]) - face_rad) % (2 * np.pi)
        exterior_rad[exterior_rad < FLAT_RAD] = 2 * np.pi  # the free end of a wall
        material, constants = wall_material[wedges.face[:count] // 2], wedge_constants(exterior_rad)
        flat = np.ascontiguousarray(normals.reshape(-1, 4))
        return cls(wedges.edge_m, face_rad, exterior_rad, flat, constants, material)


class Arrivals(NamedTuple):
    """J paths from the transmitter to edges, ordered by edge.

    `start` (E + 1,) is the first path of each edge, `edge` (J,) the edge, `reflections` (J,) their number, `length_m`
    (J,) the length in the plan, `walls` (J, R) and `points` (J, R, 3) are as in `unfold`, `material` and `cosine` (J,
    R) of these walls and angles of incidence, `angle` (J, 4) the direction of arrival as in `wedge_angle`, `faces` (J,
    2) the cosines of incidence at 0-face and n-face, -1 in the shadow, `lit` (J,) True where the 0-face is lit.
    `toward` (J, 2) are horizontal unit vectors of departure, `gain` (J,) the largest gain there. `crossed` (J,) walls
    leave the fraction `left` (J,) of the power.
    """

    start: NDArray[np.int64]
    edge: NDArray[np.int32]
    reflections: NDArray[np.int64]
    length_m: Floats
    walls: NDArray[np.int64]
    points: Floats
    material: NDArray[np.int64]
    cosine: Floats
    angle: Floats
    faces: Floats
    lit: Bools
    toward: Floats
    gain: Floats
    left: Floats
    crossed: NDArray[np.int64]

    @classmethod
    def empty(cls, count: int, reflections: int) -> "Arrivals":
        size = count, max(1, reflections)
        start, edge, length_m = np.zeros(0, np.int64), np.zeros(count, np.int32), np.zeros(count)
        number, walls, material = np.zeros(count, np.int64), np.zeros(size, np.int64), np.zeros(size, np.int64)
        angle, faces, lit = np.zeros((count, 4)), np.zeros((count, 2)), np.zeros(count, np.bool_)
        toward, crossed = np.zeros((count, 2)), np.zeros(count, np.int64)
        reflected = walls, np.zeros((*size, 3)), material, np.zeros(size)
        return cls(
            start,
            edge,
            number,
            length_m,
            *reflected,
            angle,
            faces,
            lit,
            toward,
            np.ones(count),
            np.ones(count),
            crossed,
        )


def arrive(
    tree: BeamTree, pairs: NDArray[np.int32], edges: Edges, building: Building, reflections: int, trail: Trail
) -> Arrivals:
    """Return the paths of pairs (beam, edge) that reach an edge from outside its wedge."""
    pairs = pairs[np.argsort(pairs[:, 1], kind="stable")]
    every, good = Arrivals.empty(len(pairs), reflections), np.zeros(len(pairs), np.bool_)
    plan, room, shortest_m = building.plan, building.room, shortest_leg_m(building)
    _unfold_all(
        tree, pairs, edges, plan.pieces_m, building.material, room.tx_m, room.gains, trail, every, shortest_m, good
    )
    if building.limits.walls:
        _cross_all(edges, building, trail, every, good)
    columns: list[Any] = [column[good] for column in every[1:]]
    return Arrivals(np.searchsorted(columns[0], np.arange(len(edges.position_m) + 1)), *columns)


def shortest_leg_m(building: Building) -> float:
    return 20.0 * _ASIDE_M if building.limits.walls > 0 else NEAR_M


@njit(cache=True, borrows=True, nogil=True)
def _unfold_all(tree, pairs, edges, pieces_m, material, tx_m, gains, trail, arrivals, shortest_m, good):
    """Write the paths of pairs (beam, edge) as rows of `arrivals`, and which are `good`: outside a wedge."""
    for i in range(len(pairs)):
        edge = pairs[i, 1]
        target = edges.position_m[edge]
        count, length = unfold(tree, pairs[i, 0], pieces_m, target, trail.walls, trail.bounce)
        arrivals.edge[i], arrivals.reflections[i], arrivals.length_m[i] = edge, count, length
        for k in range(count):
            wall = arrivals.walls[i, k] = trail.walls[k]
            arrivals.material[i, k], arrivals.cosine[i, k] = material[wall], trail.bounce[k, 3]
            for column in range(3):
                arrivals.points[i, k, column] = trail.bounce[k, column]
        good[i] = count >= 0 and _arrives(i, edges, tx_m, gains, arrivals) > shortest_m


@njit(cache=True, borrows=True)
def _arrives(i, edges, tx_m, gains, arrivals):
    """Write the directions of path i at both ends; return the length of its last leg, -1 if it is in the wedge."""
    edge, count = arrivals.edge[i], arrivals.reflections[i]
    target, exterior, points = edges.position_m[edge], edges.exterior_rad[edge], arrivals.points
    (x, y), (to_x, to_y) = (tx_m[0], tx_m[1]), (target[0], target[1])
    if count > 0:
        (x, y), (to_x, to_y) = (points[i, count - 1, 0], points[i, count - 1, 1]), (points[i, 0, 0], points[i, 0, 1])
    x, y, to_x, to_y = x - target[0], y - target[1], to_x - tx_m[0], to_y - tx_m[1]
    from_0 = angle_rad(edges.face_rad[edge], exterior, np.arctan2(y, x))
    turned = wedge_angle(from_0, exterior)
    arrivals.angle[i, 0], arrivals.angle[i, 1], arrivals.angle[i, 2], arrivals.angle[i, 3] = turned
    for k, from_face in enumerate((from_0, exterior - from_0)):
        arrivals.faces[i, k] = max(0.0, np.sin(from_face)) if from_face <= np.pi else -1.0
    away = max(np.hypot(to_x, to_y), 1e-12)
    arrivals.toward[i, 0], arrivals.toward[i, 1] = to_x / away, to_y / away
    arrivals.gain[i] = gain_at_azimuth(gains, to_x, to_y)
    arrivals.lit[i], good = outside(edges.normals, edge, x, y)
    return np.hypot(x, y) if good else -1.0


@njit(cache=True, borrows=True, nogil=True)
def _cross_all(edges, building, trail, arrivals, good):
    """Write the walls that straight paths to edges cross, and the power left; too many walls are not `good`."""
    for i in range(len(good)):
        if good[i]:
            length = arrivals.length_m[i]
            count, crossed = to_edge(building, edges.position_m[arrivals.edge[i]], length, length, trail)
            good[i], arrivals.crossed[i] = count >= 0 and crossed <= building.limits.walls, crossed
            arrivals.left[i] = leg_power(trail, max(count, 0), building)


@njit(cache=True, borrows=True)
def leg_power(trail, count, building):
    """Return a bound of the power after a leg's walls, as if it were horizontal, for any polarisation."""
    power, table = 1.0, building.materials.transmission
    for k in range(count):
        if not (trail.same_wall[k] or building.plan.low[trail.surface[k]]):
            power *= power_near(table, building.material[trail.surface[k]], trail.cosine[k])
    return power


@njit(cache=True, borrows=True)
def to_edge(building, origin, length, total, trail):
    part, tx_m = 1.0 - _ASIDE_M / length, building.room.tx_m
    x, y = tx_m[0] + part * (origin[0] - tx_m[0]), tx_m[1] + part * (origin[1] - tx_m[1])
    leg = Leg((tx_m[0], tx_m[1]), (x, y), np.int64(-1), np.int64(-1), 0.0, part * length / total)
    return cross_leg(building.plan, building.interior, leg, 0, trail)


@njit(cache=True, borrows=True)
def from_edge(building, origin, target, length, total, count, trail):
    part = _ASIDE_M / length
    x, y = origin[0] + part * (target[0] - origin[0]), origin[1] + part * (target[1] - origin[1])
    done = (total - length + _ASIDE_M) / total
    leg = Leg((x, y), (target[0], target[1]), np.int64(-1), np.int64(-1), done, 1.0)
    return cross_leg(building.plan, building.interior, leg, count, trail)


@njit(cache=True, borrows=True)
def outside(normals, edge, x, y):
    """Return whether a point, relative to an edge, is in front of the 0-face, and of either face."""
    first = normals[edge, 0] * x + normals[edge, 1] * y > _EXTERIOR_M
    return first, first or normals[edge, 2] * x + normals[edge, 3] * y > _EXTERIOR_M


@njit(cache=True, borrows=True)
def angle_rad(face_rad, exterior_rad, azimuth_rad):
    """Return the angle of a direction from the 0-face of an edge; rounding may turn 0 into 2 pi."""
    angle = (azimuth_rad - face_rad) % (2 * np.pi)
    return 0.0 if angle > 0.5 * exterior_rad + np.pi else angle
