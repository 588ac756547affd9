"""The one door to the path solver: scene + transmitter + receivers -> TracedLinks."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.errors import PositionError
from sionna_partial.files import temporary_folder
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings, settings_or_default
from sionna_partial.tracing.beams import trace_beams
from sionna_partial.tracing.candidates import Candidates, specular_candidates
from sionna_partial.tracing.diffraction import diffraction_candidates
from sionna_partial.tracing.scene import SceneGeometry, build_scene, write_scene
from sionna_partial.tracing.solver import SceneSolver, SolvedPaths, join_paths

Progress = Callable[[float, str], None]
"""Called with the share of the work done, in [0, 1], and what is being done."""


@dataclass(frozen=True)
class TracedLinks:
    """Every traced path from one transmitter to N receivers.

    Paths are listed one after the other, ordered by receiver and then by delay; P is their number.

    Parameters
    ----------
    tx : (3,) float64 array
        Transmitter position [m].
    rx : (N, 3) float64 array
        Receiver positions [m].
    link_state : (N,) uint8 array of LinkState
    gain_db : (N,) float64 array
        Omnidirectional path gain [dB], at least -150 (paper, eq. 5).
    path_rx : (P,) int32 array
        Index of the receiver that each path ends at.
    a : (P,) complex128 array
        Complex path gain (isotropic antennas, vertical polarisation).
    delay_s : (P,) float64 array
        Propagation delay [s].
    departure_rad, arrival_rad : (P, 2) float64 arrays
        Zenith and azimuth of departure at the transmitter and of arrival at the receiver [rad].
    interactions : (P, D) uint8 array
        Sionna RT's `InteractionType` of every interaction in order from the transmitter; 0 where there is none.
    vertices_m : (P, D, 3) float64 array
        Places of the interactions [m]; NaN where there is none.
    settings : TraceSettings
    scene_settings : SceneSettings
    """

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    link_state: NDArray[np.uint8]
    gain_db: NDArray[np.float64]
    path_rx: NDArray[np.int32]
    a: NDArray[np.complex128]
    delay_s: NDArray[np.float64]
    departure_rad: NDArray[np.float64]
    arrival_rad: NDArray[np.float64]
    interactions: NDArray[np.uint8]
    vertices_m: NDArray[np.float64]
    settings: TraceSettings
    scene_settings: SceneSettings


def trace_links(
    scene: PartialMap | str | Path,
    tx: ArrayLike,
    rx: ArrayLike,
    *,
    settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    progress: Progress | None = None,
) -> TracedLinks:
    """Trace every path from one transmitter to N receivers with Sionna RT.

    Line of sight and specular reflections are complete: candidates come from exact beams and are verified by Sionna
    RT's image method. So are, if switched on, paths with one diffraction at a vertical edge of the walls (corners, door
    jambs, open wall ends) and at most two reflections around it. With refraction or diffuse reflection switched on,
    Sionna RT shoots rays instead, one receiver at a time, for paths of every kind, which is slow and finds most paths,
    not all. The answer for a receiver does not depend on the other receivers.

    Parameters
    ----------
    scene : PartialMap or path
        What is known of the building; unknown space is free (paper, Section III-B).
    tx : (3,) array-like
        Transmitter position [m].
    rx : (N, 3) array-like
        Receiver positions [m]; N may be 0.
    settings : TraceSettings, optional
    scene_settings : SceneSettings, optional
    progress : callable, optional
        Called as ``progress(share_done, message)``.

    Returns
    -------
    TracedLinks

    Raises
    ------
    PositionError
        For a transmitter or receiver that is not finite, outside the map or inside a wall.
    SettingsError
        For a frequency that the material does not cover, or settings of another kind.
    BackendError
        If LLVM or Sionna RT cannot be used.
    OutputError
        If no temporary file can be written.
    """
    settings = settings_or_default("settings", settings, TraceSettings)
    scene_settings = settings_or_default("scene_settings", scene_settings, SceneSettings)
    scene_settings.material.require_frequency(settings.frequency_hz)
    partial = scene if isinstance(scene, PartialMap) else load_map(scene)
    tx_m, rx_m = _positions(partial, tx, rx)
    report = progress or (lambda share, message: None)
    report(0.0, "building the scene")
    geometry = build_scene(partial, scene_settings)
    shift = np.array([*geometry.origin_m, 0.0])
    with temporary_folder() as folder:
        xml = write_scene(geometry, folder, offset_m=geometry.origin_m, frequency_hz=settings.frequency_hz)
        parts = list(_solve_blocks(geometry, xml, settings, tx_m - shift, rx_m - shift, report))
    paths = join_paths(parts, settings.max_depth)
    paths.vertices_m[:] += shift
    link_state, gain_db = _link_summary(paths, len(rx_m))
    return TracedLinks(
        tx=tx_m,
        rx=rx_m,
        link_state=link_state,
        gain_db=gain_db,
        path_rx=paths.path_rx,
        a=paths.a,
        delay_s=paths.delay_s,
        departure_rad=paths.departure_rad,
        arrival_rad=paths.arrival_rad,
        interactions=paths.interactions,
        vertices_m=paths.vertices_m,
        settings=settings,
        scene_settings=scene_settings,
    )


def _positions(partial: PartialMap, tx: ArrayLike, rx: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Check the positions and give the transmitter as (3,), the receivers as (N, 3)."""
    tx_m = partial.require_positions("tx", tx)
    if tx_m.ndim != 1:
        raise PositionError(f"tx has shape {tx_m.shape}: give one transmitter (3,), and call once for each.")
    with suppress(ValueError):  # nested lists of unequal lengths have no size
        rx = np.zeros((0, 3)) if np.size(rx) == 0 else rx
    rx_m = partial.require_positions("rx", rx)
    if rx_m.ndim != 2:
        raise PositionError(f"rx has shape {rx_m.shape}: give receivers as (N, 3).")
    return tx_m, rx_m


