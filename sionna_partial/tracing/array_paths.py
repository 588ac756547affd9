"""Coefficients of traced paths between the antennas of two arrays."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.checks import require, require_bool
from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.antennas import Antennas
from sionna_partial.tracing.interactions import DIFFRACTION, DIFFUSE, REFLECTION
from sionna_partial.tracing.paths import SolvedPaths

BLOCK_BYTES = 4_000_000
"""Size of coefficients that are computed together, to fit caches [bytes]."""

UPRIGHT = 1e-3
"""Largest change of the direction's vertical part at a vertical edge."""

_log = logging.getLogger(__name__)


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
            delay_s = after_shortest(delay_s, first) if self.normalize_delays else delay_s
            gains, at_rx, at_tx = self.plane_waves(rows)
            left = (gains * self._carrier(delay_s.astype(np.float32)))[:, :, None, :] * at_rx[:, None, :, None]
            a = left[..., None] * at_tx[:, None, None, None, :]
        else:
            gains, longer_m = self._gains(rows)[:, :, None, :, None], self._longer_m(rows)
            spread = (1.0 / (1.0 + longer_m / (SPEED_OF_LIGHT_M_S * delay_s))).astype(np.complex64)
            delay_s = delay_s + longer_m / SPEED_OF_LIGHT_M_S
            delay_s = after_shortest(delay_s, first) if self.normalize_delays else delay_s
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


def after_shortest(delay_s: Floats, first: Indices) -> Floats:
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
