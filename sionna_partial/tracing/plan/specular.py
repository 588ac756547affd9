"""Specular candidates of floor plans: sequences of walls, with the reflections off floor and ceiling added.

Floor and ceiling follow analytically: unfolded, the height of a path changes linearly with its length in the plan, so
where it meets floor and ceiling depends on that length alone.
"""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.process import njit
from sionna_partial.scene.floor_plan import grow
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import REFLECTION
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.plan.beams import Beams, trace_beams
from sionna_partial.tracing.power import ISOTROPIC, Gains, Materials, at_flats, at_wall, gain_towards
from sionna_partial.tracing.select import Listed

NOTHING, FLOOR, CEILING, EDGE, WALLS = range(5)
"""Surfaces by number: no surface, the floor, the ceiling, a vertical edge, and from `WALLS` on the wall segments."""

_PAIRS_AT_ONCE = 200_000
"""Number of (sequence of walls, receiver) pairs in a block of candidates, which bounds the memory."""


class Room(NamedTuple):
    """Surfaces around a transmitter (3,) and receivers (N, 3), in the local frame [m].

    Walls (S, 2, 2) stand between the floor at 0 and the ceiling at `height_m`; `floor` and `ceiling` are whether they
    reflect. `wall_material` (S,) and `flat_material` are indices of materials, `top_m` (S,) the heights of the walls,
    `gains` the gains of the transmit antenna.
    """

    walls_m: Floats
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
        """Take it from a scene, whose faces have these materials."""
        flats = geometry.floor_face >= 0, geometry.ceiling_face >= 0
        of_flats = int(material_of_face[geometry.floor_face]) if flats[0] else 0
        materials = material_of_face[: 2 * len(geometry.segments) : 2], of_flats
        return cls(geometry.walls_m, float(geometry.height_m), *flats, tx_m, rx_m, *materials, geometry.top_m, gains)


class SpecularCandidates:
    """All specular paths of at most `max_depth` reflections between the transmitter and the receivers of a room."""

    name = "reflections"

    def __init__(self, geometry: SceneGeometry, room: Room, max_depth: int, materials: Materials) -> None:
        self._geometry, self._room, self._max_depth, self._materials = geometry, room, max_depth, materials

    def listed(self, found: Floats, *, pairs_at_once: int = _PAIRS_AT_ONCE) -> Iterator[Listed]:
        """List the candidates; none is negligible."""
        room, plan = self._room, self._geometry.plan
        beams = trace_beams(plan, room.tx_m[:2], room.rx_m[:, :2], self._max_depth)
        count = len(beams.pair_rx)
        for start in range(0, count, pairs_at_once):
            stop = min(start + pairs_at_once, count)
            pair, variant, bound = _list_heights(beams, start, stop, room, self._max_depth, self._materials)
            write = partial(self._written, beams, pair, variant)
            yield Listed(beams.pair_rx[pair], bound, write, stop / count)

    def _written(self, beams: Beams, pair: Indices, variant: NDArray[np.int8], rows: Indices) -> Candidates:
        pair = pair[rows]
        surface, vertices_m = _write_heights(beams, pair, variant[rows], self._room, self._max_depth)
        kind = np.where(surface == NOTHING, 0, REFLECTION).astype(np.uint8)
        return Candidates(beams.pair_rx[pair], kind, faces_of(surface, self._geometry), vertices_m)


def faces_of(surface: NDArray[np.int32], geometry: SceneGeometry) -> NDArray[np.int32]:
    """Return the faces of the scene (C, D) of surfaces; edges have none yet: -1, as where there is no surface."""
    walls = 2 * np.arange(len(geometry.segments))
    face = np.concatenate([[-1, geometry.floor_face, geometry.ceiling_face, -1], walls]).astype(np.int32)
    return face[surface]


