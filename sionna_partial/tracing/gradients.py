"""Derivatives of the path gain with respect to the transmitter's position, the materials and the frequency."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.path_set import PathScene, one_transmitter, path_settings
from sionna_partial.tracing.trace import Progress, checked_positions, link_summary


@dataclass(frozen=True)
class GainGradients:
    """Path gain from one transmitter to N receivers, and its derivatives.

    The derivatives are those of the paths that exist: they do not include paths that appear or vanish. They are 0 in
    an outage, where the gain is -150 dB.

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

    The paths are those of `trace_links` with the same arguments. The power of a link is the sum of the powers of its
    paths, without their phases. Candidates are verified first; Dr.Jit then differentiates the image method and the
    field calculator of Sionna RT for the paths among them, in forward mode, one parameter after the other.

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
        Called as ``progress(fraction_done, message)``.

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
        If LLVM or Sionna RT cannot be used, or Sionna RT is another than the fast engine was made for.
    OutputError
        If no temporary file can be written.

    Examples
    --------
    In free space, the gain falls with 20 log10 of the distance and of the frequency. At 2 m it rises by 20 / ln(10) / 2
    dB for each metre that the transmitter comes nearer:

    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> field = sp.PartialMap(np.zeros((20, 60), dtype=np.uint8), resolution_m=0.1)
    >>> no_floor = sp.SceneSettings(floor_extent="none")
    >>> found = sp.gain_gradients(field, (1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)], scene_settings=no_floor)
    >>> (found.tx_db_per_m + 0.0).round(3).tolist()
    [[4.343, 0.0, 0.0]]
    >>> (found.frequency_db_per_hz * 1e9).round(4).tolist()
    [-0.3102]
    """
    partial = scene if isinstance(scene, PartialMap) else load_map(scene)
    settings, scene_settings = path_settings(partial, settings, scene_settings)
    tx_m, rx_m = checked_positions(partial, one_transmitter(tx), rx, settings.frequency_hz)
    report = progress or (lambda fraction, message: None)
    report(0.0, "building the scene")
    power, is_direct, slopes = np.zeros(len(rx_m)), np.zeros(len(rx_m), dtype=bool), np.zeros((7, len(rx_m)))
    if len(rx_m):
        paths = PathScene(partial, settings=settings, scene_settings=scene_settings)

        def part(fraction: float, message: str) -> None:
            report(0.1 + 0.9 * fraction, message.replace("verifying", "differentiating"))

        for block in paths.blocks(tx_m[0], rx_m, part):
            is_direct[block.path_rx[block.is_direct]] = True
            columns = np.concatenate(list(block.slopes(block.base, together=True).values()), axis=1)
            for total, values in zip((power, *slopes), (block.power, *columns.T), strict=True):
                total += np.bincount(block.path_rx, weights=values, minlength=len(rx_m))
    link_state, gain_db = link_summary(power, is_direct)
    above = gain_db > GAIN_FLOOR_DB
    slopes_db = np.where(above, 10.0 / math.log(10.0) * slopes / np.where(above, power, 1.0), 0.0)
    return GainGradients(
        tx=tx_m[0].copy(),
        rx=rx_m.copy(),
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
