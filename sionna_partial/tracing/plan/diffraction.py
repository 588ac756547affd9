"""Candidates of floor plans that are diffracted once at a vertical edge, with few reflections before and after.

An edge is a point in the plan. Beams from the transmitter reach edges, beams from an edge reach receivers, and a path
joins one of each. On a vertical edge Keller's cone keeps the slope of a path, so heights unfold along the whole path in
the plan as they do without the edge.
"""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.process import in_order, njit
from sionna_partial.scene.floor_plan import Plan, bin_points, grow
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import DIFFRACTION, REFLECTION
from sionna_partial.tracing.paths import Candidates, Wedges
from sionna_partial.tracing.plan.beams import Beams, trace_beams_in
from sionna_partial.tracing.plan.specular import (
    CEILING,
    EDGE,
    FLOOR,
    NOTHING,
    WALLS,
    Room,
    can_bounce,
    faces_of,
    incidence,
    merge_heights,
    unfold,
    unfolded_height,
)
from sionna_partial.tracing.power import (
    Materials,
    at_edge,
    at_flats,
    at_wall,
    gain_towards,
    most_at_edge,
    most_at_wall,
    utd_terms,
    wedge_angle,
    wedge_constants,
)
from sionna_partial.tracing.select import Listed

MAX_REFLECTIONS = 2
"""Largest number of reflections around the diffraction, those off floor and ceiling included."""

_EXTERIOR_M = 1e-5
"""Distance from the plane of a face [m] at which the path solver counts a point as outside a wedge."""

_NEAR_M = 1e-3
"""Shortest leg in the plan next to an edge [m]: walls that meet there do not reflect it."""

NEGLIGIBLE = 3e-6
"""Rough bound of diffracted paths, relative to the reflected ones of a link, below which none is listed."""

_FLAT_RAD = 1e-3
"""Walls that meet at less than this angle from a straight line form no edge [rad]."""

_EDGES_AT_ONCE = 32
"""Number of edges whose beams are held in memory together. It does not depend on the receivers, nor does the order of
the candidates."""


class _Arrivals(NamedTuple):
    """J paths from the transmitter to edges, ordered by edge.

    `start` (E + 1,) gives the first of each edge, `reflections` (J,) their number, `length_m` (J,) the length in
    the plan, `walls` (J, R) and `points` (J, R, 3) the reflections as `unfold` writes them, `material` (J, R) of
    those walls, `cosine` (J, R) of the angles of incidence there, `angle` (J, 4) the direction of arrival as
    `wedge_angle` gives it, `faces` (J, 2) the cosines of the angles of incidence at 0-face and n-face, -1 in the
    shadow, and `lit` (J,) whether the 0-face is lit. `toward` (J, 2) are horizontal unit vectors of departure, and
    `gain` (J,) the largest gain of the antenna there.
    """

    start: NDArray[np.int64]
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


class _Edges(NamedTuple):
    """Edges in the plan: positions (E, 2) [m], direction of the 0-face and exterior angle [rad], normals (E, 4).

    `utd` (E, 5) are the `wedge_constants`, and `material` (E, 2) is the one of both faces where the 0-face is lit, and
    where it is not: to Sionna RT an edge is of one shape.
    """

    position_m: Floats
    face_rad: Floats
    exterior_rad: Floats
    normals: Floats
    utd: Floats
    material: NDArray[np.int64]


class _Departure(NamedTuple):
    """Scratch of a leg after an edge: walls and points as `unfold` writes them, cosines of the angles of incidence.

    `material` has the material of each wall, and at its end of floor and ceiling.
    """

    walls: NDArray[np.int64]
    points: Floats
    cosine: Floats
    material: NDArray[np.int64]


class _Task(NamedTuple):
    """Beams from a group of edges, all edges, arrivals there, the room, and the most reflections of a path."""

    beams: Beams
    group: Indices
    edges: _Edges
    arrivals: _Arrivals
    room: Room
    reflections: int