@njit(cache=True, nogil=True)
def _list_heights(beams, start, stop, room, max_depth, materials):  # type: ignore[no-untyped-def]
    """List every order of wall, floor and ceiling reflections of some pairs: pair, variant and bound (C,)."""
    parent, segment, source = beams.parent, beams.segment, beams.source
    pair_node, pair_rx, walls_m, tx_m, rx_m = beams.pair_node, beams.pair_rx, room.walls_m, room.tx_m, room.rx_m
    wall_material, largest, wavelength = room.wall_material, materials.largest, materials.wavelength_m
    size, directed = max(1, max_depth), len(room.gains.table) > 1
    walls, points, cosine = np.empty(size, np.int64), np.empty((size, 3)), np.empty(size)
    material = np.full(size + 1, room.flat_material)
    pair, variant, bound = np.empty(1024, np.int32), np.empty(1024, np.int8), np.empty(1024)
    count = np.int64(0)
    for i in range(start, stop):
        target = rx_m[pair_rx[i]]
        k, length, good = unfold(parent, segment, source, pair_node[i], walls_m, target, walls, points)
        if not good:
            continue
        incidence(walls_m, tx_m, target, walls[:k], points, cosine)
        for level in range(k):
            material[level] = wall_material[walls[level]]
        for bounces in range(max_depth - k + 1):
            for first in (FLOOR, CEILING):
                if not can_bounce(bounces, first, room):
                    continue
                height = unfolded_height(room, target, bounces, first)
                power = _specular_power(wavelength, largest, material, cosine, k, length, height, bounces)
                if directed:
                    x, y = (points[0, 0], points[0, 1]) if k > 0 else (target[0], target[1])
                    slope = height * sign_of_rise(room, target, bounces, first) / max(length, 1e-9)
                    power *= gain_of_leg(room, x - tx_m[0], y - tx_m[1], slope)
                pair, variant, bound = grow(pair, count + 1), grow(variant, count + 1), grow(bound, count + 1)
                pair[count], variant[count] = i, 2 * bounces + first - FLOOR
                bound[count] = power if k + bounces > 0 else np.inf
                count += 1
    return pair[:count].copy(), variant[:count].copy(), bound[:count].copy()


@njit(cache=True, nogil=True)
def _write_heights(beams, pairs, variants, room, max_depth):  # type: ignore[no-untyped-def]
    """Write surfaces (C, D) and vertices (C, D, 3) of some variants of pairs."""
    size, count = max(1, max_depth), len(pairs)
    walls, points, met = np.empty(size, np.int64), np.empty((size, 3)), np.empty(size, np.int64)
    surface, vertices = np.zeros((count, size), np.int32), np.zeros((count, size, 3))
    for c in range(count):
        node, target = beams.pair_node[pairs[c]], room.rx_m[beams.pair_rx[pairs[c]]]
        k, _, _ = unfold(beams.parent, beams.segment, beams.source, node, room.walls_m, target, walls, points)
        for level in range(k):
            met[level] = WALLS + walls[level]
        bounces, first = variants[c] // 2, FLOOR + variants[c] % 2
        merge_heights(met[:k], points[:k], room, target, bounces, first, surface[c], vertices[c])
    return surface, vertices


@njit(cache=True)
def sign_of_rise(room, target, bounces, first):  # type: ignore[no-untyped-def]
    """Return 1 where a path rises at first, -1 where it falls."""
    if bounces == 0:
        return 1.0 if target[2] >= room.tx_m[2] else -1.0
    return -1.0 if first == FLOOR else 1.0


@njit(cache=True)
def gain_of_leg(room, x, y, slope):  # type: ignore[no-untyped-def]
    """Return the gain of the transmit antenna towards a horizontal offset, for a path of some slope."""
    return gain_towards(room.gains, x, y, slope * np.hypot(x, y))


@njit(cache=True)
def unfolded_height(room, target, bounces, first):  # type: ignore[no-untyped-def]
    """Height [m] that a path covers, unfolded: floor and ceiling in turn, `bounces` times."""
    if bounces == 0:
        return abs(target[2] - room.tx_m[2])
    to_first = room.tx_m[2] if first == FLOOR else room.height_m - room.tx_m[2]
    last_is_floor = (bounces % 2 == 1) == (first == FLOOR)
    from_last = target[2] if last_is_floor else room.height_m - target[2]
    return to_first + (bounces - 1) * room.height_m + from_last


@njit(cache=True)
def incidence(all_walls, start, end, walls, points, cosine):  # type: ignore[no-untyped-def]
    """Write the cosines of the angles of incidence, seen from above, at a sequence of walls."""
    x, y = start[0], start[1]
    for level in range(len(walls)):
        wall = all_walls[walls[level]]
        wx, wy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
        dx, dy = points[level, 0] - x, points[level, 1] - y
        if dx * dx + dy * dy < 1e-12:  # at the wall itself: the next leg has the same angle
            dx = (points[level + 1, 0] if level + 1 < len(walls) else end[0]) - points[level, 0]
            dy = (points[level + 1, 1] if level + 1 < len(walls) else end[1]) - points[level, 1]
        size = np.hypot(wx, wy) * np.hypot(dx, dy)
        cosine[level] = (wx * dy - wy * dx) / size if size > 0.0 else 0.0
        x, y = points[level, 0], points[level, 1]


