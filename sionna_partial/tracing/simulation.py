"""Simulation of the paths between transmitters and receivers in a map, by Sionna RT."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.checks import Progress, no_progress, require, require_choice, require_memory, settings_or_default
from sionna_partial.constants import MEMORY_GB, NO_RECEIVER, CellState
from sionna_partial.display import part_of, reporting
from sionna_partial.errors import BackendError, MemoryLimitError
from sionna_partial.files import atomic_files, temporary_folder
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.scene import material_is_unknown, scene_settings_of
from sionna_partial.settings import SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.antennas import Antenna
from sionna_partial.tracing.engine import REMEDY, SceneSolver, engine_fault
from sionna_partial.tracing.finder import Counted, ExactFinder, Found, Purpose, RayFinder, write_scene_of
from sionna_partial.tracing.interactions import Interaction, only_by_rays, with_defaults
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.path_set import PathParameters, PathSet
from sionna_partial.tracing.paths import SEEN_M, LinkSums, LocatedPaths, PathColumns, PathFiles, SolvedPaths, path_bytes
from sionna_partial.tracing.positions import checked_positions, valid_links

Unobserved = Callable[[Floats, NDArray[np.uint8], Floats, Floats], Floats]
"""Function that returns the lengths (P,) of paths in unobserved space: from points (P, 3) by interactions (P, D) at
vertices (P, D, 3) to points (P, 3) [m]."""

InvalidLinks = Literal["raise", "nan"]

_log = logging.getLogger(__name__)


LARGE_JOB = 8_000
"""Number of links from which the memory of their paths is estimated."""

SAMPLE = 100
"""Number of receivers for this estimate."""


class ResolvedSettings(NamedTuple):
    """Settings on one map: defaults instead of None, and the map's material, if it has one."""

    trace_settings: TraceSettings
    scene_settings: SceneSettings


class Request(NamedTuple):
    """Paths that are wanted: with 1 or 2 polarisations, for an antenna and purpose as in `ExactFinder.paths`."""

    polarisations: int = 1
    antenna: Antenna | None = None
    purpose: Purpose = "links"
    unobserved: Unobserved | None = None


