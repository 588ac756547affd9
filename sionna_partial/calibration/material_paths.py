"""The paths of measured links as functions of the materials: traced once, evaluated by Sionna RT for any material.

The image method verifies the paths once. Their places do not depend on the materials, so that the field calculator
alone gives their power for other ones: all transmitters together, in some hundredths of a second.
"""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.files import temporary_folder
from sionna_partial.prediction.link_context import path_unobserved_m
from sionna_partial.tracing.candidates import Candidates
from sionna_partial.tracing.engine import SceneSolver, Variables, VerifiedPaths, forward_passes
from sionna_partial.tracing.finder import write_scene_of
from sionna_partial.tracing.fixed_paths import PATHS_PER_BLOCK, PathScene
from sionna_partial.tracing.slab import VACUUM_F_M
from sionna_partial.tracing.trace import Progress

KEPT_SHARE = 0.96
"""Share of the power of each link that the kept paths have, for each of `EXTREMES`."""

EXTREMES = tuple((permittivity, loss) for permittivity in (1.2, 3.0, 8.0, 30.0) for loss in (0.0, 0.03, 3.0))
"""Materials between which any other lies: relative permittivity, and its imaginary part."""

MOST_COPIES, PATHS_AT_ONCE = 32, 300_000
"""Number of materials that are evaluated together, and of paths, counted for each of them."""

_COPY = "-copy"


