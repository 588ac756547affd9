"""Candidates of the path solver: chains of walls, with the reflections off floor and ceiling added.

Floor and ceiling follow analytically: unfolded, the height of a path changes linearly along its way in the plan, so
where it meets floor and ceiling depends on the length of that way alone.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sionna_partial.tracing.beams import Beams
from sionna_partial.tracing.scene import SceneGeometry

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

    def rows(self, index: NDArray[np.intp]) -> "Candidates":
        """Pick some of the candidates."""
        wedge = None if self.wedges is None or self.wedge is None else self.wedge[index]
        return replace(self, rx=self.rx[index], face=self.face[index], vertices_m=self.vertices_m[index], wedge=wedge)


def specular_candidates(
    beams: Beams,
    geometry: SceneGeometry,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    max_depth: int,
    *,
    pairs_per_block: int = 20_000,
) -> Iterator[tuple[Candidates, float]]:
    """Add the reflections off floor and ceiling, block by block.

    Parameters
    ----------
    beams : Beams
        Result of `trace_beams` for the walls of `geometry`.
    geometry : SceneGeometry
    tx_m, rx_m : (3,) and (N, 3) arrays
        Transmitter and receivers in the local frame [m], between floor (z = 0) and ceiling.
    max_depth : int
        Largest number of interactions of a path.
    pairs_per_block : int
        Number of pairs in a block, which bounds the memory.

    Yields
    ------
    Candidates
    float
        Share of all pairs done with this block.
    """
    for start in range(0, len(beams.pair_node), pairs_per_block):
        stop = min(start + pairs_per_block, len(beams.pair_node))
        rx, surface, vertices_m = _expand_heights(
            beams.parent,
            beams.segment,
            beams.source,
            beams.pair_node[start:stop],
            beams.pair_rx[start:stop],
            geometry.walls_m,
            tx_m,
            rx_m,
            geometry.height_m,
            geometry.floor_face >= 0,
            geometry.ceiling_face >= 0,
            max_depth,
        )
        yield Candidates(rx, faces_of(surface, geometry), vertices_m), stop / len(beams.pair_node)


def faces_of(surface: NDArray[np.int32], geometry: SceneGeometry) -> NDArray[np.int32]:
    """Turn wall segments, FLOOR, CEILING and BEND (C, D) into faces of the scene; -1 stays."""
    walls = 2 * np.arange(len(geometry.segments), dtype=np.int32)
    others = np.array([EDGE, geometry.ceiling_face, geometry.floor_face, -1], dtype=np.int32)
    return np.concatenate([walls, others])[surface]


@njit(cache=True)
def _expand_heights(  # type: ignore[no-untyped-def]
    parent, segment, source, pair_node, pair_rx, walls, tx, rx, height, floor, ceiling, max_depth
):
    """Every order of wall, floor and ceiling reflections of each pair (see `specular_candidates`)."""
    depth_size = max(1, max_depth)
    chain = np.empty(depth_size, np.int64)
    place = np.empty((depth_size, 3))
    total = 0
    for i in range(len(pair_node)):
        total += 1 + 2 * (max_depth - chain_length(parent, pair_node[i]))
    out_rx = np.empty(total, np.int32)
    surface = np.full((total, depth_size), -1, np.int32)
    vertices = np.zeros((total, depth_size, 3))
    count = 0
    for i in range(len(pair_node)):
        target = rx[pair_rx[i]]
        k, _, good = unfold(parent, segment, source, pair_node[i], walls, target, chain, place)
        if not good:
            continue
        for bounces in range(max_depth - k + 1):
            for first in (FLOOR, CEILING):
                if not can_bounce(bounces, first, floor, ceiling):
                    continue
                out_rx[count] = pair_rx[i]
                merge_heights(chain[:k], place[:k], tx, target, height, bounces, first, surface[count], vertices[count])
                count += 1
    return out_rx[:count], surface[:count], vertices[:count]


@njit(cache=True)
def can_bounce(bounces, first, floor, ceiling):  # type: ignore[no-untyped-def]
    """Whether a path can meet floor and ceiling alternately `bounces` times; without any, `first` counts as FLOOR."""
    if bounces == 0:
        return first == FLOOR
    if bounces == 1:
        return floor if first == FLOOR else ceiling
    return floor and ceiling


@njit(cache=True)
def chain_length(parent, node):  # type: ignore[no-untyped-def]
    """Count the walls from the root down to a node."""
    length = 0
    while parent[node] >= 0:
        length += 1
        node = parent[node]
    return length


@njit(cache=True)
def unfold(parent, segment, source, node, walls, target, chain, place):  # type: ignore[no-untyped-def]
    """Wall reflection points of one pair: (x, y, share of the path's length) in order from the transmitter.

    Returns the number of reflections, the length of the way in the plan and whether all points exist.
    """
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
def merge_heights(chain, place, tx, target, height, bounces, first, surface, vertices):  # type: ignore[no-untyped-def]
    """Write one candidate: wall reflections and `bounces` alternating floor and ceiling reflections in path order."""
    to_first = tx[2] if first == FLOOR else height - tx[2]
    last_is_floor = (bounces % 2 == 1) == (first == FLOOR)
    from_last = target[2] if last_is_floor else height - target[2]
    climb = to_first + (bounces - 1) * height + from_last if bounces else 1.0
    walls, flats = 0, 0
    px, py, done = tx[0], tx[1], 0.0
    for depth in range(len(chain) + bounces):
        share = (to_first + flats * height) / climb if flats < bounces else 2.0
        is_floor = (flats % 2 == 0) == (first == FLOOR)
        if walls < len(chain) and place[walls, 2] <= share:
            px, py, done = place[walls, 0], place[walls, 1], place[walls, 2]
            surface[depth] = chain[walls]
            vertices[depth, 0], vertices[depth, 1] = px, py
            vertices[depth, 2] = _height_at(done, tx[2], target[2], height, bounces, first, to_first, climb)
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
def _height_at(share, tx_z, rx_z, height, bounces, first, to_first, climb):  # type: ignore[no-untyped-def]
    """Height of a path after a share of its length."""
    if bounces == 0:
        return tx_z + share * (rx_z - tx_z)
    travelled = share * climb
    if travelled <= to_first:
        return tx_z - travelled if first == FLOOR else tx_z + travelled
    legs = int((travelled - to_first) // height)
    rest = travelled - to_first - legs * height
    rising = (legs % 2 == 0) == (first == FLOOR)
    return rest if rising else height - rest


def in_copies_of_scene(candidates: Candidates, vertices_m: NDArray[np.floating], faces: int, count: int) -> Candidates:
    """Repeat candidates for each copy of a scene.

    Parameters
    ----------
    candidates : Candidates
    vertices_m : (C, D, 3) array
        Their points of interaction [m].
    faces, count : int
        Number of faces of the scene, and of its copies, whose faces follow one another.

    Returns
    -------
    Candidates
        Those of the first copy, then those of the second, and so on.
    """
    shift = faces * np.repeat(np.arange(count, dtype=np.int32), len(candidates.rx))
    face = np.tile(candidates.face, (count, 1))
    new = replace(
        candidates,
        rx=np.tile(candidates.rx, count),
        face=np.where(face >= 0, face + shift[:, None], face),
        vertices_m=np.tile(vertices_m, (count, 1, 1)),
    )
    wedges, wedge = candidates.wedges, candidates.wedge
    if wedges is None or wedge is None:
        return new
    edges = len(wedges.edge_m)
    faces_of = wedges.face.reshape(2, 1, edges, 2) + faces * np.arange(count, dtype=np.int32)[:, None, None]
    normals = np.broadcast_to(wedges.normal.reshape(2, 1, edges, 2, 2), (2, count, edges, 2, 2))
    copies = replace(
        wedges,
        edge_m=np.tile(wedges.edge_m, (count, 1)),
        face=faces_of.reshape(-1, 2),
        normal=normals.reshape(-1, 2, 2),
    )
    copy = np.repeat(np.arange(count, dtype=np.int32), len(wedge))
    side, edge = np.divmod(np.tile(wedge, count), np.int32(edges))
    return replace(new, wedges=copies, wedge=(side * count + copy) * np.int32(edges) + edge)
