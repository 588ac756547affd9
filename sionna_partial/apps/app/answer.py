"""Newest coverage of a window, and the layers that the page shows."""

import math
from dataclasses import dataclass, field, replace
from datetime import date
from typing import Any

import numpy as np
import xarray as xr

from sionna_partial.apps.app.drawing import Plan
from sionna_partial.apps.app.marks import Marks
from sionna_partial.apps.app.radio import MOST_TRANSMITTERS, RadioSettings
from sionna_partial.arrays import Floats
from sionna_partial.checks import Checked, require_choice
from sionna_partial.constants import GAIN_FLOOR_DB, CellState
from sionna_partial.coverage.dataset import OFFSET
from sionna_partial.coverage.link_budget import LinkBudget
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.coverage_plot import plot_layer
from sionna_partial.plots.coverage_viewer import STATES, level_codes, radio_layers, server_codes, step_codes
from sionna_partial.plots.layers import Scale
from sionna_partial.plots.panel import Outline
from sionna_partial.plots.report import LIKELY
from sionna_partial.plots.style import STATE_COLOURS, figure_png
from sionna_partial.prediction.rule import LinkPrediction

OUTLINES = {"p_above": f"where P = {LIKELY:g}", "power_mean_dbm": "where the mean is", "": "none"}
"""Layers with a line at the threshold."""

LAYERS = radio_layers(MOST_TRANSMITTERS)

NETWORK_LAYERS = ("sinr_mean_db", "best_server")
"""Layers of several transmitters alone."""

RATE = "rate_mbit_s"
"""Layer of frequencies and bandwidths that a standard has."""

LEVELS = ("power_mean_dbm", "gain_mean_db", "snr_mean_db")
"""Layers whose scales follow the threshold."""

_STEP_DB, _BELOW, _ABOVE = 5.0, 6, 8
"""Steps of scales [dB], and their number below and above the threshold."""

_RATE_STEPS = 10


@dataclass(frozen=True)
class View(Checked):
    """Choice of a picture: layer, transmitter ("" is the strongest), the whole home, and the line at the threshold."""

    layer: str = "p_above"
    transmitter: str = ""
    truth: bool = False
    outline: str = "p_above"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("layer", self.layer, LAYERS)
        require_choice("outline", self.outline, OUTLINES)


