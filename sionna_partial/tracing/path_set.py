"""The forward model: the paths of links as functions of the transmitters' positions, the materials and the frequency.

Paths are found once, by a complete trace. Sionna RT then gives their power and vertices for other values, and Dr.Jit
the derivatives. A path that other values make invalid has no power; one that they would make possible is not found.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Bools, Floats, Indices, States
from sionna_partial.checks import Progress, require
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.display import Shown
from sionna_partial.errors import BackendError, PositionError
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.progress import part_of, reporting
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.candidates import Candidates
from sionna_partial.tracing.engine import REMEDY, HeldPaths, Variables, engine_fault, forward_passes
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import SolvedPaths, join_paths, widened
from sionna_partial.tracing.trace import checked_positions, checked_settings, link_summary, load_scene

PATHS_PER_BLOCK = 50_000
"""Number of paths that are evaluated together, which bounds the memory."""

Part = tuple[Candidates, SolvedPaths]
"""Candidates and the paths that they are, one for one, in scene coordinates."""


@dataclass(frozen=True)
class PathParameters(Shown):
    """What the power of paths depends on.

    Parameters
    ----------
    tx_m : (3,) or (T, 3) float64 array
        Transmitter positions [m].
    relative_permittivity, conductivity_s_m, thickness_m : (M,) float64 arrays
        Of each material: real relative permittivity, conductivity [S/m] and thickness [m]. ITU materials follow the
        frequency on top of that, as Sionna RT has them.
    frequency_hz : () float64 array
        Carrier frequency [Hz].
    """

    tx_m: Floats
    relative_permittivity: Floats
    conductivity_s_m: Floats
    thickness_m: Floats
    frequency_hz: Floats


PARAMETERS = tuple(field.name for field in fields(PathParameters))
MATERIAL_PARAMETERS = PARAMETERS[1:4]


class PathScene:
    """A scene that is written and opened once, for the paths of any transmitters.

    Raises a SettingsError for paths that only rays find, and a BackendError where the fast engine cannot be used.
    """

    def __init__(
        self, partial: PartialMap, *, settings: TraceSettings | None = None, scene_settings: SceneSettings | None = None
    ) -> None:
        self.partial = partial
        self.settings, self.scene_settings = path_settings(partial, settings, scene_settings)
        if engine_fault():
            raise BackendError(f"Gradients need the fast engine, and {engine_fault()}: {REMEDY}")
        self.shift_m = np.array([*partial.origin_m, 0.0])
        self._finder, self.solver = load_scene(partial, self.settings, self.scene_settings)

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the M radio materials, in the order of `PathParameters`."""
        return tuple(self.solver.materials)

    def parameters(self, tx_m: ArrayLike) -> PathParameters:
        """Return those of the scene, with transmitters (3,) or (T, 3) [m]."""
        permittivity, conductivity_s_m, thickness_m = np.reshape([*self.solver.materials.values()], (-1, 3)).T
        return PathParameters(
            tx_m=np.array(tx_m, dtype=np.float64),
            relative_permittivity=permittivity,
            conductivity_s_m=conductivity_s_m,
            thickness_m=thickness_m,
            frequency_hz=np.array(self.settings.frequency_hz),
        )

    def paths(self, tx: ArrayLike, rx: ArrayLike, *, progress: Progress | bool | None = None) -> "PathSet":
        """Find all paths from transmitters (3,) or (T, 3) to receivers (N, 3) [m], as `trace_links` does."""
        tx_m, rx_m = checked_positions(self.partial, tx, rx, self.settings.frequency_hz)
        tx_m, rx_m = tx_m.reshape(np.shape(tx)).copy(), rx_m.copy()
        with reporting(progress) as report:
            found = PathSet.joined([PathSet(self, tx_m, rx_m, []), *self.blocks(tx_m, rx_m, report)])
            report(1.0, "traced")
        return found

    def blocks(
        self, tx_m: Floats, rx_m: Floats, report: Progress, rx_of_tx: Sequence[Indices] | None = None
    ) -> Iterator["PathSet"]:
        """Find the same paths some at a time, which bounds the memory, for positions that have been checked.

        `rx_of_tx` selects the receivers of each transmitter, in place of all of them.
        """
        positions_m = tx_m.reshape(-1, 3)
        for number, position_m in enumerate(positions_m):
            chosen = np.arange(len(rx_m)) if rx_of_tx is None else rx_of_tx[number]
            if not len(chosen):
                continue
            ends = position_m - self.shift_m, rx_m[chosen] - self.shift_m
            part_report = part_of(report, number / len(positions_m), (number + 1) / len(positions_m))
            for candidates, paths in self._finder.paths(self.solver, *ends, part_report):
                rx = chosen[candidates.rx].astype(np.int32)
                path_tx = np.full(len(rx), number, np.int32)
                part = replace(candidates, rx=rx), replace(paths, path_tx=path_tx, path_rx=rx)
                yield PathSet(self, tx_m, rx_m, [part])