@dataclass(frozen=True, eq=False)
class MaterialPaths:
    """P paths of N links.

    Parameters
    ----------
    scene : PathScene
    materials : tuple of str
        Names of its M materials.
    tx_m, rx_m : (T, 3) and (N, 3) float64 arrays
        Transmitters, and the receiver of each link, in world coordinates [m].
    parts : tuple of ((C,) int64 array, Candidates)
        Transmitters of candidates, and the candidates, whose receivers are links.
    unobserved_m : (P,) float64 array
        Unobserved length of each path [m].
    """

    scene: PathScene
    materials: tuple[str, ...]
    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    parts: tuple[tuple[NDArray[np.int64], Candidates], ...]
    unobserved_m: NDArray[np.float64]

    def __len__(self) -> int:
        """Return the number of paths P."""
        return len(self.link)

    @cached_property
    def link(self) -> NDArray[np.int64]:
        """Link (P,) of each path."""
        return np.concatenate([np.zeros(0, np.int64), *(each.rx for _, each in self.parts)])

    @cached_property
    def is_direct(self) -> NDArray[np.bool_]:
        """Whether each path (P,) is the line of sight."""
        return np.concatenate([np.zeros(0, bool), *((each.face == -1).all(axis=1) for _, each in self.parts)])

    def kept(self, mask: NDArray[np.bool_]) -> "MaterialPaths":
        """Return the paths of a mask (P,)."""
        parts, first = [], 0
        for tx_index, candidates in self.parts:
            rows = np.flatnonzero(mask[first : first + len(tx_index)])
            first += len(tx_index)
            if len(rows):
                parts.append((tx_index[rows], candidates.rows(rows)))
        return replace(self, parts=tuple(parts), unobserved_m=self.unobserved_m[mask])

    def of_links(self, chosen: NDArray[np.bool_]) -> "MaterialPaths":
        """Return the paths of the links of a mask (N,), which are counted anew."""
        paths, number = self.kept(chosen[self.link]), (np.cumsum(chosen) - 1).astype(np.int32)
        parts = tuple((tx_index, replace(each, rx=number[each.rx])) for tx_index, each in paths.parts)
        return replace(paths, parts=parts, rx_m=self.rx_m[chosen])

    def power(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Evaluate |a|^2 of each path (P,) for M relative permittivities and conductivities [S/m]."""
        _, variables = self._variables(permittivity, conductivity_s_m)
        found = [self.scene.solver.power(each, variables, differentiable=False) for each in self._verified]
        return np.concatenate([np.zeros(0), *(each.numpy() for each in found)])

    def powers(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Evaluate |a|^2 of each path (B, P) for (B, M) materials, at most `at_once` of them."""
        import drjit as dr
        import mitsuba as mi

        solver, base, held = self._copies
        rows = np.minimum(np.arange(self.at_once), len(permittivity) - 1)
        values: list[list[Any]] = [[], [], []]
        for name, constants in base.items():
            kind, _, copy = name.rpartition(_COPY)
            own = constants.copy()
            if kind in self.materials:
                column = self.materials.index(kind)
                own[:2] = permittivity[rows[int(copy)], column], conductivity_s_m[rows[int(copy)], column]
            for each, value in zip(values, own, strict=True):
                each.append(dr.opaque(mi.Float, float(value)))
        nothing = dr.opaque(mi.Float, 0.0)
        first, second, third = map(tuple, values)
        variables = Variables(nothing, nothing, nothing, first, second, third, nothing)
        found = [solver.power(each, variables, differentiable=False).numpy() for each in held]
        power = [np.zeros((self.at_once, 0)), *(each.reshape(self.at_once, -1) for each in found)]
        return np.concatenate(power, axis=1)[: len(permittivity)]

    def slopes(
        self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Evaluate |a|^2 of each path (P,), and differentiate it (P, 2 M): by permittivities, then conductivities."""
        import drjit as dr

        powers, slopes = [np.zeros(0)], [np.zeros((0, 2 * len(self.materials)))]
        for paths in self._verified:
            leaves, variables = self._variables(permittivity, conductivity_s_m)
            dr.enable_grad(leaves)
            power = self.scene.solver.power(paths, variables)
            columns = [slope.numpy().astype(np.float64) for slope in forward_passes(power, leaves)]
            slopes.append(np.stack(columns, axis=1))
            powers.append(dr.detach(power).numpy().astype(np.float64))
        return np.concatenate(powers), np.concatenate(slopes)

    def strong(self) -> NDArray[np.bool_]:
        """Find the paths (P,) that have `KEPT_SHARE` of the power of their link for some of `EXTREMES`."""
        strong = np.zeros(len(self), dtype=bool)
        ones = np.ones(len(self.materials))
        scale_s_m = 2.0 * np.pi * self.scene.settings.frequency_hz * VACUUM_F_M
        for permittivity, loss in EXTREMES:
            strong |= _has_share(self.link, self.power(permittivity * ones, loss * scale_s_m * ones), KEPT_SHARE)
        return strong

    @property
    def at_once(self) -> int:
        """Number of materials that `powers` evaluates together."""
        return max(1, min(MOST_COPIES, PATHS_AT_ONCE // max(1, len(self))))

    @cached_property
    def _copies(self) -> tuple[SceneSolver, dict[str, NDArray[np.float64]], list[VerifiedPaths]]:
        """A scene with copies of this one, each with materials of its own, what they are, and the paths in all."""
        with temporary_folder() as folder:
            written = write_scene_of(self.scene.partial, folder, self.scene.settings, self.scene.scene_settings)
            shapes = tuple(f"{name}{_COPY}{copy}" for copy in range(self.at_once) for name in written.shapes)
            solver = SceneSolver(_write_copies(written.xml, self.at_once), shapes, self.scene.settings)
        blocks = zip(_blocks(self.parts), self._verified, strict=True)
        held = [solver.in_copies(each, tx_index, paths, self.at_once) for (tx_index, each), paths in blocks]
        return solver, solver.materials, held

    @cached_property
    def _verified(self) -> list[VerifiedPaths]:
        shift_m = self.scene.shift_m
        return [
            self.scene.solver.verified(candidates, tx_index, self.tx_m - shift_m, self.rx_m - shift_m)
            for tx_index, candidates in _blocks(self.parts)
        ]

    def _variables(
        self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]
    ) -> tuple[list[Any], Variables]:
        """Return a variable for each of the 2 M parameters, and all of them for the solver."""
        import drjit as dr
        import mitsuba as mi

        base = self.scene.solver.materials
        nothing = dr.opaque(mi.Float, 0.0)
        leaves = [[dr.opaque(mi.Float, float(value)) for value in own] for own in (permittivity, conductivity_s_m)]
        constants = {name: [dr.opaque(mi.Float, float(value)) for value in own] for name, own in base.items()}
        for number, name in enumerate(self.materials):
            constants[name][:2] = leaves[0][number], leaves[1][number]
        first, second, third = (tuple(own[row] for own in constants.values()) for row in range(3))
        return [*leaves[0], *leaves[1]], Variables(nothing, nothing, nothing, first, second, third, nothing)


def find_material_paths(
    scene: PathScene,
    materials: Sequence[str],
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    progress: Progress,
) -> MaterialPaths:
    """Trace the paths of N links, and keep those that may have some power.

    Paths run both ways: they are traced from those ends of which there are fewer.

    Parameters
    ----------
    scene : PathScene
    materials : sequence of str
        Names of the materials that are to change.
    tx, rx : (N, 3) float64 arrays
        Positions where they may be [m].
    progress : callable
        Called as ``progress(share_done, message)``.

    Returns
    -------
    MaterialPaths
    """
    if len(np.unique(rx, axis=0)) < len(np.unique(tx, axis=0)):
        tx, rx = rx, tx
    places, index = np.unique(tx, axis=0, return_inverse=True)
    nothing = MaterialPaths(scene, tuple(materials), places, rx, (), np.zeros(0))
    kept, new = nothing, nothing
    for number, place in enumerate(places):
        links = np.flatnonzero(index.ravel() == number)

        def traced(fraction: float, message: str, number: int = number) -> None:
            progress((number + fraction) / len(places), f"tracing transmitter {number + 1} of {len(places)}")

        for block in scene.blocks(place, rx[links], traced):
            start_m, end_m = np.broadcast_to(place, (len(block), 3)), block.rx_m[block.rx_of_path]
            length_m = path_unobserved_m(scene.partial, start_m, block.interactions, block.vertices_m, end_m)
            parts = [
                (np.full(len(each.rx), number), replace(each, rx=links[each.rx].astype(np.int32)))
                for each, _ in block.parts
            ]
            new = _joined(new, replace(nothing, parts=tuple(parts), unobserved_m=length_m))
            if len(new) > PATHS_PER_BLOCK:
                kept, new = _joined(kept, new.kept(new.strong())), nothing
    return _joined(kept, new.kept(new.strong()))


def _write_copies(xml: Path, count: int) -> Path:
    """Write a scene beside another one, that holds everything in it `count` times."""
    root, copies = ET.parse(xml).getroot(), ET.Element("scene", version="2.1.0")
    for copy in range(count):
        for node in root:
            own = deepcopy(node)
            for each in (own, *own.iter("ref")):
                each.set("id", f"{each.get('id')}{_COPY}{copy}")
            copies.append(own)
    path = xml.with_name("copies.xml")
    ET.ElementTree(copies).write(path, encoding="utf-8")
    return path


def link_gains_db(power: NDArray[np.float64], link: NDArray[np.int64], links: int) -> NDArray[np.float64]:
    """Gain of N links [dB] from the power of their paths (P,); -inf where there is none."""
    with np.errstate(divide="ignore"):
        return 10.0 * np.log10(np.bincount(link, weights=power, minlength=links))


def _has_share(link: NDArray[np.int64], power: NDArray[np.float64], share: float) -> NDArray[np.bool_]:
    """Find the strongest paths of each link that have a share of its power together."""
    order = np.lexsort((-power, link))
    sums = np.cumsum(power[order])
    total = np.bincount(link, weights=power)
    before = sums - power[order] - (np.cumsum(total) - total)[link[order]]
    strong = np.zeros(len(link), dtype=bool)
    strong[order] = (before < share * total[link[order]]) & (power[order] > 0.0)
    return strong


def _joined(one: MaterialPaths, other: MaterialPaths) -> MaterialPaths:
    """Join paths of the same links: all that reflect, then all that diffract."""
    lengths: list[NDArray[np.float64]] = []
    parts = []
    for bent in (False, True):
        chosen = []
        for paths in (one, other):
            first = 0
            for tx_index, candidates in paths.parts:
                if (candidates.wedges is not None) == bent and len(tx_index):
                    chosen.append((tx_index, candidates))
                    lengths.append(paths.unobserved_m[first : first + len(tx_index)])
                first += len(tx_index)
        if chosen:
            parts.append((np.concatenate([tx_index for tx_index, _ in chosen]), _stacked([each for _, each in chosen])))
    return replace(one, parts=tuple(parts), unobserved_m=np.concatenate([np.zeros(0), *lengths]))


def _stacked(candidates: list[Candidates]) -> Candidates:
    """Join candidates of one kind, filled up to the same number of interactions."""
    depth = max(each.face.shape[1] for each in candidates)
    count = sum(len(each.rx) for each in candidates)
    face, vertices_m = np.full((count, depth), -1, np.int32), np.zeros((count, depth, 3))
    first = 0
    for each in candidates:
        rows, columns = slice(first, first + len(each.rx)), slice(each.face.shape[1])
        face[rows, columns], vertices_m[rows, columns] = each.face, each.vertices_m
        first += len(each.rx)
    wedge = [each.wedge for each in candidates if each.wedge is not None]
    return replace(
        candidates[0],
        rx=np.concatenate([each.rx for each in candidates]),
        face=face,
        vertices_m=vertices_m,
        wedge=np.concatenate(wedge) if wedge else None,
    )


def _blocks(
    parts: Sequence[tuple[NDArray[np.int64], Candidates]],
) -> Iterator[tuple[NDArray[np.int64], Candidates]]:
    """Cut candidates into blocks, which bounds the memory."""
    for tx_index, candidates in parts:
        for start in range(0, len(tx_index), PATHS_PER_BLOCK):
            rows = np.arange(start, min(start + PATHS_PER_BLOCK, len(tx_index)))
            yield tx_index[rows], candidates.rows(rows)
