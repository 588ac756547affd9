"""Whether the fast engine can be trusted with the Sionna RT that is installed."""

import functools
import itertools
from pathlib import Path

import numpy as np

from sionna_partial.constants import CellState
from sionna_partial.files import temporary_folder
from sionna_partial.llvm import load_llvm
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.beams import trace_beams
from sionna_partial.tracing.candidates import specular_candidates
from sionna_partial.tracing.contract import TESTED_VERSIONS, contract_breaches, sionna_version, warn_of_breaches
from sionna_partial.tracing.diffraction import diffraction_candidates, find_wedges
from sionna_partial.tracing.paths import SolvedPaths, join_paths
from sionna_partial.tracing.scene import SHAPES, SceneGeometry, build_scene, write_scene
from sionna_partial.tracing.solver import SceneSolver
from sionna_partial.tracing.stock import stock_paths

DELAY_S = 3e-12
"""Largest difference of a delay between both engines [s]: 1 mm."""

GAIN_SHARE = 0.01
"""Largest difference of a coefficient between both engines, as a share of its magnitude."""

TX_M = np.array([1.03, 1.52, 1.4])
"""Transmitter in the small room, which sees one face of the pillar [m]."""

RX_M = np.array([[1.47, 2.51, 1.7], [3.05, 0.61, 1.2], [3.12, 2.57, 1.3]])
"""Receivers in the small room [m]: one that sees the transmitter, and two beside and behind the pillar."""

SETTINGS = (
    TraceSettings(max_depth=3, diffraction=False, samples_per_tx=50_000),
    TraceSettings(max_depth=1, diffraction=True, samples_per_tx=50_000),
)
"""Settings in the small room. With reflections before it, a diffraction would show the wedge from where both faces are
lit: which of them Sionna RT's rays take for the first is chance, and its coefficients are not symmetric in them."""


@functools.cache
def fast_engine_works() -> bool:
    """Whether `SceneSolver` can be used; if not, a warning says why, once for each process.

    The parts that it leans on must be there. With a version of Sionna RT that was not tested, it must also find the
    same paths in a small room as the public path solver does, which takes some seconds.

    Returns
    -------
    bool

    Raises
    ------
    BackendError
        If no LLVM can be used.
    """
    load_llvm()
    breaches = contract_breaches()
    if not breaches and sionna_version() not in TESTED_VERSIONS:
        breaches = probe_breaches()
    if breaches:
        warn_of_breaches(breaches)
    return not breaches


def probe_breaches() -> tuple[str, ...]:
    """Solve a small room on internal and on public parts of Sionna RT; never raises.

    Returns
    -------
    tuple of str
        In what the two differ; empty if they agree.
    """
    breaches = []
    try:
        with temporary_folder() as folder:
            geometry = build_scene(small_room())
            xml = write_scene(geometry, folder, offset_m=geometry.origin_m)
            for settings in SETTINGS:
                ours, theirs = _fast(geometry, xml, settings), _stock(xml, settings)
                breaches += differences(ours, theirs)
    except Exception as error:
        breaches.append(f"a small room cannot be solved ({error!r})")
    return tuple(dict.fromkeys(breaches))


def differences(ours: SolvedPaths, theirs: SolvedPaths) -> list[str]:
    """Name the first difference between joined paths of both engines, if there is any."""
    if len(ours.a) != len(theirs.a):
        return [f"{len(ours.a)} paths were found in a small room that has {len(theirs.a)}"]
    if not np.array_equal(ours.path_rx, theirs.path_rx):
        return ["paths in a small room end at other receivers"]
    if not np.allclose(ours.delay_s, theirs.delay_s, rtol=0.0, atol=DELAY_S):
        return ["paths in a small room have other delays"]
    if not np.allclose(np.abs(ours.a - theirs.a) / np.abs(theirs.a), 0.0, atol=GAIN_SHARE):
        return ["paths in a small room have other coefficients"]
    return []


def small_room() -> PartialMap:
    """Make a room of 4 m x 3 m with a pillar, which has edges to diffract at."""
    state = np.full((32, 42), CellState.FREE, dtype=np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = CellState.WALL
    state[12:20, 20:26] = CellState.WALL
    return PartialMap(state, 0.1)


def _fast(geometry: SceneGeometry, scene_xml: Path, settings: TraceSettings) -> SolvedPaths:
    solver, depth = SceneSolver(scene_xml, SHAPES, settings), settings.max_depth
    beams = trace_beams(geometry.walls_m, TX_M[:2], RX_M[:, :2], depth)
    blocks = specular_candidates(beams, geometry, TX_M, RX_M, depth)
    if settings.diffraction:
        wedges = find_wedges(geometry, open_ends=False)
        blocks = itertools.chain(blocks, diffraction_candidates(geometry, wedges, TX_M, RX_M, depth))
    return join_paths([solver.verify(candidates, TX_M, RX_M) for candidates, _ in blocks], depth)


def _stock(scene_xml: Path, settings: TraceSettings) -> SolvedPaths:
    parts = [paths for paths, _ in stock_paths(scene_xml, settings, TX_M, RX_M, edges=False)]
    return join_paths(parts, settings.max_depth)
