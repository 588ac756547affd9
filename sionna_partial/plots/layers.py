"""Layers of a coverage map: their quantities, colours and titles."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.colors import Colormap, ListedColormap, Normalize, to_rgb
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Floats
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.coverage.dataset import probability_above, transmitter_text
from sionna_partial.plots.style import STATE_COLOURS

_GAINS_DB, _GAINS_THROUGH_WALLS_DB = (GAIN_FLOOR_DB, -60.0), (-110.0, -30.0)
"""Ranges of mean path gains [dB]; gains through walls are less spread."""


@dataclass(frozen=True)
class Layer:
    """Picture (ny, nx) of a quantity with its colour scale, or (ny, nx, 3); no label, no colour bar."""

    title: str
    picture: Callable[[xr.Dataset], NDArray[Any]]
    norm: Normalize | None = None
    cmap: str | Colormap | None = None
    label: str = ""
    ticks: tuple[Sequence[float], Sequence[str]] | None = None


@dataclass(frozen=True)
class Scale:
    """Colours of a layer in steps from `low` to `high`, its ticks and their names, and the title of its bar."""

    palette: Sequence[str]
    low: float
    high: float
    ticks: Sequence[float]
    names: Sequence[str]
    title: str

    def of(self, layer: Layer) -> Layer:
        """Return a layer with this scale."""
        norm, cmap = Normalize(self.low, self.high), ListedColormap([*self.palette])
        return replace(layer, norm=norm, cmap=cmap, label=self.title, ticks=(self.ticks, self.names))


def mix_state_colours(p_los: ArrayLike, p_nlos: ArrayLike, p_outage: ArrayLike) -> Floats:
    """Return the colours (..., 3) of link states, mixed by their probabilities (paper, Section IV-C)."""
    colours = np.array([to_rgb(STATE_COLOURS[state]) for state in (LinkState.LOS, LinkState.NLOS, LinkState.OUTAGE)])
    return np.stack([p_los, p_nlos, p_outage], axis=-1).astype(np.float64) @ colours


def coverage_layers(threshold_db: float, coverage: xr.Dataset | None = None) -> dict[str, Layer]:
    """Return layers by name; gains through walls are less spread."""
    through_walls = coverage is not None and coverage.attrs.get("walls") == "through walls"
    probability = Normalize(0.0, 1.0), "cividis", "probability"
    colours = ListedColormap([STATE_COLOURS[state] for state in sorted(LinkState)])
    layers = {
        "link_state": Layer("Most probable link state", _variable("link_state"), Normalize(0, 2), colours),
        "state_mixture": Layer(
            "Link state", lambda data: mix_state_colours(data["p_los"], data["p_nlos"], data["p_outage"])
        ),
        "gain_mean_db": Layer(
            "Mean path gain",
            _variable("gain_mean_db"),
            Normalize(*(_GAINS_THROUGH_WALLS_DB if through_walls else _GAINS_DB)),
            "viridis",
            "dB",
        ),
        "gain_std_db": Layer(
            "Std. dev. of the path gain", _variable("gain_std_db"), Normalize(0.0, 40.0), "magma_r", "dB"
        ),
        "p_above": Layer(
            f"P(path gain > {round(threshold_db, 1):g} dB)".replace("-", "\N{MINUS SIGN}"),
            lambda data: probability_above(data, threshold_db),
            *probability,
        ),
    }
    names = {"p_los": "P(LOS)", "p_nlos": "P(NLOS)", "p_outage": "P(outage)"}
    return layers | {name: Layer(title, _variable(name), *probability) for name, title in names.items()}


def _variable(name: str) -> Callable[[xr.Dataset], NDArray[Any]]:
    return lambda data: data[name].to_numpy()


def headline(what: str, maps: Mapping[str, xr.Dataset]) -> str:
    """Return a title: transmitters, frequency, walls and, for a partial map, receivers."""
    attributes = next(iter(maps.values())).attrs
    if attributes.get("receivers") == "indoor" and not attributes["map_complete"]:
        what = f"{what} for receivers that are indoors"
    walls = f", {attributes['walls']}" if "walls" in attributes else ""
    return f"{what}: {transmitter_text(maps)}, {attributes['frequency_hz'] / 1e9:g} GHz{walls}"
