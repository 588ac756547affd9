"""Paths over vertical edges between opaque walls: arrivals at edges are joined with departures to receivers.

    tx ---> wall ---> E ---> wall ---> rx        arrival j, the edge, and departure i; a variant adds reflections at
       arrival j         departure i             floor and ceiling

A rough bound, by the azimuth in whole degrees, drops most pairs before the diffraction is computed.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.process import njit
from sionna_partial.tracing.plan.arrivals import NEAR_M, Arrivals, Edges, angle_rad, outside
from sionna_partial.tracing.plan.room import Room, gain_of_departure, has_variant, rise_of
from sionna_partial.tracing.power import (
    EXPECTED,
    VERTICAL,
    Field,
    Materials,
    at_edge,
    at_face,
    at_flats,
    at_wall,
    most_at_edge,
    most_at_wall,
    utd_terms,
    wedge_angle,
)

_HALF_DEGREE = 0.0044
"""Sine of half of half a degree."""

_TURNED = Field(1.0, 0.0, 0.0)
"""Vertical field that walls may have turned."""


class Departures(NamedTuple):
    """K paths from edges to receivers.

    Path k runs from `edge` to receiver `rx`, with `reflections` at walls and `length_m` in the plan. The reflections
    are too many for any path where a leg is too short or inside the wedge. `material` and `cosine` (K, R) are as in
    `Arrivals`, and `most` (K,) bounds the field after these walls. At the edge, the path leaves in the direction
    `azimuth_deg` (K,), whole degrees from x, or `angle` (K, 4), as in `wedge_angle`.
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

    @classmethod
    def empty(cls, rx: NDArray[np.integer], most_reflections: int) -> "Departures":
        count, size = len(rx), (len(rx), most_reflections)
        edge, reflections, azimuth_deg = np.empty(count, np.int64), np.zeros(count, np.int64), np.empty(count, np.int64)
        reflected, most = (np.empty(size, np.int64), np.empty(size)), np.ones(count)
        number = rx.astype(np.int64)
        return cls(edge, number, reflections, np.empty(count), *reflected, most, azimuth_deg, np.empty((count, 4)))


class Bounds(NamedTuple):
    """Bounds of J arrivals: fields (J,), coefficients (J, 2) of the edge's faces, and powers (J, 360) by azimuth.

    Powers are to be divided by the length after the edge and the total length.
    """

    most: Floats
    faces: NDArray[np.complex128]
    power: Floats

    @classmethod
    def empty(cls, count: int) -> "Bounds":
        return cls(np.empty(count), np.empty((count, 2), np.complex128), np.empty((count, 360)))


class Joining(NamedTuple):
    """Arrivals and departures to join, with their bounds.

    `heights_m` (N, V) are the heights of the variants, -1 where there is none, `needed` (N,) the smallest bounds that
    matter. The expected power of weaker paths is added to `unlisted` (N,). `terms` and `weight` (V,) are scratch.
    """

    edges: Edges
    arrivals: Arrivals
    departures: Departures
    bounds: Bounds
    heights_m: Floats
    needed: Floats
    unlisted: Floats
    terms: Floats
    weight: Floats

    @classmethod
    def of(
        cls,
        edges: Edges,
        arrivals: Arrivals,
        departures: Departures,
        bounds: Bounds,
        heights_m: Floats,
        needed: Floats,
        unlisted: Floats,
    ) -> "Joining":
        scratch = np.empty((4, 3)), np.empty(heights_m.shape[1])
        return cls(edges, arrivals, departures, bounds, heights_m, needed, unlisted, *scratch)


class Reflected(NamedTuple):
    """Reflections at walls on one side of an edge: materials and cosines of incidence (R,), and their number."""

    material: NDArray[np.int64]
    cosine: Floats
    number: np.int64


class Shape(NamedTuple):
    """Shape of a path over an edge.

    `boundary` is sqrt(2 k L) of the UTD, `sine` and `slope` are the horizontal and vertical part of the direction,
    `bounces` the number of reflections at floor and ceiling.
    """

    boundary: float
    sine: float
    slope: float
    bounces: int | np.int64


@njit(cache=True, borrows=True)
def strength_of(materials, before, face, after, shape, terms, flat_material):
    """Return the bound of a vertical field after reflections and the diffraction, without the spread of the wave.

    `face` is the material of the wedge and the cosines at its faces, `terms` are from `utd_terms`.
    """
    field, largest = VERTICAL, materials.largest
    for k in range(before.number):
        field = at_wall(largest, before.material[k], before.cosine[k], shape.sine, shape.slope, field)
    tables = materials.reflection, materials.transition
    cosines = face[1], face[2]
    field = at_edge(tables, face[0], terms, shape.boundary, cosines, shape.sine, shape.slope, field)
    for k in range(after.number):
        field = at_wall(largest, after.material[k], after.cosine[k], shape.sine, shape.slope, field)
    return at_flats(largest, flat_material, shape.slope, shape.bounces, field)


