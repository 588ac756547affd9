"""Candidates of floor plans that go through walls and are diffracted once at a vertical edge.

Both legs of such a path are straight in the plan: from the transmitter to the edge, and from there to the receiver,
with walls to go through on either or on both. Floor and ceiling may reflect it.
"""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.process import in_order, njit
from sionna_partial.scene.floor_plan import grow
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import DIFFRACTION
from sionna_partial.tracing.paths import Candidates, Wedges
from sionna_partial.tracing.plan.crossings import CrossingCandidates, can_bounce_as
from sionna_partial.tracing.plan.diffraction import angle_rad, edges_of, outside
from sionna_partial.tracing.plan.legs import (
    Leg,
    columns_of,
    cross_leg,
    empty_paths,
    has_long_legs,
    trail_of,
    write_kinds,
)
from sionna_partial.tracing.plan.specular import WALLS, gain_of_leg, merge_heights, sign_of_rise, unfolded_height
from sionna_partial.tracing.power import (
    at_edge,
    at_flats,
    gain_at_azimuth,
    power_near,
    utd_terms,
    wedge_angle,
)
from sionna_partial.tracing.select import Listed

_EDGES_AT_ONCE = 16

_ASIDE_M = 1e-3
"""Distance from an edge at which a leg ends: the walls that meet there are not crossed [m]."""

_VARIANTS = 3
"""Reflections at floor and ceiling: none, floor, ceiling."""


class Arrivals(NamedTuple):
    """Straight lines from the transmitter to E edges.

    `good` (E,) is whether they come from the sector of the edge and are long enough, `length_m` (E,) their length in
    the plan, `power` (E,) what walls on them leave, and `crossed` (E,) their number. `angle` (E, 4), `faces` (E, 2) and
    `lit` (E,) are as for `DiffractionCandidates`.
    """

    good: Bools
    length_m: Floats
    power: Floats
    crossed: NDArray[np.int64]
    angle: Floats
    faces: Floats
    lit: Bools


class CrossedEdgeCandidates:
    """All paths over one vertical edge, through a wall at least, without reflections at walls."""

    name = "diffractions through walls"

    def __init__(self, geometry: SceneGeometry, wedges: Wedges, crossing: CrossingCandidates) -> None:
        self._geometry, self._wedges, self._building = geometry, wedges, crossing.building
        self._lowered = crossing.lowered
        self._edges = edges_of(wedges, crossing.building.room.wall_material)

    def listed(self, found: Floats) -> Iterator[Listed]:
        """List the paths that links may need whose other indirect paths have the power `found` (N,)."""
        if not len(self._wedges.edge_m):
            return
        plan, needed = self._geometry.plan, self._building.limits.min_power(found)
        arrivals = _arrivals(self._edges, self._building, trail_of(plan))

        def of_edges(first: int) -> tuple[Indices, Indices, Indices, Floats]:
            some = np.arange(first, min(first + _EDGES_AT_ONCE, len(self._wedges.edge_m)))
            return _listed(some, self._edges, arrivals, needed, self._building, trail_of(plan))  # type: ignore[no-any-return]

        parts = list(in_order(of_edges, range(0, len(self._wedges.edge_m), _EDGES_AT_ONCE)))
        edge, rx, variant, power = (np.concatenate(column) for column in zip(*parts, strict=True))
        yield Listed(rx, power, partial(self._written, arrivals, edge, rx, variant), 1.0)

    def _written(self, arrivals: Arrivals, edge: Indices, rx: Indices, variant: Indices, rows: Indices) -> Candidates:
        edge, rx = edge[rows], rx[rows]
        written = _written(edge, rx, variant[rows], self._edges, self._building, trail_of(self._geometry.plan))
        wedge = np.where(arrivals.lit[edge], edge, edge + len(self._wedges.edge_m)).astype(np.int32)
        columns = columns_of(self._geometry, *written)
        columns["face"] = np.where(columns["kind"] == DIFFRACTION, self._wedges.face[wedge, :1], columns["face"])
        candidates = Candidates(rx.astype(np.int32), **columns, wedge=wedge, wedges=self._wedges)
        possible = (candidates.kind > 0).any(axis=1)  # a row without any would be a direct path once more
        return self._lowered(candidates.rows(np.flatnonzero(possible)))


