"""Paths of links as functions of transmitter positions, materials and frequency.

A complete trace finds the paths. Sionna RT then gives their power and vertices for other values, and Dr.Jit the
derivatives. A path that becomes invalid has no power; new paths are not found.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Bools, Floats, read_only
from sionna_partial.display import Shown
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.engine import HeldPaths, SceneSolver, Variables, to_device
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import Candidates, LinkSums, SolvedPaths, join_paths

PATHS_PER_BLOCK = 50_000
"""Number of paths evaluated together, to bound the memory."""

Part = tuple[Candidates, SolvedPaths]
"""Candidates in scene coordinates, and their paths in world coordinates, row by row."""


@read_only
@dataclass(frozen=True)
class PathParameters(Shown):
    """Parameters of the power of paths.

    Parameters
    ----------
    tx_m : (3,) or (T, 3) float64 array
        Transmitter positions [m].
    relative_permittivity, conductivity_s_m, thickness_m : (M,) float64 arrays
        Real relative permittivity, conductivity [S/m] and thickness [m] of each material at the traced frequency; the
        first two follow the frequency.
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


class _Simulation(Protocol):
    """Members of the `Simulation` that found the paths."""

    trace_settings: TraceSettings
    resolved: Any

    @property
    def solver(self) -> SceneSolver: ...
    def parameters(self, tx_m: ArrayLike) -> PathParameters: ...
    def require_frequency(self, frequency_hz: float) -> None: ...
    def in_scene(self, points_m: Floats) -> Floats: ...
    def in_world(self, points_m: Floats) -> Floats: ...


class PathSet:
    """P paths from T transmitters to N receivers, found once by a `Simulation`.

    Attributes
    ----------
    base : PathParameters
        Parameters for which the paths were found.
    rx_m, path_tx, path_rx, interactions
        As in `TracedLinks`.
    power : (P,) float64 array
        |a|^2 of each path at `base`.
    is_direct : (P,) bool array
        True for the line of sight.
    vertices_m : (P, D, 3) float64 array
        Points of interaction at `base` [m]; NaN for none.
    """

    def __init__(self, simulation: _Simulation, tx_m: Floats, rx_m: Floats, parts: list[Part]) -> None:
        self.base, self.rx_m, self._parts = simulation.parameters(tx_m), rx_m, _merged(parts)
        self._simulation = simulation
        self._held: dict[int, HeldPaths] = {}
        ends = np.cumsum([0, *(len(candidates.rx) for candidates, _ in self._parts)]).tolist()
        self._rows = [slice(*rows) for rows in itertools.pairwise(ends)]
        paths = SolvedPaths.concatenate(self.solved, simulation.trace_settings.most_interactions)
        self.path_tx, self.path_rx, self.interactions = paths.path_tx, paths.path_rx, paths.interactions
        self.power, self.vertices_m = paths.power, paths.vertices_m
        self.is_direct = paths.is_direct

    def __len__(self) -> int:
        return len(self.path_rx)

    @property
    def solved(self) -> list[SolvedPaths]:
        """The paths as found."""
        return [solved for _, solved in self._parts]

    @classmethod
    def joined(cls, sets: Sequence["PathSet"]) -> "PathSet":
        """Join paths between the same transmitters and receivers; at least one set."""
        first = sets[0]
        return cls(first._simulation, first.base.tx_m, first.rx_m, [part for paths in sets for part in paths._parts])

    def kept(self, mask: Bools) -> "PathSet":
        """Return the paths of a mask (P,)."""
        parts = []
        for (candidates, paths), rows in zip(self._parts, self._rows, strict=True):
            index = np.flatnonzero(mask[rows])
            parts.append((candidates.rows(index), paths.take(index)))
        return PathSet(self._simulation, self.base.tx_m, self.rx_m, parts)

    def links(self) -> TracedLinks:
        """Return the links as `trace_links` does."""
        paths = join_paths(self.solved, self._simulation.trace_settings.most_interactions)
        sums = LinkSums(math.prod(self.base.tx_m.shape[:-1]), len(self.rx_m))
        for solved in self.solved:
            sums.add(solved)
        shape = (*self.base.tx_m.shape[:-1], len(self.rx_m))
        link_state, gain_db = (values.reshape(shape) for values in sums.states_and_gains())
        return TracedLinks(
            tx=self.base.tx_m,
            rx=self.rx_m,
            link_state=link_state,
            gain_db=gain_db,
            **vars(paths),
            **self._simulation.resolved._asdict(),
        )

    def at(self, parameters: PathParameters) -> tuple[Floats, Floats]:
        """Evaluate power (P,), 0 for an invalid path, and vertices (P, D, 3) for other parameters.

        This and the derivatives raise a SettingsError for a frequency that a material does not cover.
        """
        if all(np.array_equal(getattr(parameters, name), getattr(self.base, name)) for name in PARAMETERS):
            return self.power.copy(), self.vertices_m.copy()
        solver, (_, variables), power = self._simulation.solver, self._variables(parameters), np.zeros(len(self))
        if not self._moves(parameters):
            for number, rows in enumerate(self._rows):
                power[rows] = solver.power(self._held_paths(number), variables, differentiable=False).numpy()
            return power, self.vertices_m.copy()
        vertices_m = np.full_like(self.vertices_m, math.nan)
        for (candidates, paths), rows in zip(self._parts, self._rows, strict=True):
            found = solver.moved(candidates, paths.path_tx, *self._ends(), variables, differentiable=False)
            power[rows] = found[0].numpy()
            in_scene_m = np.transpose(found[1].numpy()).reshape(len(candidates.rx), -1, 3)
            vertices_m[rows, : in_scene_m.shape[1]] = self._simulation.in_world(in_scene_m)
        vertices_m[self.interactions == 0] = math.nan
        return power, vertices_m

    def slopes(
        self, parameters: PathParameters, names: Sequence[str] = PARAMETERS, *, together: bool = False
    ) -> dict[str, Floats]:
        """Differentiate the power of each path with respect to the K entries of fields of `PathParameters`: (P, K).

        For transmitters, these are x, y, z of the path's own; with `together` all materials change by as much. Dr.Jit
        makes one forward pass for each entry: a backward pass takes longer than seven, and its derivatives of the
        position differ from run to run.
        """
        count = {name: 1 if together else len(self.base.thickness_m) for name in MATERIAL_PARAMETERS}
        power = {name: np.zeros((len(self), {**count, "tx_m": 3, "frequency_hz": 1}[name])) for name in names}
        for rows, name, entry, (of_power, _) in self._passes(parameters, names, together=together):
            power[name][rows, entry] = of_power.numpy()
        return power

    def transmitter_slopes(self, parameters: PathParameters) -> tuple[Floats, Floats]:
        """Differentiate power (P, 3) and vertices (P, D, 3, 3) with respect to the transmitter, the last axis."""
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
        import drjit as dr

        solver, moves = self._simulation.solver, "tx_m" in names or self._moves(parameters)
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
            for some in ({"tx_m"}, {*PARAMETERS[1:]}):
                entries = [(name, entry) for name in names if name in some for entry in range(len(leaves[name]))]
                passes = _forward_passes(results, [leaves[name][entry] for name, entry in entries])
                for (name, entry), slopes in zip(entries, passes, strict=True):
                    yield rows, name, entry, slopes

    def _moves(self, parameters: PathParameters) -> bool:
        return not np.array_equal(parameters.tx_m, self.base.tx_m)

    def _ends(self) -> tuple[Floats, Floats]:
        return self._simulation.in_scene(self.base.tx_m.reshape(-1, 3)), self._simulation.in_scene(self.rx_m)

    def _held_paths(self, number: int) -> HeldPaths:
        if number not in self._held:
            candidates, paths = self._parts[number]
            self._held[number] = self._simulation.solver.held(candidates, paths.path_tx, *self._ends())
        return self._held[number]

    def _variables(
        self, parameters: PathParameters, names: Sequence[str] = (), *, together: bool = False
    ) -> tuple[dict[str, list[Any]], Variables]:
        import drjit as dr
        import mitsuba as mi

        def opaque(values: ArrayLike) -> list[Any]:
            return [dr.opaque(mi.Float, float(value)) for value in np.ravel(values)]

        if parameters.frequency_hz != self.base.frequency_hz:
            self._simulation.require_frequency(float(parameters.frequency_hz))
        values = {name: opaque(getattr(parameters, name)) for name in MATERIAL_PARAMETERS}
        frequency_hz = opaque(parameters.frequency_hz - self.base.frequency_hz)
        leaves = {**values, "tx_m": opaque(np.zeros(3)), "frequency_hz": frequency_hz}
        if together:
            leaves.update((name, opaque(0.0)) for name in MATERIAL_PARAMETERS)
        dr.enable_grad([leaves[name] for name in names])
        if together:
            values = {name: [value + leaves[name][0] for value in own] for name, own in values.items()}
        shift_m = (parameters.tx_m - self.base.tx_m).reshape(-1, 3).T.astype(np.float32)
        shift = tuple(to_device(mi.Float, column) + leaf for column, leaf in zip(shift_m, leaves["tx_m"], strict=True))
        materials = {name: tuple(own) for name, own in values.items()}
        same = parameters.frequency_hz == self.base.frequency_hz and "frequency_hz" not in names
        return leaves, Variables(shift_m=shift, frequency_hz=None if same else frequency_hz[0], **materials)


