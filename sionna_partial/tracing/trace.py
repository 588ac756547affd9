"""The one door to the path solver: scene + transmitter + receivers -> TracedLinks."""

import logging
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from functools import partial as partial_function
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.constants import GAIN_FLOOR_DB, MEMORY_GB, SPEED_OF_LIGHT_M_S, LinkState
from sionna_partial.errors import MemoryLimitError, PositionError
from sionna_partial.files import atomic_files, temporary_folder
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.scene import scene_settings_of
from sionna_partial.settings import SceneSettings, TraceSettings, settings_or_default
from sionna_partial.tracing.generator import Finder, WrittenScene, bends_at, write_scene_of
from sionna_partial.tracing.paths import PathColumns, PathFiles, SolvedPaths, path_bytes
from sionna_partial.tracing.probe import fast_engine_works
from sionna_partial.tracing.solver import SceneSolver
from sionna_partial.tracing.stock import stock_paths

_log = logging.getLogger(__name__)

Progress = Callable[[float, str], None]
"""Called with the share of the work done, in [0, 1], and what is being done."""


SHORTEST_M = 0.011
"""Shortest distance of a link [m]. Sionna RT drops every leg of a path of 1 cm or less."""

RECEIVERS_OF_PLAN, RECEIVERS_OF_MESH = 6_000, 50_000
"""Number of receivers whose paths are found together, which bounds the memory. A mesh has fewer paths, and costs rays
each time."""

SAMPLE = 100
"""Number of receivers from which the number of all paths is estimated."""

Solve = Callable[[NDArray[np.float64], NDArray[np.float64]], Iterator[tuple[SolvedPaths, float, str]]]
"""Solves the paths from one transmitter (3,) to receivers (N, 3), in scene coordinates, block by block: the paths of a
block, the share of the work done, and what is being done."""


@dataclass(frozen=True)
class TracedLinks:
    """Every traced path from one or T transmitters to N receivers.

    Paths are listed one after the other, ordered by transmitter, receiver and delay; P is their number.

    Parameters
    ----------
    tx : (3,) or (T, 3) float64 array
        Transmitter positions [m].
    rx : (N, 3) float64 array
        Receiver positions [m].
    link_state : (N,) or (T, N) uint8 array of LinkState
    gain_db : (N,) or (T, N) float64 array
        Omnidirectional path gain [dB], at least -150 (paper, eq. 5).
    path_tx, path_rx : (P,) int32 arrays
        Indices of the transmitter and the receiver that each path joins.
    a : (P,) complex128 array
        Complex path gain (isotropic antennas, vertical polarisation).
    delay_s : (P,) float64 array
        Propagation delay [s].
    departure_rad, arrival_rad : (P, 2) float64 arrays
        Zenith and azimuth of departure at the transmitter and of arrival at the receiver [rad].
    interactions : (P, D) uint8 array
        Sionna RT's `InteractionType` of every interaction in order from the transmitter; 0 where there is none.
    vertices_m : (P, D, 3) float64 array
        Places of the interactions [m]; NaN where there is none.
    settings : TraceSettings
        With `diffraction` True or False.
    scene_settings : SceneSettings
        With the map's material, if it has one.
    """

    tx: NDArray[np.float64]
    rx: NDArray[np.float64]
    link_state: NDArray[np.uint8]
    gain_db: NDArray[np.float64]
    path_tx: NDArray[np.int32]
    path_rx: NDArray[np.int32]
    a: NDArray[np.complex128]
    delay_s: NDArray[np.float64]
    departure_rad: NDArray[np.float64]
    arrival_rad: NDArray[np.float64]
    interactions: NDArray[np.uint8]
    vertices_m: NDArray[np.float64]
    settings: TraceSettings
    scene_settings: SceneSettings


