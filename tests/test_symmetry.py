"""A building that is turned, mirrored or moved, radios with it, gives the same links."""

from functools import cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.tracing.simulation import clear_of_walls

OFFSETS_M = (0.0, -37.31, 1234.5, 1e7)


def transformed(
    partial: sp.PartialMap, points_m: NDArray[np.float64], which: int, offset_m: float
) -> tuple[sp.PartialMap, NDArray[np.float64]]:
    """Mirror a map in x (1) and y (2), swap its axes (4), and move it; points (N, 3) [m] go with it."""
    state, (x0, y0, x1, y1) = partial.state, partial.bounds_m
    x, y, z = (points_m - [x0, y0, 0.0]).T
    if which & 1:
        state, x = state[:, ::-1], x1 - x0 - x
    if which & 2:
        state, y = state[::-1], y1 - y0 - y
    if which & 4:
        state, x, y = state.T, y, x
    new = sp.PartialMap(state, partial.resolution_m, (offset_m, -offset_m))
    return new, np.column_stack([x + offset_m, y - offset_m, z])


@cache
def links_of(seed: int, stage: int, which: int = 0, offset_m: float = 0.0) -> sp.TracedLinks:
    """Trace a home, complete (stage 0) or after so many steps, from one of its free cells."""
    home = sp.make_home(seed, "apartment")
    partial = home if stage == 0 else sp.explore(home, steps=(stage,), seed=seed)[0]
    rng = np.random.default_rng(seed)
    free = np.argwhere(partial.state == sp.CellState.FREE)[:, ::-1]
    cells_in = free[rng.permutation(len(free))[:150]] + rng.uniform(0.2, 0.8, (150, 2))
    points_m = np.column_stack([cells_in * partial.resolution_m + partial.origin_m, np.full(150, 1.5)])
    points_m = points_m[clear_of_walls(partial, points_m)]
    partial, points_m = transformed(partial, points_m, which, offset_m)
    far = np.linalg.norm(points_m[1:] - points_m[0], axis=1) > 0.1
    return sp.trace_links(partial, points_m[0], points_m[1:][far])


@given(st.sampled_from([60_001, 60_004]), st.sampled_from([0, 80]), st.integers(0, 7), st.sampled_from(OFFSETS_M))
@settings(max_examples=15, deadline=None)
def test_gains_and_states_are_those_of_the_building(seed: int, stage: int, which: int, offset_m: float) -> None:
    here, there = links_of(seed, stage), links_of(seed, stage, which, offset_m)
    assert (here.link_state == there.link_state).mean() > 0.99
    assert (np.abs(here.gain_db - there.gain_db) <= 0.5).mean() >= 0.99