class Simulation:
    """Forward model: the paths of any links in one map, found by Sionna RT.

    The scene and compiled kernels are kept, so that later calls are faster. Every function that traces a map accepts a
    Simulation.

    Parameters
    ----------
    scene : PartialMap or path
        Map of the building; unknown space is free.
    trace_settings : TraceSettings, optional
    scene_settings : SceneSettings, optional

    Attributes
    ----------
    partial : PartialMap
    trace_settings : TraceSettings
        As given; `resolved` has the values on this map.
    scene_settings : SceneSettings
    resolved : ResolvedSettings
    material_unknown : bool
        True where paths go through walls of an unknown material.

    Raises
    ------
    MapError
        If the map cannot be read.
    SettingsError
        For a frequency that a material does not cover, or settings of another kind.

    Examples
    --------
    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> field = sp.PartialMap(np.zeros((20, 60), dtype=np.uint8), resolution_m=0.1)
    >>> simulation = sp.Simulation(field, scene_settings=sp.SceneSettings(floor_extent="none"))
    >>> [simulation.links((1.0, 1.0, 1.5), [(x, 1.0, 1.5)]).gain_db.round(1).item() for x in (3.0, 5.0)]
    [-67.4, -73.4]
    """

    @takes_settings
    def __init__(
        self,
        scene: PartialMap | str | Path,
        trace_settings: TraceSettings | None = None,
        scene_settings: SceneSettings | None = None,
    ) -> None:
        self.partial = scene if isinstance(scene, PartialMap) else load_map(scene)
        self.trace_settings = settings_or_default("trace_settings", trace_settings, TraceSettings)
        self.scene_settings = settings_or_default("scene_settings", scene_settings, SceneSettings)
        self.resolved = resolved_settings(self.partial, self.trace_settings, self.scene_settings)
        self.material_unknown = self.trace_settings.through_walls and material_is_unknown(
            self.partial, self.scene_settings
        )
        self._origin_m = np.array([*self.partial.origin_m, 0.0])

    def __repr__(self) -> str:
        x0, y0, x1, y1 = self.partial.bounds_m
        frequency = f"{self.trace_settings.frequency_hz / 1e9:g} GHz"
        walls = "through walls" if self.trace_settings.through_walls else "opaque walls"
        return f"Simulation({x1 - x0:.4g} x {y1 - y0:.4g} m, {frequency}, {walls})"

    def links(
        self,
        tx: ArrayLike,
        rx: ArrayLike,
        *,
        polarisations: Literal[1, 2] = 2,
        folder: str | Path | None = None,
        memory_gb: float = MEMORY_GB,
        invalid: InvalidLinks = "raise",
        progress: Progress | bool | None = None,
    ) -> TracedLinks:
        """Trace every path from one or more transmitters to N receivers: see `trace_links`.

        Parameters
        ----------
        tx, rx, folder, memory_gb, invalid, progress
            As in `trace_links`.
        polarisations : {2, 1}
            1 traces vertical polarisation alone, with a quarter of the memory for `TracedLinks.transfer`.
        """
        require_choice("invalid", invalid, get_args(InvalidLinks))
        require_memory(memory_gb)
        require(polarisations in (1, 2), "polarisations", polarisations, "give 1 or 2.")
        if invalid == "nan":
            tx_m, rx_m, valid = valid_links(self.partial, tx, rx, self.trace_settings.frequency_hz)
        else:
            tx_m, rx_m = checked_positions(self.partial, tx, rx, self.trace_settings.frequency_hz)
            valid = np.ones((len(tx_m), len(rx_m)), dtype=bool)
        ends: dict[str, Any] = {"tx": tx_m.reshape(np.shape(tx)), "rx": rx_m}
        room = self.trace_settings.most_interactions, polarisations
        settings = self.resolved._asdict()
        with reporting(progress) as report:
            report(0.0, "building the scene")
            self._require_memory(tx_m, rx_m, None if folder is not None else memory_gb, valid, path_bytes(*room))
            part = part_of(report, 0.1, 1.0)
            if folder is None:
                columns = PathColumns(*room)
                ends |= self._fill(columns, tx_m, rx_m, valid, part, polarisations)
                return TracedLinks(**_shaped(ends), **vars(columns.paths()), **settings)
            with atomic_files(folder) as files:
                paths = PathFiles(room[0], files, polarisations)
                ends |= self._fill(paths, tx_m, rx_m, valid, part, polarisations)
                paths.close()
                for name, values in _shaped(ends).items():
                    np.save(files / f"{name}.npy", values)
        names = [field.name for field in fields(TracedLinks) if field.name not in settings]
        stored: dict[str, Any] = {name: np.load(Path(folder) / f"{name}.npy", mmap_mode="r") for name in names}
        return TracedLinks(**stored, **settings)

    def with_every_path(self, links: TracedLinks, *, progress: Progress | bool | None = None) -> TracedLinks:
        """Trace links of this map again with ``power_tolerance_db=0``: channels then contain the weakest paths, too.

        Parameters
        ----------
        links : TracedLinks
            Returned as they are if they were traced without a tolerance.
        progress : bool or callable, optional
            As in `predict_map`.

        Raises
        ------
        MapError, PositionError, BackendError
            As `trace_links`.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> simulation = sp.Simulation(sp.make_home(3))
        >>> links = simulation.links((2.0, 3.0, 1.5), [(2.5, 3.0, 1.5)])
        >>> every = simulation.with_every_path(links)
        >>> every.trace_settings.power_tolerance_db, len(every.a) > len(links.a)
        (0.0, True)
        """
        if links.trace_settings.power_tolerance_db == 0.0:
            return links
        settings = replace(links.trace_settings, power_tolerance_db=0.0)
        every = Simulation(self.partial, settings, links.scene_settings)
        return every.links(links.tx, links.rx, invalid="nan", progress=progress)

    def with_tolerance(self, power_tolerance_db: float) -> Simulation:
        """Return the simulation of this map with another tolerance [dB], which is this one if it is equal."""
        if power_tolerance_db == self.trace_settings.tolerance_db:
            return self
        settings = replace(self.trace_settings, power_tolerance_db=power_tolerance_db)
        return Simulation(self.partial, settings, self.scene_settings)

    def paths(self, tx: ArrayLike, rx: ArrayLike, *, progress: Progress | bool | None = None) -> PathSet:
        """Find all paths from transmitters (3,) or (T, 3) to receivers (N, 3) [m], which can be differentiated.

        Raises
        ------
        PositionError
            As `trace_links`.
        BackendError
            As `trace_links`, and for an unsupported release of Sionna RT.
        SettingsError
            For paths that only rays find.
        """
        tx_m, rx_m = checked_positions(self.partial, tx, rx, self.trace_settings.frequency_hz)
        tx_m, rx_m = tx_m.reshape(np.shape(tx)).copy(), rx_m.copy()
        with reporting(progress) as report:
            found = PathSet.joined([PathSet(self, tx_m, rx_m, []), *self.path_blocks(tx_m, rx_m, report)])
            report(1.0, "traced")
        return found

    def blocks(
        self,
        tx_m: Floats,
        rx_m: Floats,
        report: Progress,
        antenna: Antenna | None = None,
        unobserved: Unobserved | None = None,
    ) -> Iterator[SolvedPaths]:
        """Find the paths for powers from a transmitter (3,) to receivers (N, 3), checked positions, in blocks.

        `antenna` is as in `ExactFinder.paths`. The power of a link is within the tolerance, and with `unobserved` its
        power through observed space: weak paths are left out, and others amplified by their expected power. Paths are
        then LocatedPaths if the transmitter is observed.
        """
        every, request = [np.arange(len(rx_m))], Request(1 if antenna is None else 2, antenna, "powers", unobserved)
        for group in self._groups(tx_m[None], rx_m, every, report, request):
            yield from (paths for _, paths in group)
        report(1.0, "traced")

    def path_blocks(
        self, tx_m: Floats, rx_m: Floats, report: Progress, rx_of_tx: Iterable[Indices] | None = None
    ) -> Iterator[PathSet]:
        """Find the paths of `paths` in blocks, for checked positions; `rx_of_tx` selects receivers by transmitter."""
        sources_m = tx_m.reshape(-1, 3)
        chosen = [np.arange(len(rx_m))] * len(sources_m) if rx_of_tx is None else rx_of_tx
        for group in self._groups(sources_m, rx_m, chosen, report, Request()):
            for candidates, paths in group:
                if candidates is not None:
                    yield PathSet(self, tx_m, rx_m, [(replace(candidates, rx=paths.path_rx), paths)])

    @property
    def solver(self) -> SceneSolver:
        """The solver of candidates in scene coordinates; raises as `require_exact`."""
        self.require_exact()
        assert isinstance(self._finder, ExactFinder)
        return self._finder.solver

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the M radio materials, in the order of `PathParameters`."""
        return tuple(self.solver.materials)

    def parameters(self, tx_m: ArrayLike) -> PathParameters:
        """Return the parameters of the scene, with transmitters (3,) or (T, 3) [m]."""
        permittivity, conductivity_s_m, thickness_m = np.reshape([*self.solver.materials.values()], (-1, 3)).T
        return PathParameters(
            tx_m=np.array(tx_m, dtype=np.float64),
            relative_permittivity=permittivity,
            conductivity_s_m=conductivity_s_m,
            thickness_m=thickness_m,
            frequency_hz=np.array(self.trace_settings.frequency_hz),
        )

    def require_frequency(self, frequency_hz: float) -> None:
        """Raise a SettingsError unless all materials cover a frequency [Hz]."""
        settings = replace(self.trace_settings, frequency_hz=float(frequency_hz))
        resolved_settings(self.partial, settings, self.scene_settings)

    def require_exact(self) -> None:
        """Raise a SettingsError for paths that only rays find, and a BackendError for an unsupported Sionna RT."""
        for kind in self._only_by_rays:
            remedy = "paths that are found by shooting rays have no gradients: give False"
            require(False, kind.setting, True, f"{remedy}, and trace_links for the gain alone.")
        if engine_fault():
            raise BackendError(f"Gradients need the fast engine, and {engine_fault()}: {REMEDY}")

    def in_scene(self, points_m: Floats) -> Floats:
        """Return world points (..., 3) [m] relative to the map's corner."""
        return points_m - self._origin_m

    def in_world(self, points_m: Floats) -> Floats:
        """Return scene points (..., 3) [m] in the world."""
        return points_m + self._origin_m

    @property
    def _only_by_rays(self) -> list[Interaction]:
        return only_by_rays(self.resolved.trace_settings, self.partial.environment.kind)

    @cached_property
    def _finder(self) -> ExactFinder | RayFinder:
        """Load the finder of paths; log a warning where only rays find them."""
        if self._only_by_rays:
            names = [f"{kind.setting} on a mesh" if kind.exact_on else kind.setting for kind in self._only_by_rays]
            message = "%s: Sionna RT shoots %d rays for one receiver after the other, and finds most paths, not all"
            _log.warning(message, " and ".join(names).replace("_", " "), self.trace_settings.samples_per_tx)
        with temporary_folder() as folder:
            settings, scene_settings = self.resolved
            scene = write_scene_of(self.partial, folder, settings, scene_settings)
            if self._only_by_rays or engine_fault():
                return RayFinder(scene)
            materials = self.partial.environment.scene_materials(scene_settings.traced_material)
            solver = SceneSolver(scene.xml, scene.shapes, settings, materials)
            return ExactFinder(scene, solver, self.material_unknown)

    def _groups(
        self, tx_m: Floats, rx_m: Floats, rx_of_tx: Iterable[Indices], report: Progress, request: Request
    ) -> Iterator[Iterator[Found]]:
        at_once = self.partial.environment.receivers_at_once
        groups = [
            (tx, chosen[start : start + at_once].astype(np.int32))
            for tx, chosen in enumerate(rx_of_tx)
            for start in range(0, len(chosen), at_once)
        ]
        for number, (tx, chosen) in enumerate(groups):
            part = part_of(report, number / len(groups), (number + 1) / len(groups))
            counted = self._counted(tx_m[tx], rx_m[chosen], request.unobserved)
            found = self._finder.paths(
                self.in_scene(tx_m[tx]),
                self.in_scene(rx_m[chosen]),
                request.polarisations,
                part,
                request.antenna,
                purpose=request.purpose,
                counted=counted,
            )
            yield self._in_world(tx, chosen, found)

    def _counted(self, tx_m: Floats, rx_m: Floats, unobserved: Unobserved | None) -> Counted | None:
        """Count the paths in observed space where both ends are observed, elsewhere all paths."""
        if unobserved is None or self.partial.state_at(tx_m) == CellState.UNKNOWN:
            return None
        rx_seen = self.partial.state_at(rx_m) != CellState.UNKNOWN

        def counted(paths: SolvedPaths) -> tuple[LocatedPaths, Bools]:
            rows, rx = np.flatnonzero(~paths.is_direct), paths.path_rx
            vertices_m, start_m = self.in_world(paths.vertices_m[rows]), np.broadcast_to(tx_m, (len(rows), 3))
            unobserved_m = np.zeros(len(rx))
            unobserved_m[rows] = unobserved(start_m, paths.interactions[rows], vertices_m, rx_m[rx[rows]])
            return LocatedPaths(**vars(paths), unobserved_m=unobserved_m), ~rx_seen[rx] | (unobserved_m < SEEN_M)

        return counted

    def _in_world(self, tx: int, chosen: NDArray[np.int32], found: Iterator[Found]) -> Iterator[Found]:
        for candidates, paths in found:
            if len(paths.a):
                world = replace(paths, vertices_m=self.in_world(paths.vertices_m))
                yield candidates, world.between(tx, chosen)

    def _fill(
        self,
        columns: PathColumns | PathFiles,
        tx_m: Floats,
        rx_m: Floats,
        valid: Bools,
        report: Progress,
        polarisations: int,
    ) -> dict[str, Any]:
        sums = LinkSums(*valid.shape)
        rx_of_tx = map(np.flatnonzero, valid)
        for group in self._groups(tx_m, rx_m, rx_of_tx, report, Request(polarisations)):
            parts = [paths for _, paths in group]
            columns.append(parts)
            for paths in parts:
                sums.add(paths)
        report(1.0, "traced")
        link_state, gain_db = sums.states_and_gains()
        link_state[~valid], gain_db[~valid] = NO_RECEIVER, np.nan
        return {"link_state": link_state, "gain_db": gain_db}

    def _require_memory(
        self, tx_m: Floats, rx_m: Floats, memory_gb: float | None, valid: Bools, bytes_each: int
    ) -> None:
        if valid.sum() <= LARGE_JOB:
            return
        source = int(valid.sum(axis=1).argmax())
        all_m = rx_m[valid[source]]
        some = all_m[np.linspace(0, len(all_m) - 1, min(len(all_m), SAMPLE)).astype(int)]
        every = [np.arange(len(some))]
        groups = self._groups(tx_m[source][None], some, every, no_progress, Request())
        found = sum(len(paths.a) for group in groups for _, paths in group)
        count = round(found / len(some) * valid.sum())
        size_gb = 2 * count * bytes_each / 1e9
        _log.info("about %d paths, which take %.1f GB", count, size_gb)
        if memory_gb is not None and size_gb > memory_gb:
            raise MemoryLimitError(
                f"memory_gb = {memory_gb:g} is too little for about {count:,} paths, which take {size_gb:.1f} GB: give "
                "a folder for the paths, fewer receivers, or more memory_gb."
            )