def trace_links(
    scene: PartialMap | str | Path,
    tx: ArrayLike,
    rx: ArrayLike,
    *,
    settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    folder: str | Path | None = None,
    memory_gb: float = MEMORY_GB,
    progress: Progress | None = None,
) -> TracedLinks:
    """Trace every path from one or more transmitters to N receivers with Sionna RT.

    On a floor plan, line of sight, specular reflections and paths with one diffraction at a vertical edge of the walls
    (corners, door jambs) and at most two reflections around it are complete, but for legs of 1 cm or less, which Sionna
    RT drops: candidates come from exact beams and are verified by Sionna RT's image method. On a mesh, rays say which
    chains of planes there are; line of sight and nearly all specular reflections are found. With refraction, diffuse
    reflection or, on a mesh, diffraction switched on, Sionna RT's public path solver shoots rays instead, receiver by
    receiver, which is slow and finds most paths, not all. So it is where Sionna RT is another than `contract` expects.
    The answer for a receiver does not depend on the other receivers.

    Parameters
    ----------
    scene : PartialMap or path
        What is known of the building; unknown space is free (paper, Section III-B).
    tx : (3,) or (T, 3) array-like
        Transmitter positions [m].
    rx : (N, 3) array-like
        Receiver positions [m]; N may be 0.
    settings : TraceSettings, optional
    scene_settings : SceneSettings, optional
    folder : path, optional
        Where the paths are written while they are traced, an `.npy` file for each array. The arrays of the result are
        then read from there when they are needed, and `memory_gb` does not limit them.
    memory_gb : float
        How much memory the paths may take [GB]. Their size is estimated first, from some of the receivers.
    progress : callable, optional
        Called as ``progress(fraction_done, message)``.

    Returns
    -------
    TracedLinks

    Raises
    ------
    MemoryLimitError
        If the paths would take more than `memory_gb`.
    PositionError
        For a transmitter or receiver that is not finite, outside the map or inside a wall, or a receiver within 1.1 cm
        of a transmitter (at low frequencies, where Friis' formula is above 0 dB).
    SettingsError
        For a frequency that a material does not cover, or settings of another kind.
    BackendError
        If LLVM or Sionna RT cannot be used.
    OutputError
        If no temporary file can be written.
    """
    partial = scene if isinstance(scene, PartialMap) else load_map(scene)
    settings, scene_settings = checked_settings(partial, settings, scene_settings)
    places, rx_m = checked_positions(partial, tx, rx, settings.frequency_hz)
    tx_m = places.reshape(np.shape(tx))
    report, depth = progress or (lambda share, message: None), max(1, settings.max_depth)
    report(0.0, "building the scene")
    with temporary_folder() as work:
        tracer = Tracer(partial, work, settings, scene_settings)
        tracer.require_memory(places, rx_m, None if folder is not None else memory_gb)
        if folder is None:
            return _traced_links(tracer, tx_m, rx_m, report)
        with atomic_files(folder) as place:
            columns = PathFiles(depth, place)
            link_state, gain_db = tracer.links(tx_m, rx_m, report, columns)
            columns.close()
            for name, values in (("tx", tx_m), ("rx", rx_m), ("link_state", link_state), ("gain_db", gain_db)):
                np.save(place / f"{name}.npy", values)
    stored = {field.name: np.load(Path(folder) / f"{field.name}.npy", mmap_mode="r") for field in _ARRAYS}
    return TracedLinks(**stored, settings=settings, scene_settings=scene_settings)


def _traced_links(
    tracer: "Tracer", tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], report: Progress
) -> TracedLinks:
    columns = PathColumns(max(1, tracer.settings.max_depth))
    link_state, gain_db = tracer.links(tx_m, rx_m, report, columns)
    found = {field.name: getattr(columns.paths(), field.name) for field in fields(SolvedPaths)}
    return TracedLinks(
        tx_m, rx_m, link_state, gain_db, **found, settings=tracer.settings, scene_settings=tracer.scene_settings
    )


def trace_each(
    partial: PartialMap,
    tx: Sequence[ArrayLike],
    rx: Sequence[ArrayLike],
    *,
    settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
) -> list[TracedLinks]:
    """Trace every path from each of T transmitters to receivers of its own, on a scene that is built once.

    Parameters
    ----------
    partial : PartialMap
    tx : sequence of T (3,) array-likes
        Transmitter positions [m].
    rx : sequence of T (N, 3) array-likes
        Receiver positions of each transmitter [m]; N may differ, and be 0.
    settings : TraceSettings, optional
    scene_settings : SceneSettings, optional

    Returns
    -------
    list of T TracedLinks
        Each is what `trace_links` gives for that transmitter and its receivers, whose errors are raised here too.
    """
    settings, scene_settings = checked_settings(partial, settings, scene_settings)
    places = [
        checked_positions(partial, place, receivers, settings.frequency_hz)
        for place, receivers in zip(tx, rx, strict=True)
    ]
    with temporary_folder() as folder:
        tracer = Tracer(partial, folder, settings, scene_settings)
        return [_traced_links(tracer, tx_m[0], rx_m, lambda share, message: None) for tx_m, rx_m in places]


_ARRAYS = tuple(field for field in fields(TracedLinks) if not field.name.endswith("settings"))