class PathSet:
    """The P paths from T transmitters to N receivers, found once by a `PathScene`.

    Attributes
    ----------
    base : PathParameters
        For which they were found.
    rx_m : (N, 3) float64 array
        Receiver positions [m].
    path_tx, path_rx : (P,) int32 arrays
        Transmitter and receiver of each path.
    power : (P,) float64 array
        Squared magnitude |a|^2 of each, at `base`.
    interactions : (P, D) uint8 array
        Sionna RT's `InteractionType` of every interaction in order from the transmitter; 0 where there is none.
    is_direct : (P,) bool array
        Whether each is the line of sight.
    vertices_m : (P, D, 3) float64 array
        Positions of the interactions at `base` [m]; NaN where there is none.
    """

    def __init__(self, scene: PathScene, tx_m: Floats, rx_m: Floats, parts: list[Part]) -> None:
        self.base, self.rx_m, self._scene, self._parts = scene.parameters(tx_m), rx_m, scene, _merged(parts)
        self._held: dict[int, HeldPaths] = {}
        ends = np.cumsum([0, *(len(candidates.rx) for candidates, _ in self._parts)]).tolist()
        self._rows = [slice(*each) for each in itertools.pairwise(ends)]
        paths = SolvedPaths.concatenate([solved for _, solved in self._parts], scene.settings.max_depth)
        self.path_tx, self.path_rx, self.interactions = paths.path_tx, paths.path_rx, paths.interactions
        self.power, self.vertices_m = np.abs(paths.a) ** 2, paths.vertices_m + scene.shift_m
        self.is_direct = paths.is_direct

    def __len__(self) -> int:
        """Return the number of paths P."""
        return len(self.path_rx)

    @classmethod
    def joined(cls, sets: Sequence["PathSet"]) -> "PathSet":
        """Join paths between the same transmitters and receivers; at least one set."""
        first = sets[0]
        return cls(first._scene, first.base.tx_m, first.rx_m, [part for each in sets for part in each._parts])

    def kept(self, mask: Bools) -> "PathSet":
        """Return the paths of a mask (P,)."""
        parts = []
        for (candidates, paths), rows in zip(self._parts, self._rows, strict=True):
            index = np.flatnonzero(mask[rows])
            parts.append((candidates.rows(index), paths.take(index)))
        return PathSet(self._scene, self.base.tx_m, self.rx_m, parts)

    def links(self) -> TracedLinks:
        """Return the links as `trace_links` does."""
        paths = join_paths([solved for _, solved in self._parts], self._scene.settings.max_depth)
        paths.vertices_m[:] += self._scene.shift_m
        shape = (*self.base.tx_m.shape[:-1], len(self.rx_m))
        link = self.path_tx.astype(np.int64) * len(self.rx_m) + self.path_rx
        power = np.bincount(link, weights=self.power, minlength=math.prod(shape))
        is_direct = np.bincount(link[self.is_direct], minlength=len(power)) > 0
        link_state, gain_db = link_summary(power.astype(np.float64), is_direct)
        return TracedLinks(
            tx=self.base.tx_m,
            rx=self.rx_m,
            link_state=link_state.reshape(shape),
            gain_db=gain_db.reshape(shape),
            **vars(paths),
            settings=self._scene.settings,
            scene_settings=self._scene.scene_settings,
        )

    def at(self, parameters: PathParameters) -> tuple[Floats, Floats]:
        """Evaluate power (P,), 0 where a path is not valid any more, and vertices (P, D, 3) for other parameters.

        For a frequency that a material does not cover this raises a SettingsError; so do the derivatives.
        """
        if all(np.array_equal(getattr(parameters, name), getattr(self.base, name)) for name in PARAMETERS):
            return self.power.copy(), self.vertices_m.copy()
        solver, (_, variables), power = self._scene.solver, self._variables(parameters), np.zeros(len(self))
        if not self._moves(parameters):
            for number, rows in enumerate(self._rows):
                power[rows] = solver.power(self._held_paths(number), variables, differentiable=False).numpy()
            return power, self.vertices_m.copy()
        vertices_m = np.full_like(self.vertices_m, math.nan)
        for (candidates, paths), rows in zip(self._parts, self._rows, strict=True):
            found = solver.moved(candidates, paths.path_tx, *self._ends(), variables, differentiable=False)
            power[rows], depth = found[0].numpy(), candidates.face.shape[1]
            vertices_m[rows, :depth] = np.transpose(found[1].numpy()).reshape(-1, depth, 3) + self._scene.shift_m
        vertices_m[self.interactions == 0] = math.nan
        return power, vertices_m

    def slopes(
        self, parameters: PathParameters, names: Sequence[str] = PARAMETERS, *, together: bool = False
    ) -> dict[str, Floats]:
        """Differentiate the power of each path with respect to the K entries of fields of `PathParameters`: (P, K).

        Of the transmitters, that is the x, y, z of each path's own; with `together` all materials change by as much.
        Dr.Jit passes forward once for each entry. Backwards, one pass takes longer than these seven of a floor plan,
        and its derivatives of the position differ from run to run.
        """
        count = {name: 1 if together else len(self.base.thickness_m) for name in MATERIAL_PARAMETERS}
        power = {name: np.zeros((len(self), {**count, "tx_m": 3, "frequency_hz": 1}[name])) for name in names}
        for rows, name, entry, (of_power, _) in self._passes(parameters, names, together=together):
            power[name][rows, entry] = of_power.numpy()
        return power

    def transmitter_slopes(self, parameters: PathParameters) -> tuple[Floats, Floats]:
        """Differentiate power (P, 3) and vertices (P, D, 3, 3) with respect to the x, y, z of the transmitter.

        The last axis is the transmitter's; derivatives are 0 where there is no vertex.
        """
        power, vertices_m = np.zeros((len(self), 3)), np.zeros((*self.vertices_m.shape, 3))
        for rows, _, entry, (of_power, of_vertices) in self._passes(parameters, ("tx_m",)):
            power[rows, entry] = of_power.numpy()
            columns = np.transpose(of_vertices.numpy()).reshape(rows.stop - rows.start, -1, 3)
            vertices_m[rows, : columns.shape[1], :, entry] = columns
        vertices_m[self.interactions == 0] = 0.0
        return power, vertices_m

    def _passes(
        self, parameters: PathParameters, names: Sequence[str], *, together: bool = False
    ) -> Iterator[tuple[slice, str, int, Any]]:
        """Pass forward from each entry of each parameter: derivatives of power and vertices, block by block."""
        import drjit as dr

        solver, moves = self._scene.solver, "tx_m" in names or self._moves(parameters)
        for number, (candidates, paths) in enumerate(self._parts):
            rows = self._rows[number]
            leaves, variables = self._variables(parameters, names, together=together)
            if moves:
                ends = self._ends()
                power, vertices_m = solver.moved(candidates, paths.path_tx, *ends, variables, differentiable=True)
            else:
                power = solver.power(self._held_paths(number), variables, differentiable=True)
                vertices_m = dr.zeros(type(power))
            results = power, vertices_m + dr.opaque(type(power), 0.0)  # power is made of them: theirs would be cleared
            for name in names:
                for entry, slopes in enumerate(forward_passes(results, leaves[name])):
                    yield rows, name, entry, slopes

    def _moves(self, parameters: PathParameters) -> bool:
        return not np.array_equal(parameters.tx_m, self.base.tx_m)

    def _ends(self) -> tuple[Floats, Floats]:
        """Transmitters (T, 3) and receivers (N, 3) at `base`, in scene coordinates [m]."""
        return self.base.tx_m.reshape(-1, 3) - self._scene.shift_m, self.rx_m - self._scene.shift_m

    def _held_paths(self, number: int) -> HeldPaths:
        """Return the paths of a part at `base`, which are verified once."""
        if number not in self._held:
            candidates, paths = self._parts[number]
            self._held[number] = self._scene.solver.held(candidates, paths.path_tx, *self._ends())
        return self._held[number]

    def _variables(
        self, parameters: PathParameters, names: Sequence[str] = (), *, together: bool = False
    ) -> tuple[dict[str, list[Any]], Variables]:
        """Return what is differentiated with respect to, by name, and all variables for the solver."""
        import drjit as dr
        import mitsuba as mi

        def opaque(values: ArrayLike) -> list[Any]:
            return [dr.opaque(mi.Float, float(value)) for value in np.ravel(values)]

        if parameters.frequency_hz != self.base.frequency_hz:
            settings = replace(self._scene.settings, frequency_hz=float(parameters.frequency_hz))
            checked_settings(self._scene.partial, settings, self._scene.scene_settings)
        values = {name: opaque(getattr(parameters, name)) for name in MATERIAL_PARAMETERS}
        frequency_hz = opaque(parameters.frequency_hz - self.base.frequency_hz)
        leaves = {**values, "tx_m": opaque(np.zeros(3)), "frequency_hz": frequency_hz}
        if together:
            leaves.update((name, opaque(0.0)) for name in MATERIAL_PARAMETERS)
        dr.enable_grad([leaves[name] for name in names])
        if together:
            values = {name: [value + leaves[name][0] for value in own] for name, own in values.items()}
        shift_m = (parameters.tx_m - self.base.tx_m).reshape(-1, 3).T.astype(np.float32)
        shift = tuple(mi.Float(column) + leaf for column, leaf in zip(shift_m, leaves["tx_m"], strict=True))
        materials = {name: tuple(own) for name, own in values.items()}
        return leaves, Variables(shift_m=shift, frequency_hz=frequency_hz[0], **materials)


