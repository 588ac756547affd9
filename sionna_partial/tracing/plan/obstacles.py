"""Obstacles of a floor plan, which do not reach the ceiling: paths cross their walls and tops, or run above them."""

from dataclasses import dataclass, replace

import numpy as np

from sionna_partial.arrays import Floats, Indices
from sionna_partial.process import njit
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import REFRACTION
from sionna_partial.tracing.line import group_faces
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.plan.room import Building

_MAX_LIDS = 8
"""Largest number of tops of obstacles that a path may cross."""


@dataclass(frozen=True)
class Lowered:
    """Function that lowers walls on candidates, which all reach the ceiling, to obstacles.

    `walls_m` (S, 2, 2) are the walls, `corners_m` (T, 3, 2) the triangles of the tops of obstacles, `lid_m` (T,) their
    heights and `lid_face` (T,) a face of each in the scene.
    """

    building: Building
    walls_m: Floats
    corners_m: Floats
    lid_m: Floats
    lid_face: Indices
    max_walls: int

    @classmethod
    def of(cls, geometry: SceneGeometry, building: Building, max_walls: int) -> "Lowered":
        lids, count = geometry.lids, [len(lid.triangles) for lid in geometry.lids]
        corners_m = np.concatenate([np.zeros((0, 3, 2)), *(lid.corners_m[lid.triangles] for lid in lids)])
        lid_m = np.repeat(np.array([lid.top_m for lid in lids], float), count)
        return cls(
            building,
            geometry.walls_m,
            corners_m,
            lid_m,
            np.repeat(np.array(geometry.lid_faces, np.intp), count),
            max_walls,
        )

    def __call__(self, candidates: Candidates) -> Candidates:
        """Remove walls below paths, and candidates that then cross nothing; add the tops of obstacles."""
        room, interior = self.building.room, self.building.interior
        if (room.top_m >= room.height_m).all() or not len(candidates.rx):
            return candidates
        wide = candidates.widened(candidates.kind.shape[1] + _MAX_LIDS)
        kind, face, vertices_m = wide.kind.copy(), wide.face.copy(), wide.vertices_m.copy()
        same = np.zeros(kind.shape, dtype=bool)
        lids = self.corners_m, self.lid_m, self.lid_face
        ends_m = room.tx_m, room.rx_m[candidates.rx]
        walls = _lower(kind, face, vertices_m, same, (self.walls_m, room.top_m), lids, ends_m, interior)
        lowered = replace(wide, kind=kind, face=face, vertices_m=vertices_m, same_wall=same)
        return lowered.rows(np.flatnonzero((walls > 0) & (walls <= self.max_walls)))


@njit(cache=True)
def _lower(kind, face, vertices, same, walls, lids, ends, interior):
    """Write the walls that candidates cross at their heights, in place; return numbers (C,), -1 if too many."""
    (tx_m, targets), (walls_m, top_m) = ends, walls
    crossings, most = np.zeros(len(kind), np.int64), kind.shape[1]
    old_kind, old_face, old = np.empty(most, np.uint8), np.empty(most, np.int32), np.empty((most, 3))
    for c in range(len(kind)):
        old_kind[:], old_face[:], old[:] = kind[c], face[c], vertices[c]
        kind[c], face[c], vertices[c] = 0, -1, 0.0
        here, start, begin, count, d = tx_m, tx_m, np.int64(0), 0, 0
        while count >= 0:
            there = old[d] if old_kind[d] > 0 else targets[c]
            count = _add_lids(here, there, lids, kind[c], face[c], vertices[c], count)
            crossed = old_kind[d] == REFRACTION
            if count < 0 or count >= most - 1:
                crossings[c] = -1
                break
            if not crossed:
                crossings[c] += _group(face[c], vertices[c], same[c], (begin, count), (start, there), walls_m, interior)
            if old_kind[d] == 0:
                break
            if not crossed or there[2] <= top_m[old_face[d] // 2]:
                kind[c, count], face[c, count], vertices[c, count] = old_kind[d], old_face[d], there
                count += 1
            if not crossed:
                start, begin = there, count
            here, d = there.copy(), d + 1
    return crossings


@njit(cache=True, borrows=True)
def _add_lids(here, there, lids, kind, face, vertices, count):
    """Add the tops that a segment crosses to `count` entries, in order; return their number, -1 if too many."""
    corners, heights, faces = lids
    first = count
    for i in range(len(heights)):
        if (here[2] - heights[i]) * (there[2] - heights[i]) >= 0.0:
            continue
        t = (heights[i] - here[2]) / (there[2] - here[2])
        x, y = here[0] + t * (there[0] - here[0]), here[1] + t * (there[1] - here[1])
        inside = True
        for k in range(3):
            a, b = corners[i, k], corners[i, (k + 1) % 3]
            inside &= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) >= -1e-9
        if not inside or (count > first and face[count - 1] == faces[i]):
            continue
        if count >= len(kind) - 1:
            return -1
        at = count
        while at > first and abs(vertices[at - 1, 2] - here[2]) > abs(heights[i] - here[2]):
            kind[at], face[at] = kind[at - 1], face[at - 1]
            for axis in range(3):
                vertices[at, axis] = vertices[at - 1, axis]
            at -= 1
        kind[at], face[at] = REFRACTION, faces[i]
        vertices[at, 0], vertices[at, 1], vertices[at, 2] = x, y, heights[i]
        count += 1
    return count


@njit(cache=True)
def _group(face, vertices, same, span, ends, walls_m, interior):
    (begin, end), (here, there) = span, ends
    dx, dy = there[0] - here[0], there[1] - here[1]
    length, cosine, found = max(np.hypot(dx, dy), 1e-9), np.ones(end - begin), np.empty(end - begin)
    for j in range(end - begin):
        vertex = vertices[begin + j]
        found[j] = np.hypot(vertex[0] - here[0], vertex[1] - here[1]) / length
        if face[begin + j] < 2 * len(walls_m):
            wall = walls_m[face[begin + j] // 2]
            wx, wy = wall[1, 0] - wall[0, 0], wall[1, 1] - wall[0, 1]
            cosine[j] = abs(wx * dy - wy * dx) / (length * np.hypot(wx, wy))
    line, order = (here, there, np.hypot(dx, dy)), (dx < 0.0 or (dx == 0.0 and dy < 0.0), False)
    return group_faces(interior, line, found, cosine, same[begin:end], order)