class _Pair(NamedTuple):
    """The number of a pair of a beam from an edge and a receiver, and the arrivals there, `start` to `stop`.

    `left` is how many more reflections a path may have, `onward_m` the length of the leg, `departure` its direction as
    `wedge_angle` gives it. `material` and `cosine` are as in a `_Departure`, `utd` (5,) and `at_faces` (2,)
    as in `_Edges`, `heights_m` as `_heights` gives them.
    """

    number: np.int32
    start: np.int64
    stop: np.int64
    left: np.int64
    onward_m: float
    departure: tuple[float, float, float, float]
    material: NDArray[np.int64]
    cosine: Floats
    utd: Floats
    at_faces: NDArray[np.int64]
    heights_m: Floats


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
        height_m=geometry.top_m[pair[:, 0] // 2],
        face=np.concatenate([pair, pair[:, ::-1]]),
        normal=np.concatenate([normal, normal[:, ::-1]]),
    )


class DiffractionCandidates:
    """All paths over one vertical edge, with at most two reflections, and `walls_a_side` of them at walls on each side.

    The beams from the edges are traced on all cores.
    """

    name = "diffractions"

    def __init__(
        self,
        geometry: SceneGeometry,
        wedges: Wedges,
        room: Room,
        max_depth: int,
        materials: Materials,
        walls_a_side: int = MAX_REFLECTIONS,
    ) -> None:
        self._geometry, self._wedges, self._room, self._materials = geometry, wedges, room, materials
        self._reflections = min(MAX_REFLECTIONS, max_depth - 1)
        self._walls_a_side = min(walls_a_side, self._reflections)

    def listed(self, found: Floats) -> Iterator[Listed]:
        """List the candidates over some edges at a time; those far below the power `found` (N,) are negligible."""
        if self._reflections < 0 or not len(self._wedges.edge_m):
            return
        plan, room = self._geometry.plan, self._room
        edges, receivers = edges_of(self._wedges, room.wall_material), bin_points(room.rx_m[:, :2])
        arrivals = _arrivals(plan, edges, room, self._walls_a_side)
        reached = np.flatnonzero(np.diff(arrivals.start))
        groups = [reached[first : first + _EDGES_AT_ONCE] for first in range(0, len(reached), _EDGES_AT_ONCE)]

        def of_group(number: int) -> Listed:
            group = groups[number]
            fewest = np.minimum.reduceat(arrivals.reflections, arrivals.start[group])
            onward = np.minimum(self._walls_a_side, self._reflections - fewest)
            beams = trace_beams_in(plan, receivers, self._wedges.edge_m[group], onward)
            task = _Task(beams, group, edges, arrivals, room, self._reflections)
            pair, joined, bound, unlisted = _list_joined(task, self._materials, NEGLIGIBLE * found)
            write = partial(self._written, task, pair, joined)
            return Listed(beams.pair_rx[pair], bound, write, (number + 1) / len(groups), unlisted)

        yield from in_order(of_group, range(len(groups)))

    def _written(self, task: "_Task", pair: Indices, joined: Indices, rows: Indices) -> Candidates:
        rx, wedge, surface, vertices_m = _write_joined(task, pair[rows], joined[rows])
        edge, met = surface == EDGE, surface != NOTHING
        kind = np.where(edge, DIFFRACTION, np.where(met, REFLECTION, 0)).astype(np.uint8)
        face = np.where(edge, self._wedges.face[wedge, :1], faces_of(surface, self._geometry))
        return Candidates(rx, kind, face, vertices_m, wedge, self._wedges)


