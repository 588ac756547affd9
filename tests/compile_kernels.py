"""Compile and cache the functions of numba that most tests need: two processes of tests would compile each twice."""

import sys

import numpy as np
from meshes import box, scene_mesh

import sionna_partial as sp
from sionna_partial.maps.mesh.cells import MeshReading, mesh_map

TX_M, RX_M = (2.0, 1.5, 1.5), [(5.0, 3.0, 1.5)]


def plan() -> sp.PartialMap:
    state = np.zeros((40, 70), dtype=np.uint8)
    state[[0, -1]] = state[:, [0, -1]] = state[:25, 35] = state[20:24, 50:54] = sp.CellState.WALL
    return sp.map_from_array(state, resolution_m=0.1).with_obstacle_height(0.75)


def mesh() -> sp.PartialMap:
    return mesh_map(scene_mesh(box((0, 0, 0), (7, 4, 3)), box((3, 0, 0), (3.1, 2, 3))), MeshReading())


def main(kind: str) -> None:
    room = {"plan": plan, "mesh": mesh}[kind]()
    for frequency_hz in (28e9, 5e9):
        sp.trace_links(room, TX_M, RX_M, trace_settings=sp.TraceSettings(frequency_hz=frequency_hz))
    if kind == "plan":
        explored = sp.explore(room, steps=(3,), seed=0)[0]
        sp.link_features(explored, sp.trace_links(explored, TX_M, RX_M))


if __name__ == "__main__":
    main(sys.argv[1])
