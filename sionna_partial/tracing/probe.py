"""Whether the fast engine can be trusted with the Sionna RT that is installed."""

import functools

import numpy as np

from sionna_partial.constants import CellState
from sionna_partial.files import temporary_folder
from sionna_partial.llvm import load_llvm
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.contract import TESTED_VERSIONS, contract_breaches, sionna_version, warn_of_breaches
from sionna_partial.tracing.generator import WrittenScene, write_scene_of
from sionna_partial.tracing.paths import SolvedPaths, join_paths
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
    TraceSettings(max_depth=3, diffraction=False, samples_per_tx=50_000, power_tolerance_db=0.0),
    TraceSettings(max_depth=1, diffraction=True, samples_per_tx=50_000, power_tolerance_db=0.0),
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
            for settings in SETTINGS:
                scene = write_scene_of(small_room(), folder, settings, SceneSettings())
                breaches += differences(_fast(scene, settings), _stock(scene, settings))
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


def _fast(scene: WrittenScene, settings: TraceSettings) -> SolvedPaths:
    solver = SceneSolver(scene.xml, scene.shapes, settings)
    parts = [paths for _, paths, _, _ in scene.paths(solver, TX_M, RX_M)]
    return join_paths(parts, settings.max_depth)


def _stock(scene: WrittenScene, settings: TraceSettings) -> SolvedPaths:
    parts = [paths for paths, _ in stock_paths(scene.xml, settings, TX_M, RX_M, edges=False)]
    return join_paths(parts, settings.max_depth)
