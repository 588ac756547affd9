"""Derivatives of the path gain of links, with respect to transmitter, materials and frequency."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats, States, read_only
from sionna_partial.checks import Progress
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.display import Shown, reporting
from sionna_partial.errors import PositionError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.paths import LinkSums
from sionna_partial.tracing.positions import checked_positions
from sionna_partial.tracing.simulation import Simulation, simulation_of


def one_transmitter(tx: ArrayLike) -> ArrayLike:
    """Return a position; several raise a PositionError."""
    if np.ndim(tx) != 1:
        raise PositionError(f"tx has shape {np.shape(tx)}: give one transmitter as (3,).")
    return tx


@read_only
@dataclass(frozen=True)
class GainGradients(Shown):
    """Path gain from one transmitter to N receivers, and its derivatives.

    The derivatives do not include paths that appear or vanish. They are 0 in an outage, where the gain is -150 dB.

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
        Derivatives with respect to the transmitter's x, y and z [dB/m].
    relative_permittivity_db : (N,) float64 array
        With respect to the real relative permittivity [dB], of all materials of a mesh together.
    conductivity_db_per_s_m : (N,) float64 array
        With respect to their conductivity [dB / (S/m)].
    thickness_db_per_m : (N,) float64 array
        With respect to their thickness [dB/m].
    frequency_db_per_hz : (N,) float64 array
        With respect to the carrier frequency [dB/Hz], which the constants of materials follow.
    trace_settings : TraceSettings
    scene_settings : SceneSettings

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> found = sp.gain_gradients(partial, (1.5, 1.5, 1.5), [(3.0, 2.0, 1.5)])
    >>> found.tx_db_per_m.shape, found.frequency_db_per_hz.shape
    ((1, 3), (1,))
    """

    tx: Floats
    rx: Floats
    link_state: States
    gain_db: Floats
    tx_db_per_m: Floats
    relative_permittivity_db: Floats
    conductivity_db_per_s_m: Floats
    thickness_db_per_m: Floats
    frequency_db_per_hz: Floats
    trace_settings: TraceSettings
    scene_settings: SceneSettings


@takes_settings
def gain_gradients(
    scene: PartialMap | str | Path | Simulation,
    tx: ArrayLike,
    rx: ArrayLike,
    *,
    trace_settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    progress: Progress | bool | None = None,
) -> GainGradients:
    """Differentiate the path gain from a transmitter to N receivers with Sionna RT and Dr.Jit.

    The paths are as in `trace_links`; the power of a link is the sum of its paths' powers, without phases. Dr.Jit
    differentiates in forward mode.

    Parameters
    ----------
    scene, rx, scene_settings, progress
        As in `trace_links`.
    tx : (3,) array-like
        Transmitter position [m].
    trace_settings : TraceSettings, optional
        Diffuse reflection must be off, and on meshes diffraction.

    Raises
    ------
    PositionError
        As `trace_links`, and for several transmitters.
    BackendError
        As `trace_links`, and for an unsupported release of Sionna RT.
    OutputError
        As `trace_links`.
    SettingsError
        For a frequency that the material does not cover, settings of another kind, or paths that only rays find.

    Examples
    --------
    In free space, the gain falls with 20 log10 of distance and frequency; at 2 m by 20 / ln(10) / 2 dB per metre:

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
    simulation = simulation_of(scene, trace_settings, scene_settings)
    simulation.require_exact()
    frequency_hz = simulation.trace_settings.frequency_hz
    tx_m, rx_m = checked_positions(simulation.partial, one_transmitter(tx), rx, frequency_hz)
    sums, slopes = LinkSums(1, len(rx_m)), np.zeros((7, len(rx_m)))
    with reporting(progress) as report:
        report(0.0, "building the scene")

        def part(fraction: float, message: str) -> None:
            report(0.1 + 0.9 * fraction, message.replace("verifying", "differentiating"))

        for block in simulation.path_blocks(tx_m, rx_m, part):
            for paths in block.solved:
                sums.add(paths)
            columns = np.concatenate(list(block.slopes(block.base, together=True).values()), axis=1)
            for total, values in zip(slopes, columns.T, strict=True):
                total += np.bincount(block.path_rx, weights=values, minlength=len(rx_m))
    link_state, gain_db = (values[0] for values in sums.states_and_gains())
    above = gain_db > GAIN_FLOOR_DB
    slopes_db = np.where(above, 10.0 / math.log(10.0) * slopes / np.where(above, sums.power, 1.0), 0.0)
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
        **simulation.resolved._asdict(),
    )