@dataclass(frozen=True)
class Tracer:
    """Finds paths on one scene, which is written to `folder` when the first are asked for.

    Parameters
    ----------
    partial : PartialMap
    folder : Path
    settings, scene_settings : TraceSettings, SceneSettings
        From `checked_settings`.
    """

    partial: PartialMap
    folder: Path
    settings: TraceSettings
    scene_settings: SceneSettings

    @cached_property
    def _solver(self) -> tuple[Solve, int]:
        """How paths are found, and for how many receivers at once."""
        return _solver(self.partial, self.folder, self.settings, self.scene_settings)

    def links(
        self, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], report: Progress, columns: PathColumns | PathFiles
    ) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        """Trace the links between transmitters (3,) or (T, 3) and receivers (N, 3) [m] into columns of paths.

        Returns their link states and path gains [dB], (N,) or (T, N).
        """
        places = tx_m.reshape(-1, 3)
        shape, links = (*tx_m.shape[:-1], len(rx_m)), len(places) * len(rx_m)
        power, is_direct = np.zeros(links), np.zeros(links, bool)
        for block in self._blocks(places, rx_m, report):
            columns.append(block)
            for paths in block:
                link = paths.path_tx.astype(np.int64) * len(rx_m) + paths.path_rx
                np.add.at(power, link, np.abs(paths.a) ** 2)
                is_direct[link[paths.is_direct]] = True
        link_state, gain_db = link_summary(power, is_direct)
        return link_state.reshape(shape), gain_db.reshape(shape)

    def require_memory(self, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], memory_gb: float | None) -> None:
        """Say how much memory the paths will take, estimated from some receivers of a large job.

        Raises a MemoryLimitError if that is more than `memory_gb`.
        """
        if len(tx_m) * len(rx_m) <= RECEIVERS_OF_PLAN:
            return
        some = rx_m[np.linspace(0, len(rx_m) - 1, min(len(rx_m), SAMPLE)).astype(int)]
        found = sum(len(paths.a) for paths in self.paths(tx_m[0], some, lambda share, message: None))
        count = round(found / len(some) * len(rx_m) * len(tx_m))
        size_gb = 2 * count * path_bytes(max(1, self.settings.max_depth)) / 1e9
        _log.info("about %d paths, which take %.1f GB", count, size_gb)
        if memory_gb is not None and size_gb > memory_gb:
            raise MemoryLimitError(
                f"memory_gb = {memory_gb:g} is too little for about {count:,} paths, which take {size_gb:.1f} GB: give "
                "a folder for the paths, fewer receivers, or more memory_gb."
            )

    def _blocks(
        self, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], report: Progress
    ) -> Iterator[list[SolvedPaths]]:
        """Find all paths between transmitters (T, 3) and receivers (N, 3) [m], some receivers at a time."""
        if len(rx_m) == 0:
            return
        at_once = self._solver[1]
        starts = [(tx, start) for tx in range(len(tx_m)) for start in range(0, len(rx_m), at_once)]
        for number, (tx, start) in enumerate(starts):

            def within(share: float, message: str, number: int = number) -> None:
                report(0.1 + 0.9 * (number + share) / len(starts), message)

            yield [paths.between(tx, start) for paths in self.paths(tx_m[tx], rx_m[start : start + at_once], within)]

    def paths(self, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], report: Progress) -> Iterator[SolvedPaths]:
        """Find all paths between a transmitter (3,) and receivers (N, 3) [m], some paths at a time."""
        shift = np.array([*self.partial.origin_m, 0.0])
        for paths, share, message in self._solver[0](tx_m - shift, rx_m - shift):
            report(share, message)
            if len(paths.a):
                yield replace(paths, vertices_m=paths.vertices_m + shift)
        report(1.0, "traced")


def checked_settings(
    partial: PartialMap, settings: TraceSettings | None, scene_settings: SceneSettings | None
) -> tuple[TraceSettings, SceneSettings]:
    """Put defaults in place of None, and the map's material in place of the settings'.

    Raises a SettingsError unless all materials cover the frequency.
    """
    settings = settings_or_default("settings", settings, TraceSettings)
    scene_settings = scene_settings_of(partial, scene_settings, "scene_settings")
    default = scene_settings.material
    for material in {default} if partial.mesh is None else partial.mesh.used_materials(default):
        material.require_frequency(settings.frequency_hz)
    if settings.diffraction is None:
        settings = replace(settings, diffraction=partial.mesh is None)
    return settings, scene_settings


