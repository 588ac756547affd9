"""Paths through walls where obstacles end below the ceiling: paths cross obstacles, or run above them."""

from dataclasses import dataclass, replace

import numpy as np

from sionna_partial.arrays import Floats, Indices
from sionna_partial.process import njit
from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import REFRACTION
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.plan.specular import Room
from sionna_partial.tracing.walls import Interior, group_faces

_MOST_LIDS = 8
"""Most tops of obstacles that a path may cross."""


@dataclass(frozen=True)
class Lowered:
    """Candidates of plans whose walls all reach the ceiling -> those that cross obstacles where these are.

    `top_m` (S,) are the heights of walls. Of the tops of obstacles, `corners_m` (T, 3, 2) are triangles, `lid_m` (T,)
    their heights and `lid_face` (T,) a face of each in the scene.
    """

    top_m: Floats
    corners_m: Floats
    lid_m: Floats
    lid_face: Indices
    room: Room
    interior: Interior
    max_walls: int

    @classmethod
    def of(cls, geometry: SceneGeometry, room: Room, interior: Interior, max_walls: int) -> "Lowered":
        """Take it from a scene."""
        lids, count = geometry.lids, [len(each.triangles) for each in geometry.lids]
        corners_m = np.concatenate([np.zeros((0, 3, 2)), *(each.corners_m[each.triangles] for each in lids)])
        lid_m, lid_face = (
            np.repeat(np.array(values, kind), count)
            for values, kind in (([each.top_m for each in lids], float), (geometry.lid_faces, np.intp))
        )
        return cls(geometry.top_m, corners_m, lid_m, lid_face, room, interior, max_walls)

    def __call__(self, candidates: Candidates) -> Candidates:
        """Leave out what paths are above, and candidates that go through nothing then; add the tops of obstacles."""
        if (self.top_m >= self.room.height_m).all() or candidates.same_wall is None or not len(candidates.rx):
            return candidates
        wide = candidates.widened(candidates.kind.shape[1] + _MOST_LIDS)
        kind, face, vertices_m = wide.kind.copy(), wide.face.copy(), wide.vertices_m.copy()
        same = np.zeros(kind.shape, dtype=bool)
        lids = self.corners_m, self.lid_m, self.lid_face
        ends_m = self.room.tx_m, self.room.rx_m[candidates.rx]
        walls = _lower(kind, face, vertices_m, same, (self.room.walls_m, self.top_m), lids, ends_m, self.interior)
        lowered = replace(wide, kind=kind, face=face, vertices_m=vertices_m, same_wall=same)
        return lowered.rows(np.flatnonzero((walls > 0) & (walls <= self.max_walls)))


@njit(cache=True)
def _lower(kind, face, vertices, same, walls, lids, ends, interior):  # type: ignore[no-untyped-def]
    """Write the walls that candidates cross at their heights, in place; return the numbers (C,), -1 if too many."""
    (tx_m, targets), (walls_m, top_m) = ends, walls
    crossings, most = np.zeros(len(kind), np.int64), kind.shape[1]
    old_kind, old_face, old = np.empty(most, np.uint8), np.empty(most, np.int32), np.empty((most, 3))
    for c in range(len(kind)):
        old_kind[:], old_face[:], old[:] = kind[c], face[c], vertices[c]
        kind[c], face[c], vertices[c] = 0, -1, 0.0
        here, start, begin, count, d = tx_m, tx_m, 0, 0, 0
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


@njit(cache=True)
def _add_lids(here, there, lids, kind, face, vertices, count):  # type: ignore[no-untyped-def]
    """Add the tops that a segment crosses to `count` entries, in order; the number now, -1 if there is no room."""
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
            kind[at], face[at], vertices[at] = kind[at - 1], face[at - 1], vertices[at - 1]
            at -= 1
        kind[at], face[at] = REFRACTION, faces[i]
        vertices[at, 0], vertices[at, 1], vertices[at, 2] = x, y, heights[i]
        count += 1
    return count


@njit(cache=True)
def _group(face, vertices, same, span, ends, walls_m, interior):  # type: ignore[no-untyped-def]
    """Write which of the faces that a leg crosses are further faces of a wall; return the number of walls."""
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
    return group_faces(interior, here, there, found, cosine, same[begin:end])