@njit(cache=True)
def _leg_power(trail, count, building):  # type: ignore[no-untyped-def]
    """Fraction of the power that the walls of a leg leave at most, if it is horizontal, however polarised."""
    power, table = 1.0, building.materials.transmission
    for k in range(count):
        if not (trail.same_wall[k] or building.plan.low[trail.surface[k]]):
            power *= power_near(table[building.material[trail.surface[k]]], trail.cosine[k])
    return power


@njit(cache=True)
def _to_edge(building, origin, length, total, trail):  # type: ignore[no-untyped-def]
    """Write the walls on a line from the transmitter to an edge; return the numbers of entries and of walls."""
    part, tx_m = 1.0 - _ASIDE_M / length, building.room.tx_m
    x, y = tx_m[0] + part * (origin[0] - tx_m[0]), tx_m[1] + part * (origin[1] - tx_m[1])
    leg = Leg((tx_m[0], tx_m[1]), (x, y), np.int64(-1), np.int64(-1), 0.0, part * length / total)
    return cross_leg(building.plan, building.interior, leg, 0, trail)


@njit(cache=True)
def _from_edge(building, origin, target, length, total, count, trail):  # type: ignore[no-untyped-def]
    """Add the walls on a line of some length from an edge to a receiver; return as `_to_edge`."""
    part = _ASIDE_M / length
    x, y = origin[0] + part * (target[0] - origin[0]), origin[1] + part * (target[1] - origin[1])
    done = (total - length + _ASIDE_M) / total
    leg = Leg((x, y), (target[0], target[1]), np.int64(-1), np.int64(-1), done, 1.0)
    return cross_leg(building.plan, building.interior, leg, count, trail)


@njit(cache=True)
def _arrivals(edges, building, trail):  # type: ignore[no-untyped-def]
    """Follow the lines from the transmitter to all edges."""
    room = building.room
    count = len(edges.position_m)
    good, lit = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    length, power, crossed = np.zeros(count), np.zeros(count), np.zeros(count, np.int64)
    angle, faces = np.zeros((count, 4)), np.zeros((count, 2))
    for e in range(count):
        origin, exterior = edges.position_m[e], edges.exterior_rad[e]
        x, y = room.tx_m[0] - origin[0], room.tx_m[1] - origin[1]
        length[e] = np.hypot(x, y)
        lit[e], in_front = outside(edges.normals[e], x, y)
        if not in_front or length[e] < 20.0 * _ASIDE_M:
            continue
        entries, crossed[e] = _to_edge(building, origin, length[e], length[e], trail)
        good[e] = entries >= 0 and crossed[e] <= building.limits.walls
        if good[e]:
            power[e] = _leg_power(trail, entries, building)
        from_0 = angle_rad(edges.face_rad[e], exterior, x, y)
        angle[e, 0], angle[e, 1], angle[e, 2], angle[e, 3] = wedge_angle(from_0, exterior)
        for k, from_face in enumerate((from_0, exterior - from_0)):
            faces[e, k] = max(0.0, np.sin(from_face)) if from_face <= np.pi else -1.0
    return Arrivals(good, length, power, crossed, angle, faces, lit)