def edges_of(wedges: Wedges, wall_material: NDArray[np.int64]) -> _Edges:
    """Lay out wedges for the search of paths."""
    normals = wedges.normal[: len(wedges.edge_m)]
    face_rad, end_rad = np.arctan2(-normals[:, 0, 0], normals[:, 0, 1]), np.arctan2(normals[:, 1, 0], -normals[:, 1, 1])
    exterior_rad = (end_rad - face_rad) % (2 * np.pi)
    exterior_rad[exterior_rad < _FLAT_RAD] = 2 * np.pi  # the free end of a wall
    material = wall_material[wedges.face[: len(wedges.edge_m)] // 2]
    constants = wedge_constants(exterior_rad)
    return _Edges(wedges.edge_m, face_rad, exterior_rad, normals.reshape(-1, 4), constants, material)


def _arrivals(plan: Plan, edges: _Edges, room: Room, reflections: int) -> _Arrivals:
    """Find the paths of at most `reflections` walls from the transmitter to each edge."""
    beams = trace_beams_in(plan, bin_points(edges.position_m), room.tx_m[None, :2], np.array([reflections]))
    order = np.argsort(beams.pair_rx, kind="stable")
    node, edge = beams.pair_node[order], beams.pair_rx[order]
    good, *columns = _unfold_all(beams, node, edge, edges, room, max(1, reflections))
    start = np.searchsorted(edge[good], np.arange(len(edges.position_m) + 1))
    count, _, _, points_m = columns[:4]
    first_m = np.where(count[:, None] > 0, points_m[:, 0, :2], edges.position_m[edge])[good] - room.tx_m[:2]
    toward = first_m / np.maximum(np.hypot(*first_m.T), 1e-12)[:, None]
    degrees = (np.degrees(np.arctan2(toward[:, 1], toward[:, 0])) + 360.5).astype(np.intp)
    gain = room.gains.by_azimuth[degrees % len(room.gains.by_azimuth)]
    return _Arrivals(*[start, *(column[good] for column in columns), toward, gain])


@njit(cache=True)
def _unfold_all(beams, node, edge, edges, room, reflections):  # type: ignore[no-untyped-def]
    """Return whether each path reaches an edge from outside its wedge, and the columns of `_Arrivals`."""
    good, count = np.empty(len(node), np.bool_), np.empty(len(node), np.int64)
    length, walls = np.empty(len(node)), np.empty((len(node), reflections), np.int64)
    points, cosine = np.empty((len(node), reflections, 3)), np.empty((len(node), reflections))
    material = np.zeros((len(node), reflections), np.int64)
    angle, faces, lit = np.empty((len(node), 4)), np.empty((len(node), 2)), np.empty(len(node), np.bool_)
    for i in range(len(node)):
        target = edges.position_m[edge[i]]
        count[i], length[i], good[i] = unfold(
            beams.parent, beams.segment, beams.source, node[i], room.walls_m, target, walls[i], points[i]
        )
        if not good[i]:
            continue
        x, y = room.tx_m[0], room.tx_m[1]
        if count[i] > 0:
            x, y = points[i, count[i] - 1, 0], points[i, count[i] - 1, 1]
            incidence(room.walls_m, room.tx_m, target, walls[i, : count[i]], points[i], cosine[i])
            for k in range(count[i]):
                material[i, k] = room.wall_material[walls[i, k]]
        x, y = x - target[0], y - target[1]
        lit[i], in_front = outside(edges.normals[edge[i]], x, y)
        good[i] = in_front and np.hypot(x, y) > _NEAR_M
        exterior = edges.exterior_rad[edge[i]]
        from_0 = angle_rad(edges.face_rad[edge[i]], exterior, x, y)
        angle[i, 0], angle[i, 1], angle[i, 2], angle[i, 3] = wedge_angle(from_0, exterior)
        for k, from_face in enumerate((from_0, exterior - from_0)):
            faces[i, k] = max(0.0, np.sin(from_face)) if from_face <= np.pi else -1.0
    return good, count, length, walls, points, material, cosine, angle, faces, lit


@njit(cache=True)
def _root(parent, node):  # type: ignore[no-untyped-def]
    """Root of a node's tree."""
    while parent[node] >= 0:
        node = parent[node]
    return node


@njit(cache=True)
def outside(normals, x, y):  # type: ignore[no-untyped-def]
    """Return whether a point, seen from the edge, is in front of the 0-face of a wedge, and in front of either face."""
    first = normals[0] * x + normals[1] * y > _EXTERIOR_M
    return first, first or normals[2] * x + normals[3] * y > _EXTERIOR_M


@njit(cache=True)
def angle_rad(face_rad, exterior_rad, x, y):  # type: ignore[no-untyped-def]
    """Angle of a direction from an edge, counted from its 0-face, where rounding may turn 0 into 2 pi."""
    angle = (np.arctan2(y, x) - face_rad) % (2 * np.pi)
    return 0.0 if angle > 0.5 * exterior_rad + np.pi else angle


@njit(cache=True, nogil=True)
def _list_joined(task, materials, negligible):  # type: ignore[no-untyped-def]
    """Join arrivals at edges and departures from them: pairs, arrivals with variants, and bounds (C,); unlisted (N,).

    The number of an arrival, and twice the reflections at floor and ceiling with the first of these, are one number.
    Loops take arrays out of tuples before they begin: numba counts references at every access, on all cores.
    """
    beams, group, edges, arrivals, room, reflections = task
    size, unlisted = reflections + 1, np.zeros(len(room.rx_m))
    out = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty(1024), np.int64(0)
    leg, terms = _leg_of(room, size), np.empty((4, 3))
    start, pair_rx, pair_node, heights = arrivals.start, beams.pair_rx, beams.pair_node, _heights(room, size)
    most = _most_of_arrivals(materials.largest, arrivals, edges.material, heights.max())
    for i in range(len(pair_node)):
        here = pair_rx[i]
        edge, target = group[_root(beams.parent, pair_node[i]) // 4], room.rx_m[here]
        after, onward, departure = _depart(beams, pair_node[i], edges, edge, room, target, leg)
        if after < 0:
            continue
        arrived, beyond = (start[edge], start[edge + 1]), (leg.material, leg.cosine[:after])
        of_edge = edges.utd[edge], edges.material[edge], heights[here]
        pair = _Pair(np.int32(i), *arrived, reflections - after, onward, departure, *beyond, *of_edge)
        rises = 1.0 if target[2] >= room.tx_m[2] else -1.0
        out, rough = _bound(materials, arrivals, most, pair, negligible[here], terms, (room.gains, rises), out)
        unlisted[here] += rough
    pairs, joined, bound, used = out
    return pairs[:used].copy(), joined[:used].copy(), bound[:used].copy(), unlisted


@njit(cache=True, nogil=True)
def _write_joined(task, pairs, joined):  # type: ignore[no-untyped-def]
    """Write receivers, wedges (C,), surfaces (C, D) and vertices (C, D, 3) of candidates."""
    beams, group, edges, arrivals, room, reflections = task
    size, count = reflections + 1, len(pairs)
    rx, wedge = np.empty(count, np.int32), np.empty(count, np.int32)
    surface, vertices = np.zeros((count, size), np.int32), np.zeros((count, size, 3))
    leg, met, points = _leg_of(room, size), np.empty(size, np.int64), np.empty((size, 3))
    for c in range(count):
        node, j, variant = beams.pair_node[pairs[c]], joined[c] // (2 * size), joined[c] % (2 * size)
        rx[c] = beams.pair_rx[pairs[c]]
        edge, target = group[_root(beams.parent, node) // 4], room.rx_m[rx[c]]
        after, onward, _ = _depart(beams, node, edges, edge, room, target, leg)
        wedge[c] = edge if arrivals.lit[j] else edge + len(edges.position_m)
        number = _join(arrivals, j, edges.position_m[edge], leg.walls[:after], leg.points, onward, met, points)
        whole, first = (met[:number], points[:number]), FLOOR + variant % 2
        merge_heights(*whole, room, target, variant // 2, first, surface[c], vertices[c])
    return rx, wedge, surface, vertices


@njit(cache=True)
def _leg_of(room, size):  # type: ignore[no-untyped-def]
    """Make room for a leg after an edge."""
    return _Departure(
        np.empty(size, np.int64), np.empty((size, 3)), np.empty(size), np.full(size + 1, room.flat_material)
    )


@njit(cache=True)
def _depart(beams, node, edges, edge, room, target, leg):  # type: ignore[no-untyped-def]
    """Write a leg from an edge to a receiver: its number of walls (-1 if there is none), length [m] and direction."""
    origin, exterior = edges.position_m[edge], edges.exterior_rad[edge]
    count, length, good = unfold(
        beams.parent, beams.segment, beams.source, node, room.walls_m, target, leg.walls, leg.points
    )
    x, y = (leg.points[0, 0], leg.points[0, 1]) if count > 0 else (target[0], target[1])
    x, y = x - origin[0], y - origin[1]
    direction = wedge_angle(angle_rad(edges.face_rad[edge], exterior, x, y), exterior)
    if not good or np.hypot(x, y) < _NEAR_M or not outside(edges.normals[edge], x, y)[1]:
        return -1, length, direction
    incidence(room.walls_m, origin, target, leg.walls[:count], leg.points, leg.cosine)
    for k in range(count):
        leg.material[k] = room.wall_material[leg.walls[k]]
    return count, length, direction


@njit(cache=True)
def _heights(room, size):  # type: ignore[no-untyped-def]
    """Heights [m] that paths to each receiver cover (N, bounces, 2), off floor or ceiling first; -1 where none can."""
    heights = np.empty((len(room.rx_m), size, 2))
    for rx in range(len(room.rx_m)):
        for bounces in range(size):
            for first in (FLOOR, CEILING):
                possible = can_bounce(bounces, first, room)
                height = unfolded_height(room, room.rx_m[rx], bounces, first) if possible else -1.0
                heights[rx, bounces, first - FLOOR] = height
    return heights


@njit(cache=True)
def _bound(materials, arrivals, most, pair, negligible, terms, antenna, out):  # type: ignore[no-untyped-def]
    """Add all paths of a pair: one for each arrival, number of bounces and first flat; return the unlisted power.

    Paths with a rough bound below `negligible`, which takes `most`, are not listed. `antenna` are its gains, and 1 or
    -1 where paths without reflections at floor and ceiling rise or fall.
    """
    largest, tables, wavelength = (
        materials.largest,
        (materials.reflection, materials.transition),
        materials.wavelength_m,
    )
    earlier, is_lit, lengths, reflections, angle, lit, before = (
        arrivals.material,
        arrivals.lit,
        arrivals.length_m,
        arrivals.reflections,
        arrivals.angle,
        arrivals.faces,
        arrivals.cosine,
    )
    toward, gain, (gains, rises) = arrivals.toward, arrivals.gain, antenna
    directed = len(gains.table) > 1
    number, start, stop, remain, onward, departure, material, cosine, utd, at_faces, heights = pair
    constants = utd[0], utd[1], utd[2], utd[3], utd[4]
    most_after = _most_at_walls(largest, material, cosine, len(cosine), onward, heights.max())
    pairs, joined, bound, used = out
    unlisted, size = 0.0, len(heights)
    for j in range(start, stop):
        left, length = remain - reflections[j], lengths[j]
        if left < 0:
            continue
        utd_terms(constants, (angle[j, 0], angle[j, 1], angle[j, 2], angle[j, 3]), departure, terms)
        spread = wavelength**3 / (64.0 * np.pi**4 * length * onward)
        boundary = 4.0 * np.pi / wavelength * length * onward / (length + onward)
        amplitude = most_after * most[j, 0] * most_at_edge(terms, np.sqrt(boundary), most[j, 1], most[j, 2])
        rough = (2 * left + 1) * amplitude**2 * spread / (length + onward) * gain[j]
        if rough < negligible:
            unlisted += rough
            continue
        for bounces in range(left + 1):
            for up in range(2):
                height = heights[bounces, up]
                if height < 0.0:
                    continue
                total = np.sqrt((length + onward) ** 2 + height**2)
                sine, slope, field = (length + onward) / total, height / total, (1.0, 0.0, 1.0)
                for k in range(reflections[j]):
                    field = at_wall(largest, earlier[j, k], before[j, k], sine, slope, field)
                edge = np.sqrt(boundary * sine)
                own = at_faces[0] if is_lit[j] else at_faces[1]
                field = at_edge(tables, own, terms, edge, (lit[j, 0], lit[j, 1]), sine, slope, field)
                for k in range(len(cosine)):
                    field = at_wall(largest, material[k], cosine[k], sine, slope, field)
                pairs, joined, bound = grow(pairs, used + 1), grow(joined, used + 1), grow(bound, used + 1)
                pairs[used], joined[used] = number, (j * size + bounces) * 2 + up
                strength = at_flats(largest, material[-1], slope, bounces, field) ** 2 * spread / total
                if directed:
                    rise = (rises if bounces == 0 else 2.0 * up - 1.0) * height / (length + onward)
                    strength *= gain_towards(gains, toward[j, 0], toward[j, 1], rise)
                bound[used] = strength
                used += 1
    return (pairs, joined, bound, used), unlisted


@njit(cache=True)
def _most_of_arrivals(largest, arrivals, material, highest):  # type: ignore[no-untyped-def]
    """Return bounds (J, 3) of fields that arrive at edges, and of reflections at the two faces there."""
    most = np.empty((len(arrivals.lit), 3))
    for edge in range(len(arrivals.start) - 1):
        for j in range(arrivals.start[edge], arrivals.start[edge + 1]):
            length, own = arrivals.length_m[j], material[edge] if arrivals.lit[j] else material[edge, 1:]
            most[j, 0] = _most_at_walls(
                largest, arrivals.material[j], arrivals.cosine[j], arrivals.reflections[j], length, highest
            )
            for k in range(2):
                face = arrivals.faces[j, k : k + 1]
                most[j, 1 + k] = _most_at_walls(largest, own, face, 1, length, highest) if face[0] >= 0.0 else 1.0
    return most


@njit(cache=True)
def _most_at_walls(largest, material, cosine, count, length, highest):  # type: ignore[no-untyped-def]
    """Bound of what walls leave of a field whose path has some length in the plan, and rises by `highest` at most."""
    most, sine = 1.0, length / np.sqrt(length * length + highest * highest)
    for k in range(count):
        most *= most_at_wall(largest, material[k], cosine[k] * sine)
    return most


@njit(cache=True)
def _join(arrivals, j, origin, walls, points, onward, met, met_points):  # type: ignore[no-untyped-def]
    """Write the surfaces that a whole path meets in the plan, and where, as `unfold` does; return their number."""
    before, length = arrivals.reflections[j], arrivals.length_m[j]
    total = length + onward
    for n in range(before):
        met[n] = WALLS + arrivals.walls[j, n]
        met_points[n, 0], met_points[n, 1] = arrivals.points[j, n, 0], arrivals.points[j, n, 1]
        met_points[n, 2] = arrivals.points[j, n, 2] * length / total
    met[before] = EDGE
    met_points[before, 0], met_points[before, 1], met_points[before, 2] = origin[0], origin[1], length / total
    for n in range(len(walls)):
        met[before + 1 + n] = WALLS + walls[n]
        met_points[before + 1 + n, 0], met_points[before + 1 + n, 1] = points[n, 0], points[n, 1]
        met_points[before + 1 + n, 2] = (length + onward * points[n, 2]) / total
    return before + 1 + len(walls)
