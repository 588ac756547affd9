"""predict_map: map, transmitter and predictor -> coverage map, an xarray.Dataset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr
from numpy.typing import ArrayLike

from sionna_partial.checks import Progress, require_choice, require_memory
from sionna_partial.constants import DEFAULT_HEIGHT_M, MEMORY_GB
from sionna_partial.coverage.job import TxAntenna, predict_coverage
from sionna_partial.link_model import LinkModel, link_model_of
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.simulation import Simulation

RECEIVERS = ("indoor", "anywhere")
"""Receivers that probabilities and gains refer to: indoors (default), or anywhere."""


@takes_settings
def predict_map(
    scene: PartialMap | str | Path | Simulation | LinkModel,
    tx: ArrayLike | Mapping[str, ArrayLike] | None = None,
    *,
    tx_antenna: TxAntenna = None,
    rx_height_m: float = DEFAULT_HEIGHT_M,
    spacing_m: float = 0.15,
    predictor: Predictor | str | Path | None = None,
    scene_settings: SceneSettings | None = None,
    trace_settings: TraceSettings | None = None,
    measurements: Any = None,
    receivers: str = RECEIVERS[0],
    memory_gb: float = MEMORY_GB,
    progress: Progress | bool | None = None,
) -> xr.Dataset:
    """Predict link state and path gain, with their uncertainty, everywhere on a map.

    The known part of the map is traced. The predictor turns the traced links and the unobserved lengths into
    distributions (paper, Section III). On a complete map the trace itself is the prediction.

    Probabilities and gains hold for a receiver that is indoors, as in the paper; `p_indoor` is the probability that it
    is. With ``receivers="anywhere"`` they include receivers outdoors, whose links count as outages. On a complete map
    a receiver is indoors wherever a cell is free, and outdoors elsewhere.

    Receivers inside walls, within 1.1 cm of a wall or at the transmitter (within 1.1 cm, or within wavelength / 4 pi,
    where Friis' formula is above 0 dB) are left out: `valid` is False there, floating-point variables and link states
    are NaN. A NetCDF file holds these link states as 255, its `_FillValue`.

    Without `tx`, the position of the transmitter is found from measurements: `p_transmitter` is its posterior, and
    probabilities and gains are averaged over 8 positions drawn from it.

    Parameters
    ----------
    scene : PartialMap, path, Simulation or LinkModel
        The map, or a file that `load_map` reads. With a `LinkModel`, later calls are faster.
    tx : (3,) or (2,) array-like, (T, 3) array-like, mapping of names to positions, or None
        Transmitter position [m]; 1.5 m high where no z is given. It may be in unknown space. Several are named "tx1",
        "tx2" and so on, or as in the mapping. None if it is not known: then `measurements` are of one transmitter,
        1.5 m high unless they have its z.
    tx_antenna : Antenna, AntennaPattern or str, a sequence of these or mapping of names to them, optional
        Antenna of the transmitter, or of each of several; isotropic and vertically polarised by default. Gains then
        include the antenna. Link states do not depend on the antenna: a link in a null of the pattern has a low gain,
        and is no outage.
    rx_height_m : float
        Height of the receivers [m].
    spacing_m : float
        Distance between receivers [m]. Their grid starts half of it inside the lower-left corner of the map.
    predictor : None, "map", "paper", path or Predictor
        None is the shipped default, "map"; a path is a predictor that you saved. On a complete map it is not used.
    scene_settings : SceneSettings, optional
    trace_settings : TraceSettings, optional
    measurements : Measurements, mapping, data frame or path, optional
        Gains that were measured of this transmitter (see `Measurements`), which improve the prediction of other
        receivers (`Assimilation`). Those of transmitters farther than 0.5 m from `tx` are
        not used where walls are opaque; through walls they teach the material of walls and the offset of powers.
        Where the material is unknown, the attribute `wall_material` of the map has its probabilities, and
        `wall_loss_db` the expected loss of a wall.
    receivers : {"indoor", "anywhere"}
        Probabilities and gains given that a receiver is indoors, or of one that may be outdoors, in outage.
    memory_gb : float
        Memory limit of the process [GB]. Receivers are traced and predicted in blocks that fit.
    progress : bool or callable, optional
        False shows none; a callable is called as ``progress(fraction_done, message)``. By default a bar appears in
        terminals and notebooks after 2 s.

    Returns
    -------
    xarray.Dataset
        On (y, x), in metres: the variables of `ATTRIBUTES`, and the settings, versions and predictor in attributes.
        With several transmitters what depends on them is on (tx, y, x); ``.sel(tx=name)`` is the map of one.
        Without `tx` also `p_transmitter` on (tx_y, tx_x), the probability of each cell; the attribute `transmitter_m`
        is then the position from which the expected distance is smallest, `transmitter_std_m` the root mean square
        distance from it, and the features belong to the drawn position nearest to it.

    Raises
    ------
    MapError
        If the map cannot be read.
    MemoryLimitError
        If the job cannot be done within `memory_gb`; nothing was begun.
    MeasurementError
        If the measurements cannot be read, or none is usable.
    PositionError
        For a transmitter outside the map or in a wall, or if no receiver can be anywhere.
    SettingsError
        For a height, spacing or frequency out of range, or another value of `receivers`.
    PredictorError
        If the predictor cannot be read.
    BackendError
        If LLVM or Sionna RT cannot be used.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> coverage = sp.predict_map(partial, tx=(1.5, 1.5, 1.5), spacing_m=0.5)
    >>> coverage["p_los"].sel(x=3.25, y=2.25).item()
    1.0
    """
    model = link_model_of(scene, predictor, trace_settings, scene_settings)
    require_choice("receivers", receivers, RECEIVERS)
    require_memory(memory_gb)
    grid = {"rx_height_m": rx_height_m, "spacing_m": spacing_m, "receivers": receivers}
    return predict_coverage(model, tx, tx_antenna, measurements, memory_gb, progress, **grid)
