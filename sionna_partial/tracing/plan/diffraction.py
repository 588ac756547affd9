"""Candidates of floor plans that are diffracted once at a vertical edge, with few reflections before and after.

An edge is a point in the plan. Beams from the transmitter reach edges, beams from an edge reach receivers, and a path
joins one of each. On a vertical edge Keller's cone keeps the slope of a path, so heights unfold along the whole path in
the plan as they do without the edge.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.process import in_order, njit
from sionna_partial.scene.floor_plan import Plan, PointBins, bin_points, grow
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.bounds import LEVELS, Strengths, level_of, reflected_power, utd_terms
from sionna_partial.tracing.candidates import Candidates, Wedges
from sionna_partial.tracing.plan.beams import Beams, trace_beams_in
from sionna_partial.tracing.plan.specular import (
    CEILING,
    DIFFRACTED,
    FLOOR,
    Room,
    can_bounce,
    clear,
    faces_of,
    incidence,
    merge_heights,
    unfold,
    unfolded_height,
)

MAX_REFLECTIONS = 2
"""Largest number of reflections around the diffraction, those off floor and ceiling included."""

_EXTERIOR_M = 1e-5
"""Distance from the plane of a face [m] at which the path solver counts a point as outside a wedge."""

_NEAR_M = 1e-3
"""Shortest leg in the plan next to an edge [m]: walls that meet there do not reflect it."""

_FLAT_RAD = 1e-3
"""Walls that meet at less than this angle from a straight line form no edge [rad]."""

_EDGES_AT_ONCE = 32
"""Number of edges whose beams are held in memory together. It does not depend on the receivers, nor does the order of
the candidates."""


class _Arrivals(NamedTuple):
    """J paths from the transmitter to edges, ordered by edge.

    `start` (E + 1,) gives the first of each edge, `reflections` (J,) their number, `length_m` (J,) the length in
    the plan, `walls` (J, R) and `points` (J, R, 3) the reflections as `unfold` writes them, `cosine` (J, R) of the
    angles of incidence there, `angle_rad` (J,) the direction of arrival, counted from the 0-face, and `lit` (J,)
    whether that face is lit.
    """

    start: NDArray[np.int64]
    reflections: NDArray[np.int64]
    length_m: Floats
    walls: NDArray[np.int64]
    points: Floats
    cosine: Floats
    angle_rad: Floats
    lit: Bools


class _Edges(NamedTuple):
    """Edges in the plan: positions (E, 2) [m], direction of the 0-face and exterior angle [rad], normals (E, 4)."""

    position_m: Floats
    face_rad: Floats
    exterior_rad: Floats
    normals: Floats


def find_wedges(geometry: SceneGeometry, *, open_ends: bool) -> Wedges:
    """Find the vertical edges of the walls that diffract, with or without those where observation ended."""
    vertex = geometry.segments.ravel()
    away = geometry.vertices_m[geometry.segments[:, ::-1].ravel()] - geometry.vertices_m[vertex]
    angle = np.arctan2(away[:, 1], away[:, 0])
    order = np.lexsort([angle, vertex])
    vertex, angle = vertex[order], angle[order]
    start, count = np.unique(vertex, return_index=True, return_counts=True)[1:]
    after = np.arange(len(vertex)) + 1
    after[start + count - 1] = start
    width = (angle[after] - angle) % (2 * np.pi)
    width[after == np.arange(len(vertex))] = 2 * np.pi
    wide = np.flatnonzero((width > np.pi + _FLAT_RAD) & (open_ends | ~geometry.open_end[vertex]))
    face = (order ^ 1).astype(np.int32)  # of the two triangles of a wall, the second stands at its first end
    pair = np.stack([face[wide], face[after[wide]]], axis=1)
    first, last = angle[wide], angle[after[wide]]
    normal = np.array([[-np.sin(first), np.cos(first)], [np.sin(last), -np.cos(last)]]).transpose(2, 0, 1)
    return Wedges(
        edge_m=geometry.vertices_m[vertex[wide]],
        height_m=geometry.height_m,
        face=np.concatenate([pair, pair[:, ::-1]]),
        normal=np.concatenate([normal, normal[:, ::-1]]),
    )


class DiffractionCandidates:
    """All paths over one vertical edge, with at most two reflections, and `walls_a_side` of them at walls on each side.

    The beams from the edges are traced once, on all cores, when they are first asked for.
    """

    def __init__(
        self, geometry: SceneGeometry, wedges: Wedges, room: Room, max_depth: int, walls_a_side: int = MAX_REFLECTIONS
    ) -> None:
        self._geometry, self._wedges, self._room = geometry, wedges, room
        self._reflections = min(MAX_REFLECTIONS, max_depth - 1)
        self._walls_a_side = min(walls_a_side, self._reflections)
        self._beams: dict[int, tuple[Beams, NDArray[np.uint8]]] = {}
        self._edges = _edges_of(wedges)
        if self._reflections >= 0 and len(wedges.edge_m):
            self._arrivals = _arrivals(geometry.plan, self._edges, room, self._walls_a_side)

    def blocks(self, strengths: Strengths) -> Iterator[tuple[Candidates, float]]:
        """Yield the candidates that are asked for, and the fraction of the work done; add up the bounds of all."""
        if self._reflections < 0 or not len(self._wedges.edge_m):
            return
        receivers, geometry = bin_points(self._room.rx_m[:, :2]), self._geometry
        reached = np.flatnonzero(np.diff(self._arrivals.start))
        groups = [reached[first : first + _EDGES_AT_ONCE] for first in range(0, len(reached), _EDGES_AT_ONCE)]

        def listed(number: int) -> tuple[Candidates, Floats]:
            if number not in self._beams:
                beams = self._trace(groups[number], receivers)
                self._beams[number] = beams, np.zeros(len(beams.pair_rx), np.uint8)
            own = strengths._replace(power=np.zeros_like(strengths.power))
            rx, wedge, surface, vertices_m = _combine(
                *self._beams[number], groups[number], self._edges, self._arrivals, self._room, self._reflections, own
            )
            return Candidates(rx, faces_of(surface, geometry), vertices_m, wedge, self._wedges), own.power

        for number, (candidates, power) in enumerate(in_order(listed, range(len(groups)))):
            strengths.power[:] += power
            yield candidates, (number + 1) / len(groups)

    def _trace(self, group: Indices, receivers: PointBins) -> Beams:
        """Trace the beams from a group of edges."""
        arrivals = self._arrivals
        fewest = np.minimum.reduceat(arrivals.reflections, arrivals.start[group])
        onward = np.minimum(self._walls_a_side, self._reflections - fewest)
        return trace_beams_in(self._geometry.plan, receivers, self._wedges.edge_m[group], onward)


def _edges_of(wedges: Wedges) -> _Edges:
    """Lay out wedges for the search of paths."""
    normals = wedges.normal[: len(wedges.edge_m)]
    face_rad, end_rad = np.arctan2(-normals[:, 0, 0], normals[:, 0, 1]), np.arctan2(normals[:, 1, 0], -normals[:, 1, 1])
    exterior_rad = (end_rad - face_rad) % (2 * np.pi)
    exterior_rad[exterior_rad < _FLAT_RAD] = 2 * np.pi  # the free end of a wall
    return _Edges(wedges.edge_m, face_rad, exterior_rad, normals.reshape(-1, 4))


def _arrivals(plan: Plan, edges: _Edges, room: Room, reflections: int) -> _Arrivals:
    """Find the paths of at most `reflections` walls from the transmitter to each edge."""
    beams = trace_beams_in(plan, bin_points(edges.position_m), room.tx_m[None, :2], np.array([reflections]))
    order = np.argsort(beams.pair_rx, kind="stable")
    node, edge = beams.pair_node[order], beams.pair_rx[order]
    good, *columns = _unfold_all(beams, node, edge, edges, room, max(1, reflections))
    start = np.searchsorted(edge[good], np.arange(len(edges.position_m) + 1))
    return _Arrivals(start, *(column[good] for column in columns))


@njit(cache=True)
def _unfold_all(beams, node, edge, edges, room, reflections):  # type: ignore[no-untyped-def]
    """Whether each path to an edge comes from outside its wedge, and not from the edge itself; then `_Arrivals`."""
    good, count = np.empty(len(node), np.bool_), np.empty(len(node), np.int64)
    length, walls = np.empty(len(node)), np.empty((len(node), reflections), np.int64)
    points, cosine = np.empty((len(node), reflections, 3)), np.empty((len(node), reflections))
    angle, lit = np.empty(len(node)), np.empty(len(node), np.bool_)
    for i in range(len(node)):
        target = edges.position_m[edge[i]]
        count[i], length[i], good[i] = unfold(beams, node[i], room.walls_m, target, walls[i], points[i])
        if not good[i]:
            continue
        x, y = room.tx_m[0], room.tx_m[1]
        if count[i] > 0:
            x, y = points[i, count[i] - 1, 0], points[i, count[i] - 1, 1]
            incidence(room.walls_m, room.tx_m, target, walls[i, : count[i]], points[i], cosine[i])
        x, y = x - target[0], y - target[1]
        lit[i], outside = _outside(edges.normals[edge[i]], x, y)
        good[i] = outside and np.hypot(x, y) > _NEAR_M
        angle[i] = _angle_rad(edges, edge[i], x, y)
    return good, count, length, walls, points, cosine, angle, lit


@njit(cache=True)
def _root(parent, node):  # type: ignore[no-untyped-def]
    """Root of a node's tree."""
    while parent[node] >= 0:
        node = parent[node]
    return node


