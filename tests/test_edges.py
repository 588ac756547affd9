"""Edges drawn as small plans, and paths over them against brute force in the plan and their geometry in space."""

import itertools

import numpy as np
import pytest
from extruded import ROOM, SPLINTERS, chains_between, diffracted_blocks, extrude
from numpy.typing import NDArray

from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import DIFFRACTION
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.plan.edges import MAX_REFLECTIONS, find_wedges

TX = np.array([1.07, 1.93, 1.2])
CORNER = np.array([[(3.0, 2.0), (5.0, 2.0)], [(3.0, 2.0), (3.0, 4.0)]])
"""An L: the sector inside, of 90 degrees, is up and to the right of (3, 2)."""


def _join(
    geometry: SceneGeometry,
    rx: NDArray[np.float64],
    tx: NDArray[np.float64] = TX,
    max_depth: int = 3,
    walls_a_side: int = MAX_REFLECTIONS,
) -> Candidates:
    """Candidates of all blocks."""
    wedges = find_wedges(geometry, open_ends=False)
    blocks = diffracted_blocks(geometry, wedges, tx, rx, max_depth, walls_a_side)
    parts = [part for part, _ in blocks]
    names = ("rx", "kind", "face", "vertices_m", "wedge")
    return Candidates(*(np.concatenate([getattr(part, name) for part in parts]) for name in names), wedges)


def _star(*degrees: float) -> NDArray[np.float64]:
    """Walls of 1 m from the origin, given by their directions."""
    angle = np.radians(degrees)
    return np.stack([np.zeros((len(angle), 2)), np.column_stack([np.cos(angle), np.sin(angle)])], axis=1)


def _ways(found: Candidates, floor_face: int) -> list[tuple[tuple[float, ...], int, int]]:
    """All numbers of each candidate, and how many walls mirror it before and after its edge; sorted."""
    ways = []
    columns = found.rx, found.kind, found.face, found.vertices_m, found.wedge
    for rx, kind, face, vertices, wedge in zip(*columns, strict=True):
        at, used = int(np.flatnonzero(kind == DIFFRACTION)[0]), kind != 0
        wall = used & (kind != DIFFRACTION) & (face < floor_face)
        row = (float(rx), float(wedge), *face[used].tolist(), *vertices[used].ravel().tolist())
        ways.append((row, int(wall[:at].sum()), int(wall[at + 1 :].sum())))
    return sorted(ways)