@dataclass(frozen=True, eq=False)
class Answer:
    """Coverage (tx, y, x), SINR of several transmitters, and the coverage of the whole home where it is known."""

    coverage: xr.Dataset
    eirp_dbm: Floats
    settings: RadioSettings
    is_final: bool
    network: xr.Dataset | None = None
    truth: xr.Dataset | None = None
    made: date = field(default_factory=date.today)

    def layers_of(self, name: str, threshold_dbm: float, *, truth: bool = False) -> xr.Dataset:
        """Return `p_above` and the other layers (y, x) of a transmitter, or of the strongest for ""."""
        coverage = self.truth if truth and self.truth is not None else self.coverage
        radio, eirp_dbm = coverage.radio, self.eirp_dbm
        power = radio.power(eirp_dbm=eirp_dbm)
        snr = radio.snr(eirp_dbm=eirp_dbm, bandwidth_hz=self.settings.bandwidth_hz)
        every = coverage.assign(power.data_vars).assign(snr.data_vars)
        best = np.nan_to_num(power["power_mean_dbm"].to_numpy(), nan=-np.inf).argmax(axis=0)  # strongest on average
        names = [str(each) for each in coverage["tx"].to_numpy()]
        at = xr.DataArray(best, dims=("y", "x")) if name not in names else names.index(name)
        one = every.isel(tx=at)
        threshold_db = np.clip(threshold_dbm - eirp_dbm, GAIN_FLOOR_DB, 0.0)[:, None, None]
        above = LinkPrediction.of_columns(lambda each: coverage[each].to_numpy()).probability_above(threshold_db)
        above = above[names.index(name)] if name in names else np.fmax.reduce(above, axis=0)  # of any transmitter
        found: dict[str, Any] = {"p_above": (("y", "x"), above)}
        standard, _ = self.settings.schemes
        if standard and len(names) == 1:
            rate = radio.rate(standard, eirp_dbm=eirp_dbm, bandwidth_hz=self.settings.bandwidth_hz)
            found[RATE] = rate.isel(tx=0, drop=True) / 1e6
        if self.network is not None:
            found |= {RATE: self.network["rate_bit_s"] / 1e6} if standard else {}
            found |= {"best_server": (("y", "x"), best), "sinr_mean_db": self.network["sinr_mean_db"]}
        return one.assign(found)

    def scale(self, layer: str, name: str, threshold_dbm: float) -> Scale | None:
        """Return the scale of a layer in steps, None for others.

        Levels [dBm or dB] have steps of 5 dB, whose colours break at the threshold.
        """
        names = [str(each) for each in self.coverage["tx"].to_numpy()]
        if layer == "best_server":
            codes = server_codes(MOST_TRANSMITTERS)[: len(names)]
            return Scale(codes, -0.5, len(names) - 0.5, [*range(len(names))], names, LAYERS[layer].title)
        if layer == "link_state":
            codes = [STATE_COLOURS[state] for state in sorted(STATE_COLOURS)]
            return Scale(codes, -0.5, len(codes) - 0.5, [*range(len(codes))], STATES, LAYERS[layer].title)
        standard, table = self.settings.schemes
        if layer == RATE and table:
            ticks = np.linspace(0.0, table[-1].rate_bit_s / 1e6, _RATE_STEPS + 1).tolist()
            title = f"Mbit/s; {standard}, one spatial stream"
            return Scale(step_codes(_RATE_STEPS), 0.0, ticks[-1], ticks, [f"{tick:.0f}" for tick in ticks], title)
        if layer not in LEVELS:
            return None
        eirp_dbm = self.eirp_dbm[names.index(name)] if name in names else self.eirp_dbm.max()
        noise_dbm = LinkBudget(bandwidth_hz=self.settings.bandwidth_hz).noise_dbm
        threshold = threshold_dbm - (0.0, float(eirp_dbm), round(noise_dbm))[LEVELS.index(layer)]
        low, high = threshold - _BELOW * _STEP_DB, threshold + _ABOVE * _STEP_DB
        ticks = np.arange(low, high + 1.0, 2.0 * _STEP_DB).tolist()
        title = f"{LAYERS[layer].label.partition(';')[0]}; colours break at {threshold:g}"
        return Scale(level_codes(_BELOW, _ABOVE), low, high, ticks, [f"{tick:g}" for tick in ticks], title)

    def title(self, view: View, threshold_dbm: float) -> str:
        """Return the title of a picture: layer, transmitter, and of which map it is."""
        title = LAYERS[view.layer].title.replace("threshold", f"{threshold_dbm:g} dBm")
        if view.transmitter or len(self.eirp_dbm) > 1:
            of_all = "any transmitter" if view.layer == "p_above" else "the strongest transmitter"
            title += f", {view.transmitter or of_all}" if view.layer not in (*NETWORK_LAYERS, RATE) else ""
        if not self.is_final:
            return f"{title} (coarse)"
        return title + (", the whole home" if self.truth is not None else ", the partial map") * view.truth

    def outline(self, view: View, one: xr.Dataset, threshold_dbm: float) -> Outline | None:
        """Return the line at the threshold, for the layers of `layers_of`."""
        if not view.outline:
            return None
        values = one[view.outline].to_numpy()
        if view.outline == "p_above":
            return Outline(values, LIKELY, f"P = {LIKELY:g}", f"P(> {threshold_dbm:g} dBm) < {LIKELY:g}")
        return Outline(values, threshold_dbm, f"{threshold_dbm:g} dBm", f"mean below {threshold_dbm:g} dBm")

    def agreement(self) -> tuple[float, float] | None:
        """Return the fraction of correct link states on the free floor, and the RMSE of the gain [dB]."""
        if self.truth is None:
            return None
        here = (self.truth["valid"] & self.coverage["valid"]).to_numpy() == 1
        here &= self.truth["cell_state"].to_numpy() == CellState.FREE
        states, gains_db = (
            [each[name].to_numpy()[here] for each in (self.coverage, self.truth)]
            for name in ("link_state", "gain_mean_db")
        )
        if not here.any():
            return None
        return float((states[0] == states[1]).mean()), math.sqrt(float(np.mean((gains_db[0] - gains_db[1]) ** 2)))


def measured_powers_dbm(answer: Answer | None) -> list[tuple[str, float]]:
    """Return the power that fits the measured powers of each measured transmitter [dBm]."""
    if answer is None or OFFSET not in answer.coverage.coords:
        return []
    powers_dbm = answer.coverage[OFFSET].to_numpy().tolist()
    pairs = zip(map(str, answer.coverage["tx"].to_numpy()), powers_dbm, strict=True)
    return [(name, power_dbm) for name, power_dbm in pairs if math.isfinite(power_dbm)]


def answer_png(
    answer: Answer,
    view: View,
    threshold_dbm: float,
    partial: PartialMap,
    title: str,
    plan: Plan | None = None,
    marks: Marks | None = None,
) -> bytes:
    """Return the picture of the page as PNG, with the floor plan and the marks that it shows."""
    name = view.transmitter
    one = answer.layers_of(name, threshold_dbm, truth=view.truth)
    layer, scale = LAYERS[view.layer], answer.scale(view.layer, name, threshold_dbm)
    layer = scale.of(layer) if scale else layer
    layer = replace(layer, title=answer.title(view, threshold_dbm))
    outline, drawn = answer.outline(view, one, threshold_dbm), None if plan is None else (plan.shade, plan.size_m)
    figure = plot_layer(answer.coverage, one, layer, outline, partial, title, drawn, marks.draw if marks else None)
    return figure_png(figure)
