"""Beams: DFT codebooks, and the gain of every pair of beams of a link."""

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sionna_partial.channels.responses import ArrayPaths, labelled, phasors, require_memory
from sionna_partial.checks import real_array, require, require_whole
from sionna_partial.constants import MEMORY_GB, SPEED_OF_LIGHT_M_S
from sionna_partial.errors import SettingsError

if TYPE_CHECKING:
    from sionna_partial.tracing.links import ChannelPaths

MAX_ANTENNAS = 4096
"""Largest number of antennas of a codebook."""

PATHS_AT_ONCE = 20_000
"""Number of paths whose beams are computed together, which bounds the memory."""


def dft_codebook(rows: int, columns: int, polarisations: int = 1) -> NDArray[np.complex128]:
    """Return the beams of a planar array that are orthogonal to each other, as weights of its antennas.

    Parameters
    ----------
    rows, columns : int
        Those of the `sionna.rt.PlanarArray`, whose antennas are numbered column by column.
    polarisations : int
        2 for a dual-polarised array: beams of the first polarisation come first.

    Returns
    -------
    (polarisations * rows * columns, polarisations * rows * columns) complex128 array
        One beam of unit power in each row.

    Raises
    ------
    SettingsError
        For numbers that are none of an array.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.dft_codebook(8, 8).shape
    (64, 64)
    """
    for name, value in (("rows", rows), ("columns", columns)):
        require_whole(name, value, 1, MAX_ANTENNAS)
    require_whole("polarisations", polarisations, 1, 2)
    count = polarisations * rows * columns
    require(count <= MAX_ANTENNAS, "rows, columns", (rows, columns), f"give {MAX_ANTENNAS} antennas at most.")
    vertical, horizontal = (np.fft.fft(np.eye(size)) / np.sqrt(size) for size in (rows, columns))
    return np.kron(np.eye(polarisations), np.kron(horizontal, vertical))


def beam_gains(
    paths: "ChannelPaths",
    codebook: ArrayLike,
    rx_codebook: ArrayLike | None = None,
    *,
    memory_gb: float = MEMORY_GB,
    **options: Any,
) -> xr.Dataset:
    """Gains of pairs of beams (`TracedLinks.beam_gains`).

    A plane wave of a path excites a receive beam by u_k and a transmit beam by v_k, for each pattern k of the receiving
    antennas. The power |sum_k u_k v_k|^2 is a sum of products of a number of one beam and a number of the other, so
    that those of all pairs and paths of a link are one product of matrices.
    """
    arrays = ArrayPaths.of(paths, **options)
    at_tx = _weights("codebook", codebook, len(arrays.tx))
    at_rx = _weights("rx_codebook", np.eye(len(arrays.rx)) if rx_codebook is None else rx_codebook, len(arrays.rx))
    shape = arrays.links, len(at_rx), len(at_tx)
    require_memory(arrays, len(at_rx) * len(at_tx), "pairs of beams", memory_gb, each_bytes=4)
    gain = np.zeros(shape, np.float32)
    for start, stop, rows, first in arrays.chunks(PATHS_AT_ONCE):
        received, sent = _excitations(arrays, rows, at_rx, at_tx)
        for link, (low, high) in enumerate(zip(first[:-1], first[1:], strict=True), start):
            gain[link] = np.tensordot(received[low:high], sent[low:high], ((0, 1), (0, 1)))
    ranked = np.sort(gain.reshape(shape[0], -1), axis=1)[:, ::-1]
    best = np.stack(np.unravel_index(gain.reshape(shape[0], -1).argmax(axis=1), shape[1:]), axis=1)
    reached = ranked[:, 0] > 0.0
    ...
