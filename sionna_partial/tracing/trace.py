"""trace_links: every path of some links, from any input with a map."""

from __future__ import annotations

from pathlib import Path

from numpy.typing import ArrayLike

from sionna_partial.checks import Progress
from sionna_partial.constants import MEMORY_GB
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.simulation import InvalidLinks, Simulated, Simulation, simulation_of


@takes_settings
def trace_links(
    scene: PartialMap | str | Path | Simulation | Simulated,
    tx: ArrayLike,
    rx: ArrayLike,
    *,
    trace_settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    folder: str | Path | None = None,
    memory_gb: float = MEMORY_GB,
    invalid: InvalidLinks = "raise",
    progress: Progress | bool | None = None,
) -> TracedLinks:
    """Trace every path from one or more transmitters to N receivers with Sionna RT.

    On a floor plan, line of sight, specular reflections and paths with one diffraction at a vertical edge and at most
    two reflections are complete, except legs of 1 cm or less, which Sionna RT drops: exact beams give candidates, which
    Sionna RT's image method verifies. On a mesh, rays find the sequences of planes; line of sight and nearly all
    reflections are found. Both include paths through walls. With diffuse reflection, diffraction on a mesh, or a
    release of Sionna RT other than 2.2, its public path solver shoots rays for one receiver at a time: slow, and not
    all paths are found. The result of a receiver does not depend on other receivers.

    Parameters
    ----------
    scene : PartialMap, path, Simulation or LinkModel
        Map of the building; unknown space is free (paper, Section III-B).
    tx : (3,) or (T, 3) array-like
        Transmitter positions [m].
    rx : (N, 3) array-like
        Receiver positions [m]; N may be 0.
    trace_settings : TraceSettings, optional
    scene_settings : SceneSettings, optional
    folder : path, optional
        Folder for the paths, an `.npy` file for each array, which the result reads on demand, without the limit
        `memory_gb`.
    memory_gb : float
        Largest memory of the paths [GB], estimated from some receivers.
    invalid : {"raise", "nan"}
        Receivers that are not finite, outside the map, in a wall, not between floor and ceiling, or at the transmitter:
        an error, or a link without paths, with link state 255 and gain NaN.
    progress : bool or callable, optional
        As in `predict_map`.

    Raises
    ------
    MemoryLimitError
        If the paths would take more than `memory_gb`.
    PositionError
        For an invalid transmitter or (with "raise") receiver, such as one within 1.1 cm of a transmitter (more at low
        frequencies, where Friis' formula is above 0 dB).
    SettingsError
        For a frequency that a material does not cover, settings of another kind, or another value of `invalid`.
    BackendError
        If LLVM or Sionna RT cannot be used.
    OutputError
        If no temporary file can be written.

    Examples
    --------
    In free space, the gain at a distance of 2 m is 20 log10(wavelength / (4 pi 2 m)), at 28 GHz:

    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> field = sp.PartialMap(np.zeros((20, 60), dtype=np.uint8), resolution_m=0.1)
    >>> open_air = sp.SceneSettings(floor_extent="none")
    >>> links = sp.trace_links(field, (1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)], scene_settings=open_air)
    >>> links.gain_db.round(2).tolist()
    [-67.41]
    """
    simulation = simulation_of(scene, trace_settings, scene_settings)
    return simulation.links(tx, rx, folder=folder, memory_gb=memory_gb, invalid=invalid, progress=progress)
