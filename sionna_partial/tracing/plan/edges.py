"""Paths of a floor plan that are diffracted once at a vertical edge.

An edge is a point in the plan. A candidate joins a path from the transmitter to an edge and a path from there to a
receiver. On a vertical edge Keller's cone keeps the slope of a path, so that heights unfold along the whole path.

Between opaque walls, beams find pairs of edges and receivers with few reflections; through walls, straight lines join
all edges and receivers.
"""

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.process import in_order, njit
from sionna_partial.scene.outlines import bin_points, grow
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import DIFFRACTION, REFLECTION
from sionna_partial.tracing.line import has_long_legs
from sionna_partial.tracing.paths import Candidates, Wedges
from sionna_partial.tracing.plan.arrivals import (
    FLAT_RAD,
    Arrivals,
    Edges,
    angle_rad,
    arrive,
    from_edge,
    leg_power,
    outside,
    shortest_leg_m,
    to_edge,
)
from sionna_partial.tracing.plan.beams import BeamTree, Sources, needed_of, trace_beams
from sionna_partial.tracing.plan.joining import (
    Bounds,
    Departures,
    Joining,
    Reflected,
    Shape,
    bound_arrivals,
    depart,
    list_joined,
    spread_of,
    strength_of,
    write_heights,
    write_terms,
)
from sionna_partial.tracing.plan.reflections import CrossingCandidates, unfold
from sionna_partial.tracing.plan.room import (
    Building,
    Room,
    WrittenPaths,
    add_entry,
    candidates_of,
    gain_of_departure,
    has_variant,
    rise_of,
    trail_of,
    write_path,
)
from sionna_partial.tracing.power import Materials, wedge_angle
from sionna_partial.tracing.select import Listed

MAX_REFLECTIONS = 2
"""Largest number of reflections around the diffraction, floor and ceiling included."""

_NEGLIGIBLE = 3e-5
"""Smallest rough bound of a listed diffracted path, relative to the reflected paths of its link."""

_UNSEEN = 1e-18
"""Power of a path below which no gain, at least -150 dB, shows it."""

_EDGES_AT_ONCE = 32
"""Number of edges whose beams are in memory together; the order of candidates depends on it."""

