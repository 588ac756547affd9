"""Beams: the gain of every pair of beams of a link."""

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sionna_partial.channels.responses import WORK_BYTES, ArrayPaths, labelled, require_memory
from sionna_partial.checks import real_array, require
from sionna_partial.constants import GAIN_FLOOR_DB, MEMORY_GB
from sionna_partial.errors import SettingsError
from sionna_partial.tracing.antennas import Antennas
from sionna_partial.tracing.links import path_gain_db

if TYPE_CHECKING:
    from sionna_partial.tracing.links import TracedLinks

PATHS_AT_ONCE = 20_000
"""Number of paths whose beams are computed together at most, in no more than `WORK_BYTES`."""

_BEAM_BYTES, _PAIR_BYTES = 32, 48
"""Memory of a beam of a path, and of a pair of beams of a link, while they are computed [bytes]."""

MAX_WEIGHT = 1e6
"""Largest magnitude of a weight: powers are of single precision."""


def beam_gains(
    paths: "TracedLinks",
    codebook: ArrayLike,
    rx_codebook: ArrayLike | None = None,
    *,
    memory_gb: float = MEMORY_GB,
    **antennas: Any,
) -> xr.Dataset:
    """Gains of pairs of beams (`TracedLinks.beam_gains`)."""
    arrays = ArrayPaths.of(paths, **antennas)
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
    """Weights (beams, patterns, positions) of a codebook (beams, antennas)."""
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
    """Numbers of receive beams (P, M, B) and of transmit beams (P, M, C) whose products, over M, are powers of paths.

    A path excites a beam by u_k at the receiver and v_k at the transmitter, for each pattern k of the receiver. The
    power |sum_k u_k v_k|^2 has the terms |u_k|^2 |v_k|^2, and for two patterns 2 Re(u_1 u_2* v_1 v_2*).
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
