"""Fixed paths: the paths of links as functions of the transmitter's place, of the materials and of the frequency.

The paths are found once, by a complete trace. After that Sionna RT's image method and field calculator give their
power and their vertices for other values, and Dr.Jit the derivatives; nothing is traced again. So
a path that the new values make invalid loses its power, and one that they would make possible is not there.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.errors import BackendError, PositionError
from sionna_partial.files import temporary_folder
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import SceneSettings, TraceSettings, require
from sionna_partial.tracing.candidates import Candidates
from sionna_partial.tracing.engine import REMEDY, SceneSolver, Variables, engine_fault, forward_passes
from sionna_partial.tracing.finder import write_scene_of
from sionna_partial.tracing.paths import SolvedPaths, join_paths
from sionna_partial.tracing.trace import Progress, TracedLinks, checked_positions, checked_settings, link_summary

PATHS_PER_BLOCK = 50_000
"""Number of paths that are evaluated together, which bounds the memory."""


@dataclass(frozen=True)
class PathParameters:
    """What the power of paths depends on, or what derives from each of them.

    Parameters
    ----------
    tx_m : (3,) float64 array
        Transmitter position [m].
    relative_permittivity, conductivity_s_m, thickness_m : (M,) float64 arrays
        Of each material: real relative permittivity, conductivity [S/m] and thickness [m]. ITU materials follow the
        frequency on top of that, as Sionna RT has them.
    frequency_hz : () float64 array
        Carrier frequency [Hz].
    """

    tx_m: NDArray[np.float64]
    relative_permittivity: NDArray[np.float64]
    conductivity_s_m: NDArray[np.float64]
    thickness_m: NDArray[np.float64]
    frequency_hz: NDArray[np.float64]


PARAMETERS = tuple(field.name for field in fields(PathParameters))
MATERIAL_PARAMETERS = PARAMETERS[1:4]


class PathScene:
    """A scene that is written and opened once, for the paths of any transmitters.

    Parameters
    ----------
    partial : PartialMap
        What is known of the building; unknown space is free.
    settings : TraceSettings, optional
        Refraction and diffuse reflection must be off; diffraction too on meshes.
    scene_settings : SceneSettings, optional

    Raises
    ------
    SettingsError
        For a frequency that a material does not cover, settings of another kind, or paths that only rays find.
    BackendError
        If LLVM or Sionna RT cannot be used, or Sionna RT is not what the fast engine was made for.
    OutputError
        If no temporary file can be written.

    Attributes
    ----------
    shift_m : (3,) float64 array
        Where the origin of scene coordinates is [m].
    written : PlanScene or MeshScene
    solver : SceneSolver
    """

    def __init__(
        self,
        partial: PartialMap,
        *,
        settings: TraceSettings | None = None,
        scene_settings: SceneSettings | None = None,
    ) -> None:
        self.partial = partial
        self.settings, self.scene_settings = fixed_path_settings(partial, settings, scene_settings)
        if engine_fault():
            raise BackendError(f"Gradients need the fast engine, and {engine_fault()}: {REMEDY}")
        self.shift_m = np.array([*partial.origin_m, 0.0])
        with temporary_folder() as folder:
            self.written = write_scene_of(partial, folder, self.settings, self.scene_settings)
            self.solver = SceneSolver(self.written.xml, self.written.shapes, self.settings)

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the M radio materials, in the order of `PathParameters`."""
        return tuple(self.solver.materials)

    def parameters(self, tx_m: ArrayLike) -> PathParameters:
        """Return what the scene has, with a transmitter (3,) [m]."""
        permittivity, conductivity_s_m, thickness_m = np.reshape([*self.solver.materials.values()], (-1, 3)).T
        frequency_hz = np.array(self.settings.frequency_hz)
        return PathParameters(
            np.array(tx_m, dtype=np.float64), permittivity, conductivity_s_m, thickness_m, frequency_hz
        )

    def paths(self, tx: ArrayLike, rx: ArrayLike, *, progress: Progress | None = None) -> "FixedPaths":
        """Find all paths from a transmitter to N receivers, as `trace_links` does.

        Parameters
        ----------
        tx : (3,) array-like
            Transmitter position [m].
        rx : (N, 3) array-like
            Receiver positions [m]; N may be 0.
        progress : callable, optional
            Called as ``progress(share_done, message)``.

        Returns
        -------
        FixedPaths

        Raises
        ------
        PositionError
            For a transmitter or receiver that is not finite, outside the map or inside a wall, a receiver at the
            transmitter, or several transmitters.
        """
        tx_m, rx_m = checked_ends(self.partial, tx, rx, self.settings.frequency_hz)
        report = progress or (lambda fraction, message: None)
        parts = [each for part in self.blocks(tx_m, rx_m, report) for each in part.parts]
        report(1.0, "traced")
        return FixedPaths(self, self.parameters(tx_m), rx_m, parts)

    def blocks(self, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], report: Progress) -> Iterator["FixedPaths"]:
        """Find the same paths block by block, which bounds the memory; positions come from `checked_ends`."""
        base, (tx, rx) = self.parameters(tx_m), (tx_m - self.shift_m, rx_m - self.shift_m)
        for found in self.written.paths(self.solver, tx, rx, report) if len(rx) else ():
            yield FixedPaths(self, base, rx_m, [found])