@njit(cache=True)
def _outside(normals, x, y):  # type: ignore[no-untyped-def]
    """Whether a point, seen from the edge, is in front of the 0-face of a wedge, and in front of either face."""
    first = normals[0] * x + normals[1] * y > _EXTERIOR_M
    return first, first or normals[2] * x + normals[3] * y > _EXTERIOR_M


@njit(cache=True)
def _angle_rad(edges, edge, x, y):  # type: ignore[no-untyped-def]
    """Angle of a direction from an edge, counted from its 0-face, where rounding may turn 0 into 2 pi."""
    angle = (np.arctan2(y, x) - edges.face_rad[edge]) % (2 * np.pi)
    return 0.0 if angle > 0.5 * edges.exterior_rad[edge] + np.pi else angle


@njit(cache=True, nogil=True)
def _combine(beams, best, group, edges, arrivals, room, reflections, strengths):  # type: ignore[no-untyped-def]
    """Join arrivals at edges and departures from them: receivers, wedges, surfaces and vertices of candidates."""
    size = reflections + 1
    rx, wedge = np.empty(1024, np.int32), np.empty(1024, np.int32)
    surface, vertices, used = np.empty((1024, size), np.int32), np.empty((1024, size, 3)), np.int64(0)
    walls, points, cosine = np.empty(size, np.int64), np.empty((size, 3)), np.empty(size)
    all_walls, all_points, terms, flat = np.empty(size, np.int64), np.empty((size, 3)), np.empty(4), np.empty(2)
    for i in range(len(beams.pair_node)):
        here = beams.pair_rx[i]
        if best[i] >= strengths.last[here]:
            continue
        best[i] = LEVELS
        edge = group[_root(beams.parent, beams.pair_node[i]) // 4]
        target, origin = room.rx_m[here], edges.position_m[edge]
        after, onward, good = unfold(beams, beams.pair_node[i], room.walls_m, target, walls, points)
        ox, oy = (points[0, 0], points[0, 1]) if after > 0 else (target[0], target[1])
        ox, oy = ox - origin[0], oy - origin[1]
        if not good or np.hypot(ox, oy) < _NEAR_M or not _outside(edges.normals[edge], ox, oy)[1]:
            continue
        incidence(room.walls_m, origin, target, walls[:after], points, cosine)
        departure = _angle_rad(edges, edge, ox, oy)
        for j in range(arrivals.start[edge], arrivals.start[edge + 1]):
            before = arrivals.reflections[j]
            left = reflections - before - after
            if left < 0:
                continue
            length = arrivals.length_m[j]
            _diffract(strengths, edges.exterior_rad[edge], arrivals, j, departure, onward, terms, flat)
            for bounces in range(left + 1):
                for first in (FLOOR, CEILING):
                    if not can_bounce(bounces, first, room):
                        continue
                    height = unfolded_height(room, target, bounces, first)
                    power = _diffracted_power(strengths, terms, flat, length, onward, height, bounces)
                    sine = (length + onward) / np.hypot(length + onward, height)
                    for k in range(before):
                        power *= reflected_power(strengths.reflection[0], arrivals.cosine[j, k] * sine)
                    for k in range(after):
                        power *= reflected_power(strengths.reflection[0], cosine[k] * sine)
                    level = level_of(power)
                    if len(strengths.power):
                        strengths.power[here, level] += power
                    best[i] = min(best[i], level)
                    if not strengths.first[here] <= level < strengths.last[here]:
                        continue
                    rx, wedge = grow(rx, used + 1), grow(wedge, used + 1)
                    surface, vertices = grow(surface, used + 1), grow(vertices, used + 1)
                    rx[used], wedge[used] = here, edge if arrivals.lit[j] else edge + len(edges.position_m)
                    clear(surface[used], vertices[used])
                    count = _join(arrivals, j, origin, walls[:after], points, onward, all_walls, all_points)
                    whole = all_walls[:count], all_points[:count]
                    merge_heights(*whole, room, target, bounces, first, surface[used], vertices[used])
                    used += 1
    return rx[:used].copy(), wedge[:used].copy(), surface[:used].copy(), vertices[:used].copy()


@njit(cache=True)
def _diffract(strengths, exterior, arrivals, j, departure, onward, terms, flat):  # type: ignore[no-untyped-def]
    """Write the UTD terms of a path over an edge, and the cosines of incidence at its two faces.

    Angles count from the face that is lit.
    """
    arrival, length = arrivals.angle_rad[j], arrivals.length_m[j]
    if not arrivals.lit[j]:
        arrival, departure = exterior - arrival, exterior - departure
    most = 0.5 * np.sqrt(4.0 * np.pi**2 / strengths.wavelength_m * length * onward / (length + onward))
    utd_terms(exterior, arrival, departure, most, terms)
    flat[0] = np.sin(arrival)
    flat[1] = np.sin(exterior - arrival)
    if exterior > np.pi + arrival:
        flat[1] = 2.0  # the other face is in the shadow: Sionna RT takes it for a perfect mirror


@njit(cache=True)
def _diffracted_power(strengths, terms, flat, length, onward, height, bounces):  # type: ignore[no-untyped-def]
    """Upper bound of the power over an edge, without the reflections at walls."""
    total = np.hypot(length + onward, height)
    sine = (length + onward) / total
    first = np.sqrt(reflected_power(strengths.reflection[0], flat[0] * sine))
    last = 1.0 if flat[1] > 1.0 else np.sqrt(reflected_power(strengths.reflection[0], flat[1] * sine))
    field = (first * (terms[0] + terms[3]) + last * (terms[1] + terms[2])) / sine
    wavelength = strengths.wavelength_m
    spread = sine * sine / (length * onward * total)  # 1 / (s s' (s + s'))
    power = (wavelength / (4.0 * np.pi)) ** 2 * spread * field**2 * wavelength / (4.0 * np.pi**2)
    return power * reflected_power(strengths.reflection[0], height / total) ** bounces if bounces > 0 else power


@njit(cache=True)
def _join(arrivals, j, origin, walls, points, onward, all_walls, all_points):  # type: ignore[no-untyped-def]
    """Write the walls and the edge that a whole path meets, and where, as `unfold` does; return their number."""
    before, length = arrivals.reflections[j], arrivals.length_m[j]
    total = length + onward
    for n in range(before):
        all_walls[n] = arrivals.walls[j, n]
        all_points[n, 0], all_points[n, 1] = arrivals.points[j, n, 0], arrivals.points[j, n, 1]
        all_points[n, 2] = arrivals.points[j, n, 2] * length / total
    all_walls[before] = DIFFRACTED
    all_points[before, 0], all_points[before, 1], all_points[before, 2] = origin[0], origin[1], length / total
    for n in range(len(walls)):
        all_walls[before + 1 + n] = walls[n]
        all_points[before + 1 + n, 0], all_points[before + 1 + n, 1] = points[n, 0], points[n, 1]
        all_points[before + 1 + n, 2] = (length + onward * points[n, 2]) / total
    return before + 1 + len(walls)
