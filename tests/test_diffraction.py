"""Ways over an edge against brute force in the plan, and their geometry in space."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray
from test_beams import ROOM, SPLINTERS, _exists

from sionna_partial.tracing.candidates import CEILING, EDGE, FLOOR, Candidates
from sionna_partial.tracing.diffraction import Wedges, diffraction_candidates

TX = np.array([1.07, 1.93, 1.2])


def _free_ends(walls: NDArray[np.float64]) -> Wedges:
    """Both ends of every wall as screens."""
    segment, end = np.repeat(np.arange(len(walls)), 2), np.tile([0, 1], len(walls))
    along = walls[segment, 1] - walls[segment, 0]
    normal = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
    return Wedges(segment, end, normal, -normal)


def _join(
    walls: NDArray[np.float64], wedges: Wedges, rx: NDArray[np.float64], *, horizontal: bool = False, max_depth: int = 3
) -> Candidates:
    blocks = [
        block
        for block, _ in diffraction_candidates(
            walls, wedges, TX, rx, height_m=2.5, horizontal=horizontal, max_depth=max_depth, candidates_per_block=50
        )
    ]
    fields = Candidates.__dataclass_fields__
    return Candidates(*(np.concatenate([getattr(block, name) for block in blocks]) for name in fields))


def _chains(walls: NDArray[np.float64], start: NDArray[np.float64], stop: NDArray[np.float64]) -> set[tuple[int, ...]]:
    """Textbook wall chains between two points, of which either may be the end of a wall."""
    return {
        chain
        for length in range(3)
        for chain in itertools.product(range(len(walls)), repeat=length)
        if all(a != b for a, b in itertools.pairwise(chain)) and _exists(walls, chain, start, stop)
    }


def test_finds_exactly_the_ways_over_free_ends_that_brute_force_finds() -> None:
    walls = np.concatenate([SPLINTERS[[0, 1, 3]] + 0.013, [[(0.0, 0.2), (6.0, 0.0)]]])
    rng = np.random.default_rng(5)
    rx = np.column_stack([rng.uniform(0.3, 5.7, 12), rng.uniform(0.4, 3.8, 12), np.full(12, 1.5)])
    wedges = _free_ends(walls)
    found = _join(walls, wedges, rx)
    ways = set()
    for receiver, surface, wedge in zip(found.rx, found.surface, found.wedge, strict=True):
        at = int(np.flatnonzero(surface == EDGE)[0])
        after = surface[at + 1 :]
        ways.add((int(receiver), tuple(surface[:at]), wedge % len(wedges.end), tuple(after[after >= 0])))
    truth = set()
    for index, (segment, end) in enumerate(zip(wedges.segment, wedges.end, strict=True)):
        edge = walls[segment, end]
        for receiver, point in enumerate(rx[:, :2]):
            pairs = itertools.product(_chains(walls, TX[:2], edge), _chains(walls, edge, point))
            truth |= {(receiver, before, index, after) for before, after in pairs if len(before) + len(after) <= 2}
    assert len(truth) > 200
    assert ways == truth


def test_paths_keep_their_slope_at_the_edge_and_mirror_elsewhere() -> None:
    rx = np.array([[4.5, 0.7, 2.1], [5.2, 3.1, 0.4]])
    screens = _free_ends(ROOM)
    kept = screens.segment >= 4
    wedges = Wedges(*(getattr(screens, name)[kept] for name in ("segment", "end", "normal_0", "normal_n")))
    found = _join(ROOM, wedges, rx, horizontal=True)
    assert {FLOOR, CEILING} <= set(found.surface.ravel().tolist())
    for index, surface, vertices in zip(found.rx, found.surface, found.vertices_m, strict=True):
        points = np.concatenate([TX[None], vertices[surface != -1], rx[index][None]])
        direction = np.diff(points, axis=0)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        for number, before, after in zip(surface, direction[:-1], direction[1:], strict=False):
            if number == EDGE:
                assert after[2] == pytest.approx(before[2], abs=1e-9)
                continue
            along = ROOM[number, 1] - ROOM[number, 0] if number >= 0 else np.zeros(2)
            normal = np.array([along[1], -along[0], 0.0]) / np.hypot(*along) if number >= 0 else np.array([0, 0, 1.0])
            np.testing.assert_allclose(after, before - 2 * np.dot(before, normal) * normal, atol=1e-9)


@pytest.mark.parametrize("max_depth", [0, 1, 2, 3, 6])
def test_depth_limits_the_reflections(max_depth: int) -> None:
    found = list(
        diffraction_candidates(
            ROOM, _free_ends(ROOM), TX, np.array([[4.5, 0.7, 2.1]]), height_m=2.5, horizontal=True, max_depth=max_depth
        )
    )
    depth = max((int((block.surface != -1).sum(axis=1).max()) for block, _ in found), default=0)
    assert depth == min(max_depth, 3)


def test_a_corner_does_not_diffract_inside() -> None:
    walls = np.array([[(3.0, 2.0), (5.0, 2.0)], [(3.0, 2.0), (3.0, 4.0)]])
    outwards = np.array([[0.0, -1.0]]), np.array([[-1.0, 0.0]])
    corner = Wedges(np.array([0]), np.array([0]), *outwards)
    inside, outside = np.array([[4.0, 3.0, 1.0]]), np.array([[4.0, 1.0, 1.0]])
    assert (
        len(list(diffraction_candidates(walls, corner, TX, inside, height_m=2.5, horizontal=False, max_depth=1))) == 0
    )
    block, share = next(diffraction_candidates(walls, corner, TX, outside, height_m=2.5, horizontal=False, max_depth=1))
    assert share == 1.0
    np.testing.assert_allclose(block.vertices_m[0, 0, :2], [3.0, 2.0])
    # Face 0 is lit: the transmitter is below the horizontal wall.
    assert block.wedge.tolist() == [0]


def test_the_face_that_the_transmitter_lights_comes_first() -> None:
    walls = np.array([[(3.0, 2.0), (5.0, 2.0)], [(3.0, 2.0), (3.0, 4.0)]])
    swapped = Wedges(np.array([0]), np.array([0]), np.array([[0.0, -1.0]]), np.array([[-1.0, 0.0]]))
    above = np.array([1.07, 3.0, 1.2])
    blocks = diffraction_candidates(
        walls, swapped, above, np.array([[4.0, 1.0, 1.0]]), height_m=2.5, horizontal=False, max_depth=1
    )
    assert next(blocks)[0].wedge.tolist() == [1]


def test_without_wedges_there_are_no_candidates() -> None:
    none = Wedges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)))
    assert not list(diffraction_candidates(ROOM, none, TX, TX[None] + 1.0, height_m=2.5, horizontal=True, max_depth=3))


def test_a_way_over_a_junction_of_three_walls_counts_once() -> None:
    walls = np.array([[(2.0, 2.0), (3.0, 2.0)], [(3.0, 2.0), (4.0, 2.0)], [(3.0, 2.0), (3.0, 3.0)]])
    screens = _free_ends(walls)
    junction = Wedges(
        np.array([0, 1, 2]), np.array([1, 0, 0]), screens.normal_0[[0, 2, 4]], screens.normal_n[[0, 2, 4]]
    )
    blocks = diffraction_candidates(
        walls, junction, TX, np.array([[4.0, 1.0, 1.0]]), height_m=2.5, horizontal=False, max_depth=1
    )
    assert [len(block.rx) for block, _ in blocks] == [1]
