"""Paths of a floor plan that are diffracted once at a vertical edge.

An edge is a point in the plan. A candidate joins a path from the transmitter to an edge and a path from there to a
receiver. On a vertical edge Keller's cone keeps the slope of a path, so that heights unfold along the whole path.

Between opaque walls, beams find pairs of edges and receivers with few reflections; through walls, straight lines join
all edges and receivers.
"""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.process import in_order, njit
from sionna_partial.scene.outlines import bin_points, grow
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import DIFFRACTION, REFLECTION
from sionna_partial.tracing.paths import Candidates, Wedges
from sionna_partial.tracing.plan.beams import BeamTree, Sources, needed_of, trace_beams
from sionna_partial.tracing.plan.clipping import EXPECTED
from sionna_partial.tracing.plan.reflections import CrossingCandidates, unfold
from sionna_partial.tracing.plan.room import (
    Building,
    Leg,
    Room,
    add_entry,
    candidates_of,
    cross_leg,
    empty_paths,
    gain_of_departure,
    has_long_legs,
    has_variant,
    rise_of,
    trail_of,
    write_path,
)
from sionna_partial.tracing.power import (
    Materials,
    at_edge,
    at_face,
    at_flats,
    at_wall,
    gain_at_azimuth,
    most_at_edge,
    most_at_wall,
    power_near,
    utd_terms,
    wedge_angle,
    wedge_constants,
)
from sionna_partial.tracing.select import Listed

MAX_REFLECTIONS = 2
"""Largest number of reflections around the diffraction, floor and ceiling included."""

_EXTERIOR_M = 1e-5
"""Distance from a face [m] at which the path solver counts a point as outside a wedge."""

_NEAR_M = 1e-3
"""Shortest leg next to an edge [m]: walls that meet there do not reflect it."""

_ASIDE_M = 1e-3
"""Distance from an edge at which a leg through walls ends [m]: walls that meet there are not crossed."""

_NEGLIGIBLE = 3e-5
"""Smallest rough bound of a listed diffracted path, relative to the reflected paths of its link."""

_UNSEEN = 1e-18
"""Power of a path below which no gain, at least -150 dB, shows it."""

_HALF_DEGREE = 0.0044
"""Sine of half of half a degree."""

_FLAT_RAD = 1e-3
"""Smallest angle between walls and a straight line at an edge [rad]."""

_EDGES_AT_ONCE = 32
"""Number of edges whose beams are in memory together; the order of candidates depends on it."""

_VARIANTS = 4
"""Variants of paths through walls: at most one reflection at floor or ceiling."""


class _Arrivals(NamedTuple):
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


