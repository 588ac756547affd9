"""Channel responses between antenna arrays: impulse and frequency responses, taps, spreads, beams."""

import itertools
import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.checks import float_array, real_array, require, require_bool, require_number, require_whole
from sionna_partial.constants import GAIN_FLOOR_DB, MEMORY_GB, SPEED_OF_LIGHT_M_S
from sionna_partial.errors import MemoryLimitError, SettingsError
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.antennas import Antennas
from sionna_partial.tracing.interactions import DIFFRACTION, DIFFUSE, REFLECTION
from sionna_partial.tracing.paths import SolvedPaths, path_gain_db

_log = logging.getLogger(__name__)

BLOCK_BYTES = 4_000_000
"""Size of coefficients that are computed together, to fit caches [bytes]."""

WORK_BYTES = 100_000_000
"""Memory of functions of delays, or of beams, that are computed together [bytes]."""

UPRIGHT = 1e-3
"""Largest change of the direction's vertical part at a vertical edge."""

FIRST_TAP, MORE_TAPS = -6, 6
"""Default first tap, and taps after the longest path: the sinc filter is 5 % at the sixth."""

PATHS_AT_ONCE = 20_000

_BEAM_BYTES, _PAIR_BYTES = 32, 48
"""Memory of a beam of a path, and of a pair of beams [bytes]."""

MAX_WEIGHT = 1e6
"""Largest magnitude of a weight: powers have single precision."""