def _merged(parts: list[Part]) -> list[Part]:
    """Join parts of one kind, without diffraction or with it, and cut them to `PATHS_PER_BLOCK`."""
    merged = []
    for is_diffracted in (False, True):
        some = [part for part in parts if (part[0].wedges is not None) == is_diffracted and len(part[0].rx)]
        if not some:
            continue
        depth = max(candidates.face.shape[1] for candidates, _ in some)
        candidates = Candidates.concatenate(
            [
                replace(each, face=widened(each.face, depth, -1), vertices_m=widened(each.vertices_m, depth, 0.0))
                for each, _ in some
            ]
        )
        paths = SolvedPaths.concatenate([solved for _, solved in some], depth)
        for start in range(0, len(paths.a), PATHS_PER_BLOCK):
            rows = np.arange(start, min(start + PATHS_PER_BLOCK, len(paths.a)))
            whole = len(rows) == len(paths.a)
            merged.append((candidates, paths) if whole else (candidates.rows(rows), paths.take(rows)))
    return merged


def one_transmitter(tx: ArrayLike) -> ArrayLike:
    """Return a position, or raise a PositionError for several."""
    if np.ndim(tx) != 1:
        raise PositionError(f"tx has shape {np.shape(tx)}: give one transmitter as (3,).")
    return tx