class _Edges(NamedTuple):
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
    def of(cls, wedges: Wedges, wall_material: NDArray[np.int64]) -> "_Edges":
        normals, count = wedges.normal[: len(wedges.edge_m)], len(wedges.edge_m)
        face_rad = np.arctan2(-normals[:, 0, 0], normals[:, 0, 1])
        exterior_rad = (np.arctan2(normals[:, 1, 0], -normals[:, 1, 1]) - face_rad) % (2 * np.pi)
        exterior_rad[exterior_rad < _FLAT_RAD] = 2 * np.pi  # the free end of a wall
        material, constants = wall_material[wedges.face[:count] // 2], wedge_constants(exterior_rad)
        flat = np.ascontiguousarray(normals.reshape(-1, 4))
        return cls(wedges.edge_m, face_rad, exterior_rad, flat, constants, material)


class _Departures(NamedTuple):
    """K paths from edges to receivers.

    `edge` and `rx` (K,) are their ends, `reflections` (K,) their number, too large where a leg is too short or inside
    the wedge, `length_m` (K,) the length in the plan. `material` and `cosine` (K, R) are as in `_Arrivals`, `most` (K,)
    bounds the field after these walls, `azimuth_deg` and `angle` (K, 4) are the direction at the edge, from x in whole
    degrees and as in `wedge_angle`.
    """

    edge: NDArray[np.int64]
    rx: NDArray[np.int64]
    reflections: NDArray[np.int64]
    length_m: Floats
    material: NDArray[np.int64]
    cosine: Floats
    most: Floats
    azimuth_deg: NDArray[np.int64]
    angle: Floats


class _Bounds(NamedTuple):
    """Bounds of arrivals from `_bounds_of_arrivals`, and the largest rise of a path [m]."""

    most: Floats
    faces: NDArray[np.complex128]
    power: Floats
    highest_m: float


def find_wedges(geometry: SceneGeometry, *, open_ends: bool) -> Wedges:
    """Find the vertical edges that diffract, with or without those where observation ended."""
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
    face = (order ^ 1).astype(np.int32)  # the second of the two triangles of a wall is at its first end
    pair = np.stack([face[wide], face[after[wide]]], axis=1)
    first, last = angle[wide], angle[after[wide]]
    normal = np.array([[-np.sin(first), np.cos(first)], [np.sin(last), -np.cos(last)]]).transpose(2, 0, 1)
    return Wedges(
        edge_m=geometry.vertices_m[vertex[wide]],
        height_m=geometry.top_m[pair[:, 0] // 2],
        face=np.concatenate([pair, pair[:, ::-1]]),
        normal=np.concatenate([normal, normal[:, ::-1]]),
    )


class _EdgeCandidates:
    """Paths over one vertical edge in a building."""

    def __init__(self, geometry: SceneGeometry, wedges: Wedges, building: Building) -> None:
        self._geometry, self._wedges, self._building = geometry, wedges, building
        self._edges = _Edges.of(wedges, building.room.wall_material)

    def _arrivals(self, tree: BeamTree, pairs: NDArray[np.int32], reflections: int) -> _Arrivals:
        pairs = pairs[np.argsort(pairs[:, 1], kind="stable")]
        trail = trail_of(self._geometry.plan)
        good, *columns = _unfold_all(tree, pairs, self._edges, self._building, max(1, reflections), trail)
        edge = pairs[good, 1]
        start = np.searchsorted(edge, np.arange(len(self._edges.position_m) + 1))
        return _Arrivals(start, edge, *(column[good] for column in columns))

    def _candidates(
        self, tree: BeamTree, arrivals: _Arrivals, chosen: tuple[Indices, Indices, Indices, Indices], size: int
    ) -> Candidates:
        paths = _write_joined(tree, self._edges, arrivals, chosen, self._building, trail_of(self._geometry.plan), size)
        edge, lit = arrivals.edge[chosen[2]], arrivals.lit[chosen[2]]
        wedge = np.where(lit, edge, edge + len(self._edges.position_m)).astype(np.int32)
        opaque = self._building.limits.walls == 0
        return candidates_of(self._geometry, chosen[1], paths, opaque=opaque, wedge=wedge, wedges=self._wedges)


class DiffractionCandidates(_EdgeCandidates):
    """All paths over one edge between opaque walls: at most two reflections, `walls_a_side` at walls on each side."""

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
        super().__init__(geometry, wedges, Building.opaque(geometry.plan, room, materials, max_depth))
        self._reflections = min(MAX_REFLECTIONS, max_depth - 1)
        self._walls_a_side = min(walls_a_side, self._reflections)

    def listed(self, found: Floats) -> Iterator[Listed]:
        if self._reflections < 0 or not len(self._wedges.edge_m):
            return
        room, edges = self._building.room, self._edges
        receivers, to_edges = bin_points(room.rx_m[:, :2]), bin_points(edges.position_m)
        transmitter = Sources.equal(room.tx_m[None, :2], self._walls_a_side, len(edges.position_m))
        arrivals = self._arrivals(*trace_beams(self._building, to_edges, transmitter), self._walls_a_side)
        materials, heights = self._building.materials, _heights(room, self._reflections + 1)
        reached, highest_m = np.flatnonzero(np.diff(arrivals.start)), heights.max()
        needed = needed_of(np.maximum(_NEGLIGIBLE * found, _UNSEEN if found.any() else 0.0), room, 4.0 * np.pi)
        if not len(reached):
            return
        most, faces, power = _bounds_of_arrivals(edges, arrivals, materials, highest_m)
        bounds = _Bounds(most, faces, power, highest_m)
        start = arrivals.start[reached]
        onward = np.arange(self._walls_a_side + 1)
        possible = arrivals.reflections[:, None] <= self._reflections - onward
        sums = [np.add.reduceat(power * some[:, None], start) for some in possible.T]
        more, strongest = np.logical_or.reduceat(possible, start).sum(axis=1) - 1, np.stack(sums, axis=1)
        position_m, before_m = edges.position_m[reached], np.minimum.reduceat(arrivals.length_m, start)
        groups = [slice(first, first + _EDGES_AT_ONCE) for first in range(0, len(reached), _EDGES_AT_ONCE)]

        def of_group(number: int) -> Listed:
            unlisted, group = np.zeros(len(found)), groups[number]
            ends = position_m[group], more[group], strongest[group], before_m[group]
            sources = Sources(*ends, needed, unlisted)
            tree, pairs = trace_beams(self._building, receivers, sources)
            departures = _depart(tree, pairs, reached[group], edges, self._building, highest_m, self._reflections)
            listing = edges, arrivals, departures, bounds
            pair, joined, bound = _list_joined(self._building, listing, heights, needed.power, unlisted)
            write = partial(self._written, tree, pairs, arrivals, pair, joined)
            return Listed(pairs[pair, 1], bound, write, (number + 1) / len(groups), unlisted)

        yield from in_order(of_group, range(len(groups)))

    def _written(
        self,
        tree: BeamTree,
        pairs: NDArray[np.int32],
        arrivals: _Arrivals,
        pair: NDArray[np.int32],
        joined: NDArray[np.int32],
        rows: Indices,
    ) -> Candidates:
        size, (node, rx) = self._reflections + 1, pairs[pair[rows]].T.copy()
        arrival, variant = np.divmod(joined[rows], 2 * size)
        return self._candidates(tree, arrivals, (node, rx, arrival, variant), size)


class CrossedEdgeCandidates(_EdgeCandidates):
    """All paths over one vertical edge, through at least one wall, without reflections at walls."""

    name = "diffractions through walls"

    def __init__(self, geometry: SceneGeometry, wedges: Wedges, crossing: CrossingCandidates) -> None:
        super().__init__(geometry, wedges, crossing.building)
        self._lowered = crossing.lowered

    def listed(self, found: Floats) -> Iterator[Listed]:
        count = len(self._wedges.edge_m)
        if not count:
            return
        edges, building, needed = self._edges, self._building, self._building.limits.min_power(found)
        pairs = np.stack([np.zeros(count, np.int32), np.arange(count, dtype=np.int32)], axis=1)
        arrivals = self._arrivals(_straight_lines(building.room.tx_m[None, :2].copy()), pairs, 0)

        def of_edges(first: int) -> tuple[NDArray[np.int32], Floats]:
            some = np.arange(first, min(first + _EDGES_AT_ONCE, count))
            return _list_crossed(some, edges, arrivals, needed, building, trail_of(building.plan))  # type: ignore[no-any-return]

        chosen, power = zip(*in_order(of_edges, range(0, count, _EDGES_AT_ONCE)), strict=True)
        columns = np.concatenate(chosen)
        yield Listed(columns[:, 1], np.concatenate(power), partial(self._written, arrivals, columns), 1.0)

    def _written(self, arrivals: _Arrivals, columns: NDArray[np.int32], rows: Indices) -> Candidates:
        edge, rx, arrival, variant = columns[rows].T.copy()
        size = len(trail_of(self._building.plan).surface) + 2
        tree = _straight_lines(self._edges.position_m)
        candidates = self._candidates(tree, arrivals, (edge, rx, arrival, variant), size)
        possible = (candidates.kind > 0).any(axis=1)  # an empty row would be a direct path once more
        return self._lowered(candidates.rows(np.flatnonzero(possible)))


def _straight_lines(sources_m: Floats) -> BeamTree:
    none = np.full(len(sources_m), -1, np.int32)
    return BeamTree(none, none, sources_m)


@njit(cache=True)
def _shortest_leg_m(building):
    return 20.0 * _ASIDE_M if building.limits.walls > 0 else _NEAR_M


@njit(cache=True)
def _unfold_all(tree, pairs, edges, building, reflections, trail):
    """Return which paths reach an edge from outside its wedge, and the columns of `_Arrivals`."""
    size, room, shortest_m = len(pairs), building.room, _shortest_leg_m(building)
    good, count, crossed = np.zeros(size, np.bool_), np.zeros(size, np.int64), np.zeros(size, np.int64)
    length, walls = np.zeros(size), np.zeros((size, reflections), np.int64)
    points, cosine = np.zeros((size, reflections, 3)), np.zeros((size, reflections))
    material, lit = np.zeros((size, reflections), np.int64), np.zeros(size, np.bool_)
    angle, faces, toward = np.zeros((size, 4)), np.zeros((size, 2)), np.zeros((size, 2))
    gain, left = np.ones(size), np.ones(size)
    for i in range(size):
        edge = pairs[i, 1]
        target, exterior = edges.position_m[edge], edges.exterior_rad[edge]
        count[i], length[i] = unfold(tree, pairs[i, 0], building.plan.pieces_m, target, trail.walls, trail.bounce)
        if count[i] < 0:
            continue
        (x, y), (to_x, to_y) = (room.tx_m[0], room.tx_m[1]), (target[0], target[1])
        for k in range(count[i]):
            x, y = trail.bounce[k, 0], trail.bounce[k, 1]
            points[i, k, 0], points[i, k, 1] = x, y
            points[i, k, 2], cosine[i, k], walls[i, k] = trail.bounce[k, 2], trail.bounce[k, 3], trail.walls[k]
            material[i, k] = building.material[walls[i, k]]
        if count[i] > 0:
            to_x, to_y = points[i, 0, 0], points[i, 0, 1]
        x, y, to_x, to_y = x - target[0], y - target[1], to_x - room.tx_m[0], to_y - room.tx_m[1]
        lit[i], good[i] = _outside(edges.normals, edge, x, y)
        good[i] &= np.hypot(x, y) > shortest_m
        if good[i] and building.limits.walls > 0:
            entries, crossed[i] = _to_edge(building, target, length[i], length[i], trail)
            good[i] = entries >= 0 and crossed[i] <= building.limits.walls
            left[i] = _leg_power(trail, max(entries, 0), building)
        from_0 = _angle_rad(edges.face_rad[edge], exterior, np.arctan2(y, x))
        angle[i, 0], angle[i, 1], angle[i, 2], angle[i, 3] = wedge_angle(from_0, exterior)
        for k, from_face in enumerate((from_0, exterior - from_0)):
            faces[i, k] = max(0.0, np.sin(from_face)) if from_face <= np.pi else -1.0
        away = max(np.hypot(to_x, to_y), 1e-12)
        toward[i, 0], toward[i, 1], gain[i] = to_x / away, to_y / away, gain_at_azimuth(room.gains, to_x, to_y)
    return good, count, length, walls, points, material, cosine, angle, faces, lit, toward, gain, left, crossed


@njit(cache=True)
def _leg_power(trail, count, building):
    """Return a bound of the power after a leg's walls, as if it were horizontal, for any polarisation."""
    power, table = 1.0, building.materials.transmission
    for k in range(count):
        if not (trail.same_wall[k] or building.plan.low[trail.surface[k]]):
            power *= power_near(table, building.material[trail.surface[k]], trail.cosine[k])
    return power


@njit(cache=True)
def _to_edge(building, origin, length, total, trail):
    part, tx_m = 1.0 - _ASIDE_M / length, building.room.tx_m
    x, y = tx_m[0] + part * (origin[0] - tx_m[0]), tx_m[1] + part * (origin[1] - tx_m[1])
    leg = Leg((tx_m[0], tx_m[1]), (x, y), np.int64(-1), np.int64(-1), 0.0, part * length / total)
    return cross_leg(building.plan, building.interior, leg, np.int64(0), trail)


@njit(cache=True)
def _from_edge(building, origin, target, length, total, count, trail):
    part = _ASIDE_M / length
    x, y = origin[0] + part * (target[0] - origin[0]), origin[1] + part * (target[1] - origin[1])
    done = (total - length + _ASIDE_M) / total
    leg = Leg((x, y), (target[0], target[1]), np.int64(-1), np.int64(-1), done, 1.0)
    return cross_leg(building.plan, building.interior, leg, count, trail)


@njit(cache=True)
def _outside(normals, edge, x, y):
    """Return whether a point, relative to an edge, is in front of the 0-face, and of either face."""
    first = normals[edge, 0] * x + normals[edge, 1] * y > _EXTERIOR_M
    return first, first or normals[edge, 2] * x + normals[edge, 3] * y > _EXTERIOR_M


@njit(cache=True)
def _angle_rad(face_rad, exterior_rad, azimuth_rad):
    """Return the angle of a direction from the 0-face of an edge; rounding may turn 0 into 2 pi."""
    angle = (azimuth_rad - face_rad) % (2 * np.pi)
    return 0.0 if angle > 0.5 * exterior_rad + np.pi else angle


@njit(cache=True)
def _strength(materials, walls, numbers, face, terms, path):
    """Return the bound of a vertical field after reflections and the diffraction, without the spread of the wave.

    `walls` are materials and cosines of arrivals and departures, `numbers` an arrival, a departure and their numbers of
    reflections, `face` the material of the wedge and the cosines at its faces, `path` sqrt(2 k L), the horizontal and
    vertical parts of the direction, the reflections at floor and ceiling, and the material there.
    """
    (reflection, transition, largest), (boundary, sine, slope, bounces, flat) = materials, path
    (material, cosine, material_after, cosine_after), (j, i, before, after) = walls, numbers
    field = 1.0, 0.0, 1.0
    for k in range(before):
        field = at_wall(largest, material[j, k], cosine[j, k], sine, slope, field)
    field = at_edge((reflection, transition), face[0], terms, boundary, (face[1], face[2]), sine, slope, field)
    for k in range(after):
        field = at_wall(largest, material_after[i, k], cosine_after[i, k], sine, slope, field)
    return at_flats(largest, flat, slope, bounces, field)


@njit(cache=True, nogil=True)
def _depart(tree, pairs, group, edges, building, highest, most_reflections):
    (parent, piece, source_m), (position_m, face_rad, exterior_rad, normals, _, _) = tree, edges
    rx_m, pieces_m, largest, materials = (
        building.room.rx_m,
        building.plan.pieces_m,
        building.materials.largest,
        building.material,
    )
    size, reflections = len(pairs), np.zeros(len(pairs), np.int64)
    edge, rx, azimuth_deg = np.empty(size, np.int64), pairs[:, 1].astype(np.int64), np.empty(size, np.int64)
    length_m, most, angle = np.empty(size), np.ones(size), np.empty((size, 4))
    material, cosine = np.empty((size, most_reflections), np.int64), np.empty((size, most_reflections))
    for i in range(size):
        node = root = pairs[i, 0]
        while parent[root] >= 0:
            root, reflections[i] = parent[root], reflections[i] + 1
        e = edge[i] = group[root // 4]
        x, y = rx_m[rx[i], 0] - source_m[node, 0], rx_m[rx[i], 1] - source_m[node, 1]
        length = near = np.sqrt(x * x + y * y)
        x, y, sine = x / length, y / length, length / np.sqrt(length * length + highest * highest)
        for k in range(reflections[i] - 1, -1, -1):
            wall = piece[node]
            px, py = pieces_m[wall, 0, 0], pieces_m[wall, 0, 1]
            wx, wy = pieces_m[wall, 1, 0] - px, pieces_m[wall, 1, 1] - py
            across, along, squared = abs(wx * y - wy * x), wx * x + wy * y, wx * wx + wy * wy
            near = abs(wx * (position_m[e, 1] - py) - wy * (position_m[e, 0] - px)) / max(across, 1e-15)
            material[i, k], cosine[i, k] = materials[wall], across / np.sqrt(squared)
            most[i] *= most_at_wall(largest, material[i, k], cosine[i, k] * sine)
            x, y, node = 2.0 * along / squared * wx - x, 2.0 * along / squared * wy - y, parent[node]
        if not (near >= _NEAR_M and _outside(normals, e, near * x, near * y)[1]):
            reflections[i] = most_reflections + 1
        azimuth, length_m[i] = np.arctan2(y, x), length
        azimuth_deg[i] = int(np.degrees(azimuth) + 360.5) % 360
        turned = wedge_angle(_angle_rad(face_rad[e], exterior_rad[e], azimuth), exterior_rad[e])
        angle[i, 0], angle[i, 1], angle[i, 2], angle[i, 3] = turned
    return _Departures(edge, rx, reflections, length_m, material, cosine, most, azimuth_deg, angle)


@njit(cache=True, nogil=True)
def _list_joined(building, listing, heights, negligible, unlisted):
    """Join paths to edges and from them: departures, arrivals with variants, and bounds (C,); add to `unlisted` (N,).

    One number encodes an arrival and a variant. Loops take arrays out of tuples before they begin: numba counts
    references at every access, on all cores.
    """
    room, largest, wavelength = building.room, building.materials.largest, building.materials.wavelength_m
    edges, arrivals, departures, (most, at_faces, power, _) = listing
    own, utd, directed, flat = edges.material, edges.utd, len(room.gains.table) > 1, room.flat_material
    start, _, reflections, length_m, _, _, material, cosine, angle, faces, lit, toward, gain, _, _ = arrivals
    edge, rx, after, onward_m, material_after, cosine_after, most_after, azimuth_deg, departure = departures
    tables = building.materials.reflection, building.materials.transition, largest
    walls, variants = (material, cosine, material_after, cosine_after), heights.shape[1]
    pairs, joined, bound = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty(1024)
    used, terms, weight = np.int64(0), np.empty((4, 3)), np.empty(variants)
    for i in range(len(edge)):
        e, onward, least, is_weak = edge[i], onward_m[i], negligible[rx[i]], True
        to_rx = departure[i, 0], departure[i, 1], departure[i, 2], departure[i, 3]
        for j in range(start[e], start[e + 1]):
            left, total = variants // 2 - 1 - after[i] - reflections[j], length_m[j] + onward
            if left < 0:
                continue
            rough = most_after[i] ** 2 * power[j, azimuth_deg[i]] / (onward * total)
            if rough < least:
                unlisted[rx[i]] += EXPECTED * rough
                continue
            if is_weak:
                _weigh_variants(largest, flat, heights, rx[i], length_m[start[e + 1] - 1] + onward, weight)
                is_weak = False
            utd_terms(_constants(utd, e), (angle[j, 0], angle[j, 1], angle[j, 2], angle[j, 3]), to_rx, terms)
            spread, reach = _spread(wavelength, length_m[j], onward)
            amplitude = most_after[i] * most[j] * most_at_edge(terms, np.sqrt(reach), at_faces[j, 0], at_faces[j, 1])
            rough = amplitude**2 * spread / total * gain[j]
            face = own[e, 0] if lit[j] else own[e, 1], faces[j, 0], faces[j, 1]
            for variant in range(2 * left + 2):
                height = heights[rx[i], variant]
                if height < 0.0:
                    continue
                if rough * weight[variant] < least:
                    unlisted[rx[i]] += EXPECTED * rough * weight[variant]
                    continue
                long = np.sqrt(total**2 + height**2)
                path = np.sqrt(reach * total / long), total / long, height / long, variant // 2, flat
                strength = _strength(tables, walls, (j, i, reflections[j], after[i]), face, terms, path)
                strength *= strength * spread / long
                if directed:
                    rise = rise_of(variant, room, room.rx_m[rx[i]])
                    strength *= gain_of_departure(room, toward[j, 0], toward[j, 1], rise, total)
                if used == len(pairs):
                    pairs, joined, bound = grow(pairs, used + 1), grow(joined, used + 1), grow(bound, used + 1)
                pairs[used], joined[used], bound[used] = i, j * variants + variant, strength
                used += 1
    return pairs[:used].copy(), joined[:used].copy(), bound[:used].copy()


@njit(cache=True)
def _heights(room, size):
    heights = np.full((len(room.rx_m), 2 * size), -1.0)
    for rx in range(len(room.rx_m)):
        for variant in range(2 * size):
            if has_variant(variant, room):
                heights[rx, variant] = rise_of(variant, room, room.rx_m[rx]).height_m
    return heights


@njit(cache=True)
def _weigh_variants(largest, flat, heights, rx, length, weight):
    """Write the largest powers of variants relative to a path in the plan."""
    for variant in range(len(weight)):
        height = max(heights[rx, variant], 0.0)
        total = np.sqrt(length * length + height * height)
        weight[variant] = at_flats(largest, flat, height / total, variant // 2, (1.0, 0.0, 0.0)) ** 2 * length / total


@njit(cache=True)
def _constants(utd, edge):
    return utd[edge, 0], utd[edge, 1], utd[edge, 2], utd[edge, 3], utd[edge, 4]


@njit(cache=True)
def _spread(wavelength, length, onward):
    """Return the spread of the power over an edge, to be divided by the path length, and 2 k L."""
    spread = wavelength**3 / (64.0 * np.pi**4 * length * onward)
    return spread, 4.0 * np.pi / wavelength * length * onward / (length + onward)


@njit(cache=True)
def _bounds_of_arrivals(edges, arrivals, materials, highest):
    """Return bounds (J,) of the fields of arrivals, coefficients (J, 2) of the edge's faces, and bounds (J, 360).

    The last are powers by azimuth, to be divided by the length after the edge and the total length.
    """
    most, faces = np.empty(len(arrivals.lit)), np.empty((len(arrivals.lit), 2), np.complex128)
    power, terms = np.empty((len(most), 360)), np.empty((4, 3))
    for j in range(len(most)):
        edge, length, count = arrivals.edge[j], arrivals.length_m[j], arrivals.reflections[j]
        most[j] = _most_at_walls(materials.largest, arrivals.material[j], arrivals.cosine[j], count, length, highest)
        own, exterior = edges.material[edge, 0 if arrivals.lit[j] else 1], edges.exterior_rad[edge]
        for k in range(2):
            faces[j, k] = at_face(materials.reflection, own, arrivals.faces[j, k], 1.0, 0.0)[0]
        angle = arrivals.angle[j, 0], arrivals.angle[j, 1], arrivals.angle[j, 2], arrivals.angle[j, 3]
        spread, reach = _spread(materials.wavelength_m, length, 1.0)
        for azimuth in range(360):
            departure = wedge_angle(_angle_rad(edges.face_rad[edge], exterior, np.radians(azimuth)), exterior)
            utd_terms(_constants(edges.utd, edge), angle, departure, terms)
            for k in range(4):  # the largest term within half a degree
                near = max(terms[k, 1] - _HALF_DEGREE, 1e-9)
                terms[k, 0], terms[k, 1] = terms[k, 0] * terms[k, 1] / near, near
            size = most[j] * most_at_edge(terms, np.sqrt(reach * (1.0 + length)), faces[j, 0], faces[j, 1])
            power[j, azimuth] = size**2 * spread * arrivals.gain[j]
    return most, faces, power


@njit(cache=True)
def _most_at_walls(largest, material, cosine, count, length, highest):
    most, sine = 1.0, length / np.sqrt(length * length + highest * highest)
    for k in range(count):
        most *= most_at_wall(largest, material[k], cosine[k] * sine)
    return most


@njit(cache=True, nogil=True)
def _list_crossed(group, edges, arrivals, needed, building, trail):
    """List the strong paths over some edges: edge, receiver, arrival and variant (C, 4), and powers (C,)."""
    room, materials, shortest_m = building.room, building.materials, _shortest_leg_m(building)
    chosen, power, used, terms = np.empty((1024, 4), np.int32), np.empty(1024), np.int64(0), np.empty((4, 3))
    wavelength, tables = materials.wavelength_m, (materials.reflection, materials.transition, materials.largest)
    reflecting = arrivals.material, arrivals.cosine, arrivals.material, arrivals.cosine
    for e in group:
        origin, exterior, constants = edges.position_m[e], edges.exterior_rad[e], _constants(edges.utd, e)
        for j in range(arrivals.start[e], arrivals.start[e + 1]):
            before, through, gain = arrivals.length_m[j], arrivals.left[j], arrivals.gain[j]
            angle = arrivals.angle[j, 0], arrivals.angle[j, 1], arrivals.angle[j, 2], arrivals.angle[j, 3]
            numbers, flat = (j, np.int64(0), np.int64(0), np.int64(0)), room.flat_material
            own = edges.material[e, 0] if arrivals.lit[j] else edges.material[e, 1]
            face = own, arrivals.faces[j, 0], arrivals.faces[j, 1]
            for rx in range(len(room.rx_m)):
                target = room.rx_m[rx]
                x, y = target[0] - origin[0], target[1] - origin[1]
                onward = np.hypot(x, y)
                total = before + onward
                too_weak = through * gain * (wavelength / (4.0 * np.pi * total)) ** 2 < needed[rx]
                if too_weak or onward < shortest_m or not _outside(edges.normals, e, x, y)[1]:
                    continue
                departure = wedge_angle(_angle_rad(edges.face_rad[e], exterior, np.arctan2(y, x)), exterior)
                utd_terms(constants, angle, departure, terms)
                spread, reach = _spread(wavelength, before, onward)
                path = np.sqrt(reach), 1.0, 0.0, np.int64(0), flat
                level = _strength(tables, reflecting, numbers, face, terms, path)
                if level**2 * spread * through / total * gain < needed[rx]:
                    continue
                count, crossed = _from_edge(building, origin, target, onward, total, np.int64(0), trail)
                walls = crossed + arrivals.crossed[j]
                if count < 0 or walls == 0 or walls > building.limits.walls:
                    continue
                spread *= through * _leg_power(trail, count, building)
                for variant in range(_VARIANTS):
                    rise = rise_of(variant, room, target)
                    if not has_variant(variant, room) or rise.bounces > building.limits.depth - 1:
                        continue
                    length = np.hypot(total, rise.height_m)
                    path = np.sqrt(reach * total / length), total / length, rise.height_m / length, rise.bounces, flat
                    strength = _strength(tables, reflecting, numbers, face, terms, path) ** 2 * spread / length
                    strength *= gain_of_departure(room, arrivals.toward[j, 0], arrivals.toward[j, 1], rise, total)
                    if strength >= needed[rx]:
                        chosen, power = grow(chosen, used + 1), grow(power, used + 1)
                        chosen[used, 0], chosen[used, 1], chosen[used, 2], chosen[used, 3] = e, rx, j, variant
                        power[used] = strength
                        used += 1
    return chosen[:used].copy(), power[:used].copy()


@njit(cache=True, nogil=True)
def _write_joined(tree, edges, arrivals, chosen, building, trail, size):
    node, rx, arrival, variant = chosen
    paths, room, owner = empty_paths(len(rx), size), building.room, building.plan.owner
    for c in range(len(rx)):
        j, target = arrival[c], room.rx_m[rx[c]]
        origin = edges.position_m[arrivals.edge[j]]
        after, onward = unfold(tree, node[c], building.plan.pieces_m, target, trail.walls, trail.bounce)
        count = _join(arrivals, j, origin, target, after, onward, building, trail)
        if count >= 0:
            write_path(trail, count, room, owner, target, np.int64(variant[c]), paths, c)
    return paths


@njit(cache=True, forceinline=True)
def _join(arrivals, j, origin, target, after, onward, building, trail):
    """Write all that a path meets in the plan; return the number of entries, -1 if Sionna RT drops it."""
    length, count, through_walls = arrivals.length_m[j], np.int64(0), building.limits.walls > 0
    total, reflection = length + onward, np.int64(REFLECTION)
    if through_walls:
        count, _ = _to_edge(building, origin, length, total, trail)
    for k in range(arrivals.reflections[j]):
        x, y, fraction = arrivals.points[j, k, 0], arrivals.points[j, k, 1], arrivals.points[j, k, 2]
        count = add_entry(trail, count, arrivals.walls[j, k], reflection, x, y, fraction * length / total)
    count = add_entry(trail, count, np.int64(-1), np.int64(DIFFRACTION), origin[0], origin[1], length / total)
    for k in range(after):
        x, y, fraction = trail.bounce[k, 0], trail.bounce[k, 1], trail.bounce[k, 2]
        count = add_entry(trail, count, trail.walls[k], reflection, x, y, (length + onward * fraction) / total)
    if through_walls:
        count, _ = _from_edge(building, origin, target, onward, total, count, trail)
        if count >= 0 and not has_long_legs(trail, count, total):
            return -1
    return count