def _sectors(walls: NDArray[np.float64], position: tuple[float, float] = (0.0, 0.0)) -> list[tuple[int, int]]:
    """Walls that bound the sectors in which the edge at one position diffracts, counterclockwise."""
    wedges = find_wedges(extrude(walls), open_ends=False)
    at = np.flatnonzero(np.linalg.norm(wedges.edge_m - position, axis=1) < 1e-9)
    return [tuple((wedges.face[each] // 2).tolist()) for each in at]


class TestFindWedges:
    def test_both_sides_of_a_free_end_are_faces(self) -> None:
        wedges = find_wedges(extrude([[(1.0, 1.0), (2.0, 1.0)]], height_m=2.7), open_ends=False)
        assert wedges.edge_m.tolist() == [[1.0, 1.0], [2.0, 1.0]]
        assert wedges.height_m.tolist() == [2.7, 2.7]
        # The second triangle of a wall has the vertical edge at its first end, the first that at its second end.
        assert wedges.face.tolist() == [[1, 1], [0, 0]] * 2
        up = [0.0, 1.0]
        np.testing.assert_allclose(wedges.normal[:, 0], [up, np.negative(up), np.negative(up), up], atol=1e-12)
        np.testing.assert_allclose(wedges.normal[:, 1], -wedges.normal[:, 0], atol=1e-12)

    def test_a_corner_diffracts_outside(self) -> None:
        wedges = find_wedges(extrude(CORNER), open_ends=False)
        at = int(np.flatnonzero((wedges.edge_m == [3.0, 2.0]).all(axis=1))[0])
        # Counterclockwise from the upright wall, over left and below, to the level wall.
        assert (wedges.face[at] // 2).tolist() == [1, 0]
        np.testing.assert_allclose(wedges.normal[at], [[-1.0, 0.0], [0.0, -1.0]], atol=1e-12)
        swapped = at + len(wedges.edge_m)
        assert wedges.face[swapped].tolist() == wedges.face[at, ::-1].tolist()
        np.testing.assert_array_equal(wedges.normal[swapped], wedges.normal[at, ::-1])

    @pytest.mark.parametrize(
        ("degrees", "sectors"),
        [
            ((0,), [(0, 0)]),
            ((0, 90), [(1, 0)]),
            ((0, 180), []),
            ((0, 179.99), []),
            ((0, 170), [(1, 0)]),
            ((0, 90, 180), []),
            ((0, 90, 180, 270), []),
            ((0, 45, 90), [(2, 0)]),
            ((60, 90, 120), [(2, 0)]),
            ((175, 185, 180), [(1, 0)]),
            ((0, 90, 175), [(2, 0)]),
        ],
    )
    def test_sectors_wider_than_a_half_plane(self, degrees: tuple[float, ...], sectors: list[tuple[int, int]]) -> None:
        assert _sectors(_star(*degrees)) == sectors


class TestDiffractionCandidates:
    def test_finds_exactly_the_ways_over_free_ends_that_brute_force_finds(self) -> None:
        walls = np.concatenate([SPLINTERS[[0, 1, 3]] + 0.013, [[(0.0, 0.2), (6.0, 0.0)]]])
        geometry = extrude(walls, floor_m=())
        rng = np.random.default_rng(5)
        rx = np.column_stack([rng.uniform(0.3, 5.7, 12), rng.uniform(0.4, 3.8, 12), np.full(12, 1.5)])
        found = _join(geometry, rx)
        edges = found.wedges.edge_m
        ways = set()
        for receiver, kind, face, wedge in zip(found.rx, found.kind, found.face, found.wedge, strict=True):
            at = int(np.flatnonzero(kind == DIFFRACTION)[0])
            before, after = face[:at] // 2, face[at + 1 :]
            ways.add((int(receiver), tuple(before), int(wedge % len(edges)), tuple(after[after >= 0] // 2)))
        truth = set()
        for index, edge in enumerate(edges):
            for receiver, point in enumerate(rx[:, :2]):
                onward = chains_between(walls, edge, point, 2)
                pairs = itertools.product(chains_between(walls, TX[:2], edge, 2), onward)
                truth |= {(receiver, before, index, after) for before, after in pairs if len(before) + len(after) <= 2}
        assert len(edges) == 8
        assert len(truth) > 200
        assert ways == truth
        assert len(found.rx) == len(truth)

    @pytest.mark.parametrize("walls_a_side", [0, 1, 2])
    def test_walls_on_each_side_are_limited_and_nothing_else_is(self, walls_a_side: int) -> None:
        geometry, rx = extrude(ROOM), np.array([[4.5, 0.7, 2.1], [5.2, 3.1, 0.4]])
        limited = _ways(_join(geometry, rx, walls_a_side=walls_a_side), geometry.floor_face)
        every = _ways(_join(geometry, rx), geometry.floor_face)
        assert {before for _, before, _ in every} == {after for _, _, after in every} == {0, 1, 2}
        assert limited == [way for way in every if max(way[1:]) <= walls_a_side]
        assert max(max(way[1:]) for way in limited) == walls_a_side

    @pytest.mark.parametrize(
        ("tx", "wall"),
        [((4.0, 1.0, 1.2), 0), ((1.07, 3.0, 1.2), 1), ((1.07, 1.93, 1.2), 1)],
        ids=["below lights the level wall", "left lights the upright wall", "both are lit"],
    )
    def test_the_face_that_the_transmitter_lights_comes_first(self, tx: tuple[float, ...], wall: int) -> None:
        geometry, position = extrude(CORNER), np.array(tx)
        found = _join(geometry, np.array([[2.5, 0.5, 1.0]]), position, 1)
        row = int(np.flatnonzero((found.vertices_m[:, 0, :2] == [3.0, 2.0]).all(axis=1))[0])
        normal = found.wedges.normal[found.wedge[row]]
        assert normal[0] @ (position[:2] - [3.0, 2.0]) > 0
        assert found.wedges.face[found.wedge[row], 0] // 2 == wall

    def test_without_wedges_there_are_no_candidates(self) -> None:
        geometry = extrude(ROOM[:4])
        wedges = find_wedges(geometry, open_ends=True)
        assert len(wedges.edge_m) == 4
        inside = TX[None] + [2.0, 0.5, 0.1]
        assert not diffracted_blocks(geometry, wedges, TX, inside, 3)
        empty = extrude(np.zeros((0, 2, 2)))
        assert not diffracted_blocks(empty, find_wedges(empty, open_ends=True), TX, inside, 3)