def _solve_blocks(
    geometry: SceneGeometry,
    xml: Path,
    settings: TraceSettings,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    report: Progress,
) -> Iterator[SolvedPaths]:
    """Solve the paths in scene coordinates, block by block."""
    if len(rx_m) == 0:
        return
    report(0.02, "starting Sionna RT")
    solver = SceneSolver(xml, settings, tx_m, rx_m)
    if settings.refraction or settings.diffuse_reflection:
        for done, paths in enumerate(solver.shoot()):
            yield paths
            report(0.1 + 0.9 * (done + 1) / len(rx_m), f"shooting rays to {len(rx_m)} receivers")
        return
    for candidates, share_done, message in _candidates(geometry, settings, solver, tx_m, rx_m):
        yield solver.verify(candidates)
        report(0.1 + 0.9 * share_done, message)


def _candidates(
    geometry: SceneGeometry,
    settings: TraceSettings,
    solver: SceneSolver,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
) -> Iterator[tuple[Candidates, float, str]]:
    """Exact candidates in blocks, with the share of the work done and its name."""
    walls_m = geometry.vertices_m[geometry.segments]
    extent: dict[str, Any] = {
        "height_m": geometry.height_m,
        "horizontal": len(geometry.floor_m) > 0,
        "max_depth": settings.max_depth,
    }
    beams = trace_beams(walls_m, tx_m[:2], rx_m[:, :2], settings.max_depth)
    part = 0.2 if settings.diffraction else 1.0
    for candidates, share in specular_candidates(beams, walls_m, tx_m, rx_m, **extent):
        yield candidates, part * share, "verifying reflections"
    if not settings.diffraction:
        return
    for candidates, share in diffraction_candidates(walls_m, solver.wedges, tx_m, rx_m, **extent):
        yield candidates, part + (1.0 - part) * share, "verifying diffractions"


def _link_summary(paths: SolvedPaths, count: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Link state (count,) and omnidirectional path gain (count,) [dB] of all receivers (paper, eq. 5)."""
    power = np.abs(paths.a) ** 2
    total = np.bincount(paths.path_rx, weights=power, minlength=count)
    with np.errstate(divide="ignore"):
        gain_db = np.maximum(10.0 * np.log10(total), GAIN_FLOOR_DB)
    link_state = np.where(gain_db > GAIN_FLOOR_DB, LinkState.NLOS, LinkState.OUTAGE).astype(np.uint8)
    direct = (paths.interactions == 0).all(axis=1)
    link_state[paths.path_rx[direct]] = LinkState.LOS
    return link_state, gain_db
