"""Beams against brute force: every chain of walls, tried one by one with the textbook image method."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from sionna_partial.tracing.beams import trace_beams
from sionna_partial.tracing.candidates import CEILING, FLOOR, specular_candidates

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


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _blocked(walls: NDArray[np.float64], start: NDArray[np.float64], stop: NDArray[np.float64]) -> bool:
    """Whether a wall crosses the open segment from start to stop."""
    along, wall = stop - start, walls[:, 1] - walls[:, 0]
    area = _cross(along, wall)
    with np.errstate(all="ignore"):
        t = _cross(walls[:, 0] - start, wall) / area
        u = _cross(walls[:, 0] - start, along) / area
    return bool(((t > 1e-9) & (t < 1 - 1e-9) & (u > -1e-9) & (u < 1 + 1e-9)).any())


def _exists(
    walls: NDArray[np.float64], chain: tuple[int, ...], tx: NDArray[np.float64], rx: NDArray[np.float64]
) -> bool:
    """Textbook image method in the plan."""
    images = [tx]
    for wall in walls[list(chain)]:
        along = wall[1] - wall[0]
        normal = np.array([-along[1], along[0]]) / np.hypot(*along)
        images.append(images[-1] - 2 * np.dot(images[-1] - wall[0], normal) * normal)
    points = [rx]
    for number, image in zip(reversed(chain), reversed(images[1:]), strict=True):
        wall = walls[number]
        along = wall[1] - wall[0]
        before, after = _cross(along, image - wall[0]), _cross(along, points[-1] - wall[0])
        if before * after >= 0:
            return False
        point = image + before / (before - after) * (points[-1] - image)
        if not 0 <= np.dot(point - wall[0], along) <= np.dot(along, along):
            return False
        points.append(point)
    points.append(tx)
    return not any(_blocked(walls, a, b) for a, b in itertools.pairwise(points))


def _chains(beams, rx: int) -> set[tuple[int, ...]]:
    """Wall chains that the beams give for one receiver."""
    found = set()
    for node in beams.pair_node[beams.pair_rx == rx]:
        chain: list[int] = []
        while beams.parent[node] >= 0:
            chain.insert(0, int(beams.segment[node]))
            node = beams.parent[node]
        found.add(tuple(chain))
    return found


@pytest.mark.parametrize("walls", [ROOM, np.concatenate([ROOM, SPLINTERS]), SPLINTERS], ids=["room", "all", "open"])
def test_finds_exactly_the_chains_that_brute_force_finds(walls: NDArray[np.float64]) -> None:
    rng = np.random.default_rng(3)
    tx = np.array([1.07, 1.93])
    rx = np.column_stack([rng.uniform(0.1, 5.9, 25), rng.uniform(0.1, 3.9, 25)])
    beams = trace_beams(walls, tx, rx, 2)
    # One door splits one line into two walls: chains count once for a line, so compare lines.
    line = np.arange(len(walls))
    if len(walls) > 4:
        line[line == 5] = 4
    for index in range(len(rx)):
        truth = {
            tuple(line[list(chain)])
            for length in range(3)
            for chain in itertools.product(range(len(walls)), repeat=length)
            if all(line[a] != line[b] for a, b in itertools.pairwise(chain)) and _exists(walls, chain, tx, rx[index])
        }
        assert {tuple(line[list(chain)]) for chain in _chains(beams, index)} == truth


def test_lists_each_chain_of_lines_once_for_a_receiver_on_the_lattice() -> None:
    tx = np.array([1.0, 2.0])
    rx = np.array([[4.5, 2.0], [3.0, 2.0], [5.0, 2.5]])
    beams = trace_beams(ROOM, tx, rx, 4)
    pairs = [
        (_chain_lines(beams, node), rx_index) for node, rx_index in zip(beams.pair_node, beams.pair_rx, strict=True)
    ]
    assert len(pairs) == len(set(pairs))


def _chain_lines(beams, node: int) -> tuple[int, ...]:
    chain: list[int] = []
    while beams.parent[node] >= 0:
        chain.insert(0, min(int(beams.segment[node]), 4))
        node = beams.parent[node]
    return tuple(chain)


def test_without_walls_every_receiver_is_reached_directly() -> None:
    rx = np.array([[5.0, 5.0], [-3.0, 2.0], [0.0, -7.0]])
    beams = trace_beams(np.zeros((0, 2, 2)), np.zeros(2), rx, 6)
    assert sorted(beams.pair_rx) == [0, 1, 2]
    assert (beams.parent[beams.pair_node] == -1).all()


def test_without_receivers_there_are_no_pairs() -> None:
    assert len(trace_beams(ROOM, np.array([1.0, 1.0]), np.zeros((0, 2)), 3).pair_rx) == 0


def test_floor_and_ceiling_reflections_have_the_unfolded_lengths() -> None:
    tx, rx, height = np.array([0.0, 0.0, 1.0]), np.array([[4.0, 0.0, 2.0]]), 3.0
    walls = np.array([[(-5.0, 2.0), (9.0, 2.0)]])
    beams = trace_beams(walls, tx[:2], rx[:, :2], 3)
    blocks = specular_candidates(beams, walls, tx, rx, height_m=height, horizontal=True, max_depth=3)
    candidates, share = next(blocks)
    assert share == 1.0
    lengths = {}
    for surface, vertices in zip(candidates.surface, candidates.vertices_m, strict=True):
        points = np.concatenate([tx[None], vertices[surface != -1], rx])
        key = tuple("w" if s >= 0 else {FLOOR: "f", CEILING: "c"}[s] for s in surface if s != -1)
        lengths[key] = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    climb = {"f": tx[2] + rx[0, 2], "c": 2 * height - 3.0, "fc": 2 * height - 1.0, "cf": 2 * height + 1.0, "": 1.0}
    climb |= {"fcf": 2 * height + 3.0, "cfc": 4 * height - 3.0}
    for reflections in climb:
        assert lengths[tuple(reflections)] == pytest.approx(np.hypot(4.0, climb[reflections]))
    walled = {key: length for key, length in lengths.items() if "w" in key}
    assert len(walled) == 1 + 2 + 2
    for key, length in walled.items():
        reflections = "".join(key).replace("w", "")
        assert length == pytest.approx(np.hypot(np.hypot(4.0, 4.0), climb[reflections]))


def test_candidate_reflections_obey_the_law_of_reflection() -> None:
    tx, rx = np.array([1.1, 0.7, 1.2]), np.array([[2.3, 3.1, 2.1], [4.7, 1.2, 0.4]])
    beams = trace_beams(ROOM, tx[:2], rx[:, :2], 4)
    candidates, _ = next(specular_candidates(beams, ROOM, tx, rx, height_m=2.5, horizontal=True, max_depth=4))
    assert len(candidates.rx) > 100
    for index, surface, vertices in zip(candidates.rx, candidates.surface, candidates.vertices_m, strict=True):
        points = np.concatenate([tx[None], vertices[surface != -1], rx[index][None]])
        direction = np.diff(points, axis=0)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        for number, before, after in zip(surface, direction[:-1], direction[1:], strict=False):
            along = ROOM[number, 1] - ROOM[number, 0] if number >= 0 else np.zeros(2)
            normal = np.array([along[1], -along[0], 0.0]) / np.hypot(*along) if number >= 0 else np.array([0, 0, 1.0])
            np.testing.assert_allclose(after, before - 2 * np.dot(before, normal) * normal, atol=1e-9)


def test_blocks_together_hold_what_one_block_holds() -> None:
    tx, rx = np.array([1.1, 0.7, 1.2]), np.array([[2.3, 3.1, 2.1], [4.7, 1.2, 0.4]])
    beams = trace_beams(ROOM, tx[:2], rx[:, :2], 3)
    common = {"height_m": 2.5, "horizontal": True, "max_depth": 3}
    whole = next(specular_candidates(beams, ROOM, tx, rx, **common))[0]
    parts = [part for part, _ in specular_candidates(beams, ROOM, tx, rx, pairs_per_block=3, **common)]
    assert len(parts) > 3
    np.testing.assert_array_equal(np.concatenate([part.surface for part in parts]), whole.surface)
    np.testing.assert_array_equal(np.concatenate([part.vertices_m for part in parts]), whole.vertices_m)
