"""Candidates of paths, and paths that Sionna RT has verified."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices, States
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.tracing.interactions import REFLECTION, REFRACTION

SHORTEST_LEG_M = 0.0101
"""Sionna RT drops paths with legs of 1 cm or less [m]."""

SEEN_M = 1e-3
"""Largest unobserved length of a path in observed space [m]."""


@dataclass(frozen=True)
class SolvedPaths:
    """Verified paths in scene coordinates (fields as in `TracedLinks`; D may be less).

    `transfer` is (P, 1, 1) for vertically polarised antennas alone.
    """

    path_tx: NDArray[np.int32]
    path_rx: NDArray[np.int32]
    transfer: NDArray[np.complex128]
    delay_s: Floats
    departure_rad: Floats
    arrival_rad: Floats
    interactions: NDArray[np.uint8]
    vertices_m: NDArray[Any]

    @property
    def a(self) -> NDArray[np.complex128]:
        return self.transfer[:, 0, 0]

    @property
    def power(self) -> Floats:
        power: Floats = np.abs(self.a) ** 2
        return power

    @property
    def is_direct(self) -> Bools:
        return (self.interactions == 0).all(axis=1)

    def link(self, receivers: int) -> NDArray[np.int64]:
        """Return the index (P,) of the link of each path among (T, receivers) links."""
        return self.path_tx.astype(np.int64) * receivers + self.path_rx

    def take(self, index: NDArray[Any]) -> "SolvedPaths":
        return replace(self, **{name: column[index] for name, column in vars(self).items()})

    def between(self, tx: int, rx: NDArray[np.int32]) -> "SolvedPaths":
        return replace(self, path_tx=np.full(len(self.a), tx, np.int32), path_rx=rx[self.path_rx])

    @classmethod
    def concatenate(cls, parts: Sequence["SolvedPaths"], depth: int) -> "SolvedPaths":
        parts = [join_paths([], depth), *parts]
        columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(cls)}
        for name, value in (("interactions", 0), ("vertices_m", math.nan)):
            columns[name] = [widened(column, max(1, depth), value) for column in columns[name]]
        return cls(**{name: np.concatenate(column) for name, column in columns.items()})

    @classmethod
    def of_vertices(
        cls,
        path_rx: NDArray[np.int32],
        transfer: NDArray[np.complex128],
        delay_s: Floats,
        interactions: NDArray[np.uint8],
        vertices_m: NDArray[Any],
        *,
        tx_m: Floats,
        rx_m: Floats,
    ) -> "SolvedPaths":
        """Make paths of one transmitter from vertices that are NaN where there is no interaction."""
        vertices_m = np.where(interactions[:, :, None] > 0, vertices_m, np.float32(math.nan))
        count = (interactions > 0).sum(axis=1)
        direct = (count == 0)[:, None]
        first, last = vertices_m[:, 0], vertices_m[np.arange(len(count)), np.maximum(count, 1) - 1]
        return cls(
            path_tx=np.zeros(len(transfer), np.int32),
            path_rx=path_rx,
            transfer=transfer,
            delay_s=delay_s,
            departure_rad=zenith_azimuth(np.where(direct, rx_m[path_rx], first) - tx_m),
            arrival_rad=zenith_azimuth(np.where(direct, tx_m, last) - rx_m[path_rx]),
            interactions=interactions,
            vertices_m=vertices_m,
        )


@dataclass(frozen=True)
class LocatedPaths(SolvedPaths):
    """Verified paths with their lengths in unobserved space, `unobserved_m` (P,), 0 for direct paths."""

    unobserved_m: Floats


class PathColumns:
    """Paths of a trace in columns that grow in place, so that memory holds the paths once."""

    def __init__(self, depth: int, polarisations: int = 1) -> None:
        types = _column_types(depth, polarisations)
        self._columns: dict[str, NDArray[Any]] = {
            name: np.zeros((0, *shape), kind) for name, (shape, kind) in types.items()
        }

    def append(self, parts: list[SolvedPaths]) -> None:
        order = path_order(parts)
        row, start = np.empty(len(order), np.int64), len(self._columns["path_rx"])
        row[order] = start + np.arange(len(order))
        for name, column in self._columns.items():
            column.resize((start + len(order), *column.shape[1:]), refcheck=False)
            if name == "vertices_m":
                column[start:] = math.nan
            first = 0
            for values in (getattr(part, name) for part in parts):
                at = row[first : first + len(values)]
                column[at if values.shape[1:] == column.shape[1:] else (at, slice(0, values.shape[1]))] = values
                first += len(values)

    def paths(self) -> SolvedPaths:
        for column in self._columns.values():
            column.setflags(write=False)
        return SolvedPaths(**self._columns)


class PathFiles:
    """Paths of a trace in a folder, a `.npy` file for each column, which `TracedLinks` maps into memory."""

    def __init__(self, depth: int, folder: Path, polarisations: int) -> None:
        self._folder, self._count, self._room = folder, 0, (depth, polarisations)
        for name in _column_types(*self._room):
            self._file(name).touch()
        self.close()

    def append(self, parts: list[SolvedPaths]) -> None:
        joined = join_paths(parts, *self._room)
        self._count += len(joined.a)
        for name in _column_types(*self._room):
            with self._file(name).open("ab") as stream:
                getattr(joined, name).tofile(stream)

    def close(self) -> None:
        """Write the headers, whose length does not depend on the number of paths."""
        for name, (shape, kind) in _column_types(*self._room).items():
            header = {"descr": np.dtype(kind).str, "fortran_order": False, "shape": (self._count, *shape)}
            with self._file(name).open("r+b") as stream:
                np.lib.format.write_array_header_1_0(stream, header)

    def _file(self, name: str) -> Path:
        return self._folder / f"{name}.npy"


def widened(columns: NDArray[Any], depth: int, value: float) -> NDArray[Any]:
    """Pad columns (P, d, ...) to the depth D: (P, D, ...)."""
    wide = np.full((len(columns), depth, *columns.shape[2:]), value, dtype=columns.dtype)
    wide[:, : columns.shape[1]] = columns
    return wide


def _column_types(depth: int, polarisations: int) -> dict[str, tuple[tuple[int, ...], type]]:
    shape = {"interactions": (depth,), "vertices_m": (depth, 3), "departure_rad": (2,), "arrival_rad": (2,)}
    shape["transfer"] = (polarisations, polarisations)
    kind = {"path_tx": np.int32, "path_rx": np.int32, "transfer": np.complex128, "interactions": np.uint8}
    return {field.name: (shape.get(field.name, ()), kind.get(field.name, np.float64)) for field in fields(SolvedPaths)}


def path_bytes(depth: int, polarisations: int) -> int:
    types = _column_types(depth, polarisations).values()
    return sum(math.prod(shape) * np.dtype(kind).itemsize for shape, kind in types)


def join_paths(parts: list[SolvedPaths], max_depth: int, polarisations: int = 1) -> SolvedPaths:
    """Join lists of paths, ordered by transmitter, receiver and delay."""
    columns = PathColumns(max(1, max_depth), polarisations)
    columns.append(parts)
    return columns.paths()


def path_order(parts: list[SolvedPaths]) -> NDArray[np.int64]:
    """Return the order of paths by transmitter, receiver and delay; Sionna RT's delays have single precision."""
    if not parts:
        return np.zeros(0, np.int64)
    tx, rx, delay_s = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("path_tx", "path_rx", "delay_s")
    )
    link = tx.astype(np.uint64) * np.uint64(int(rx.max(initial=0)) + 1) + rx.astype(np.uint64)
    return np.argsort(link << np.uint64(32) | delay_s.astype(np.float32).view(np.uint32), kind="stable")


