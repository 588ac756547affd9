"""Edges drawn as small plans, and paths over them against brute force in the plan and their geometry in space."""

import itertools

import numpy as np
import pytest
from extruded import ROOM, SPLINTERS, chains_between, diffracted_blocks, extrude
from numpy.typing import NDArray

from sionna_partial.scene.scene import SceneGeometry
from sionna_partial.tracing.interactions import DIFFRACTION
from sionna_partial.tracing.paths import Candidates
from sionna_partial.tracing.plan.edges import find_wedges

TX = np.array([1.07, 1.93, 1.2])


def _join(geometry: SceneGeometry, rx: NDArray[np.float64]) -> Candidates:
    """Candidates of all blocks."""
    wedges = find_wedges(geometry, open_ends=False)
    parts = [part for part, _ in diffracted_blocks(geometry, wedges, TX, rx, 3)]
    names = ("rx", "kind", "face", "vertices_m", "wedge")
    return Candidates(*(np.concatenate([getattr(part, name) for part in parts]) for name in names), wedges)


def _star(*degrees: float) -> NDArray[np.float64]:
    """Walls of 1 m from the origin, given by their directions."""
    angle = np.radians(degrees)
    return np.stack([np.zeros((len(angle), 2)), np.column_stack([np.cos(angle), np.sin(angle)])], axis=1)


def _sectors(walls: NDArray[np.float64], position: tuple[float, float] = (0.0, 0.0)) -> list[tuple[int, int]]:
    """Walls that bound the sectors in which the edge at one position diffracts, counterclockwise."""
    wedges = find_wedges(extrude(walls), open_ends=False)
    at = np.flatnonzero(np.linalg.norm(wedges.edge_m - position, axis=1) < 1e-9)
    return [tuple((wedges.face[each] // 2).tolist()) for each in at]


class TestFindWedges:
    @pytest.mark.parametrize(
        ("degrees", "sectors"),
        [
            ((0,), [(0, 0)]),
            ((0, 179.99), []),
            ((0, 170), [(1, 0)]),
            ((0, 90, 180), []),
            ((0, 45, 90), [(2, 0)]),
            ((60, 90, 120), [(2, 0)]),
            ((175, 185, 180), [(1, 0)]),
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

    def test_without_wedges_there_are_no_candidates(self) -> None:
        geometry = extrude(ROOM[:4])
        wedges = find_wedges(geometry, open_ends=True)
        assert len(wedges.edge_m) == 4
        inside = TX[None] + [2.0, 0.5, 0.1]
        assert not diffracted_blocks(geometry, wedges, TX, inside, 3)
        empty = extrude(np.zeros((0, 2, 2)))
        assert not diffracted_blocks(empty, find_wedges(empty, open_ends=True), TX, inside, 3)
