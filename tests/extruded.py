"""Extruded floor plans, and the textbook image method that exact beams are compared with."""

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.settings import Material
from sionna_partial.tracing.paths import Candidates, Wedges
from sionna_partial.tracing.plan.edges import DiffractionCandidates
from sionna_partial.tracing.plan.reflections import SpecularCandidates
from sionna_partial.tracing.plan.room import Room
from sionna_partial.tracing.power import Materials, materials_of
from sionna_partial.tracing.select import Listed

Floats = NDArray[np.float64]
Blocks = list[tuple[Candidates, float]]

CELLS = {".": CellState.FREE, "#": CellState.WALL, "?": CellState.UNKNOWN}

ROOM = np.array(
    [[(0, 0), (6, 0)], [(6, 0), (6, 4)], [(6, 4), (0, 4)], [(0, 4), (0, 0)], [(3, 0), (3, 1.5)], [(3, 2.5), (3, 4)]],
    dtype=float,
)
"""A room of 6 m x 4 m, parted by a wall with a door."""

SPLINTERS = np.array(
    [[(0.5, 3.2), (1.4, 3.7)], [(4.2, 0.6), (5.1, 1.3)], [(4.9, 0.5), (4.3, 1.4)], [(3.8, 3.0), (4.6, 3.0)]],
    dtype=float,
)
"""Free-standing walls, tilted, two of them crossing."""


def drawn(text: str, resolution_m: float = 0.5, origin_m: tuple[float, float] = (0.0, 0.0)) -> PartialMap:
    """Make a map of a drawing: `.` free, `#` wall, `?` unknown; its last line is at the bottom."""
    rows = text.split()
    state = np.array([[CELLS[sign] for sign in row] for row in reversed(rows)], dtype=np.uint8)
    return PartialMap(state, resolution_m, origin_m)


HALF = drawn("########## #....????# #....????# #....????# ##########", 1.0)
"""A room of which half has been seen."""


