"""Candidates: paths that the geometry allows, before Sionna RT has verified them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.tracing.paths import widened

EDGE = -2
"""Stands for the face of an interaction in a candidate where that is a diffraction."""

WALL, SAME_WALL = 1, 2
"""What crossing a face costs: the loss of a wall, or nothing, since it belongs to a wall that has been crossed."""


@dataclass(frozen=True)
class Wedges:
    """W vertical edges, each with the two faces that bound the room around it.

    Around an edge, walls bound sectors. Only a sector wider than a half-plane holds directions that the walls hide from
    each other, so an edge diffracts in one sector at most, and where three or more walls meet mostly in none. A free
    end of a wall has both of its sides as faces. In candidates, wedge W + i is wedge i with its faces swapped.

    `edge_m` (W, 2) are the edges in the plan, which rise from 0 to `height_m` [m]; `face` (2 W, 2) the 0-face and the
    n-face of the scene, where the sector of wedge i < W ends counterclockwise; `normal` (2 W, 2, 2) their unit normals,
    which point into the sector.
    """

    edge_m: Floats
    height_m: float
    face: NDArray[np.int32]
    normal: Floats


@dataclass(frozen=True)
class Candidates:
    """C geometrically possible paths, to be verified.

    `rx` (C,) is the receiver of each. `face` (C, D) is the face of the scene at every interaction in order from the
    transmitter, counted through its shapes; any of the faces in one plane stands for all. It is EDGE where the path is
    diffracted, and -1 where there is no interaction. `vertices_m` (C, D, 3) are the points of interaction [m]. If all
    candidates are diffracted, `wedge` (C,) is the one of `wedges` at which each is. If any candidate goes through
    walls, `crossed` (C, D) is WALL where it does, SAME_WALL at further faces of that wall, which cost nothing, and 0
    elsewhere.
    """

    rx: NDArray[np.int32]
    face: NDArray[np.int32]
    vertices_m: Floats
    wedge: NDArray[np.int32] | None = None
    wedges: Wedges | None = None
    crossed: NDArray[np.uint8] | None = None

    def is_like(self, other: "Candidates") -> bool:
        """Whether both can be verified together."""
        same = self.face.shape[1] == other.face.shape[1] and self.wedges is other.wedges
        return same and (self.crossed is None) == (other.crossed is None)

    @classmethod
    def concatenate(cls, parts: list["Candidates"]) -> "Candidates":
        """Join candidates that can be verified together; at least one part."""
        wedge = None if parts[0].wedge is None else np.concatenate([each.wedge for each in parts])  # type: ignore[misc]
        crossed = None if parts[0].crossed is None else np.concatenate([each.crossed for each in parts])  # type: ignore[misc]
        rx, face, vertices_m = (
            np.concatenate([getattr(each, name) for each in parts]) for name in ("rx", "face", "vertices_m")
        )
        return cls(rx, face, vertices_m, wedge, parts[0].wedges, crossed)

    def widened(self, depth: int) -> "Candidates":
        """Return them with room for `depth` interactions."""
        crossed = None if self.crossed is None else widened(self.crossed, depth, 0)
        face, vertices_m = widened(self.face, depth, -1), widened(self.vertices_m, depth, 0.0)
        return replace(self, face=face, vertices_m=vertices_m, crossed=crossed)

    def rows(self, index: Indices) -> "Candidates":
        """Pick some of the candidates."""
        wedge = None if self.wedges is None or self.wedge is None else self.wedge[index]
        crossed = None if self.crossed is None else self.crossed[index]
        rx, face, vertices_m = self.rx[index], self.face[index], self.vertices_m[index]
        return replace(self, rx=rx, face=face, vertices_m=vertices_m, wedge=wedge, crossed=crossed)