@dataclass(frozen=True)
class ArrayPaths:
    """Paths of all links between antenna arrays at `tx_m` (T, 3) and `rx_m` (N, 3)."""

    paths: SolvedPaths
    tx_m: Floats
    rx_m: Floats
    trace_settings: TraceSettings
    tx: Antennas
    rx: Antennas
    synthetic_array: bool
    normalize_delays: bool

    @classmethod
    def of(
        cls,
        paths: SolvedPaths,
        tx_m: Floats,
        rx_m: Floats,
        trace_settings: TraceSettings,
        *,
        tx_array: Any = None,
        rx_array: Any = None,
        tx_orientation_rad: ArrayLike | None = None,
        rx_orientation_rad: ArrayLike | None = None,
        synthetic_array: bool = True,
        normalize_delays: bool = True,
    ) -> "ArrayPaths":
        for name, value in (("synthetic_array", synthetic_array), ("normalize_delays", normalize_delays)):
            require_bool(name, value)
        if trace_settings.power_tolerance_db:
            _log_tolerance(trace_settings.power_tolerance_db)
        require(
            paths.transfer.shape[1:] == (2, 2),
            "transfer",
            paths.transfer.shape,
            "these paths were traced for one polarisation; trace the links with trace_links.",
        )
        frequency_hz = trace_settings.frequency_hz
        tx = Antennas.of("tx", tx_array, tx_orientation_rad, count=len(tx_m), frequency_hz=frequency_hz)
        rx = Antennas.of("rx", rx_array, rx_orientation_rad, count=len(rx_m), frequency_hz=frequency_hz)
        return cls(paths, tx_m, rx_m, trace_settings, tx, rx, synthetic_array, normalize_delays)

    @property
    def links(self) -> int:
        return len(self.tx_m) * len(self.rx_m)

    @property
    def antennas(self) -> str:
        return f"{len(self.rx)} x {len(self.tx)} antennas"

    @cached_property
    def first(self) -> Indices:
        """Return the first path of each link, and the number of paths: (links + 1,)."""
        return np.searchsorted(self.paths.link(len(self.rx_m)), np.arange(self.links + 1))

    @property
    def most(self) -> int:
        return int(np.diff(self.first).max(initial=0))

    @property
    def work_bytes(self) -> int:
        """Return the memory of the largest of the `blocks`."""
        coefficients = max(BLOCK_BYTES // 16, len(self.rx) * len(self.tx) * self.most)
        return coefficients * (32 if self.synthetic_array else 80)

    def antenna_positions(self) -> dict[str, Any]:
        """Return the positions of antennas relative to their end, before it is turned [m]."""
        metre = {"long_name": "antenna positions relative to the end, before it is turned", "units": "m"}
        sides = {"tx_ant": self.tx, "rx_ant": self.rx}
        return {f"{name}_m": ((name, "axis"), side.of_each_antenna_m, metre) for name, side in sides.items()}

    def empty(self, links: int) -> tuple[NDArray[np.complex64], Floats]:
        shape = links, self.most, len(self.rx), len(self.tx)
        return np.zeros(shape, np.complex64), np.full(shape[:2] if self.synthetic_array else shape, np.nan)

    def spans(self, paths_at_once: int) -> Iterator[tuple[slice, slice, Indices]]:
        """Yield slices of links and of their paths, and the first path of each link in the slice."""
        start = 0
        while start < self.links:
            stop = int(np.searchsorted(self.first, self.first[start] + paths_at_once, side="right")) - 1
            stop = min(max(stop, start + 1), self.links)
            rows = slice(int(self.first[start]), int(self.first[stop]))
            yield slice(start, stop), rows, self.first[start : stop + 1] - rows.start
            start = stop

    def blocks(self) -> Iterator["Block"]:
        for span in self.spans(max(1, BLOCK_BYTES // (16 * len(self.tx) * len(self.rx)))):
            yield self.block(*span)

    def block(self, links: slice, rows: slice, first: Indices) -> "Block":
        delay_s = np.asarray(self.paths.delay_s[rows])[:, None, None]
        if self.synthetic_array:
            delay_s = _after_shortest(delay_s, first) if self.normalize_delays else delay_s
            gains, at_rx, at_tx = self.plane_waves(rows)
            left = (gains * self._carrier(delay_s.astype(np.float32)))[:, :, None, :] * at_rx[:, None, :, None]
            a = left[..., None] * at_tx[:, None, None, None, :]
        else:
            gains, longer_m = self._gains(rows)[:, :, None, :, None], self._longer_m(rows)
            spread = (1.0 / (1.0 + longer_m / (SPEED_OF_LIGHT_M_S * delay_s))).astype(np.complex64)
            delay_s = delay_s + longer_m / SPEED_OF_LIGHT_M_S
            delay_s = _after_shortest(delay_s, first) if self.normalize_delays else delay_s
            a = gains * (spread * self._carrier(delay_s))[:, None, :, None, :]
            delay_s = np.tile(delay_s, (1, gains.shape[1], gains.shape[3]))
        return Block(links, first, a.reshape(len(a), len(self.rx), len(self.tx)), delay_s)

    def _carrier(self, delay_s: NDArray[np.floating[Any]]) -> NDArray[np.complex64]:
        """Return exp(-j 2 pi f delay); single precision is rounded as in Sionna RT."""
        per_second = delay_s.dtype.type(-2.0 * np.pi) * delay_s.dtype.type(self.trace_settings.frequency_hz)
        return phasors(per_second * delay_s)

    def plane_waves(self, rows: slice) -> tuple[NDArray[np.complex64], NDArray[np.complex64], NDArray[np.complex64]]:
        """Return gains between patterns (P, K_rx, K_tx), and phases at the antennas of both arrays."""
        radians = 2.0 * np.pi * self.trace_settings.frequency_hz / SPEED_OF_LIGHT_M_S
        at_rx, at_tx = (phasors(radians * each) for each in self._advances_m(rows))
        return self._gains(rows), at_rx, at_tx

    def _gains(self, rows: slice) -> NDArray[np.complex64]:
        each = self.paths
        at_rx = self.rx.fields(np.asarray(each.arrival_rad[rows]), each.path_rx[rows])
        at_tx = self.tx.fields(np.asarray(each.departure_rad[rows]), each.path_tx[rows])
        gains: NDArray[np.complex128] = at_rx.conj() @ each.transfer[rows] @ at_tx.transpose(0, 2, 1)
        return gains.astype(np.complex64)

    def _advances_m(self, rows: slice) -> tuple[Floats, Floats]:
        each = self.paths
        at_rx_m = self.rx.advance_m(np.asarray(each.arrival_rad[rows]), each.path_rx[rows])
        return at_rx_m, self.tx.advance_m(np.asarray(each.departure_rad[rows]), each.path_tx[rows])

    def _longer_m(self, rows: slice) -> Floats:
        """Return the extra length (P, A_rx, A_tx) [m] of paths between antennas over the centres.

        Reflected paths are straight from the image of the transmitter, paths over vertical edges in the unfolded half
        planes. Other edges and diffuse reflections keep their points.
        """
        unfolded, (at_rx_m, at_tx_m) = Unfolded.of(self, rows), self._advances_m(rows)
        rotations = self.rx.rotations(self.paths.path_rx[rows]), self.tx.rotations(self.paths.path_tx[rows])
        length_m = SPEED_OF_LIGHT_M_S * np.asarray(self.paths.delay_s[rows])[:, None, None]
        between = rotations[0].transpose(0, 2, 1) @ unfolded.before @ rotations[1]
        square = np.sum(self.rx.positions_m**2, axis=1)[:, None] + np.sum(self.tx.positions_m**2, axis=1)
        square = square - 2.0 * length_m * (at_rx_m[:, :, None] + at_tx_m[:, None, :])
        square -= 2.0 * (self.rx.positions_m @ between @ self.tx.positions_m.T)
        longer_m: Floats = np.sqrt(length_m**2 + square) - length_m
        split = np.flatnonzero(unfolded.split)
        if len(split):
            moved = [
                each[split if len(each) > 1 else slice(None)] @ antennas.positions_m.T
                for each, antennas in zip(rotations, (self.rx, self.tx), strict=True)
            ]
            longer_m[split] = unfolded.longer_at_edges_m(split, *moved)
        return longer_m


@cache
def _log_tolerance(tolerance_db: float) -> None:
    message = "channels lack paths that change powers by up to power_tolerance_db = %g dB: Simulation.with_every_path"
    _log.info("%s has all", message % tolerance_db)


def phasors(angle: NDArray[np.floating[Any]]) -> NDArray[np.complex64]:
    """Return exp(j angle) of angles [rad], reduced to a turn in their own precision."""
    turn = angle.dtype.type(2.0 * np.pi)
    angle = (angle - turn * np.floor(angle * (angle.dtype.type(1.0) / turn))).astype(np.float32)
    found = np.empty(angle.shape, np.complex64)
    found.real, found.imag = np.cos(angle), np.sin(angle)
    return found


def _after_shortest(delay_s: Floats, first: Indices) -> Floats:
    reached, count = np.flatnonzero(np.diff(first)), np.diff(first)
    if not len(reached):
        return delay_s
    shortest = np.minimum.reduceat(delay_s.min(axis=(1, 2)), first[reached])
    return delay_s - np.repeat(shortest, count[reached])[:, None, None]


@dataclass(frozen=True)
class Block:
    """Coefficients (P, A_rx, A_tx) of the paths of some links, and delays of that shape or (P, 1, 1).

    The paths of link i are `first[i]` to `first[i + 1]`.
    """

    links: slice
    first: Indices
    a: NDArray[np.complex64]
    delay_s: Floats

    def fill(self, a: NDArray[np.complex64], delay_s: Floats) -> None:
        count = np.diff(self.first)
        link = np.repeat(np.arange(len(count)), count)
        number = np.arange(len(link)) - np.repeat(self.first[:-1], count)
        a[link, number] = self.a
        delay_s[link, number] = self.delay_s[:, 0, 0] if delay_s.ndim == 2 else self.delay_s


@dataclass(frozen=True)
class Unfolded:
    """Displacements of both ends of P paths, with the reflections unfolded.

    `before` (P, 3, 3) maps displacements of the transmitter through all reflections, or up to the point where a path is
    `split` (P,): diffracted or scattered. From there `to_tx_m` and `to_rx_m` (P, 3) lead to the images of both ends;
    `after` maps displacements of the receiver; `upright` (P,): the edge is vertical.
    """

    before: Floats
    after: Floats
    to_tx_m: Floats
    to_rx_m: Floats
    split: Bools
    upright: Bools

    @classmethod
    def of(cls, arrays: ArrayPaths, rows: slice) -> "Unfolded":
        paths = arrays.paths
        types, vertices_m = np.asarray(paths.interactions[rows]), np.asarray(paths.vertices_m[rows])
        rx_m = arrays.rx_m[paths.path_rx[rows]]
        here_m, (count, depth) = arrays.tx_m[paths.path_tx[rows]], types.shape
        points_m = np.concatenate([vertices_m, rx_m[:, None]], axis=1)
        points_m = np.where(np.isnan(points_m), rx_m[:, None], points_m)
        mirrored, length_m = np.tile(np.eye(3), (count, 1, 1)), np.zeros(count)
        before, to_tx_m = mirrored.copy(), np.zeros((count, 3))
        split, upright, leaving = np.zeros(count, bool), np.zeros(count, bool), np.zeros((count, 3))
        for step in range(depth):
            along = points_m[:, step] - here_m
            leg_m = np.linalg.norm(along, axis=1)
            arriving = along / np.maximum(leg_m, 1e-9)[:, None]
            following = points_m[:, step + 1] - points_m[:, step]
            following /= np.maximum(np.linalg.norm(following, axis=1), 1e-9)[:, None]
            length_m += leg_m
            normal = following - arriving
            normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-9)[:, None]
            reflected = types[:, step] == REFLECTION
            mirrored[reflected] -= 2.0 * (normal[reflected, :, None] * (normal[reflected, None] @ mirrored[reflected]))
            new = np.isin(types[:, step], (DIFFRACTION, DIFFUSE))
            fresh = new & ~split
            before[fresh], to_tx_m[fresh] = mirrored[fresh], -(length_m[:, None] * arriving)[fresh]
            upright |= fresh & (types[:, step] == DIFFRACTION) & (np.abs(following - arriving)[:, 2] < UPRIGHT)
            upright &= ~(new & split)
            split |= new
            mirrored[new], length_m[new], leaving[new] = np.eye(3), 0.0, following[new]
            here_m = points_m[:, step]
        length_m += np.linalg.norm(rx_m - here_m, axis=1)
        before[~split] = mirrored[~split]
        return cls(before, mirrored.transpose(0, 2, 1), to_tx_m, length_m[:, None] * leaving, split, upright)

    def longer_at_edges_m(self, split: Indices, rx_moved_m: Floats, tx_moved_m: Floats) -> Floats:
        """Return the extra length (P, A_rx, A_tx) [m] of paths `split` for displaced ends."""

        def from_edge(to_m: Floats, moved_m: Floats) -> tuple[Any, Any]:
            x, y, z = np.moveaxis(to_m[split, :, None] + moved_m, 1, 0)
            upright = self.upright[split, None]
            return np.hypot(np.hypot(x, y), np.where(upright, 0.0, z)), np.where(upright, z, 0.0)

        def length_m(rx_moved_m: Floats, tx_moved_m: Floats) -> Floats:
            rx_away, rx_z = from_edge(self.to_rx_m, self.after[split] @ rx_moved_m)
            tx_away, tx_z = from_edge(self.to_tx_m, self.before[split] @ tx_moved_m)
            return np.hypot(rx_away[:, :, None] + tx_away[:, None, :], rx_z[:, :, None] - tx_z[:, None, :])

        still = np.zeros((1, 3, 1))
        return length_m(rx_moved_m, tx_moved_m) - length_m(still, still)


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
        counted_s = _after_shortest(delay_s, arrays.first) if arrays.normalize_delays else delay_s
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