def zenith_azimuth(direction: Floats) -> Floats:
    x, y, z = direction.T
    return np.stack([np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)], axis=1)


@dataclass(frozen=True)
class Wedges:
    """W vertical edges, each with the two faces that bound the room around it.

    Walls bound sectors around an edge. Walls hide directions from each other only in a sector wider than a half-plane,
    so an edge diffracts in one sector at most; where three or more walls meet, mostly in none. A free end of a wall has
    both sides as faces. In candidates, wedge W + i is wedge i with its faces swapped.

    `edge_m` (W, 2) are positions in the plan; edges rise from 0 to `height_m` (W,) [m]. `face` (2 W, 2) are 0-face and
    n-face, where the sector of wedge i < W ends counterclockwise; `normal` (2 W, 2, 2) are their unit normals into the
    sector.
    """

    edge_m: Floats
    height_m: Floats
    face: NDArray[np.int32]
    normal: Floats


@dataclass(frozen=True)
class Candidates:
    """C geometrically possible paths, to be verified.

    `rx` (C,) are receivers, `kind` (C, D) Sionna RT's `InteractionType` in order from the transmitter, 0 for none,
    `vertices_m` (C, D, 3) points [m]. `face` (C, D) counts through the scene's shapes, -1 for none: any face of a plane
    represents all, the 0-face an edge. `wedge` (C,) are numbers in `wedges`, if all candidates are diffracted.
    `same_wall` (C, D), if any goes through walls, marks refractions at further faces of a crossed wall, which cost
    nothing.
    """

    rx: NDArray[np.int32]
    kind: NDArray[np.uint8]
    face: NDArray[np.int32]
    vertices_m: Floats
    wedge: NDArray[np.int32] | None = None
    wedges: Wedges | None = None
    same_wall: Bools | None = None

    def is_like(self, other: "Candidates") -> bool:
        same = self.face.shape[1] == other.face.shape[1] and self.wedges is other.wedges
        return same and (self.same_wall is None) == (other.same_wall is None)

    @property
    def columns(self) -> dict[str, Any]:
        """Arrays that are not None, by name."""
        arrays = {name: value for name, value in vars(self).items() if name != "wedges"}
        return {name: array for name, array in arrays.items() if array is not None}

    @classmethod
    def concatenate(cls, parts: list["Candidates"]) -> "Candidates":
        joined: dict[str, Any] = {
            name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns
        }
        return replace(parts[0], **joined)

    def widened(self, depth: int) -> "Candidates":
        nothing = {"kind": 0, "face": -1, "vertices_m": 0.0, "same_wall": 0}
        wide: dict[str, Any] = {
            name: widened(array, depth, nothing[name]) for name, array in self.columns.items() if name in nothing
        }
        return replace(self, **wide)

    def narrowed(self) -> "Candidates":
        used = max(1, int((self.kind > 0).sum(axis=1).max(initial=0)))
        return replace(self, **{name: array[:, :used] for name, array in self.columns.items() if array.ndim > 1})

    def rows(self, index: Indices) -> "Candidates":
        return replace(self, **{name: array[index] for name, array in self.columns.items()})