_VARIANTS = 4
"""Variants of paths through walls: at most one reflection at floor or ceiling."""


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
    wide = np.flatnonzero((width > np.pi + FLAT_RAD) & (open_ends | ~geometry.open_end[vertex]))
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
        self._edges = Edges.of(wedges, building.room.wall_material)

    def _arrivals(self, tree: BeamTree, pairs: NDArray[np.int32], reflections: int) -> Arrivals:
        return arrive(tree, pairs, self._edges, self._building, reflections, trail_of(self._geometry.plan))

    def _candidates(self, arrivals: Arrivals, arrival: Indices, rx: Indices, paths: WrittenPaths) -> Candidates:
        edge, lit = arrivals.edge[arrival], arrivals.lit[arrival]
        wedge = np.where(lit, edge, edge + len(self._edges.position_m)).astype(np.int32)
        opaque = self._building.limits.walls == 0
        return candidates_of(self._geometry, rx, paths, opaque=opaque, wedge=wedge, wedges=self._wedges)


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
        materials, heights_m = self._building.materials, np.full((len(room.rx_m), 2 * self._reflections + 2), -1.0)
        write_heights(room, heights_m)
        reached, highest_m = np.flatnonzero(np.diff(arrivals.start)), heights_m.max()
        needed = needed_of(np.maximum(_NEGLIGIBLE * found, _UNSEEN if found.any() else 0.0), room, 4.0 * np.pi)
        if not len(reached):
            return
        bounds = Bounds.empty(len(arrivals.edge))
        bound_arrivals(edges, arrivals, materials, highest_m, bounds, np.empty((4, 3)))
        start = arrivals.start[reached]
        onward = np.arange(self._walls_a_side + 1)
        possible = arrivals.reflections[:, None] <= self._reflections - onward
        sums = [np.add.reduceat(bounds.power * some[:, None], start) for some in possible.T]
        more, strongest = np.logical_or.reduceat(possible, start).sum(axis=1) - 1, np.stack(sums, axis=1)
        position_m, before_m = edges.position_m[reached], np.minimum.reduceat(arrivals.length_m, start)
        groups = [slice(first, first + _EDGES_AT_ONCE) for first in range(0, len(reached), _EDGES_AT_ONCE)]

        def of_group(number: int) -> Listed:
            unlisted, group = np.zeros(len(found)), groups[number]
            ends = position_m[group], more[group], strongest[group], before_m[group]
            sources = Sources(*ends, needed, unlisted)
            tree, pairs = trace_beams(self._building, receivers, sources)
            departures = Departures.empty(pairs[:, 1], self._reflections)
            walls = self._building.plan.pieces_m, self._building.material, materials.largest
            depart(tree, pairs, reached[group], edges, room.rx_m, *walls, highest_m, departures)
            joining = Joining.of(edges, arrivals, departures, bounds, heights_m, needed.power, unlisted)
            pair, joined, bound = list_joined(room, materials, joining)
            write = partial(self._written, tree, pairs, arrivals, pair, joined)
            return Listed(pairs[pair, 1], bound, write, (number + 1) / len(groups), unlisted)

        yield from in_order(of_group, range(len(groups)))

    def _written(
        self,
        tree: BeamTree,
        pairs: NDArray[np.int32],
        arrivals: Arrivals,
        pair: NDArray[np.int32],
        joined: NDArray[np.int32],
        rows: Indices,
    ) -> Candidates:
        size, (node, rx) = self._reflections + 1, pairs[pair[rows]].T.copy()
        arrival, variant = np.divmod(joined[rows], 2 * size)
        paths, trail = WrittenPaths.empty(len(rx), size), trail_of(self._geometry.plan)
        plan, chosen = self._geometry.plan, (node, rx, arrival, variant)
        inputs = self._edges.position_m, plan.pieces_m, plan.owner, self._building.room
        _write_joined(tree, *inputs, arrivals, chosen, trail, paths)
        return self._candidates(arrivals, arrival, rx, paths)


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
        shortest_m, bounds = shortest_leg_m(building), Bounds.empty(len(arrivals.edge))
        bound_arrivals(edges, arrivals, building.materials, 0.0, bounds, np.empty((4, 3)))

        def of_edges(first: int) -> tuple[NDArray[np.int32], Floats]:
            some = np.arange(first, min(first + _EDGES_AT_ONCE, count))
            output = np.empty((1024, 4), np.int32), np.empty(1024)
            trail, terms = trail_of(building.plan), np.empty((4, 3))
            inputs = edges, arrivals, bounds.power, needed, shortest_m, building
            chosen, power, used = _list_crossed(some, *inputs, trail, terms, *output)
            return chosen[:used].copy(), power[:used].copy()

        chosen, power = zip(*in_order(of_edges, range(0, count, _EDGES_AT_ONCE)), strict=True)
        columns = np.concatenate(chosen)
        yield Listed(columns[:, 1], np.concatenate(power), partial(self._written, arrivals, columns), 1.0)

    def _written(self, arrivals: Arrivals, columns: NDArray[np.int32], rows: Indices) -> Candidates:
        _, rx, arrival, variant = columns[rows].T.copy()
        trail = trail_of(self._building.plan)
        paths = WrittenPaths.empty(len(rx), len(trail.surface) + 2)
        _write_crossed(self._edges, arrivals, (rx, arrival, variant), self._building, trail, paths)
        candidates = self._candidates(arrivals, arrival, rx, paths)
        possible = (candidates.kind > 0).any(axis=1)  # an empty row would be a direct path once more
        return self._lowered(candidates.rows(np.flatnonzero(possible)))


def _straight_lines(sources_m: Floats) -> BeamTree:
    none = np.full(len(sources_m), -1, np.int32)
    return BeamTree(none, none, sources_m)


@njit(cache=True, nogil=True)
def _list_crossed(group, edges, arrivals, rough, needed, shortest_m, building, trail, terms, chosen, power):
    """List the strong paths through walls over some edges: edge, receiver, arrival and variant (C, 4), and powers.

    The two arrays are enlarged as necessary; return them, and the number of paths. `rough` is `Bounds.power`, `terms`
    is scratch.
    """
    used, receivers, start, rx_m = 0, len(needed), arrivals.start, building.room.rx_m
    for e in group:
        for j in range(start[e], start[e + 1]):
            most = used + receivers * _VARIANTS
            if most > len(power):
                chosen, power = grow(chosen, most), grow(power, most)
            origin, before, left = edges.position_m[e], arrivals.length_m[j], arrivals.left[j]
            for rx in range(receivers):
                x, y = rx_m[rx, 0] - origin[0], rx_m[rx, 1] - origin[1]
                onward = np.sqrt(x * x + y * y)
                if onward < shortest_m or not outside(edges.normals, e, x, y)[1]:
                    continue
                azimuth_rad, least = np.arctan2(y, x), needed[rx] * onward * (before + onward)
                if rough[j, int(np.degrees(azimuth_rad) + 360.5) % 360] * left < least:
                    continue
                line = rx, onward, azimuth_rad
                used = _cross_edge(j, line, edges, arrivals, needed[rx], building, trail, terms, (chosen, power), used)
    return chosen, power, used


