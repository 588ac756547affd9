"""Channel responses between antenna arrays: impulse and frequency responses, taps, spreads, beams."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Floats
from sionna_partial.checks import float_array, real_array, require, require_number, require_whole
from sionna_partial.constants import GAIN_FLOOR_DB, MEMORY_GB
from sionna_partial.errors import MemoryLimitError, SettingsError
from sionna_partial.tracing.antennas import Antennas
from sionna_partial.tracing.array_paths import ArrayPaths, after_shortest, phasors
from sionna_partial.tracing.paths import SolvedPaths, path_gain_db

WORK_BYTES = 100_000_000
"""Memory of functions of delays, or of beams, that are computed together [bytes]."""

FIRST_TAP, MORE_TAPS = -6, 6
"""Default first tap, and taps after the longest path: the sinc filter is 5 % at the sixth."""

PATHS_AT_ONCE = 20_000

_BEAM_BYTES, _PAIR_BYTES = 32, 48
"""Memory of a beam of a path, and of a pair of beams [bytes]."""

MAX_WEIGHT = 1e6
"""Largest magnitude of a weight: powers have single precision."""


def cir(arrays: ArrayPaths, memory_gb: float = MEMORY_GB) -> xr.Dataset:
    """See `TracedLinks.cir`."""
    pairs = len(arrays.rx) * len(arrays.tx)
    path_bytes = 8 * pairs + 8 * (1 if arrays.synthetic_array else pairs)
    what = f"{arrays.antennas} x {arrays.most} paths"
    require_memory(arrays, arrays.most * path_bytes, what, memory_gb, arrays.work_bytes)
    a, delay_s = arrays.empty(arrays.links)
    for block in arrays.blocks():
        block.fill(a[block.links], delay_s[block.links])
    every = ("link", "rx_ant", "tx_ant", "path")
    delay = ("link", "path") if arrays.synthetic_array else every
    variables = {
        "a": (every, np.moveaxis(a, 1, 3), _A),
        "delay_s": (delay, delay_s if arrays.synthetic_array else np.moveaxis(delay_s, 1, 3), _DELAY),
        "paths": ("link", np.diff(arrays.first), {"long_name": "number of paths", "units": "1"}),
    }
    return labelled(arrays, variables)


_A = {"long_name": "complex baseband gain of the path", "units": "1"}
_DELAY = {"long_name": "propagation delay, NaN where there is no path", "units": "s"}


def cfr(arrays: ArrayPaths, frequencies_hz: ArrayLike, memory_gb: float = MEMORY_GB) -> xr.Dataset:
    """See `TracedLinks.cfr`."""
    remedy = "give frequencies relative to the carrier [Hz], such as those of subcarriers: (F,) numbers."
    offsets_hz = float_array("frequencies_hz", frequencies_hz, SettingsError, remedy)
    carrier_hz = arrays.trace_settings.frequency_hz
    inside = offsets_hz.ndim == 1 and offsets_hz.size > 0 and bool((np.abs(offsets_hz) < carrier_hz).all())
    require(inside, "frequencies_hz", frequencies_hz, f"{remedy[:-1]} below the carrier of {carrier_hz:g} Hz.")

    def kernel(delay_s: Floats, some: slice) -> NDArray[Any]:
        return phasors(-2.0 * np.pi * delay_s[..., None] * offsets_hz[some])

    h = _filtered(arrays, kernel, len(offsets_hz), "frequencies", memory_gb)
    variables = {"h": (("link", "rx_ant", "tx_ant", "frequency"), h, {"long_name": "frequency response", "units": "1"})}
    attributes = {"long_name": "frequency relative to the carrier", "units": "Hz"}
    return labelled(arrays, variables).assign_coords(frequency=("frequency", offsets_hz, attributes))


def taps(
    arrays: ArrayPaths,
    bandwidth_hz: float,
    l_min: int = FIRST_TAP,
    l_max: int | None = None,
    memory_gb: float = MEMORY_GB,
) -> xr.Dataset:
    """See `TracedLinks.taps`."""
    require_number("bandwidth_hz", bandwidth_hz, 0.0, 1e12, open_low=True)
    if l_max is None:
        delay_s = np.asarray(arrays.paths.delay_s)[:, None, None]
        counted_s = after_shortest(delay_s, arrays.first) if arrays.normalize_delays else delay_s
        l_max = MORE_TAPS + math.ceil(bandwidth_hz * counted_s.max(initial=0.0))
    require_whole("l_min", l_min, -1_000_000, 1_000_000)
    require_whole("l_max", l_max, l_min, 1_000_000_000)

    def kernel(delay_s: Floats, some: slice) -> NDArray[Any]:
        tap = np.arange(l_min + some.start, l_min + some.stop)
        return np.sinc(tap - bandwidth_hz * delay_s[..., None]).astype(np.complex64)

    h = _filtered(arrays, kernel, l_max - l_min + 1, "taps", memory_gb)
    attributes = {"long_name": "channel tap", "units": "1"}
    table = labelled(arrays, {"h": (("link", "rx_ant", "tx_ant", "tap"), h, attributes)})
    return table.assign_coords(tap=np.arange(l_min, l_max + 1)).assign_attrs(bandwidth_hz=float(bandwidth_hz))


_VALUE_BYTES, _AXIS_BYTES = 48, 40
"""Memory of a value of a function of a delay, and of a value of an axis [bytes]."""


def _filtered(
    arrays: ArrayPaths, kernel: Callable[[Floats, slice], NDArray[Any]], size: int, what: str, memory_gb: float
) -> NDArray[np.complex64]:
    """Sum the paths of each link, weighted by `kernel` of delays: (links, A_rx, A_tx, size)."""
    pairs = len(arrays.rx) * len(arrays.tx)
    delays = max(1, arrays.most if arrays.synthetic_array else pairs)
    at_once = min(size, max(1, WORK_BYTES // (_VALUE_BYTES * delays)))
    work_bytes = arrays.work_bytes + _VALUE_BYTES * delays * at_once + _AXIS_BYTES * size
    require_memory(arrays, 8 * pairs * size, f"{arrays.antennas} x {size} {what}", memory_gb, work_bytes)
    h = np.zeros((arrays.links, len(arrays.rx), len(arrays.tx), size), np.complex64)
    parts = [slice(start, min(start + at_once, size)) for start in range(0, size, at_once)]
    for block in arrays.blocks():
        for link, (low, high) in enumerate(zip(block.first[:-1], block.first[1:], strict=True), block.links.start):
            for part in parts:
                if arrays.synthetic_array:
                    values = kernel(block.delay_s[low:high, 0, 0], part)
                    h[link, ..., part] = np.moveaxis(block.a[low:high], 0, 2) @ values
                    continue
                for a, delay_s in zip(block.a[low:high], block.delay_s[low:high], strict=True):
                    h[link, ..., part] += a[..., None] * kernel(delay_s, part)
    return h


def labelled(arrays: ArrayPaths, variables: dict[str, Any]) -> xr.Dataset:
    count, tx_m, metre = len(arrays.rx_m), arrays.tx_m, {"units": "m"}
    tx, rx = np.divmod(np.arange(arrays.links), max(1, count))
    positions = {"tx_m": (("link", "axis"), tx_m[tx], metre), "rx_m": (("link", "axis"), arrays.rx_m[rx], metre)}
    if any("tx_ant" in dims for dims, *_ in variables.values()):
        positions |= arrays.antenna_positions()
    attributes = {
        **{"frequency_hz": arrays.trace_settings.frequency_hz, "transmitters": len(tx_m), "receivers": count},
        "power_tolerance_db": arrays.trace_settings.power_tolerance_db,
        **{"synthetic_array": int(arrays.synthetic_array), "normalize_delays": int(arrays.normalize_delays)},
    }
    coordinates = {"tx": ("link", tx), "rx": ("link", rx), "axis": ["x", "y", "z"]}
    return xr.Dataset({**variables, **positions}, coords=coordinates, attrs=attributes)


def require_memory(arrays: ArrayPaths, link_bytes: int, what: str, memory_gb: float, work_bytes: int) -> None:
    require_number("memory_gb", memory_gb, 0.0, 1e6, open_low=True)
    size_gb = (arrays.links * link_bytes + work_bytes) / 1e9
    if size_gb > memory_gb:
        raise MemoryLimitError(
            f"memory_gb = {memory_gb:g} is too little for {arrays.links:,} links x {what}, which take {size_gb:,.1f} "
            "GB: give fewer of them, more memory_gb, or use save_channels, which needs memory for some links only."
        )


def spreads(paths: SolvedPaths, gain_db: Floats) -> xr.Dataset:
    """See `TracedLinks.spreads`."""
    link, power = paths.link(gain_db.shape[-1]), paths.power

    def total(values: Floats) -> Floats:
        return np.bincount(link, values, gain_db.size).astype(np.float64)

    with np.errstate(divide="ignore", invalid="ignore"):
        all_power = total(power)
        mean_s = total(power * paths.delay_s) / all_power
        delay_s = np.sqrt(total(power * (paths.delay_s - mean_s[link]) ** 2) / all_power)
        direct = total(power * paths.is_direct)
        k_factor_db = np.where(direct > 0.0, 10.0 * np.log10(direct / (all_power - direct).clip(0.0)), np.nan)

        def angular_rad(angle: Floats) -> Floats:
            length = np.hypot(total(power * np.cos(angle)), total(power * np.sin(angle))) / all_power
            return np.sqrt(-2.0 * np.log(length.clip(max=1.0)))

        angles = {
            f"{name}_{end}_spread_rad": angular_rad(values[:, column])
            for end, values in (("departure", paths.departure_rad), ("arrival", paths.arrival_rad))
            for column, name in enumerate(("zenith", "azimuth"))
        }
    values: dict[str, NDArray[Any]] = {
        "path_loss_db": np.where(all_power > 0.0, -gain_db.ravel(), np.nan),
        "k_factor_db": k_factor_db,
        "delay_spread_s": delay_s,
        **angles,
    }
    units = {name: name.rpartition("_")[2].replace("db", "dB") for name in values}
    table = {
        name: (("tx", "rx")[2 - gain_db.ndim :], each.reshape(gain_db.shape), {"units": units[name]})
        for name, each in values.items()
    }
    return xr.Dataset(table, attrs={"source": "3GPP TR 38.901, sections 7.5 and A.1"})


def beam_gains(
    arrays: ArrayPaths, codebook: ArrayLike, rx_codebook: ArrayLike | None, memory_gb: float = MEMORY_GB
) -> xr.Dataset:
    """See `TracedLinks.beam_gains`."""
    at_tx = _weights("codebook", codebook, arrays.tx)
    at_rx = _weights("rx_codebook", np.eye(len(arrays.rx)) if rx_codebook is None else rx_codebook, arrays.rx).conj()
    pairs = len(at_rx) * len(at_tx)
    terms = 4 if len(arrays.rx.patterns) > 1 else 1
    path_bytes = _BEAM_BYTES * terms * (len(at_rx) + len(at_tx))
    at_once = max(1, min(PATHS_AT_ONCE, WORK_BYTES // path_bytes))
    work_bytes = path_bytes * max(at_once, arrays.most) + _PAIR_BYTES * pairs
    require_memory(arrays, 4 * pairs, f"{pairs} pairs of beams", memory_gb, work_bytes)
    gain_db = np.full((arrays.links, len(at_rx), len(at_tx)), GAIN_FLOOR_DB, np.float32)
    best, margin_db = np.full((arrays.links, 2), -1), np.full(arrays.links, np.nan)
    for links, rows, first in arrays.spans(at_once):
        received, sent = _factors(arrays, rows, at_rx, at_tx)
        for link, (low, high) in enumerate(itertools.pairwise(first), links.start):
            if low == high:
                continue
            each = received[low:high].reshape(-1, len(at_rx)).T @ sent[low:high].reshape(-1, len(at_tx))
            power = np.maximum(each.astype(np.float64), 0.0)  # rounding
            gain_db[link], best[link] = path_gain_db(power), np.unravel_index(power.argmax(), power.shape)
            if pairs > 1:
                second, strongest = np.partition(path_gain_db(power.ravel()), -2)[-2:]
                margin_db[link] = strongest - second
    number = {"long_name": "number of the best beam, -1 for none", "units": "1"}
    variables = {
        "gain_db": (
            ("link", "rx_beam", "tx_beam"),
            gain_db,
            {"long_name": "path gain between beams", "units": "dB"},
        ),
        "best_rx_beam": ("link", best[:, 0], number),
        "best_tx_beam": ("link", best[:, 1], number),
        "margin_db": ("link", margin_db, {"long_name": "gain of the best pair over the next", "units": "dB"}),
    }
    return labelled(arrays, variables)


def _weights(name: str, codebook: ArrayLike, antennas: Antennas) -> NDArray[np.complex64]:
    count = len(antennas)
    remedy = f"give (beams, {count}) weights up to {MAX_WEIGHT:g}, one for each antenna, as dft_codebook does."
    weights = real_array(name, codebook, SettingsError, remedy, kinds="iufc")
    fits = weights.ndim == 2 and weights.shape[1:] == (count,) and len(weights) > 0
    require(fits, name, f"array of shape {weights.shape}", remedy)
    good = np.abs(weights.astype(np.complex128)) <= MAX_WEIGHT
    require(bool(good.all()), name, weights[~good][:1], remedy)
    return weights.reshape(len(weights), len(antennas.patterns), -1).astype(np.complex64)


def _factors(
    arrays: ArrayPaths, rows: slice, at_rx: NDArray[np.complex64], at_tx: NDArray[np.complex64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return factors of receive (P, M, B) and transmit beams (P, M, C): power is the sum of products over M.

    The power |sum_k u_k v_k|^2 over patterns k has the terms |u_k|^2 |v_k|^2 and, for two, 2 Re(u_1 u_2* v_1 v_2*).
    """
    gains, rx, tx = arrays.plane_waves(rows)
    received = np.stack([rx @ each.T for each in at_rx.swapaxes(0, 1)], axis=1)
    sent = gains @ np.stack([tx @ each.T for each in at_tx.swapaxes(0, 1)], axis=1)
    if received.shape[1] == 1:
        return np.abs(received) ** 2, np.abs(sent) ** 2
    cross = [math.sqrt(2.0) * each[:, 0] * each[:, 1].conj() for each in (received, sent)]
    return (
        np.concatenate([np.abs(received) ** 2, np.stack([cross[0].real, -cross[0].imag], axis=1)], axis=1),
        np.concatenate([np.abs(sent) ** 2, np.stack([cross[1].real, cross[1].imag], axis=1)], axis=1),
    )