def path_settings(
    partial: PartialMap, settings: TraceSettings | None, scene_settings: SceneSettings | None
) -> tuple[TraceSettings, SceneSettings]:
    """Check settings as `checked_settings` does, and raise a SettingsError for paths that only rays find."""
    settings, scene_settings = checked_settings(partial, settings, scene_settings)
    for name in ("refraction", "diffuse_reflection", *(() if partial.mesh is None else ("diffraction",))):
        value = getattr(settings, name)
        remedy = "paths that are found by shooting rays have no gradients: give False"
        require(not value, name, value, f"{remedy}, and trace_links for the gain alone.")
    return settings, scene_settings


@dataclass(frozen=True)
class GainGradients(Shown):
    """Path gain from one transmitter to N receivers, and its derivatives.

    The derivatives are those of the paths that exist: they do not include paths that appear or vanish. They are 0 in
    an outage, where the gain is -150 dB.

    Parameters
    ----------
    tx : (3,) float64 array
        Transmitter position [m].
    rx : (N, 3) float64 array
        Receiver positions [m].
    link_state : (N,) uint8 array of LinkState
    gain_db : (N,) float64 array
        Omnidirectional path gain [dB], at least -150 (paper, eq. 5).
    tx_db_per_m : (N, 3) float64 array
        Its derivatives with respect to the transmitter's x, y and z [dB/m].
    relative_permittivity_db : (N,) float64 array
        With respect to the real relative permittivity [dB], of all materials together where a mesh has several.
    conductivity_db_per_s_m : (N,) float64 array
        With respect to their conductivity [dB / (S/m)].
    thickness_db_per_m : (N,) float64 array
        With respect to their thickness [dB/m].
    frequency_db_per_hz : (N,) float64 array
        With respect to the carrier frequency [dB/Hz]. ITU materials follow the frequency where Sionna RT loads them by
        name, which it does for all but `vacuum`.
    settings : TraceSettings
    scene_settings : SceneSettings

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> found = sp.gain_gradients(partial, (1.5, 1.5, 1.5), [(3.0, 2.0, 1.5)])
    >>> found.tx_db_per_m.shape, found.frequency_db_per_hz.shape
    ((1, 3), (1,))
    """

    tx: Floats
    rx: Floats
    link_state: States
    gain_db: Floats
    tx_db_per_m: Floats
    relative_permittivity_db: Floats
    conductivity_db_per_s_m: Floats
    thickness_db_per_m: Floats
    frequency_db_per_hz: Floats
    settings: TraceSettings
    scene_settings: SceneSettings