def path_gain_db(power: Floats) -> Floats:
    """Return the omnidirectional path gain [dB], at least -150, for a sum of |a|^2 (paper, eq. 5)."""
    with np.errstate(divide="ignore"):
        return np.maximum(10.0 * np.log10(power), GAIN_FLOOR_DB)


class LinkSums:
    """Power of links (T, N) and line of sight, added up over blocks of paths.

    `path_power` (T N, ...) is by walls crossed, of one class or two, and reflections, up to the numbers `most`; the
    last entries include larger numbers.
    """

    def __init__(self, transmitters: int, receivers: int, *most: int) -> None:
        self._shape = transmitters, receivers
        self.path_power = np.zeros((transmitters * receivers, *(count + 1 for count in most)))
        self._is_direct = np.zeros(transmitters * receivers, dtype=bool)

    @property
    def power(self) -> Floats:
        """Power of each link (T N,)."""
        power: Floats = self.path_power.sum(axis=tuple(range(1, self.path_power.ndim)))
        return power

    def add(self, paths: SolvedPaths, classes: NDArray[np.uint8] | None = None) -> None:
        """Add paths; `classes` (P, D) are from `PartialMap.wall_classes`."""
        link, sizes = paths.link(self._shape[1]), self.path_power.shape[1:]
        counted = () if classes is None else unnamed_counts(paths.interactions, classes, len(sizes) - 1)
        counts = (np.minimum(count, size - 1) for count, size in zip(counted, sizes, strict=True))
        np.add.at(self.path_power, (link, *counts), paths.power)
        self._is_direct[link[paths.is_direct]] = True

    def states_and_gains(self) -> tuple[States, Floats]:
        """Return link state and path gain [dB] (T, N)."""
        gain_db = path_gain_db(self.power)
        link_state = np.where(gain_db > GAIN_FLOOR_DB, LinkState.NLOS, LinkState.OUTAGE).astype(np.uint8)
        link_state[self._is_direct] = LinkState.LOS
        return link_state.reshape(self._shape), gain_db.reshape(self._shape)


def unnamed_counts(interactions: NDArray[np.uint8], classes: NDArray[np.uint8], walls: int = 2) -> list[Indices]:
    """Count the crossings of walls of each class and the reflections (P,) at walls of unnamed materials."""
    at = [(interactions == REFRACTION) & (classes == number) for number in range(1, walls + 1)]
    return [np.count_nonzero(mask, axis=1) for mask in (*at, (interactions == REFLECTION) & (classes > 0))]