@njit(cache=True, nogil=True)
def _listed(group, edges, arrivals, needed, building, trail):  # type: ignore[no-untyped-def]
    """Edges, receivers, variants and powers of the paths over some edges that are strong enough."""
    room, materials = building.room, building.materials
    out, power, used = np.empty((1024, 3), np.int64), np.empty(1024), 0
    terms, wavelength = np.empty((4, 3)), materials.wavelength_m
    largest, tables = materials.largest, (materials.reflection, materials.transition)
    for e in group:
        if not arrivals.good[e]:
            continue
        origin, before, through = edges.position_m[e], arrivals.length_m[e], arrivals.power[e]
        x_edge, y_edge = origin[0] - room.tx_m[0], origin[1] - room.tx_m[1]
        strongest = gain_at_azimuth(room.gains, x_edge, y_edge)
        most = through * strongest
        constants = edges.utd[e, 0], edges.utd[e, 1], edges.utd[e, 2], edges.utd[e, 3], edges.utd[e, 4]
        arrival = arrivals.angle[e, 0], arrivals.angle[e, 1], arrivals.angle[e, 2], arrivals.angle[e, 3]
        lit = arrivals.faces[e, 0], arrivals.faces[e, 1]
        material = edges.material[e, 0] if arrivals.lit[e] else edges.material[e, 1]
        for rx in range(len(room.rx_m)):
            target = room.rx_m[rx]
            x, y = target[0] - origin[0], target[1] - origin[1]
            onward = np.hypot(x, y)
            total = before + onward
            if most * (wavelength / (4.0 * np.pi * total)) ** 2 < needed[rx] or onward < 20.0 * _ASIDE_M:
                continue
            if not outside(edges.normals[e], x, y)[1]:
                continue
            departure = wedge_angle(angle_rad(edges.face_rad[e], edges.exterior_rad[e], x, y), edges.exterior_rad[e])
            utd_terms(constants, arrival, departure, terms)
            spread = through * wavelength**3 / (64.0 * np.pi**4 * before * onward)
            boundary = np.sqrt(4.0 * np.pi / wavelength * before * onward / total)
            level = at_edge(tables, material, terms, boundary, lit, 1.0, 0.0, (1.0, 0.0, 1.0))
            if level[0] ** 2 * spread / total * strongest < needed[rx]:
                continue
            count, crossed = _from_edge(building, origin, target, onward, total, 0, trail)
            walls = crossed + arrivals.crossed[e]
            if count < 0 or walls == 0 or walls > building.limits.walls:
                continue
            behind = _leg_power(trail, count, building)
            for variant in range(_VARIANTS):
                bounces, first, possible = can_bounce_as(variant, room)
                if not possible or bounces > building.limits.depth - 1:
                    continue
                height = unfolded_height(room, target, bounces, first)
                length = np.hypot(total, height)
                sine, slope = total / length, height / length
                edge = boundary * np.sqrt(sine)
                field = at_edge(tables, material, terms, edge, lit, sine, slope, (1.0, 0.0, 1.0))
                strength = at_flats(largest, room.flat_material, slope, bounces, field) ** 2 * spread * behind / length
                rise = height * sign_of_rise(room, target, bounces, first) / total
                strength *= gain_of_leg(room, x_edge, y_edge, rise)
                if strength >= needed[rx]:
                    out, power = grow(out, used + 1), grow(power, used + 1)
                    out[used, 0], out[used, 1], out[used, 2], power[used] = e, rx, variant, strength
                    used += 1
    return out[:used, 0].copy(), out[:used, 1].copy(), out[:used, 2].copy(), power[:used].copy()


@njit(cache=True)
def _written(edge, rx, variants, edges, building, trail):  # type: ignore[no-untyped-def]
    """Write paths as `write_paths` does."""
    surface, kind, vertices, same_wall = empty_paths(len(rx), trail)
    room, item = building.room, WALLS + np.arange(len(trail.surface))
    for c in range(len(rx)):
        origin, target = edges.position_m[edge[c]], room.rx_m[rx[c]]
        before = np.hypot(room.tx_m[0] - origin[0], room.tx_m[1] - origin[1])
        onward = np.hypot(target[0] - origin[0], target[1] - origin[1])
        total = before + onward
        count, _ = _to_edge(building, origin, before, total, trail)
        trail.kind[count], trail.same_wall[count] = DIFFRACTION, False
        trail.points[count, 0], trail.points[count, 1], trail.points[count, 2] = origin[0], origin[1], before / total
        count, _ = _from_edge(building, origin, target, onward, total, count + 1, trail)
        if count < 0 or not has_long_legs(trail, count, total):
            continue
        bounces, first, _ = can_bounce_as(variants[c], room)
        merge_heights(item[:count], trail.points[:count], room, target, bounces, first, surface[c], vertices[c])
        write_kinds(trail, building.plan, count + bounces, surface[c], kind[c], same_wall[c])
    return surface, kind, vertices, same_wall
