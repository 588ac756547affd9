"""Newest coverage of a window, and the layers that the page shows."""

import math
from dataclasses import dataclass, field
from datetime import date
from typing import Any

import numpy as np
import xarray as xr

from sionna_partial.app.radio import RadioSettings
from sionna_partial.arrays import Floats
from sionna_partial.constants import GAIN_FLOOR_DB, CellState
from sionna_partial.coverage.link_budget import LinkBudget
from sionna_partial.prediction.predictor import LinkPrediction

LEVELS = ("power_mean_dbm", "gain_mean_db", "snr_mean_db")
"""Layers whose scales follow the threshold."""


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
        best = np.nan_to_num(power["power_mean_dbm"].to_numpy(), nan=-np.inf).argmax(axis=0)
        names = [str(each) for each in coverage["tx"].to_numpy()]
        at = xr.DataArray(best, dims=("y", "x")) if name not in names else names.index(name)
        one = every.isel(tx=at)
        threshold_db = np.clip(threshold_dbm - eirp_dbm, GAIN_FLOOR_DB, 0.0)[at]
        above = LinkPrediction.of_columns(lambda each: one[each].to_numpy()).probability_above(threshold_db)
        found: dict[str, Any] = {"p_above": (("y", "x"), above)}
        if self.network is not None:
            found |= {"best_server": (("y", "x"), best), "sinr_mean_db": self.network["sinr_mean_db"]}
        return one.assign(found)

    def thresholds(self, name: str, threshold_dbm: float) -> dict[str, float]:
        """Return the threshold by layer: received power [dBm], path gain and SNR of a transmitter [dB]."""
        names = [str(each) for each in self.coverage["tx"].to_numpy()]
        eirp_dbm = self.eirp_dbm[names.index(name)] if name in names else self.eirp_dbm.max()
        noise_dbm = LinkBudget(bandwidth_hz=self.settings.bandwidth_hz).noise_dbm
        offsets = 0.0, float(eirp_dbm), round(noise_dbm)
        return {name: threshold_dbm - offset for name, offset in zip(LEVELS, offsets, strict=True)}

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
