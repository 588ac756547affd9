"""A graph of wall edges -> chains that run straight through junctions."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sionna_partial.planar import cross

_LOOK_EDGES = 6
_THROUGH_COSINE = -0.85


@dataclass(frozen=True)
class WallGraph:
    """Edges between lattice points.

    Parameters
    ----------
    points : (V, 2) int64 array
        x, y in half cells; odd numbers are cell centres.
    edges : (E, 2) int64 array
        Indices into `points`.
    """

    points: NDArray[np.int64]
    edges: NDArray[np.int64]

    @property
    def degree(self) -> NDArray[np.intp]:
        """Number of edges (V,) at every point."""
        return np.bincount(self.edges.ravel(), minlength=len(self.points))

    def neighbours(self) -> list[list[int]]:
        """Points at the other ends of every point's edges."""
        beside: list[list[int]] = [[] for _ in range(len(self.points))]
        for a, b in self.edges.tolist():
            beside[a].append(b)
            beside[b].append(a)
        return beside


@dataclass(frozen=True)
class Chain:
    """A walk along edges that uses none twice.

    Parameters
    ----------
    points : list of int
        Indices into the graph's points. A loop begins and ends at the same one.
    closed : bool
        Whether it is a loop.
    """

    points: list[int]
    closed: bool


def wall_chains(graph: WallGraph) -> list[Chain]:
    """Split a graph into chains.

    A chain passes points of two edges, and junctions where another edge leads on in about the same direction; it
    ends elsewhere. Loops begin at the point farthest from their centre.

    Parameters
    ----------
    graph : WallGraph

    Returns
    -------
    list of Chain
        Every edge is in exactly one.
    """
    beside = graph.neighbours()
    onward = _onward(graph, beside)
    chains: list[Chain] = []
    used: set[tuple[int, int]] = set()
    starts = [(a, b) for a, near in enumerate(beside) if len(near) != 2 for b in near if onward.get((b, a)) is None]
    rest = [(a, b) for a, b in graph.edges.tolist()]
    for a, b in starts + rest:
        if (a, b) not in used:
            points = _walk(a, b, beside, onward)
            used.update(pairwise(points))
            used.update(pairwise(points[::-1]))
            closed = points[0] == points[-1]
            chains.append(Chain(_rotate(graph, points) if closed else points, closed))
    return chains


def step_back(start: int, first: int, beside: list[list[int]], count: int) -> list[int]:
    """Follow points of two edges from `start` through `first`, at most `count` edges."""
    points = [start, first]
    while len(points) <= count and len(beside[points[-1]]) == 2:
        a, b = beside[points[-1]]
        points.append(b if a == points[-2] else a)
    return points


def _onward(graph: WallGraph, beside: list[list[int]]) -> dict[tuple[int, int], int]:
    """Where a walk goes on at a junction: (from, junction) -> next point."""
    onward: dict[tuple[int, int], int] = {}
    for junction in np.nonzero(graph.degree > 2)[0].tolist():
        arms = beside[junction]
        tips = np.array([step_back(junction, arm, beside, _LOOK_EDGES)[-1] for arm in arms])
        vectors = (graph.points[tips] - graph.points[junction]).astype(float)
        vectors /= np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1.0)
        cosine = vectors @ vectors.T
        for flat in np.argsort(cosine, axis=None, kind="stable").tolist():
            a, b = divmod(flat, len(arms))
            if cosine[a, b] > _THROUGH_COSINE:
                break
            if a < b and (arms[a], junction) not in onward and (arms[b], junction) not in onward:
                onward[arms[a], junction] = arms[b]
                onward[arms[b], junction] = arms[a]
    return onward


def _walk(a: int, b: int, beside: list[list[int]], onward: dict[tuple[int, int], int]) -> list[int]:
    points = [a, b]
    first = (a, b)
    while True:
        near = beside[points[-1]]
        if len(near) == 2:
            following: int | None = near[1] if near[0] == points[-2] else near[0]
        else:
            following = onward.get((points[-2], points[-1]))
        if following is None or (points[-1], following) == first:
            return points
        points.append(following)


def _rotate(graph: WallGraph, points: list[int]) -> list[int]:
    """Begin a loop at its point farthest from the centre."""
    places = graph.points[points[:-1]]
    start = int(np.argmax(((places - places.mean(axis=0)) ** 2).sum(axis=1)))
    return points[start:-1] + points[: start + 1]


def turns(points: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Whether a polyline (n, 2) turns at each of its inner points (n - 2,)."""
    step = np.diff(points.astype(np.float64), axis=0)
    return cross(step[1:], step[:-1]) != 0.0
