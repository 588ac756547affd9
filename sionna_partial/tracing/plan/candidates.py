"""Candidates of the path solver: chains of walls, with the reflections off floor and ceiling added.

Floor and ceiling follow analytically: unfolded, the height of a path changes linearly along its way in the plan, so
where it meets floor and ceiling depends on the length of that way alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sionna_partial.scene.floor_plan import grow
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.plan.beams import Beams
from sionna_partial.tracing.plan.bounds import LEVELS, Strengths, level_of, reflected_power

EDGE = -2
"""Stands for the face of an interaction in a candidate where that is a diffraction."""

FLOOR, CEILING, BEND = -2, -3, -4
"""Stand for a wall segment in a chain where a path meets the floor, the ceiling or a vertical edge."""


@dataclass(frozen=True)
class Wedges:
    """Vertical edges, each with the two faces that bound the room around it.

    Around an edge, walls bound sectors. Only a sector wider than a half-plane holds directions that the walls hide from
    each other, so an edge diffracts in one sector at most, and where three or more walls meet mostly in none. A free
    end of a wall has both of its sides as faces. In candidates, wedge W + i is wedge i with its faces swapped.

    Parameters
    ----------
    edge_m : (W, 2) float64 array
        The edges in the plan [m].
    height_m : float
        Height that they rise to from 0 [m].
    face : (2 W, 2) int32 array
        0-face and n-face of the scene: counterclockwise from the 0-face of wedge i < W, the sector ends at the n-face.
    normal : (2 W, 2, 2) float64 array
        Their unit normals, which point into the sector.
    """

    edge_m: NDArray[np.float64]
    height_m: float
    face: NDArray[np.int32]
    normal: NDArray[np.float64]


@dataclass(frozen=True)
class Candidates:
    """Geometrically possible paths, to be verified by the path solver.

    Parameters
    ----------
    rx : (C,) int32 array
        Receiver of each candidate.
    face : (C, D) int32 array
        Face of the scene at every interaction in order from the transmitter, counted through its shapes; any of the
        faces in one plane stands for all. EDGE where the path diffracts, -1 where there is no interaction.
    vertices_m : (C, D, 3) float64 array
        Points of interaction [m].
    wedge : (C,) int32 array, optional
        Wedge at which each candidate diffracts.
    wedges : Wedges, optional
        Given if all candidates diffract.
    """

    rx: NDArray[np.int32]
    face: NDArray[np.int32]
    vertices_m: NDArray[np.float64]
    wedge: NDArray[np.int32] | None = None
    wedges: Wedges | None = None

    def is_like(self, other: "Candidates") -> bool:
        """Whether both can be verified together."""
        return self.face.shape[1] == other.face.shape[1] and self.wedges is other.wedges

    @classmethod
    def concatenate(cls, parts: list["Candidates"]) -> "Candidates":
        """Join candidates that can be verified together; at least one part."""
        wedge = None if parts[0].wedge is None else np.concatenate([each.wedge for each in parts])  # type: ignore[misc]
        rx, face, vertices_m = (
            np.concatenate([getattr(each, name) for each in parts]) for name in ("rx", "face", "vertices_m")
        )
        return cls(rx, face, vertices_m, wedge, parts[0].wedges)

    def rows(self, index: NDArray[np.intp]) -> "Candidates":
        """Pick some of the candidates."""
        wedge = None if self.wedges is None or self.wedge is None else self.wedge[index]
        return replace(self, rx=self.rx[index], face=self.face[index], vertices_m=self.vertices_m[index], wedge=wedge)


class Room(NamedTuple):
    """What paths meet between a transmitter and receivers in the local frame [m].

    Parameters
    ----------
    walls_m : (S, 2, 2) float64 array
    height_m : float
        Of the ceiling above the floor.
    floor, ceiling : bool
        Whether they reflect.
    tx_m, rx_m : (3,) and (N, 3) arrays
    """

    walls_m: NDArray[np.float64]
    height_m: float
    floor: bool
    ceiling: bool
    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]

    @classmethod
    def of(cls, geometry: SceneGeometry, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> "Room":
        """Take it from a scene."""
        flats = geometry.floor_face >= 0, geometry.ceiling_face >= 0
        return cls(geometry.walls_m, float(geometry.height_m), *flats, tx_m, rx_m)


def specular_candidates(
    beams: Beams,
    geometry: SceneGeometry,
    room: Room,
    max_depth: int,
    strengths: Strengths,
    best: NDArray[np.uint8],
    *,
    pairs_per_block: int = 200_000,
) -> Iterator[tuple[Candidates, float]]:
    """Add the reflections off floor and ceiling, block by block.

    Parameters
    ----------
    beams : Beams
        Result of `trace_beams` for the walls of `geometry`.
    geometry : SceneGeometry
    room : Room
        Of `geometry`; transmitter and receivers are between floor (z = 0) and ceiling.
    max_depth : int
        Largest number of interactions of a path.
    strengths : Strengths
        Which candidates are asked for; their bounds are added to its `power` and `reflected`.
    best : (K,) uint8 array
        Level of the strongest candidate of each pair, which this writes. Pairs without any that is asked for are passed
        over; zeros are right before anything is known.
    pairs_per_block : int
        Number of pairs in a block, which bounds the memory.

    Yields
    ------
    Candidates
    float
        Fraction of all pairs done with this block.
    """
    for start in range(0, len(beams.pair_node), pairs_per_block):
        stop = min(start + pairs_per_block, len(beams.pair_node))
        rx, surface, vertices_m = _expand_heights(beams, start, stop, room, max_depth, strengths, best)
        yield Candidates(rx, faces_of(surface, geometry), vertices_m), stop / len(beams.pair_node)


def faces_of(surface: NDArray[np.int32], geometry: SceneGeometry) -> NDArray[np.int32]:
    """Turn wall segments, FLOOR, CEILING and BEND (C, D) into faces of the scene; -1 stays."""
    walls = 2 * np.arange(len(geometry.segments), dtype=np.int32)
    others = np.array([EDGE, geometry.ceiling_face, geometry.floor_face, -1], dtype=np.int32)
    return np.concatenate([walls, others])[surface]


@njit(cache=True, nogil=True)
def _expand_heights(beams, start, stop, room, max_depth, strengths, best):  # type: ignore[no-untyped-def]
    """Every order of wall, floor and ceiling reflections of the pairs (see `specular_candidates`)."""
    size = max(1, max_depth)
    chain, place, cosine = np.empty(size, np.int64), np.empty((size, 3)), np.empty(size)
    out_rx, surface, vertices = np.empty(1024, np.int32), np.empty((1024, size), np.int32), np.empty((1024, size, 3))
    count = np.int64(0)
    for i in range(start, stop):
        rx = beams.pair_rx[i]
        if best[i] >= strengths.last[rx]:
            continue
        target, best[i] = room.rx_m[rx], LEVELS
        k, length, good = unfold(beams, beams.pair_node[i], room.walls_m, target, chain, place)
        if not good:
            continue
        incidence(room.walls_m, room.tx_m, target, chain[:k], place, cosine)
        for bounces in range(max_depth - k + 1):
            for first in (FLOOR, CEILING):
                if not can_bounce(bounces, first, room):
                    continue
                power = specular_power(strengths, cosine[:k], length, climb(room, target, bounces, first), bounces)
                level = level_of(power) if k + bounces > 0 else 0
                if len(strengths.power):
                    strengths.power[rx, level] += power
                best[i] = min(best[i], level)
                if bounces == 0 and k > 0:
                    strengths.reflected[rx] += power
                if not strengths.first[rx] <= level < strengths.last[rx]:
                    continue
                out_rx, surface, vertices = grow(out_rx, count + 1), grow(surface, count + 1), grow(vertices, count + 1)
                out_rx[count] = rx
                clear(surface[count], vertices[count])
                merge_heights(chain[:k], place[:k], room, target, bounces, first, surface[count], vertices[count])
                count += 1
    return out_rx[:count].copy(), surface[:count].copy(), vertices[:count].copy()


@njit(cache=True)
def clear(surface, vertices):  # type: ignore[no-untyped-def]
    """Empty one candidate."""
    for depth in range(len(surface)):
        surface[depth] = -1
        vertices[depth, 0] = vertices[depth, 1] = vertices[depth, 2] = 0.0


@njit(cache=True)
def climb(room, target, bounces, first):  # type: ignore[no-untyped-def]
    """Height [m] that a path covers, unfolded: floor and ceiling in turn, `bounces` times."""
    if bounces == 0:
        return abs(target[2] - room.tx_m[2])
    to_first = room.tx_m[2] if first == FLOOR else room.height_m - room.tx_m[2]
    last_is_floor = (bounces % 2 == 1) == (first == FLOOR)
    from_last = target[2] if last_is_floor else room.height_m - target[2]
    return to_first + (bounces - 1) * room.height_m + from_last


@njit(cache=True)
def incidence(walls, start, end, chain, place, cosine):  # type: ignore[no-untyped-def]
    """Write the cosines of the angles of incidence, seen from above, at the walls of a chain."""
    x, y = start[0], start[1]
    for level in range(len(chain)):
        wall = walls[chain[level]]
        wx, wy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
        dx, dy = place[level, 0] - x, place[level, 1] - y
        if dx * dx + dy * dy < 1e-12:  # at the wall itself: the way on has the same angle
            dx = (place[level + 1, 0] if level + 1 < len(chain) else end[0]) - place[level, 0]
            dy = (place[level + 1, 1] if level + 1 < len(chain) else end[1]) - place[level, 1]
        size = np.hypot(wx, wy) * np.hypot(dx, dy)
        cosine[level] = (wx * dy - wy * dx) / size if size > 0.0 else 0.0
        x, y = place[level, 0], place[level, 1]


@njit(cache=True)
def specular_power(strengths, cosine, length, climbed, bounces):  # type: ignore[no-untyped-def]
    """Upper bound of the power of a specular path of some length in the plan, with wall and flat reflections."""
    way = np.hypot(length, climbed)
    power = (strengths.wavelength_m / (4.0 * np.pi * way)) ** 2
    for k in range(len(cosine)):
        power *= reflected_power(strengths, cosine[k] * length / way)
    if bounces > 0:
        power *= reflected_power(strengths, climbed / way) ** bounces
    return power


@njit(cache=True)
def can_bounce(bounces, first, room):  # type: ignore[no-untyped-def]
    """Whether a path can meet floor and ceiling alternately `bounces` times; without any, `first` counts as FLOOR."""
    if bounces == 0:
        return first == FLOOR
    if bounces == 1:
        return room.floor if first == FLOOR else room.ceiling
    return room.floor and room.ceiling


@njit(cache=True)
def chain_length(parent, node):  # type: ignore[no-untyped-def]
    """Count the walls from the root down to a node."""
    length = 0
    while parent[node] >= 0:
        length += 1
        node = parent[node]
    return length


@njit(cache=True)
def unfold(beams, node, walls, target, chain, place):  # type: ignore[no-untyped-def]
    """Wall reflection points of one pair: (x, y, share of the path's length) in order from the transmitter.

    Returns the number of reflections, the length of the way in the plan and whether all points exist.
    """
    parent, segment, source = beams.parent, beams.segment, beams.source
    k = chain_length(parent, node)
    x, y = target[0], target[1]
    total = np.hypot(x - source[node, 0], y - source[node, 1])
    for level in range(k - 1, -1, -1):
        sx, sy = source[node, 0], source[node, 1]
        wall = walls[segment[node]]
        dx, dy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
        from_source = dx * (sy - wall[0, 1]) - dy * (sx - wall[0, 0])
        from_point = dx * (y - wall[0, 1]) - dy * (x - wall[0, 0])
        if abs(from_source - from_point) < 1e-15 or total == 0.0:
            return k, total, False
        share = from_source / (from_source - from_point)
        x, y = sx + share * (x - sx), sy + share * (y - sy)
        chain[level] = segment[node]
        place[level, 0], place[level, 1], place[level, 2] = x, y, np.hypot(x - sx, y - sy) / total
        node = parent[node]
    return k, total, True


@njit(cache=True)
def merge_heights(chain, place, room, target, bounces, first, surface, vertices):  # type: ignore[no-untyped-def]
    """Write one candidate: wall reflections and `bounces` alternating floor and ceiling reflections in path order."""
    tx, height = room.tx_m, room.height_m
    to_first = tx[2] if first == FLOOR else height - tx[2]
    climbed = climb(room, target, bounces, first) if bounces else 1.0
    walls, flats = 0, 0
    px, py, done = tx[0], tx[1], 0.0
    for depth in range(len(chain) + bounces):
        share = (to_first + flats * height) / climbed if flats < bounces else 2.0
        is_floor = (flats % 2 == 0) == (first == FLOOR)
        if walls < len(chain) and place[walls, 2] <= share:
            px, py, done = place[walls, 0], place[walls, 1], place[walls, 2]
            surface[depth] = chain[walls]
            vertices[depth, 0], vertices[depth, 1] = px, py
            vertices[depth, 2] = _height_at(done, tx[2], target[2], height, bounces, first, to_first, climbed)
            walls += 1
            continue
        nx, ny, stop = target[0], target[1], 1.0
        if walls < len(chain):
            nx, ny, stop = place[walls, 0], place[walls, 1], place[walls, 2]
        part = (share - done) / (stop - done) if stop > done else 0.0
        surface[depth] = FLOOR if is_floor else CEILING
        vertices[depth, 0], vertices[depth, 1] = px + part * (nx - px), py + part * (ny - py)
        vertices[depth, 2] = 0.0 if is_floor else height
        flats += 1


@njit(cache=True)
def _height_at(share, tx_z, rx_z, height, bounces, first, to_first, climbed):  # type: ignore[no-untyped-def]
    """Height of a path after a share of its length."""
    if bounces == 0:
        return tx_z + share * (rx_z - tx_z)
    travelled = share * climbed
    if travelled <= to_first:
        return tx_z - travelled if first == FLOOR else tx_z + travelled
    legs = int((travelled - to_first) // height)
    rest = travelled - to_first - legs * height
    rising = (legs % 2 == 0) == (first == FLOOR)
    return rest if rising else height - rest
