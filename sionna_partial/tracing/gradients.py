"""Derivatives of the path gain: by how much it changes with the transmitter's place, the materials and the frequency.

Candidates are verified first, without derivatives. Dr.Jit then differentiates the image method and the field
calculator of Sionna RT for those alone that turned out to be paths, forward, one parameter after the other: a pass
gives the derivatives of all paths at once.
"""

import math
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.errors import BackendError, PositionError
from sionna_partial.files import temporary_folder
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings, require
from sionna_partial.tracing.candidates import Candidates
from sionna_partial.tracing.contract import contract_remedy
from sionna_partial.tracing.generator import WrittenScene, write_scene_of
from sionna_partial.tracing.paths import SolvedPaths
from sionna_partial.tracing.probe import fast_engine_works
from sionna_partial.tracing.solver import Offsets, SceneSolver
from sionna_partial.tracing.trace import Progress, checked_positions, checked_settings, link_summary

PATHS_PER_BLOCK = 50_000
"""Number of paths that are differentiated together, which bounds the memory."""


@dataclass(frozen=True)
class GainGradients:
    """Path gain from one transmitter to N receivers, and its derivatives.

    The derivatives are those of the paths that there are: they do not see paths appear or vanish. They are 0 where the
    gain is that of an outage, -150 dB.

    Parameters
    ----------
    tx : (3,) float64 array
        Transmitter position [m].
    rx : (N, 3) float64 array
        Receiver positions [m].
    link_state : (N,) uint8 array of LinkState
    gain_db : (N,) float64 array
        Omnidirectional path gain [dB], at least -150 (paper, eq. 5).
    tx_db_per_m : (N, 3) float64 array
        Its derivatives with respect to the transmitter's x, y and z [dB/m].
    relative_permittivity_db : (N,) float64 array
        With respect to the real relative permittivity [dB], of all materials together where a mesh has several.
    conductivity_db_per_s_m : (N,) float64 array
        With respect to their conductivity [dB / (S/m)].
    thickness_db_per_m : (N,) float64 array
        With respect to their thickness [dB/m].
    frequency_db_per_hz : (N,) float64 array
        With respect to the carrier frequency [dB/Hz]. ITU materials follow the frequency where Sionna RT loads them by
        name, which it does for all but `vacuum`.
    settings : TraceSettings
    scene_settings : SceneSettings
    """

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    link_state: NDArray[np.uint8]
    gain_db: NDArray[np.float64]
    tx_db_per_m: NDArray[np.float64]
    relative_permittivity_db: NDArray[np.float64]
    conductivity_db_per_s_m: NDArray[np.float64]
    thickness_db_per_m: NDArray[np.float64]
    frequency_db_per_hz: NDArray[np.float64]
    settings: TraceSettings
    scene_settings: SceneSettings


def gain_gradients(
    scene: PartialMap | str | Path,
    tx: ArrayLike,
    rx: ArrayLike,
    *,
    settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    progress: Progress | None = None,
) -> GainGradients:
    """Differentiate the path gain from a transmitter to N receivers with Sionna RT and Dr.Jit.

    The paths are those of `trace_links` with the same arguments. The power of a receiver is the sum of the powers of
    its paths, so that phases do not count.

    Parameters
    ----------
    scene : PartialMap or path
        What is known of the building; unknown space is free.
    tx : (3,) array-like
        Transmitter position [m].
    rx : (N, 3) array-like
        Receiver positions [m]; N may be 0.
    settings : TraceSettings, optional
        Refraction and diffuse reflection must be off; diffraction too on meshes.
    scene_settings : SceneSettings, optional
    progress : callable, optional
        Called as ``progress(share_done, message)``.

    Returns
    -------
    GainGradients

    Raises
    ------
    PositionError
        For a transmitter or receiver that is not finite, outside the map or inside a wall, a receiver at the
        transmitter, or several transmitters.
    SettingsError
        For a frequency that the material does not cover, settings of another kind, or paths that only rays find.
    BackendError
        If LLVM or Sionna RT cannot be used, or Sionna RT is not what the fast engine was made for.
    OutputError
        If no temporary file can be written.

    Examples
    --------
    In the open, the gain falls with 20 log10 of the distance, and with as much of the frequency. At 2 m it rises by
    20 / ln(10) / 2 dB for each metre that the transmitter comes nearer:

    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> field = sp.PartialMap(np.zeros((20, 60), dtype=np.uint8), resolution_m=0.1)
    >>> nothing = sp.SceneSettings(floor_extent="none")
    >>> found = sp.gain_gradients(field, (1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)], scene_settings=nothing)
    >>> (found.tx_db_per_m + 0.0).round(3).tolist()
    [[4.343, 0.0, 0.0]]
    >>> (found.frequency_db_per_hz * 1e9).round(4).tolist()
    [-0.3102]
    """
    partial = scene if isinstance(scene, PartialMap) else load_map(scene)
    settings, scene_settings = checked_settings(partial, settings, scene_settings)
    _require_off(settings, "refraction", "diffuse_reflection")
    tx_m, rx_m = checked_positions(partial, tx, rx, settings.frequency_hz)
    if np.ndim(tx) != 1:
        raise PositionError(f"tx has shape {np.shape(tx)}: give one transmitter as (3,).")
    report = progress or (lambda share, message: None)
    report(0.0, "building the scene")
    shift = np.array([*partial.origin_m, 0.0])
    total = _Sums(len(rx_m))
    if len(rx_m):
        with temporary_folder() as folder:
            written = write_scene_of(partial, folder, settings, scene_settings)
            _add_paths(total, written, settings, tx_m[0] - shift, rx_m - shift, report)
    link_state, gain_db = link_summary(total.power, total.is_direct)
    slopes_db = total.slopes_db()
    return GainGradients(
        tx=tx_m[0],
        rx=rx_m,
        link_state=link_state,
        gain_db=gain_db,
        tx_db_per_m=slopes_db[:3].T,
        relative_permittivity_db=slopes_db[3],
        conductivity_db_per_s_m=slopes_db[4],
        thickness_db_per_m=slopes_db[5],
        frequency_db_per_hz=slopes_db[6],
        settings=settings,
        scene_settings=scene_settings,
    )