@njit(cache=True, borrows=True)
def _cross_edge(j, line, edges, arrivals, least, building, trail, terms, output, used):
    """List the variants of a path, by an arrival at an edge and a straight line to a receiver; return their number.

    They have at least the power `least`, and cross at least one wall. The line is (receiver, length, azimuth).
    """
    (rx, onward, azimuth_rad), room, materials, e = line, building.room, building.materials, arrivals.edge[j]
    (chosen, power), target, origin, before = output, room.rx_m[rx], edges.position_m[e], arrivals.length_m[j]
    total, exterior = before + onward, edges.exterior_rad[e]
    turned = wedge_angle(angle_rad(edges.face_rad[e], exterior, azimuth_rad), exterior)
    write_terms(edges.utd, e, arrivals.angle, j, turned, terms)
    spread, reach = spread_of(materials.wavelength_m, before, onward)
    straight = Reflected(arrivals.material[j], arrivals.cosine[j], np.int64(0))
    face = edges.material[e, 0 if arrivals.lit[j] else 1], arrivals.faces[j, 0], arrivals.faces[j, 1]
    flat = Shape(np.sqrt(reach), 1.0, 0.0, np.int64(0))
    level = strength_of(materials, straight, face, straight, flat, terms, room.flat_material)
    spread *= arrivals.left[j]
    level *= level * arrivals.gain[j] / total
    if level * spread < least:
        return used
    count, crossed = from_edge(building, origin, target, onward, total, 0, trail)
    walls = crossed + arrivals.crossed[j]
    if count < 0 or walls == 0 or walls > building.limits.walls:
        return used
    spread *= leg_power(trail, count, building)
    if level * spread < least:
        return used
    for variant in range(_VARIANTS):
        rise = rise_of(variant, room, target)
        if not has_variant(variant, room) or rise.bounces > building.limits.depth - 1:
            continue
        length = np.hypot(total, rise.height_m)
        shape = Shape(np.sqrt(reach * total / length), total / length, rise.height_m / length, rise.bounces)
        strength = strength_of(materials, straight, face, straight, shape, terms, room.flat_material)
        strength = strength**2 * spread / length
        strength *= gain_of_departure(room, arrivals.toward[j, 0], arrivals.toward[j, 1], rise, total)
        if strength >= least:
            chosen[used, 0], chosen[used, 1], chosen[used, 2], chosen[used, 3] = e, rx, j, variant
            power[used] = strength
            used += 1
    return used


@njit(cache=True, borrows=True, nogil=True)
def _write_joined(tree, position_m, pieces_m, owner, room, arrivals, chosen, trail, paths):
    """Write paths between opaque walls: `chosen` are beams, receivers, arrivals and variants (C,)."""
    node, rx, arrival, variant = chosen
    for c in range(len(rx)):
        j, target, count = arrival[c], room.rx_m[rx[c]], 0
        origin, length = position_m[arrivals.edge[j]], arrivals.length_m[j]
        after, onward = unfold(tree, node[c], pieces_m, target, trail.walls, trail.bounce)
        total = length + onward
        for k in range(arrivals.reflections[j]):
            x, y, fraction = arrivals.points[j, k, 0], arrivals.points[j, k, 1], arrivals.points[j, k, 2]
            count = add_entry(trail, count, arrivals.walls[j, k], REFLECTION, x, y, fraction * length / total)
        count = add_entry(trail, count, -1, DIFFRACTION, origin[0], origin[1], length / total)
        for k in range(after):
            x, y, fraction = trail.bounce[k, 0], trail.bounce[k, 1], trail.bounce[k, 2]
            count = add_entry(trail, count, trail.walls[k], REFLECTION, x, y, (length + onward * fraction) / total)
        write_path(trail, count, room, owner, target, variant[c], paths, c)


@njit(cache=True, borrows=True, nogil=True)
def _write_crossed(edges, arrivals, chosen, building, trail, paths):
    """Write paths through walls: `chosen` are receivers, arrivals and variants (C,). Rows stay empty without a path."""
    (rx, arrival, variant), room, owner = chosen, building.room, building.plan.owner
    for c in range(len(rx)):
        j, target = arrival[c], room.rx_m[rx[c]]
        origin, length = edges.position_m[arrivals.edge[j]], arrivals.length_m[j]
        onward = np.hypot(target[0] - origin[0], target[1] - origin[1])
        total = length + onward
        count, _ = to_edge(building, origin, length, total, trail)
        count = add_entry(trail, count, -1, DIFFRACTION, origin[0], origin[1], length / total)
        count, _ = from_edge(building, origin, target, onward, total, count, trail)
        if count >= 0 and has_long_legs(trail.points[:, 2], count, 1.0, total):
            write_path(trail, count, room, owner, target, variant[c], paths, c)
