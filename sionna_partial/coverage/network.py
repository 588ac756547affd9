"""Networks of several transmitters: best server, SINR and rate, with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.channels.joint import JointLatents
from sionna_partial.checks import number_of, require, require_names, require_type, require_whole
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.coverage.dataset import ANTENNA, TX_COORDINATES, transmitters_of
from sionna_partial.coverage.link_budget import LinkBudget, Scheme, schemes, transmit_powers_dbm
from sionna_partial.errors import SettingsError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.rule import LinkPrediction

MOST_DRAWS = 1_000
_RECEIVERS_AT_ONCE = 5_000
_LOWEST_SINR_DB = -60.0
_PLANNED_RECEIVERS, _PLAN_PASSES = 2_000, 8
"""Number of receivers by which channels are planned, and largest number of passes over the transmitters."""


def _described(long_name: str, units: str = "1") -> dict[str, str]:
    return {"long_name": long_name, "units": units}


VARIABLES = {
    "best_server": _described("number of the transmitter that is most probably the strongest, -1 for no receiver"),
    "p_best": _described("probability that this transmitter is the strongest"),
    "p_all_outage": _described("probability that all links are in outage"),
    "sinr_mean_db": _described("mean SINR of the strongest transmitter", "dB"),
    "sinr_p10_db": _described("10th percentile of the SINR", "dB"),
    "p_sinr_above": _described("probability that the SINR exceeds sinr_threshold_db"),
    "rate_bit_s": _described("mean Shannon rate", "bit/s"),
    "handover_margin_db": _described("mean lead of the strongest transmitter over the next", "dB"),
}
"""Variables on (y, x), `p_best` on (tx, y, x), and their attributes."""

_ATTRIBUTES = ("spacing_m", "bandwidth_hz", "load", "sinr_threshold_db")


def predict_network(
    coverage: xr.Dataset,
    *,
    tx_power_dbm: ArrayLike = 20.0,
    noise_figure_db: float = 7.0,
    bandwidth_hz: float = 100e6,
    load: float = 1.0,
    sinr_threshold_db: float = 0.0,
    channels: Mapping[str, Any] | Sequence[Any] | None = None,
    standard: str | None = None,
    n: int = 100,
    seed: int = 0,
) -> xr.Dataset:
    """Predict best server, SINR and rate of a network, from the coverage of its transmitters.

    Links are drawn jointly (`JointLatents`), because one unseen wall blocks several of them. In each draw a receiver is
    served by the strongest transmitter, and the others on its channel interfere: ``SINR = P_b / (N + load * sum of the
    other P)``, with P = transmit power x path gain and N = -174 dBm/Hz + 10 log10(bandwidth) + noise figure. The rate
    is bandwidth x log2(1 + SINR), or the rate of the fastest scheme of `standard` at that SINR. A receiver at a
    transmitter has 0 dB.

    Parameters
    ----------
    coverage : xarray.Dataset
        From `predict_map` with T transmitters.
    tx_power_dbm : float or (T,) array-like
        Transmit power [dBm].
    noise_figure_db : float
        Noise figure of the receivers [dB].
    bandwidth_hz : float
    load : float
        Fraction of time in which an interferer transmits, in [0, 1].
    sinr_threshold_db : float
        Threshold of `p_sinr_above` [dB].
    channels : mapping or sequence, optional
        Channel of each transmitter by its name: a plan; or the channels that there are, such as ``[1, 6, 11]``, from
        which a plan with a large mean rate is proposed. Different channels do not interfere. By default all share one.
    standard : {"wifi6", "wifi7", "nr"}, optional
        Standard of `rate_bit_s`, as in `coverage.radio.rate`; Shannon's bound by default.
    n : int
        Number of draws, at most 1,000.
    seed : int
        Seed of the draws.

    Returns
    -------
    xarray.Dataset
        The `VARIABLES` on (y, x), NaN where no receiver can be, and the coordinate `channel` on tx. SINRs below -60 dB
        count as -60 dB.

    Raises
    ------
    SettingsError
        For a coverage of one transmitter, a value out of range, channels for other transmitters, or a bandwidth or
        frequency that the standard lacks.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(7)
    >>> coverage = sp.predict_map(home, {"hall": (3.0, 4.0, 2.2), "desk": (6.0, 3.0, 1.0)}, spacing_m=0.5)
    >>> network = sp.predict_network(coverage, tx_power_dbm=20.0, bandwidth_hz=400e6)
    >>> network["best_server"].dims, network["sinr_mean_db"].units
    (('y', 'x'), 'dB')
    >>> sp.predict_network(coverage, channels=[1, 6, 11]).channel.values.tolist()
    ['1', '6']
    """
    if not isinstance(coverage, xr.Dataset) or "tx" not in coverage.dims:
        raise SettingsError("coverage has no dimension tx: give what predict_map returned for several transmitters.")
    transmitters_of(coverage)
    coverage = coverage.transpose("tx", "y", "x", ...)
    powers_dbm = transmit_powers_dbm(tx_power_dbm, coverage.sizes["tx"])
    budget = LinkBudget(noise_figure_db, bandwidth_hz, load, sinr_threshold_db)
    table = [] if standard is None else schemes(standard, bandwidth_hz, float(coverage.attrs["frequency_hz"]))
    require_whole("n", n, 2, MOST_DRAWS)
    require_whole("seed", seed, 0, 2**63)
    valid: Bools = np.any(coverage["valid"].to_numpy(), axis=0)
    if not valid.any():
        raise SettingsError("coverage has no position at which a receiver can stand: give a smaller spacing_m.")
    y, x = (axis[valid] for axis in np.meshgrid(coverage["y"], coverage["x"], indexing="ij"))
    rx_m = np.stack([x, y, np.full(len(x), float(coverage.attrs["rx_height_m"]))], axis=1)
    tx_m = np.stack([coverage[name].to_numpy() for name in TX_COORDINATES], axis=1)

    def column(name: str) -> Floats:
        """Return the values of a variable; a receiver at a transmitter has 0 dB."""
        values = coverage[name].to_numpy()[:, valid].astype(np.float64)
        return np.where(np.isnan(values), float(name == "p_los"), values)

    every = LinkPrediction.of_columns(column)
    plan = _channel_plan(coverage, channels, every.gain_mean_db + powers_dbm[:, None], budget)
    latents = JointLatents(_map_of(coverage))
    parts = []
    for start in range(0, len(rx_m), _RECEIVERS_AT_ONCE):
        here = slice(start, start + _RECEIVERS_AT_ONCE)
        gain_db = latents.draw(every.take((slice(None), here)), tx_m, rx_m[here], n, [seed])[1]
        received_dbm = np.where(gain_db > GAIN_FLOOR_DB, gain_db, -np.inf) + powers_dbm[:, None]
        parts.append(_statistics(received_dbm, budget, plan, table))
    found = {name: np.concatenate([part[name] for part in parts], axis=-1) for name in VARIABLES}
    _limit_outage(found, every.p_outage)
    coverage = coverage.assign_coords(channel=("tx", plan))
    settings = {"tx_power_dbm": powers_dbm, **asdict(budget), "draws": n, "seed": seed}
    network = _labelled(coverage, found, valid, settings)
    if standard is not None:
        network["rate_bit_s"].attrs["long_name"] = f"mean rate of {standard}, one spatial stream"
    return network


def require_network(network: xr.Dataset) -> None:
    remedy = "give what predict_network returned."
    require_type("network", network, xr.Dataset, remedy)
    wanted = {name: (("tx", "y", "x")[name != "p_best" :], "f") for name in VARIABLES}
    wanted["best_server"] = ("y", "x"), "i"
    wanted |= dict.fromkeys(("cell_state", "observed", "wall_parts"), (("y", "x"), "biu"))
    wanted |= {name: ((name.partition("_")[0],), "f") for name in ("x", "y", *TX_COORDINATES)}
    missing = ["tx"] if "tx" not in network.coords else []
    for name, (dims, kinds) in wanted.items():
        if name not in network or network[name].dims != dims or network[name].dtype.kind not in kinds:
            missing.append(name)
    missing += [name for name in _ATTRIBUTES if not math.isfinite(number_of(network.attrs.get(name)))]
    require(not missing and network["cell_state"].size > 0, "network without", missing, remedy)
    require_names("network.tx", [str(name) for name in network["tx"].to_numpy()])


def _map_of(coverage: xr.Dataset) -> PartialMap:
    spacing_m = float(coverage.attrs["spacing_m"])
    corner_m = (float(coverage["x"][0]) - spacing_m / 2, float(coverage["y"][0]) - spacing_m / 2)
    return PartialMap(coverage["cell_state"].to_numpy().astype(np.uint8), spacing_m, corner_m)


def _channel_plan(
    coverage: xr.Dataset, channels: Mapping[str, Any] | Sequence[Any] | None, mean_dbm: Floats, budget: LinkBudget
) -> list[str]:
    """Return the channel of each transmitter: as given, or that of the largest mean rate at mean powers (T, N)."""
    names = [str(name) for name in coverage["tx"].to_numpy()]
    if isinstance(channels, Mapping):
        remedy = f"give a channel to each of {', '.join(names)}, or a list of the channels that there are."
        require({*channels} == {*names}, "channels", channels, remedy)
        return [str(channels[name]) for name in names]
    if channels is None:
        return ["1"] * len(names)
    listed = isinstance(channels, Sequence) and not isinstance(channels, str) and len(channels) > 0
    require(listed, "channels", channels, "give a list, such as [1, 6, 11], or a channel for each transmitter.")
    free, some_mw = list(dict.fromkeys(map(str, channels))), 10.0 ** (mean_dbm[None] / 10.0)
    some_mw = some_mw[:, :, :: max(1, some_mw.shape[2] // _PLANNED_RECEIVERS)]
    plan, before = [free[number % len(free)] for number in range(len(names))], -math.inf
    for _ in range(_PLAN_PASSES):
        for number in range(len(names)):
            tried = [[*plan[:number], channel, *plan[number + 1 :]] for channel in free]
            rates = [float(np.log2(1.0 + _sinr(some_mw, budget, each)).mean()) for each in tried]
            plan = tried[int(np.argmax(rates))]
        if max(rates) <= before + 1e-9:
            break
        before = max(rates)
    return plan


def _sinr(power_mw: Floats, budget: LinkBudget, plan: Sequence[str]) -> Floats:
    """Return the SINR (n, N) of the strongest of T transmitters (n, T, N) on their channels."""
    best, shared = power_mw.argmax(axis=1), np.equal.outer(np.array(plan), np.array(plan)).astype(np.float64)
    on_channel_mw = np.take_along_axis(np.einsum("st,ntr->nsr", shared, power_mw), best[:, None], axis=1)[:, 0]
    best_mw = power_mw.max(axis=1)
    noise_mw = 10.0 ** (budget.noise_dbm / 10.0)
    return np.asarray(best_mw / (noise_mw + budget.load * np.maximum(on_channel_mw - best_mw, 0.0)))


def _statistics(
    received_dbm: Floats, budget: LinkBudget, plan: Sequence[str], table: Sequence[Scheme]
) -> dict[str, NDArray[Any]]:
    power_mw = 10.0 ** (received_dbm / 10.0)
    best_mw, best = power_mw.max(axis=1), power_mw.argmax(axis=1)
    received = best_mw > 0.0
    noise_mw = 10.0 ** (budget.noise_dbm / 10.0)
    sinr = _sinr(power_mw, budget, plan)
    with np.errstate(divide="ignore", invalid="ignore"):
        sinr_db = np.maximum(10.0 * np.log10(sinr), _LOWEST_SINR_DB)
        next_mw = np.sort(power_mw, axis=1)[:, -2] if power_mw.shape[1] > 1 else np.zeros_like(best_mw)
        margin_db = 10.0 * np.log10(best_mw / np.maximum(next_mw, noise_mw))
    rate_bit_s = budget.bandwidth_hz * np.log2(1.0 + sinr)
    if table:
        lowest_db, rates = np.array(table).T
        rate_bit_s = np.insert(rates, 0, 0.0)[np.searchsorted(lowest_db, sinr_db, side="right")]
    count = power_mw.shape[1]
    p_best = np.stack([((best == number) & received).mean(axis=0) for number in range(count)])
    return {
        "best_server": np.where(received.any(axis=0), p_best.argmax(axis=0), -1).astype(np.int16),
        "p_best": p_best,
        "p_all_outage": (~received).mean(axis=0),
        "sinr_mean_db": sinr_db.mean(axis=0),
        "sinr_p10_db": np.percentile(sinr_db, 10.0, axis=0),
        "p_sinr_above": (sinr_db > budget.sinr_threshold_db).mean(axis=0),
        "rate_bit_s": rate_bit_s.mean(axis=0),
        "handover_margin_db": np.where(received, np.maximum(margin_db, 0.0), 0.0).mean(axis=0),
    }


def _limit_outage(found: dict[str, NDArray[Any]], p_outage: Floats) -> None:
    """Remove the sampling error by which all links (T, N) are in outage more often than the best one."""
    excess = np.maximum(found["p_all_outage"] - p_outage.min(axis=0), 0.0)
    found["p_all_outage"] = found["p_all_outage"] - excess
    found["p_best"][p_outage.argmin(axis=0), np.arange(len(excess))] += excess


def _labelled(
    coverage: xr.Dataset, found: dict[str, NDArray[Any]], valid: Bools, settings: dict[str, Any]
) -> xr.Dataset:
    layers: dict[str, Any] = {}
    for name, values in found.items():
        whole = values.dtype.kind == "i"
        layer = np.full(
            (*values.shape[:-1], *valid.shape), -1 if whole else np.nan, values.dtype if whole else np.float32
        )
        layer[..., valid] = values
        layers[name] = (("tx", "y", "x")[3 - layer.ndim :], layer, VARIABLES[name])
    kept = coverage[["cell_state", "observed", "wall_parts"]]
    kept = kept.assign_coords(
        {name: coverage[name] for name in ("tx", "channel", *TX_COORDINATES, ANTENNA) if name in coverage.coords}
    )
    return kept.assign(layers).assign_attrs(title="Predicted network in a partially observed environment", **settings)