def _merged(parts: list[Part]) -> list[Part]:
    merged = []
    for crossing, diffracted in itertools.product((False, True), repeat=2):
        some = [
            (candidates, paths)
            for candidates, paths in parts
            if len(candidates.rx)
            and (candidates.wedges is not None, candidates.same_wall is not None) == (diffracted, crossing)
        ]
        if not some:
            continue
        faces = max(candidates.face.shape[1] for candidates, _ in some)
        depth = max(paths.interactions.shape[1] for _, paths in some)  # further faces of one wall are no interactions
        candidates = Candidates.concatenate([candidates.widened(faces) for candidates, _ in some])
        paths = SolvedPaths.concatenate([solved for _, solved in some], depth)
        for start in range(0, len(paths.a), PATHS_PER_BLOCK):
            rows = np.arange(start, min(start + PATHS_PER_BLOCK, len(paths.a)))
            whole = len(rows) == len(paths.a)
            merged.append((candidates, paths) if whole else (candidates.rows(rows), paths.take(rows)))
    return merged


def _forward_passes(results: Any, leaves: Sequence[Any]) -> Iterator[Any]:
    """Yield the derivatives of results by each variable, all by the same kernels."""
    import drjit as dr

    for leaf in leaves:
        dr.clear_grad(results)
        for each in leaves:  # Dr.Jit compiles kernels for literals, and for variables without a derivative
            dr.set_grad(each, dr.opaque(type(each), float(each is leaf)))
        dr.enqueue(dr.ADMode.Forward, leaves)
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearInterior)  # the graph stays for the next variable
        yield dr.grad(results)