@njit(cache=True)
def _specular_power(wavelength, largest, material, cosine, count, length, height, bounces):  # type: ignore[no-untyped-def]
    """Upper bound of the power of a path of some length in the plan, with reflections at walls, floor and ceiling.

    `material` has the materials of the walls, and at its end of floor and ceiling.
    """
    total = np.hypot(length, height)
    sine, slope, field = length / total, height / total, (1.0, 0.0, 1.0)
    for k in range(count):
        field = at_wall(largest, material[k], cosine[k], sine, slope, field)
    return (wavelength / (4.0 * np.pi * total) * at_flats(largest, material[-1], slope, bounces, field)) ** 2


@njit(cache=True)
def can_bounce(bounces, first, room):  # type: ignore[no-untyped-def]
    """Return whether a path can meet floor and ceiling in turn `bounces` times; without any, `first` is FLOOR."""
    if bounces == 0:
        return first == FLOOR
    if bounces == 1:
        return room.floor if first == FLOOR else room.ceiling
    return room.floor and room.ceiling


@njit(cache=True)
def unfold(parent, segment, source, node, all_walls, target, walls, points):  # type: ignore[no-untyped-def]
    """Write the walls of one pair, and where each reflects: (x, y, fraction of the path's length), in path order.

    The first arguments are columns of `Beams`. Returns the number of reflections, the length in the plan and whether
    all points exist.
    """
    k, above = 0, node
    while parent[above] >= 0:
        k, above = k + 1, parent[above]
    x, y = target[0], target[1]
    total = np.hypot(x - source[node, 0], y - source[node, 1])
    for level in range(k - 1, -1, -1):
        sx, sy = source[node, 0], source[node, 1]
        wall = all_walls[segment[node]]
        dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
        from_source = dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])
        from_point = dx * (y - wall[0, 1]) - dy * (x - wall[0, 0])
        if abs(from_source - from_point) < 1e-15 or total == 0.0:
            return k, total, False
        fraction = from_source / (from_source - from_point)
        x, y = sx + fraction * (x - sx), sy + fraction * (y - sy)
        walls[level] = segment[node]
        points[level, 0], points[level, 1], points[level, 2] = x, y, np.hypot(x - sx, y - sy) / total
        node = parent[node]
    return k, total, True


@njit(cache=True)
def merge_heights(met, points, room, target, bounces, first, surface, vertices):  # type: ignore[no-untyped-def]
    """Write one candidate: its surfaces in the plan and `bounces` reflections at floor and ceiling, in path order."""
    tx, height = room.tx_m, room.height_m
    to_first = tx[2] if first == FLOOR else height - tx[2]
    unfolded = unfolded_height(room, target, bounces, first) if bounces else 1.0
    at_met, at_flats = 0, 0
    px, py, done = tx[0], tx[1], 0.0
    for depth in range(len(met) + bounces):
        fraction = (to_first + at_flats * height) / unfolded if at_flats < bounces else 2.0
        if at_met < len(met) and points[at_met, 2] <= fraction:
            px, py, done = points[at_met, 0], points[at_met, 1], points[at_met, 2]
            surface[depth] = met[at_met]
            vertices[depth, 0], vertices[depth, 1] = px, py
            vertices[depth, 2] = height_at(done, room, target, bounces, first, to_first, unfolded)
            at_met += 1
            continue
        nx, ny, stop = target[0], target[1], 1.0
        if at_met < len(met):
            nx, ny, stop = points[at_met, 0], points[at_met, 1], points[at_met, 2]
        part = (fraction - done) / (stop - done) if stop > done else 0.0
        is_floor = (at_flats % 2 == 0) == (first == FLOOR)
        surface[depth] = FLOOR if is_floor else CEILING
        vertices[depth, 0], vertices[depth, 1] = px + part * (nx - px), py + part * (ny - py)
        vertices[depth, 2] = 0.0 if is_floor else height
        at_flats += 1


@njit(cache=True)
def height_at(fraction, room, target, bounces, first, to_first, unfolded):  # type: ignore[no-untyped-def]
    """Height of a path after a fraction of its length."""
    tx_z, height = room.tx_m[2], room.height_m
    if bounces == 0:
        return tx_z + fraction * (target[2] - tx_z)
    travelled = fraction * unfolded
    if travelled <= to_first:
        return tx_z - travelled if first == FLOOR else tx_z + travelled
    legs = int((travelled - to_first) // height)
    rest = travelled - to_first - legs * height
    rising = (legs % 2 == 0) == (first == FLOOR)
    return rest if rising else height - rest