class FixedPaths:
    """The P paths from one transmitter to N receivers, found once by a `PathScene`.

    Attributes
    ----------
    base : PathParameters
        For which they were found.
    rx_m : (N, 3) float64 array
        Receiver positions [m].
    rx_of_path : (P,) int32 array
        Receiver of each path.
    power : (P,) float64 array
        Squared magnitude |a|^2 of each, at `base`.
    interactions : (P, D) uint8 array
        Sionna RT's `InteractionType` of every interaction in order from the transmitter; 0 where there is none.
    vertices_m : (P, D, 3) float64 array
        Places of the interactions at `base` [m]; NaN where there is none.
    parts : list of (Candidates, SolvedPaths)
        What they are made of, in scene coordinates.
    """

    def __init__(
        self,
        scene: PathScene,
        base: PathParameters,
        rx_m: NDArray[np.float64],
        parts: list[tuple[Candidates, SolvedPaths]],
    ) -> None:
        self.base, self.rx_m, self.parts, self._scene = base, rx_m, parts, scene
        depth = max(1, scene.settings.max_depth)
        paths = [join_paths([], depth), *(solved for _, solved in parts)]
        self.rx_of_path = np.concatenate([each.path_rx for each in paths])
        self.power = np.concatenate([np.abs(each.a) ** 2 for each in paths])
        self.interactions = np.concatenate([_widened(each.interactions, depth, 0) for each in paths])
        self.vertices_m = np.concatenate([_widened(each.vertices_m, depth, math.nan) for each in paths]) + scene.shift_m

    def __len__(self) -> int:
        """Return the number of paths P."""
        return len(self.rx_of_path)

    @property
    def is_direct(self) -> NDArray[np.bool_]:
        """Whether each path (P,) is the line of sight."""
        return (self.interactions == 0).all(axis=1)

    def links(self) -> TracedLinks:
        """Return the links as `trace_links` does."""
        paths = join_paths([solved for _, solved in self.parts], self._scene.settings.max_depth)
        paths.vertices_m[:] += self._scene.shift_m
        power = np.bincount(self.rx_of_path, weights=self.power, minlength=len(self.rx_m)).astype(np.float64)
        is_direct = np.isin(np.arange(len(self.rx_m)), self.rx_of_path[self.is_direct])
        link_state, gain_db = link_summary(power, is_direct)
        return TracedLinks(
            tx=self.base.tx_m,
            rx=self.rx_m,
            link_state=link_state,
            gain_db=gain_db,
            **{field.name: getattr(paths, field.name) for field in fields(SolvedPaths)},
            settings=self._scene.settings,
            scene_settings=self._scene.scene_settings,
        )

    def at(self, parameters: PathParameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Evaluate the paths for other parameters.

        Parameters
        ----------
        parameters : PathParameters

        Returns
        -------
        power : (P,) float64 array
            0 where a path is not valid any more.
        vertices_m : (P, D, 3) float64 array
            NaN where there is no interaction.

        Raises
        ------
        SettingsError
            For a frequency that a material does not cover; so do the derivatives.
        """
        power, vertices_m = np.zeros(len(self)), np.full_like(self.vertices_m, math.nan)
        _, variables = self._variables(parameters)
        for block, candidates in self._blocks():
            found = self._moved(candidates, variables, differentiable=False)
            depth = candidates.face.shape[1]
            power[block] = found[0].numpy()
            vertices_m[block, :depth] = np.transpose(found[1].numpy()).reshape(-1, depth, 3)
        vertices_m[self.interactions == 0] = math.nan
        return power, vertices_m + self._scene.shift_m

    def slopes(
        self, parameters: PathParameters, names: Sequence[str] = PARAMETERS, *, together: bool = False
    ) -> dict[str, NDArray[np.float64]]:
        """Differentiate the power of each path.

        Dr.Jit passes forward once for each entry of each parameter. Backwards, one pass takes longer than these seven
        of a floor plan, and what it says of the transmitter differs from run to run.

        Parameters
        ----------
        parameters : PathParameters
            Where.
        names : sequence of str
            Fields of `PathParameters`.
        together : bool
            Whether all materials change together, by as much.

        Returns
        -------
        dict of str to (P, K) float64 array
            Derivatives with respect to the K entries of each field; those of all materials have one, `together`.
        """
        leaves, _ = self._variables(parameters, together=together)
        power = {name: np.zeros((len(self), len(leaves[name]))) for name in names}
        for block, name, entry, of_power, _ in self._passes(parameters, names, together=together):
            power[name][block, entry] = of_power.numpy()
        return power

    def transmitter_slopes(self, parameters: PathParameters) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Differentiate power and vertices of each path with respect to the transmitter's place.

        Parameters
        ----------
        parameters : PathParameters
            Where.

        Returns
        -------
        power : (P, 3) float64 array
            Derivatives of the power with respect to x, y, z [1/m].
        vertices_m : (P, D, 3, 3) float64 array
            Of the x, y, z of each vertex with respect to those of the transmitter; 0 where there is no vertex.
        """
        power, vertices_m = np.zeros((len(self), 3)), np.zeros((*self.vertices_m.shape, 3))
        for block, _, entry, of_power, of_vertices in self._passes(parameters, ("tx_m",)):
            power[block, entry] = of_power.numpy()
            places = np.transpose(of_vertices.numpy()).reshape(block.stop - block.start, -1, 3)
            vertices_m[block, : places.shape[1], :, entry] = places
        vertices_m[self.interactions == 0] = 0.0
        return power, vertices_m

    def _passes(
        self, parameters: PathParameters, names: Sequence[str], *, together: bool = False
    ) -> Iterator[tuple[slice, str, int, Any, Any]]:
        """Pass forward from each entry of each parameter: derivatives of power and vertices, block by block."""
        import drjit as dr

        for block, candidates in self._blocks():
            leaves, variables = self._variables(parameters, together=together)
            dr.enable_grad([leaves[name] for name in names])
            power, vertices_m = self._moved(candidates, variables)
            results = power, vertices_m + dr.opaque(type(power), 0.0)  # power is made of them: theirs would be cleared
            for name in names:
                for entry, slopes in enumerate(forward_passes(results, leaves[name])):
                    yield block, name, entry, *slopes

    def _moved(self, candidates: Candidates, variables: Variables, *, differentiable: bool = True) -> tuple[Any, Any]:
        tx_m, rx_m = self.base.tx_m - self._scene.shift_m, self.rx_m - self._scene.shift_m
        return self._scene.solver.moved_paths(candidates, tx_m, rx_m, variables, differentiable=differentiable)

    def _variables(
        self, parameters: PathParameters, *, together: bool = False
    ) -> tuple[dict[str, list[Any]], Variables]:
        """Return a variable for each entry of each parameter, by name, and all of them for the solver."""
        import drjit as dr
        import mitsuba as mi

        if parameters.frequency_hz != self.base.frequency_hz:
            settings = replace(self._scene.settings, frequency_hz=float(parameters.frequency_hz))
            checked_settings(self._scene.partial, settings, self._scene.scene_settings)
        values = {name: np.ravel(getattr(parameters, name)) for name in PARAMETERS}
        for name in ("tx_m", "frequency_hz"):
            values[name] = values[name] - np.ravel(getattr(self.base, name))
        leaves = {name: [dr.opaque(mi.Float, float(value)) for value in own] for name, own in values.items()}
        materials = {name: tuple(leaves[name]) for name in MATERIAL_PARAMETERS}
        if together:
            for name in MATERIAL_PARAMETERS:
                leaves[name] = [dr.opaque(mi.Float, 0.0)]
                dr.enable_grad(leaves[name])
                materials[name] = tuple(value + leaves[name][0] for value in materials[name])
        x_m, y_m, z_m = leaves["tx_m"]
        return leaves, Variables(x_m, y_m, z_m, **materials, frequency_hz=leaves["frequency_hz"][0])

    def _blocks(self) -> Iterator[tuple[slice, Candidates]]:
        """Candidates in blocks, and where their paths are among all."""
        first = 0
        for candidates, _ in self.parts:
            count = len(candidates.rx)
            for start in range(0, count, PATHS_PER_BLOCK):
                stop = min(start + PATHS_PER_BLOCK, count)
                yield slice(first + start, first + stop), candidates.rows(np.arange(start, stop))
            first += count


def _widened(columns: NDArray[Any], depth: int, value: float) -> NDArray[Any]:
    """Add interactions that there are not up to the depth D: (P, D, ...)."""
    wide = np.full((len(columns), depth, *columns.shape[2:]), value, dtype=columns.dtype)
    wide[:, : columns.shape[1]] = columns
    return wide


def fixed_path_settings(
    partial: PartialMap, settings: TraceSettings | None, scene_settings: SceneSettings | None
) -> tuple[TraceSettings, SceneSettings]:
    """Check settings as `checked_settings` does, and raise a SettingsError for paths that only rays find."""
    settings, scene_settings = checked_settings(partial, settings, scene_settings)
    _require_off(settings, "refraction", "diffuse_reflection")
    if partial.mesh is not None:
        _require_off(settings, "diffraction")
    return settings, scene_settings


def checked_ends(
    partial: PartialMap, tx: ArrayLike, rx: ArrayLike, frequency_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Check one transmitter and N receivers as `PathScene.paths` does, and give copies (3,) and (N, 3) [m]."""
    tx_m, rx_m = checked_positions(partial, tx, rx, frequency_hz)
    if np.ndim(tx) != 1:
        raise PositionError(f"tx has shape {np.shape(tx)}: give one transmitter as (3,).")
    return tx_m[0].copy(), rx_m.copy()


def _require_off(settings: TraceSettings, *names: str) -> None:
    for name in names:
        value = getattr(settings, name)
        remedy = "paths that are found by shooting rays have no gradients: give False"
        require(not value, name, value, f"{remedy}, and trace_links for the gain alone.")