def nearest_m(frequency_hz: float) -> float:
    """Shortest distance of a link [m]: Sionna RT takes none of 1 cm, and Friis' formula is above 0 dB nearer by."""
    return max(SHORTEST_M, SPEED_OF_LIGHT_M_S / frequency_hz / (4.0 * math.pi))


def checked_positions(
    partial: PartialMap, tx: ArrayLike, rx: ArrayLike, frequency_hz: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Check the positions and give the transmitters as (T, 3), the receivers as (N, 3)."""
    tx_m = partial.require_positions("tx", tx)
    with suppress(ValueError):  # nested lists of unequal lengths have no size
        rx = np.zeros((0, 3)) if np.size(rx) == 0 else rx
    rx_m = partial.require_positions("rx", rx)
    if rx_m.ndim != 2:
        raise PositionError(f"rx has shape {rx_m.shape}: give receivers as (N, 3).")
    tx_m, limit_m = tx_m.reshape(-1, 3), nearest_m(frequency_hz)
    for place in tx_m:
        distance_m = np.linalg.norm(rx_m - place, axis=1)
        if distance_m.min(initial=math.inf) < limit_m:
            index = int(distance_m.argmin())
            raise PositionError(
                f"rx[{index}] = {tuple(rx_m[index].tolist())} is {distance_m[index]:.3g} m from the transmitter, where "
                f"the path gain has no meaning: leave out receivers nearer than {limit_m:.3g} m."
            )
    return tx_m, rx_m


def _solver(
    partial: PartialMap, folder: Path, settings: TraceSettings, scene_settings: SceneSettings
) -> tuple[Solve, int]:
    """Write the scene, and choose how its paths are found, and for how many receivers at once."""
    scene = write_scene_of(partial, folder, settings, scene_settings)
    if _shoots(settings, scene) or not fast_engine_works():
        solve = partial_function(_shoot, scene, settings)
    else:
        solve = partial_function(_verify, scene.paths, SceneSolver(scene.xml, scene.shapes, settings))
    return solve, RECEIVERS_OF_PLAN if scene.is_plan else RECEIVERS_OF_MESH


def _shoots(settings: TraceSettings, scene: WrittenScene) -> bool:
    """Whether the settings ask for paths that only rays find; a warning says so."""
    wanted = {
        "refraction": settings.refraction,
        "diffuse reflection": settings.diffuse_reflection,
        "diffraction on a mesh": settings.diffraction and not scene.is_plan,
    }
    names = [name for name, is_wanted in wanted.items() if is_wanted]
    if names:
        message = "%s: Sionna RT shoots %d rays for one receiver after the other, and finds most paths, not all"
        _log.warning(message, " and ".join(names), settings.samples_per_tx)
    return bool(names)


def _verify(
    find: Finder, solver: SceneSolver, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]
) -> Iterator[tuple[SolvedPaths, float, str]]:
    """Verify the candidates of the scene."""
    for _, paths, share, message in find(solver, tx_m, rx_m):
        yield paths, share, message


def _shoot(
    scene: WrittenScene, settings: TraceSettings, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]
) -> Iterator[tuple[SolvedPaths, float, str]]:
    """Let Sionna RT's public path solver shoot rays."""
    for paths, share in stock_paths(scene.xml, settings, tx_m, rx_m):
        kept = paths if scene.wedges is None else paths.take(bends_at(scene.wedges, paths, settings.diffraction_walls))
        yield kept, share, f"shooting rays to {len(rx_m)} receivers"


def path_gain_db(power: NDArray[np.float64]) -> NDArray[np.float64]:
    """Omnidirectional path gain of links (paper, eq. 5).

    Parameters
    ----------
    power : (N,) float64 array
        Sum of |a|^2 over the paths of each link.

    Returns
    -------
    (N,) float64 array
        At least -150 [dB].
    """
    with np.errstate(divide="ignore"):
        return np.maximum(10.0 * np.log10(power), GAIN_FLOOR_DB)


def link_summary(
    power: NDArray[np.float64], is_direct: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Link state and omnidirectional path gain [dB] of links (paper, eq. 5).

    Parameters
    ----------
    power : (N,) float64 array
        Sum of |a|^2 over the paths of each link.
    is_direct : (N,) bool array
        Whether one of them has no interaction.
    """
    gain_db = path_gain_db(power)
    link_state = np.where(gain_db > GAIN_FLOOR_DB, LinkState.NLOS, LinkState.OUTAGE).astype(np.uint8)
    link_state[is_direct] = LinkState.LOS
    return link_state, gain_db
