"""The solver's verdict on a candidate must not depend on the candidates beside it."""

from pathlib import Path

import numpy as np

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.tracing.beams import trace_beams
from sionna_partial.tracing.candidates import Candidates, specular_candidates
from sionna_partial.tracing.scene import build_scene, write_scene
from sionna_partial.tracing.solver import SceneSolver


def test_order_of_candidates_changes_no_verdict(tmp_path: Path) -> None:
    """Embree loses hits of rays that are called coherent and are not."""
    home = sp.make_home(9)
    geometry = build_scene(home)
    free = (np.argwhere(home.state == CellState.FREE)[::40, ::-1] + 0.5) * home.resolution_m
    places = np.column_stack([free, np.full(len(free), 1.5)])
    tx, rx = places[len(places) // 2], np.delete(places, len(places) // 2, axis=0)
    walls = geometry.vertices_m[geometry.segments]
    beams = trace_beams(walls, tx[:2], rx[:, :2], 6)
    candidates, _ = next(specular_candidates(beams, walls, tx, rx, height_m=3.0, horizontal=True, max_depth=6))
    xml = write_scene(geometry, tmp_path, offset_m=geometry.origin_m)
    solver = SceneSolver(xml, sp.TraceSettings(), tx, rx)
    order = np.random.default_rng(0).permutation(len(candidates.rx))
    shuffled = Candidates(
        candidates.rx[order], candidates.surface[order], candidates.vertices_m[order], candidates.wedge
    )
    counts = [np.bincount(solver.verify(each).path_rx, minlength=len(rx)) for each in (candidates, shuffled)]
    np.testing.assert_array_equal(*counts)