@njit(cache=True, borrows=True)
def write_terms(utd, edge, angle, j, departure, terms):
    """Write the terms of the UTD for arrival j, with `angle` (J, 4), and a departure with a direction."""
    wedge = utd[edge, 0], utd[edge, 1], utd[edge, 2], utd[edge, 3], utd[edge, 4]
    utd_terms(wedge, (angle[j, 0], angle[j, 1], angle[j, 2], angle[j, 3]), departure, terms)


@njit(cache=True, borrows=True)
def spread_of(wavelength, length, onward):
    """Return the spread of the power over an edge, to be divided by the path length, and 2 k L (docs/physics.md)."""
    spread = wavelength**3 / (64.0 * np.pi**4 * length * onward)
    return spread, 4.0 * np.pi / wavelength * length * onward / (length + onward)


@njit(cache=True, borrows=True, nogil=True)
def depart(tree, pairs, group, edges, rx_m, pieces_m, material, largest, highest_m, departures):
    """Write the paths of pairs (beam, receiver) from edges; root 4 k of a beam is at edge `group[k]`.

    Their number of reflections is too large where a leg is too short or inside the wedge.
    """
    most_reflections = departures.material.shape[1]
    for i in range(len(pairs)):
        node = root = pairs[i, 0]
        while tree.parent[root] >= 0:
            root, departures.reflections[i] = tree.parent[root], departures.reflections[i] + 1
        e = departures.edge[i] = group[root // 4]
        target = rx_m[departures.rx[i]]
        x, y = target[0] - tree.source_m[node, 0], target[1] - tree.source_m[node, 1]
        length = np.sqrt(x * x + y * y)
        sine, departures.length_m[i] = length / np.sqrt(length * length + highest_m * highest_m), length
        x, y, near = _fold_back(
            i, node, x / length, y / length, sine, tree, edges.position_m[e], pieces_m, material, largest, departures
        )
        if not (near >= NEAR_M and outside(edges.normals, e, near * x, near * y)[1]):
            departures.reflections[i] = most_reflections + 1
        azimuth, angle = np.arctan2(y, x), departures.angle
        departures.azimuth_deg[i] = int(np.degrees(azimuth) + 360.5) % 360
        exterior = edges.exterior_rad[e]
        turned = wedge_angle(angle_rad(edges.face_rad[e], exterior, azimuth), exterior)
        angle[i, 0], angle[i, 1], angle[i, 2], angle[i, 3] = turned


@njit(cache=True, borrows=True)
def _fold_back(i, node, x, y, sine, tree, position_m, pieces_m, material, largest, departures):
    """Write the reflections of departure i, which arrives in direction (x, y).

    Return its direction at the edge, and the length of its first leg.
    """
    near = departures.length_m[i]
    for k in range(departures.reflections[i] - 1, -1, -1):
        wall = tree.piece[node]
        px, py = pieces_m[wall, 0, 0], pieces_m[wall, 0, 1]
        wx, wy = pieces_m[wall, 1, 0] - px, pieces_m[wall, 1, 1] - py
        across, along, squared = abs(wx * y - wy * x), wx * x + wy * y, wx * wx + wy * wy
        near = abs(wx * (position_m[1] - py) - wy * (position_m[0] - px)) / max(across, 1e-15)
        cosine = across / np.sqrt(squared)
        departures.material[i, k], departures.cosine[i, k] = material[wall], cosine
        departures.most[i] *= most_at_wall(largest, material[wall], cosine * sine)
        x, y, node = 2.0 * along / squared * wx - x, 2.0 * along / squared * wy - y, tree.parent[node]
    return x, y, near


def list_joined(
    room: Room, materials: Materials, joining: Joining
) -> tuple[NDArray[np.int32], NDArray[np.int32], Floats]:
    """List the departures, arrivals with variants, and bounds (C,) of all paths that receivers need.

    One number encodes an arrival and a variant.
    """
    columns: tuple[Any, ...] = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty(1024)
    first = used = 0
    while first < len(joining.departures.rx):
        first, used = _list_joined(first, room, materials, joining, columns, used)
        if first < len(joining.departures.rx):
            columns = tuple(np.concatenate([column, np.empty_like(column)]) for column in columns)
    pair, joined, bound = (column[:used].copy() for column in columns)
    return pair, joined, bound


@njit(cache=True, borrows=True, nogil=True)
def _list_joined(first, room, materials, joining, output, used):
    """Join departures from `first` on with the arrivals at their edges, up to one for which there may be no room.

    Return this departure, and the number of paths.
    """
    arrivals, departures, variants = joining.arrivals, joining.departures, joining.heights_m.shape[1]
    for i in range(first, len(departures.rx)):
        e, rx, onward, is_weak = departures.edge[i], departures.rx[i], departures.length_m[i], True
        begin, end = arrivals.start[e], arrivals.start[e + 1]
        if used + variants * (end - begin) > len(output[0]):
            return i, used
        for j in range(begin, end):
            left = variants // 2 - 1 - departures.reflections[i] - arrivals.reflections[j]
            if left < 0:
                continue
            total = arrivals.length_m[j] + onward
            rough = departures.most[i] ** 2 * joining.bounds.power[j, departures.azimuth_deg[i]] / (onward * total)
            if rough < joining.needed[rx]:
                joining.unlisted[rx] += EXPECTED * rough
                continue
            if is_weak:
                farthest, heights_m = arrivals.length_m[end - 1] + onward, joining.heights_m[rx]
                _weigh_variants(materials.largest, room.flat_material, heights_m, farthest, joining.weight)
                is_weak = False
            used = _join(i, j, left, room, materials, joining, output, used)
    return len(departures.rx), used


@njit(cache=True, borrows=True, forceinline=True)  # copying the arguments would take as long as the function
def _join(i, j, left, room, materials, joining, output, used):
    """List departure i after arrival j, with up to `left` reflections at floor and ceiling; return the new count."""
    edges, arrivals, departures, bounds, heights_m, needed, unlisted, terms, weight = joining
    pairs, joined, bound = output
    rx, onward, angle = departures.rx[i], departures.length_m[i], departures.angle
    total, least = arrivals.length_m[j] + onward, needed[rx]
    edge, to_rx = arrivals.edge[j], (angle[i, 0], angle[i, 1], angle[i, 2], angle[i, 3])
    write_terms(edges.utd, edge, arrivals.angle, j, to_rx, terms)
    spread, reach = spread_of(materials.wavelength_m, arrivals.length_m[j], onward)
    rough = most_at_edge(terms, np.sqrt(reach), bounds.faces[j, 0], bounds.faces[j, 1])
    rough = (departures.most[i] * bounds.most[j] * rough) ** 2 * spread / total * arrivals.gain[j]
    face = edges.material[edge, 0 if arrivals.lit[j] else 1], arrivals.faces[j, 0], arrivals.faces[j, 1]
    before = Reflected(arrivals.material[j], arrivals.cosine[j], arrivals.reflections[j])
    after = Reflected(departures.material[i], departures.cosine[i], departures.reflections[i])
    for variant in range(2 * left + 2):
        height = heights_m[rx, variant]
        if height < 0.0:
            continue
        if rough * weight[variant] < least:
            unlisted[rx] += EXPECTED * rough * weight[variant]
            continue
        long = np.sqrt(total**2 + height**2)
        shape = Shape(np.sqrt(reach * total / long), total / long, height / long, variant // 2)
        strength = strength_of(materials, before, face, after, shape, terms, room.flat_material)
        strength *= strength * spread / long
        if len(room.gains.table) > 1:
            rise = rise_of(variant, room, room.rx_m[rx])
            strength *= gain_of_departure(room, arrivals.toward[j, 0], arrivals.toward[j, 1], rise, total)
        pairs[used], joined[used], bound[used] = i, j * heights_m.shape[1] + variant, strength
        used += 1
    return used


@njit(cache=True, borrows=True, nogil=True)
def write_heights(room, heights_m):
    """Write the heights (N, V) of the variants that a room has."""
    for rx in range(len(heights_m)):
        for variant in range(heights_m.shape[1]):
            if has_variant(variant, room):
                heights_m[rx, variant] = rise_of(variant, room, room.rx_m[rx]).height_m


@njit(cache=True, borrows=True)
def _weigh_variants(largest, flat, heights_m, length, weight):
    """Write the largest powers of variants relative to a path in the plan."""
    for variant in range(len(weight)):
        height = max(heights_m[variant], 0.0)
        total = np.sqrt(length * length + height * height)
        weight[variant] = at_flats(largest, flat, height / total, variant // 2, _TURNED) ** 2 * length / total


@njit(cache=True, borrows=True, nogil=True)
def bound_arrivals(edges, arrivals, materials, highest_m, bounds, terms):
    """Write the bounds of arrivals; paths rise by at most `highest_m`, `terms` is scratch."""
    for j in range(len(bounds.most)):
        edge, length, most = arrivals.edge[j], arrivals.length_m[j], 1.0
        sine = length / np.sqrt(length * length + highest_m * highest_m)
        for k in range(arrivals.reflections[j]):
            most *= most_at_wall(materials.largest, arrivals.material[j, k], arrivals.cosine[j, k] * sine)
        own = edges.material[edge, 0 if arrivals.lit[j] else 1]
        for k in range(2):
            bounds.faces[j, k] = at_face(materials.reflection, own, arrivals.faces[j, k], 1.0, 0.0)[0]
        spread, reach = spread_of(materials.wavelength_m, length, 1.0)
        boundary, exterior, bounds.most[j] = np.sqrt(reach * (1.0 + length)), edges.exterior_rad[edge], most
        for azimuth in range(360):
            turned = wedge_angle(angle_rad(edges.face_rad[edge], exterior, np.radians(azimuth)), exterior)
            write_terms(edges.utd, edge, arrivals.angle, j, turned, terms)
            for k in range(4):  # the largest term within half a degree
                near = max(terms[k, 1] - _HALF_DEGREE, 1e-9)
                terms[k, 0], terms[k, 1] = terms[k, 0] * terms[k, 1] / near, near
            size = most * most_at_edge(terms, boundary, bounds.faces[j, 0], bounds.faces[j, 1])
            bounds.power[j, azimuth] = size**2 * spread * arrivals.gain[j]