def _shaped(ends: dict[str, Any]) -> dict[str, Any]:
    shape = (*ends["tx"].shape[:-1], len(ends["rx"]))
    return {name: each if name in ("tx", "rx") else each.reshape(shape) for name, each in ends.items()}


class Simulated(Protocol):
    """An object with a simulation, such as a LinkModel."""

    simulation: Simulation


def simulation_of(
    scene: PartialMap | str | Path | Simulation | Simulated,
    trace_settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
) -> Simulation:
    """Return a simulation as it is, or make one of a map."""
    simulation: Any = getattr(scene, "simulation", scene)
    if not isinstance(simulation, Simulation):
        return Simulation(simulation, trace_settings, scene_settings)
    for name, value in (("trace_settings", trace_settings), ("scene_settings", scene_settings)):
        require(value is None, name, value, "the Simulation that was given has its own: leave it out.")
    return simulation


def resolved_settings(
    partial: PartialMap, trace_settings: TraceSettings, scene_settings: SceneSettings
) -> ResolvedSettings:
    """Resolve settings on a map; raise a SettingsError unless all materials cover the frequency."""
    scene_settings = scene_settings_of(partial, scene_settings)
    for material in partial.environment.known_materials(scene_settings.traced_material):
        material.require_frequency(trace_settings.frequency_hz)
    return ResolvedSettings(with_defaults(trace_settings, partial.environment.kind), scene_settings)