def path_slopes(
    solver: SceneSolver, candidates: Candidates, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Differentiate the power of paths.

    Parameters
    ----------
    solver : SceneSolver
    candidates : Candidates
        Candidates that are paths.
    tx_m, rx_m : (3,) and (N, 3) arrays
        Transmitter and receivers, in scene coordinates [m].

    Returns
    -------
    (7, C) float64 array
        Derivatives of the power |a|^2 of each with respect to the fields of `Offsets`, in their order.
    """
    slopes = np.zeros((len(fields(Offsets)), len(candidates.rx)))
    for start in range(0, len(candidates.rx), PATHS_PER_BLOCK):
        block = slice(start, min(start + PATHS_PER_BLOCK, len(candidates.rx)))
        part = candidates.rows(np.arange(block.start, block.stop))
        slopes[:, block] = _block_slopes(solver, part, tx_m, rx_m)
    return slopes


class _Sums:
    """Sums over the paths of each of N receivers."""

    def __init__(self, receivers: int) -> None:
        self.power = np.zeros(receivers)
        self.is_direct = np.zeros(receivers, dtype=bool)
        self.slopes = np.zeros((len(fields(Offsets)), receivers))

    def add(self, paths: SolvedPaths, slopes: NDArray[np.float64]) -> None:
        count = len(self.power)
        self.power += np.bincount(paths.path_rx, weights=np.abs(paths.a) ** 2, minlength=count)
        self.is_direct[paths.path_rx[paths.is_direct]] = True
        for total, slope in zip(self.slopes, slopes, strict=True):
            total += np.bincount(paths.path_rx, weights=slope, minlength=count)

    def slopes_db(self) -> NDArray[np.float64]:
        """Turn the derivatives (7, N) into those of the gain [dB], which are 0 at its floor."""
        _, gain_db = link_summary(self.power, self.is_direct)
        above = gain_db > GAIN_FLOOR_DB
        return np.where(above, 10.0 / math.log(10.0) * self.slopes / np.where(above, self.power, 1.0), 0.0)


def _require_off(settings: TraceSettings, *names: str) -> None:
    for name in names:
        value = getattr(settings, name)
        remedy = "paths that are found by shooting rays have no gradients: give False"
        require(not value, name, value, f"{remedy}, and trace_links for the gain alone.")


def _add_paths(
    total: _Sums,
    written: WrittenScene,
    settings: TraceSettings,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    report: Progress,
) -> None:
    """Find, verify and differentiate the paths in scene coordinates, block by block."""
    if not written.is_plan:
        _require_off(settings, "diffraction")
    if not fast_engine_works():
        raise BackendError(
            f"Gradients need the internal parts of Sionna RT that the fast engine has: {contract_remedy()}"
        )
    solver = SceneSolver(written.xml, written.shapes, settings)
    for candidates, share, message in written.candidates(solver, tx_m, rx_m):
        paths, rows = solver.verify_rows(candidates, tx_m, rx_m)
        total.add(paths, path_slopes(solver, candidates.rows(rows), tx_m, rx_m))
        report(0.1 + 0.9 * share, message.replace("verifying", "differentiating"))


def _block_slopes(
    solver: SceneSolver, candidates: Candidates, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Differentiate one block of paths (see `path_slopes`)."""
    import drjit as dr
    import mitsuba as mi

    offsets = Offsets(*(dr.opaque(mi.Float, 0.0) for _ in fields(Offsets)))
    leaves = [getattr(offsets, field.name) for field in fields(Offsets)]
    dr.enable_grad(leaves)
    power = solver.path_power(candidates, tx_m, rx_m, offsets)
    slopes = np.zeros((len(leaves), len(candidates.rx)))
    for slope, leaf in zip(slopes, leaves, strict=True):
        dr.clear_grad(power)
        dr.forward_from(leaf, flags=dr.ADFlag.ClearInterior)  # the graph stays for the next parameter
        slope[:] = dr.grad(power).numpy()
    return slopes
