"""Beams against brute force: every chain of walls, tried one by one with the textbook image method."""

import itertools

import numpy as np
import pytest
from extruded import ROOM, SPLINTERS, points_of
from numpy.typing import NDArray

from sionna_partial.scene.floor_plan import prepare_plan
from sionna_partial.tracing.plan.beams import trace_beams


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
    beams = trace_beams(prepare_plan(walls), tx, rx, 2)
    # One door splits one line into two walls: chains count once for a line, so compare lines.
    line = np.arange(len(walls))
    if len(walls) > 4:
        line[line == 5] = 4
    for index in range(len(rx)):
        truth = {
            tuple(line[list(chain)])
            for length in range(3)
            for chain in itertools.product(range(len(walls)), repeat=length)
            if all(line[a] != line[b] for a, b in itertools.pairwise(chain)) and points_of(walls, chain, tx, rx[index])
        }
        assert {tuple(line[list(chain)]) for chain in _chains(beams, index)} == truth


def test_lists_each_chain_of_lines_once_for_a_receiver_on_the_lattice() -> None:
    tx = np.array([1.0, 2.0])
    rx = np.array([[4.5, 2.0], [3.0, 2.0], [5.0, 2.5]])
    beams = trace_beams(prepare_plan(ROOM), tx, rx, 4)
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
    beams = trace_beams(prepare_plan(np.zeros((0, 2, 2))), np.zeros(2), rx, 6)
    assert sorted(beams.pair_rx) == [0, 1, 2]
    assert (beams.parent[beams.pair_node] == -1).all()


def test_without_receivers_there_are_no_pairs() -> None:
    assert len(trace_beams(prepare_plan(ROOM), np.array([1.0, 1.0]), np.zeros((0, 2)), 3).pair_rx) == 0
