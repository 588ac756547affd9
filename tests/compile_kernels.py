"""Compile and cache kernels in several processes: one process compiles on one core, and two tests compile each twice.

`plan` and `mesh` are what most tests need; `beams` and `paths` are the halves of a prediction through opaque walls.
"""

import sys
from typing import Any

import numpy as np
from meshes import box, scene_mesh

import sionna_partial as sp
from sionna_partial.maps.mesh.cells import MeshReading, mesh_map
from sionna_partial.process import _announced, _Kernel

TX_M, RX_M = (2.0, 1.5, 1.5), [(5.0, 3.0, 1.5)]

AFTER_BEAMS = ("plan.arrivals", "plan.edges", "plan.joining", "plan.reflections", "select")


def plan() -> sp.PartialMap:
    state = np.zeros((40, 70), dtype=np.uint8)
    state[[0, -1]] = state[:, [0, -1]] = state[:25, 35] = state[20:24, 50:54] = sp.CellState.WALL
    return sp.map_from_array(state, resolution_m=0.1).with_obstacle_height(0.75)


def mesh() -> sp.PartialMap:
    return mesh_map(scene_mesh(box((0, 0, 0), (7, 4, 3)), box((3, 0, 0), (3.1, 2, 3))), MeshReading())


def main(kind: str) -> None:
    _announced.set()  # make says it
    room = mesh() if kind == "mesh" else plan()
    if kind == "paths":
        compile_only(tuple(f"sionna_partial.tracing.{module}" for module in AFTER_BEAMS))
    for frequency_hz in (28e9, 5e9) if kind in ("plan", "mesh") else (28e9,):
        sp.trace_links(room, TX_M, RX_M, trace_settings=sp.TraceSettings(frequency_hz=frequency_hz))
    if kind == "plan":
        explored = sp.explore(room, steps=(3,), seed=0)[0]
        sp.link_features(explored, sp.trace_links(explored, TX_M, RX_M))


def compile_only(modules: tuple[str, ...]) -> None:
    """Let Python interpret kernels of other modules that it calls: another process compiles them."""
    compiled = _Kernel.__call__

    def call(kernel: Any, *arguments: Any) -> Any:
        return compiled(kernel, *arguments) if kernel.__module__ in modules else kernel.__wrapped__(*arguments)

    _Kernel.__call__ = call  # type: ignore[method-assign]


if __name__ == "__main__":
    main(sys.argv[1])