def gain_gradients(
    scene: PartialMap | str | Path,
    tx: ArrayLike,
    rx: ArrayLike,
    *,
    trace_settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    progress: Progress | bool | None = None,
) -> GainGradients:
    """Differentiate the path gain from a transmitter to N receivers with Sionna RT and Dr.Jit.

    The paths are those of `trace_links` with the same arguments. The power of a link is the sum of the powers of its
    paths, without their phases. Candidates are verified first; Dr.Jit then differentiates the image method and the
    field calculator of Sionna RT for the paths among them, in forward mode, one parameter after the other.

    Parameters
    ----------
    scene : PartialMap or path
        What is known of the building; unknown space is free.
    tx : (3,) array-like
        Transmitter position [m].
    rx : (N, 3) array-like
        Receiver positions [m]; N may be 0.
    trace_settings : TraceSettings, optional
        Refraction and diffuse reflection must be off; diffraction too on meshes.
    scene_settings : SceneSettings, optional
    progress : bool or callable, optional
        False shows none; a callable is called as ``progress(fraction_done, message)``. By default a bar appears in
        terminals and notebooks after 2 s.

    Returns
    -------
    GainGradients

    Raises
    ------
    PositionError
        For a transmitter or receiver that is not finite, outside the map or inside a wall, a receiver at the
        transmitter, or several transmitters.
    SettingsError
        For a frequency that the material does not cover, settings of another kind, or paths that only rays find.
    BackendError
        If LLVM or Sionna RT cannot be used, or Sionna RT is another than the fast engine was made for.
    OutputError
        If no temporary file can be written.

    Examples
    --------
    In free space, the gain falls with 20 log10 of the distance and of the frequency. At 2 m it rises by 20 / ln(10) / 2
    dB for each metre that the transmitter comes nearer:

    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> field = sp.PartialMap(np.zeros((20, 60), dtype=np.uint8), resolution_m=0.1)
    >>> no_floor = sp.SceneSettings(floor_extent="none")
    >>> found = sp.gain_gradients(field, (1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)], scene_settings=no_floor)
    >>> (found.tx_db_per_m + 0.0).round(3).tolist()
    [[4.343, 0.0, 0.0]]
    >>> (found.frequency_db_per_hz * 1e9).round(4).tolist()
    [-0.3102]
    """
    partial = scene if isinstance(scene, PartialMap) else load_map(scene)
    settings, scene_settings = path_settings(partial, trace_settings, scene_settings)
    tx_m, rx_m = checked_positions(partial, one_transmitter(tx), rx, settings.frequency_hz)
    power, is_direct, slopes = np.zeros(len(rx_m)), np.zeros(len(rx_m), dtype=bool), np.zeros((7, len(rx_m)))
    with reporting(progress) as report:
        report(0.0, "building the scene")
        if len(rx_m):
            paths = PathScene(partial, settings=settings, scene_settings=scene_settings)

            def part(fraction: float, message: str) -> None:
                report(0.1 + 0.9 * fraction, message.replace("verifying", "differentiating"))

            for block in paths.blocks(tx_m[0], rx_m, part):
                is_direct[block.path_rx[block.is_direct]] = True
                columns = np.concatenate(list(block.slopes(block.base, together=True).values()), axis=1)
                for total, values in zip((power, *slopes), (block.power, *columns.T), strict=True):
                    total += np.bincount(block.path_rx, weights=values, minlength=len(rx_m))
    link_state, gain_db = link_summary(power, is_direct)
    above = gain_db > GAIN_FLOOR_DB
    slopes_db = np.where(above, 10.0 / math.log(10.0) * slopes / np.where(above, power, 1.0), 0.0)
    return GainGradients(
        tx=tx_m[0].copy(),
        rx=rx_m.copy(),
        link_state=link_state,
        gain_db=gain_db,
        tx_db_per_m=slopes_db[:3].T,
        relative_permittivity_db=slopes_db[3],
        conductivity_db_per_s_m=slopes_db[4],
        thickness_db_per_m=slopes_db[5],
        frequency_db_per_hz=slopes_db[6],
        settings=settings,
        scene_settings=scene_settings,
    )
