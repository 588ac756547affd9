"""Candidates: paths that the geometry allows, before Sionna RT has verified them."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.tracing.paths import widened


@dataclass(frozen=True)
class Wedges:
    """W vertical edges, each with the two faces that bound the room around it.

    Around an edge, walls bound sectors. Only a sector wider than a half-plane holds directions that the walls hide from
    each other, so an edge diffracts in one sector at most, and where three or more walls meet mostly in none. A free
    end of a wall has both of its sides as faces. In candidates, wedge W + i is wedge i with its faces swapped.

    `edge_m` (W, 2) are the edges in the plan, which rise from 0 to `height_m` (W,) [m]; `face` (2 W, 2) the 0-face and
    the n-face of the scene, where the sector of wedge i < W ends counterclockwise; `normal` (2 W, 2, 2) their unit
    normals, which point into the sector.
    """

    edge_m: Floats
    height_m: Floats
    face: NDArray[np.int32]
    normal: Floats


@dataclass(frozen=True)
class Candidates:
    """C geometrically possible paths, to be verified.

    `rx` (C,) is the receiver of each. `kind` (C, D) is Sionna RT's `InteractionType` of every interaction in order from
    the transmitter, 0 where there is none. `face` (C, D) is the face of the scene there, counted through its shapes:
    any of the faces in one plane stands for all, the 0-face for an edge, and -1 for none. `vertices_m` (C, D, 3) are
    the points of interaction [m]. If all candidates are diffracted, `wedge` (C,) is the one of `wedges` where each is.
    If any candidate goes through walls, `same_wall` (C, D) is True for refractions at further faces of a wall that
    has been crossed: they cost nothing.
    """

    rx: NDArray[np.int32]
    kind: NDArray[np.uint8]
    face: NDArray[np.int32]
    vertices_m: Floats
    wedge: NDArray[np.int32] | None = None
    wedges: Wedges | None = None
    same_wall: Bools | None = None

    def is_like(self, other: "Candidates") -> bool:
        """Whether both can be verified together."""
        same = self.face.shape[1] == other.face.shape[1] and self.wedges is other.wedges
        return same and (self.same_wall is None) == (other.same_wall is None)

    @classmethod
    def concatenate(cls, parts: list["Candidates"]) -> "Candidates":
        """Join candidates that can be verified together; at least one part."""
        wedge = None if parts[0].wedge is None else np.concatenate([each.wedge for each in parts])  # type: ignore[misc]
        same = None if parts[0].same_wall is None else np.concatenate([each.same_wall for each in parts])  # type: ignore[misc]
        rx, kind, face, vertices_m = (
            np.concatenate([getattr(each, name) for each in parts]) for name in ("rx", "kind", "face", "vertices_m")
        )
        return cls(rx, kind, face, vertices_m, wedge, parts[0].wedges, same)

    def widened(self, depth: int) -> "Candidates":
        """Return them with room for `depth` interactions."""
        same_wall = None if self.same_wall is None else widened(self.same_wall, depth, 0)
        kind, face = widened(self.kind, depth, 0), widened(self.face, depth, -1)
        vertices_m = widened(self.vertices_m, depth, 0.0)
        return replace(self, kind=kind, face=face, vertices_m=vertices_m, same_wall=same_wall)

    def rows(self, index: Indices) -> "Candidates":
        """Pick some of the candidates."""
        wedge = None if self.wedges is None or self.wedge is None else self.wedge[index]
        same_wall = None if self.same_wall is None else self.same_wall[index]
        columns = {name: getattr(self, name)[index] for name in ("rx", "kind", "face", "vertices_m")}
        return replace(self, **columns, wedge=wedge, same_wall=same_wall)