def extrude(
    walls_m: ArrayLike,
    *,
    height_m: float = 2.5,
    floor_m: Sequence[tuple[float, float, float, float]] = ((0, 0, 6, 4),),
    ceiling: bool = True,
    open_ends_m: Sequence[tuple[float, float]] = (),
) -> SceneGeometry:
    """Extrude walls (S, 2, 2), which meet where their ends are equal, over rectangles of floor."""
    ends = np.reshape(np.asarray(walls_m, dtype=float), (-1, 2))
    vertices_m, index = np.unique(ends, axis=0, return_inverse=True)
    is_open = [any(np.allclose(vertex, end) for end in open_ends_m) for vertex in vertices_m]
    return SceneGeometry(
        vertices_m=vertices_m,
        segments=index.reshape(-1, 2).astype(np.int64),
        open_end=np.array(is_open, dtype=bool),
        floor_m=np.array(floor_m, dtype=float).reshape(-1, 4),
        cell_m=0.1,
        height_m=height_m,
        ceiling=ceiling,
        wall_material=np.zeros(len(index) // 2, np.int64),
        materials=(Material(),),
        top_m=np.full(len(index) // 2, height_m),
        lids=(),
        origin_m=(0.0, 0.0),
    )


def cross(a: Floats, b: Floats) -> Floats:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def is_blocked(walls: Floats, start: Floats, stop: Floats, margin_m: float = 0.0) -> bool:
    """Whether a wall, longer by a margin at both ends, crosses the open segment from start to stop."""
    along, wall = stop - start, walls[:, 1] - walls[:, 0]
    area, slack = cross(along, wall), margin_m / np.hypot(*wall.T) + 1e-9
    near = max(0.0, -margin_m) / np.hypot(*along) + 1e-9
    with np.errstate(all="ignore"):
        t = cross(walls[:, 0] - start, wall) / area
        u = cross(walls[:, 0] - start, along) / area
    return bool(((t > near) & (t < 1 - near) & (u > -slack) & (u < 1 + slack)).any())


def _clear_m(walls: Floats, number: int, point: Floats) -> float:
    """Distance [m] of a point of one wall from the other walls."""
    others = np.delete(walls, number, axis=0)
    along = others[:, 1] - others[:, 0]
    share = ((point - others[:, 0]) * along).sum(axis=1) / (along**2).sum(axis=1)
    nearest = others[:, 0] + np.clip(share, 0.0, 1.0)[:, None] * along
    return float(np.hypot(*(point - nearest).T).min(initial=np.inf))


def points_of(walls: Floats, chain: Sequence[int], start: Floats, stop: Floats, margin_m: float = 0.0) -> list[Floats]:
    """Points of the path in the plan that reflects off a chain of walls: textbook image method.

    Empty if there is none, or none that passes all ends of walls by a margin.
    """
    images = [start]
    for wall in walls[list(chain)]:
        along = wall[1] - wall[0]
        normal = np.array([-along[1], along[0]]) / np.hypot(*along)
        images.append(images[-1] - 2 * np.dot(images[-1] - wall[0], normal) * normal)
    points = [stop]
    for number, image in zip(reversed(chain), reversed(images[1:]), strict=True):
        wall = walls[number]
        along = wall[1] - wall[0]
        before, after = cross(along, image - wall[0]), cross(along, points[-1] - wall[0])
        if before * after >= 0:
            return []
        point = image + before / (before - after) * (points[-1] - image)
        length = np.hypot(*along)
        if not margin_m <= np.dot(point - wall[0], along) / length <= length - margin_m:
            return []
        if margin_m > 0 and _clear_m(walls, number, point) < margin_m:
            return []
        points.append(point)
    points.append(start)
    return [] if any(is_blocked(walls, a, b, margin_m) for a, b in itertools.pairwise(points)) else points[::-1]


def chains_between(
    walls: Floats, start: Floats, stop: Floats, max_depth: int, margin_m: float = 0.0
) -> set[tuple[int, ...]]:
    """Every chain of walls that joins two points of the plan, of which either may be the end of a wall."""
    return {
        chain
        for length in range(max_depth + 1)
        for chain in itertools.product(range(len(walls)), repeat=length)
        if all(a != b for a, b in itertools.pairwise(chain)) and points_of(walls, chain, start, stop, margin_m)
    }


def specular_lengths_m(
    geometry: SceneGeometry, tx_m: Floats, rx_m: Floats, max_depth: int, margin_m: float = 0.0, shortest_m: float = 0.0
) -> Floats:
    """Sorted lengths [m] of all specular paths to one receiver whose legs are not too short.

    Floor and ceiling count as endless.
    """
    lengths = []
    for chain in chains_between(geometry.walls_m, tx_m[:2], rx_m[:2], max_depth, margin_m):
        points = points_of(geometry.walls_m, chain, tx_m[:2], rx_m[:2], margin_m)
        way = np.cumsum([0.0, *(np.hypot(*(b - a)) for a, b in itertools.pairwise(points))])
        for rise, flats in heights_m(geometry, tx_m[2], rx_m[2], max_depth - len(chain)):
            length = np.hypot(way[-1], rise)
            if np.diff(np.sort([*(way / way[-1]), *flats])).min() * length >= shortest_m:
                lengths.append(length)
    return np.sort(lengths)


def heights_m(geometry: SceneGeometry, low_m: float, high_m: float, bounces: int) -> list[tuple[float, Floats]]:
    """Unfolded differences in height [m] with at most `bounces` off floor and ceiling; fractions (B,) of the path."""
    height_m = geometry.height_m
    heights = [(abs(high_m - low_m), np.zeros(0))]
    planes = [0.0] * (geometry.floor_face >= 0) + [height_m] * (geometry.ceiling_face >= 0)
    for first in planes:
        for count in range(1, min(bounces, 1 if len(planes) == 1 else bounces) + 1):
            last = first if count % 2 else height_m - first
            legs = [abs(low_m - first), *[height_m] * (count - 1), abs(high_m - last)]
            heights.append((sum(legs), np.cumsum(legs)[:-1] / sum(legs)))
    return heights


def drywall() -> Materials:
    """Materials of drywall at 28 GHz."""
    material = Material()
    constants = np.array([material.relative_permittivity, material.conductivity_s_m, material.thickness_m])
    return materials_of([constants], 28e9)


def blocks_of(parts: Iterable[Listed]) -> Blocks:
    """Write all candidates of each part, with the fraction of the work done."""
    return [(part.write(np.arange(len(part.rx))), part.done) for part in parts]


def room_of(geometry: SceneGeometry, tx_m: Floats, rx_m: Floats) -> Room:
    """Room whose faces are all of the one material."""
    return Room.of(geometry, tx_m, rx_m, np.zeros(2 * len(geometry.segments) + 1, np.int64))


def specular_blocks(
    geometry: SceneGeometry, tx_m: Floats, rx_m: Floats, max_depth: int, pairs_at_once: int = 200_000
) -> Blocks:
    """List all specular candidates, and the fraction of the work done with each block."""
    candidates = SpecularCandidates(geometry, room_of(geometry, tx_m, rx_m), max_depth, drywall())
    return blocks_of(candidates.listed(np.zeros(len(rx_m)), pairs_at_once=pairs_at_once))


def diffracted_blocks(geometry: SceneGeometry, wedges: Wedges, tx_m: Floats, rx_m: Floats, max_depth: int) -> Blocks:
    """List all candidates with a diffraction, and the fraction of the work done with each block."""
    candidates = DiffractionCandidates(geometry, wedges, room_of(geometry, tx_m, rx_m), max_depth, drywall())
    return blocks_of(candidates.listed(np.zeros(len(rx_m))))
