"""Draws of the channels of links on a partial map."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats, States, read_only
from sionna_partial.channels.draws import PATHS_OF_DRAW, Buildings, Draws
from sionna_partial.checks import Progress, require_memory, require_whole
from sionna_partial.constants import MEMORY_GB
from sionna_partial.display import Shown, reporting
from sionna_partial.errors import MemoryLimitError
from sionna_partial.link_model import LinkModel, link_model_of
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import link_features, with_path_power
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.simulation import Simulation

if TYPE_CHECKING:
    import xarray as xr

MOST_DRAWS = 10_000

_PATH_BYTES, _DRAW_BYTES = 300, 170
"""Memory of a path, and of a link in a draw [bytes]."""


@read_only
@dataclass(frozen=True, eq=False)
class ChannelSamples(Shown):
    """n draws of the channels of links, from `sample_channels`.

    A draw is one possible building: links through the same unseen space are correlated. Phases through unseen space are
    uniform. Paths are computed on request, and are the same each time.

    Parameters
    ----------
    link_state : (n, N) or (n, T, N) uint8 array of LinkState
    gain_db : (n, N) or (n, T, N) float64 array
        Omnidirectional path gain [dB], -150 in outage.
    memory_gb : float
        Memory limit for all paths of `drawn` [GB].
    """

    link_state: States
    gain_db: Floats
    memory_gb: float
    _draws: Draws = field(repr=False)

    def __len__(self) -> int:
        return len(self.link_state)

    def links(self, draw: int) -> TracedLinks:
        """Return the links of one draw; interactions are 255 where a path was not traced.

        Raises
        ------
        SettingsError
            For a number without a draw.
        """
        require_whole("draw", draw, 0, len(self) - 1)
        traced = self._draws.traced
        columns: dict[str, Any] = self._draws.paths_of(draw)
        return replace(traced, link_state=self.link_state[draw], gain_db=self.gain_db[draw], **columns)

    @cached_property
    def drawn(self) -> TracedLinks:
        """Return all draws; draw k of transmitter t has transmitter number ``k * T + t``.

        Raises
        ------
        MemoryLimitError
            If they may take more than `memory_gb`; `links` needs less.
        """
        traced = self._draws.traced
        tx_m = np.tile(traced.tx.reshape(-1, 3), (len(self), 1))
        size_gb = self.link_state.size * PATHS_OF_DRAW * _PATH_BYTES / 1e9
        if size_gb > self.memory_gb:
            raise MemoryLimitError(
                f"memory_gb = {self.memory_gb:g} is too little: all paths of {len(self):,} draws take up to "
                f"{size_gb:.1f} GB. Use links(draw) for one draw after the other, or give more memory_gb."
            )
        columns: dict[str, Any] = self._draws.all_paths()
        columns |= {name: getattr(self, name).reshape(len(tx_m), -1) for name in ("link_state", "gain_db")}
        return replace(traced, tx=tx_m, **columns)

    def cir(self, **options: Any) -> xr.Dataset:
        """Return `TracedLinks.cir` along a first dimension "draw"."""
        return self._by_draw(self.drawn.cir(**self._tiled(options)))

    def cfr(self, frequencies_hz: ArrayLike, **options: Any) -> xr.Dataset:
        """Return `TracedLinks.cfr` along a first dimension "draw"."""
        return self._by_draw(self.drawn.cfr(frequencies_hz, **self._tiled(options)))

    def beam_gains(self, codebook: ArrayLike, rx_codebook: ArrayLike | None = None, **options: Any) -> xr.Dataset:
        """Return `TracedLinks.beam_gains` along a first dimension "draw"."""
        return self._by_draw(self.drawn.beam_gains(codebook, rx_codebook, **self._tiled(options)))

    def spreads(self) -> xr.Dataset:
        """Return `TracedLinks.spreads` along a first dimension "draw".

        Examples
        --------
        >>> import sionna_partial as sp
        >>> samples = sp.channels.sample_channels(sp.make_home(3), (2.0, 3.0, 1.5), [(3.0, 3.0, 1.5)], n=20)
        >>> samples.spreads().delay_spread_s.sizes["draw"]
        20
        """
        return self._by_draw(self.drawn.spreads())

    def _tiled(self, options: dict[str, Any]) -> dict[str, Any]:
        orientation = options.get("tx_orientation_rad")
        if orientation is None or np.ndim(orientation) != 2:
            return options
        return {**options, "tx_orientation_rad": np.tile(orientation, (len(self), 1))}

    def _by_draw(self, found: xr.Dataset) -> xr.Dataset:
        along = "link" if "link" in found.dims else "tx"
        if found.sizes[along]:
            folded = found.coarsen({along: found.sizes[along] // len(self)}).construct({along: ("draw", along)})
        else:
            folded = found.expand_dims(draw=len(self))
        if along == "link":
            first = folded.isel(draw=0)
            positions = {name: first[name] for name in ("tx_m", "rx_m")}
            return folded.assign_coords(tx=first.tx, rx=first.rx).assign(positions)
        return folded.isel(tx=0) if self.link_state.ndim == 2 else folded


@takes_settings
def sample_channels(
    scene: PartialMap | str | Path | Simulation | LinkModel,
    tx: ArrayLike,
    rx: ArrayLike,
    n: int = 100,
    seed: int = 0,
    *,
    predictor: Predictor | str | Path | None = None,
    trace_settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    memory_gb: float = MEMORY_GB,
    progress: Progress | bool | None = None,
) -> ChannelSamples:
    """Draw states, gains and paths of links on a partial map n times.

    State and gain of each link are drawn from the distribution of `LinkModel.predict`, and occur as often as predicted.
    Shared spatial latents (`JointLatents`) make a draw one possible building: links behind the same unseen wall fail
    together, and walls of unknown material have one material. Given state and gain, a draw contains the traced paths in
    observed space, others with a learned probability, and analogues from procedural homes (`PathModel`). On a complete
    map with opaque walls every draw is the trace; through walls, the gain deviates from the trace as predicted, by the
    same factor for all paths of a link.

    Parameters
    ----------
    scene : PartialMap or path
        Map of the building.
    tx : (3,) or (T, 3) array-like
        Transmitter positions [m].
    rx : (N, 3) array-like
        Receiver positions [m], indoors.
    n : int
        Number of draws, at most 10,000.
    seed : int
        Seed of the draws, at least 0.
    predictor : None, "map", "paper", path or Predictor
        As in `predict_map`.
    trace_settings : TraceSettings, optional
    scene_settings : SceneSettings, optional
    memory_gb : float
        Memory limit for the draws, and for all their paths together [GB].
    progress : bool or callable, optional
        As in `predict_map`.

    Returns
    -------
    ChannelSamples

    Raises
    ------
    MemoryLimitError
        If the draws without their paths may take more than `memory_gb`.
    MapError, PositionError, SettingsError, PredictorError, BackendError
        As `trace_links` and `predict_map`.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> samples = sp.channels.sample_channels(partial, (1.5, 1.5, 1.5), [(3.0, 2.0, 1.5)], n=20)
    >>> len(samples), samples.gain_db.shape
    (20, (20, 1))
    """
    require_whole("n", n, 1, MOST_DRAWS)
    require_whole("seed", seed, 0, 2**63)
    require_memory(memory_gb)
    model = link_model_of(scene, predictor, trace_settings, scene_settings)
    size_gb = n * np.size(tx) / 3 * np.size(rx) / 3 * _DRAW_BYTES / 1e9
    if size_gb > memory_gb:
        raise MemoryLimitError(
            f"memory_gb = {memory_gb:g} is too little: {n:,} draws of {round(np.size(tx) * np.size(rx) / 9):,} links "
            f"take up to {size_gb:.1f} GB. Give fewer draws or receivers at a time, or more memory_gb."
        )
    with reporting(progress) as report:
        report(0.0, "tracing")
        traced = model.simulation.links(tx, rx, memory_gb=memory_gb, progress=False)
        phi = link_features(model.partial, traced).flat()
        if model.simulation.material_unknown:
            phi = with_path_power(phi, model.partial, traced)
        prediction = model.predict_features(phi)
        report(0.5, "drawing")
        draws = Draws(model.partial, traced, prediction, Buildings.drawn(model, traced, prediction, n, seed), seed)
        report(1.0, "done")
    shape = (n, *traced.gain_db.shape)
    return ChannelSamples(draws.state.reshape(shape), draws.gain_db.reshape(shape), memory_gb, draws)
