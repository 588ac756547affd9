"""Compile and cache the functions of numba that most tests need: two processes of tests would compile each twice."""

import numpy as np

import sionna_partial as sp

TX_M, RX_M = (2.0, 1.5, 1.5), [(5.0, 3.0, 1.5)]


def main() -> None:
    state = np.zeros((40, 70), dtype=np.uint8)
    state[[0, -1]] = state[:, [0, -1]] = state[:25, 35] = sp.CellState.WALL
    room = sp.map_from_array(state, resolution_m=0.1)
    explored = sp.explore(room, steps=(3,), seed=0)[0]
    for frequency_hz in (28e9, 5e9):
        sp.trace_links(room, TX_M, RX_M, trace_settings=sp.TraceSettings(frequency_hz=frequency_hz))
    sp.link_features(explored, sp.trace_links(explored, TX_M, RX_M))


if __name__ == "__main__":
    main()
