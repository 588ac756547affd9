"""Scene + transmitters + receivers -> TracedLinks."""

import itertools
import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.checks import Progress, no_progress, require_choice, settings_or_default
from sionna_partial.constants import GAIN_FLOOR_DB, MEMORY_GB, NO_RECEIVER, SPEED_OF_LIGHT_M_S, CellState, LinkState
from sionna_partial.errors import BackendError, MemoryLimitError, PositionError
from sionna_partial.files import atomic_files, temporary_folder
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap, position_array
from sionna_partial.progress import part_of, reporting
from sionna_partial.scene.scene import scene_settings_of
from sionna_partial.settings import SceneSettings, TraceSettings
from sionna_partial.tracing.candidates import Wedges
from sionna_partial.tracing.engine import SceneSolver, engine_fault, load_sionna, open_scene
from sionna_partial.tracing.finder import MeshScene, PlanScene, write_scene_of
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import (
    DIFFRACTION,
    DIFFUSE,
    REFLECTION,
    PathColumns,
    PathFiles,
    SolvedPaths,
    path_bytes,
)
from sionna_partial.tracing.plan.diffraction import MAX_REFLECTIONS

InvalidLinks = Literal["raise", "nan"]
"""What becomes of links that cannot be traced."""

_log = logging.getLogger(__name__)

SHORTEST_M = 0.011
"""Shortest distance of a link [m]. Sionna RT drops every leg of a path of 1 cm or less."""

RECEIVERS_OF_PLAN, RECEIVERS_OF_MESH = 6_000, 50_000
"""Number of receivers whose paths are found together, which bounds the memory. A mesh has fewer paths, and costs rays
each time."""

TABLE_SIZE = 3_000_000
"""Entries of the hash table, at least: more lose fewer paths where refraction makes many, and take more memory."""

SAME_POINT_M = 0.03
"""Paths of the same interactions at points closer than this are one path [m]."""

SAME_EDGE_M = 1e-3
"""Distance from an edge within which a diffraction is at that edge [m]."""

SAMPLE = 100
"""Number of receivers from which the number of all paths is estimated."""


def trace_links(
    scene: PartialMap | str | Path,
    tx: ArrayLike,
    rx: ArrayLike,
    *,
    trace_settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
    folder: str | Path | None = None,
    memory_gb: float = MEMORY_GB,
    invalid: InvalidLinks = "raise",
    progress: Progress | bool | None = None,
) -> TracedLinks:
    """Trace every path from one or more transmitters to N receivers with Sionna RT.

    On a floor plan, line of sight, specular reflections and paths with one diffraction at a vertical edge of the walls
    (corners, door jambs) and at most two reflections around it are complete, but for legs of 1 cm or less, which Sionna
    RT drops: candidates come from exact beams and are verified by Sionna RT's image method. On a mesh, rays determine
    the sequences of planes; line of sight and nearly all specular reflections are found. With refraction, diffuse
    reflection or, on a mesh, diffraction switched on, Sionna RT's public path solver shoots rays instead, receiver by
    receiver, which is slow and finds most paths, not all. It also does with another release of Sionna RT than 2.2. The
    answer for a receiver does not depend on the other receivers.

    Parameters
    ----------
    scene : PartialMap or path
        What is known of the building; unknown space is free (paper, Section III-B).
    tx : (3,) or (T, 3) array-like
        Transmitter positions [m].
    rx : (N, 3) array-like
        Receiver positions [m]; N may be 0.
    trace_settings : TraceSettings, optional
    scene_settings : SceneSettings, optional
    folder : path, optional
        Where the paths are written while they are traced, an `.npy` file for each array. The arrays of the result are
        then read from there when they are needed, and `memory_gb` does not limit them.
    memory_gb : float
        How much memory the paths may take [GB]. Their size is estimated first, from some of the receivers.
    invalid : {"raise", "nan"}
        What becomes of links whose receiver can stand nowhere (it is not finite, outside the map, in a wall, not
        between floor and ceiling) or is at the transmitter: an error, or a link without paths, of link state 255 and
        gain NaN.
    progress : bool or callable, optional
        False shows none; a callable is called as ``progress(fraction_done, message)``. By default a bar appears in
        terminals and notebooks after 2 s.

    Returns
    -------
    TracedLinks

    Raises
    ------
    MemoryLimitError
        If the paths would take more than `memory_gb`.
    PositionError
        For a transmitter or receiver that is not finite, outside the map or inside a wall, or a receiver within 1.1 cm
        of a transmitter (at low frequencies, where Friis' formula is above 0 dB); with "nan" for a transmitter only.
    SettingsError
        For a frequency that a material does not cover, settings of another kind, or another value of `invalid`.
    BackendError
        If LLVM or Sionna RT cannot be used.
    OutputError
        If no temporary file can be written.

    Examples
    --------
    In free space, the gain at a distance of 2 m is 20 log10(wavelength / (4 pi 2 m)), at 28 GHz:

    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> field = sp.PartialMap(np.zeros((20, 60), dtype=np.uint8), resolution_m=0.1)
    >>> open_air = sp.SceneSettings(floor_extent="none")
    >>> links = sp.trace_links(field, (1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)], scene_settings=open_air)
    >>> links.gain_db.round(2).tolist()
    [-67.41]
    """
    partial = scene if isinstance(scene, PartialMap) else load_map(scene)
    settings, scene_settings = checked_settings(partial, trace_settings, scene_settings)
    require_choice("invalid", invalid, get_args(InvalidLinks))
    if invalid == "nan":
        tx_m, rx_m, valid = valid_links(partial, tx, rx, settings.frequency_hz)
    else:
        tx_m, rx_m = checked_positions(partial, tx, rx, settings.frequency_hz)
        valid = np.ones((len(tx_m), len(rx_m)), dtype=bool)
    shape = np.shape(tx)
    with reporting(progress) as report:
        report(0.0, "building the scene")
        tracer = Tracer(partial, settings, scene_settings, polarisations=2)
        tracer.require_memory(tx_m, rx_m, None if folder is not None else memory_gb, valid)
        if folder is None:
            return tracer.links(tx_m.reshape(shape), rx_m, report, valid)
        with atomic_files(folder) as files:
            columns = PathFiles(max(1, settings.max_depth), files, tracer.polarisations)
            link_state, gain_db = tracer.fill(columns, tx_m.reshape(shape), rx_m, report, valid)
            columns.close()
            ends = ("tx", tx_m.reshape(shape)), ("rx", rx_m)
            for name, values in (*ends, ("link_state", link_state), ("gain_db", gain_db)):
                np.save(files / f"{name}.npy", values)
    names = [field.name for field in fields(TracedLinks) if not field.name.endswith("settings")]
    stored = {name: np.load(Path(folder) / f"{name}.npy", mmap_mode="r") for name in names}
    return TracedLinks(**stored, settings=settings, scene_settings=scene_settings)


def trace_each(
    partial: PartialMap,
    tx: Sequence[ArrayLike],
    rx: Sequence[ArrayLike],
    *,
    settings: TraceSettings | None = None,
    scene_settings: SceneSettings | None = None,
) -> list[TracedLinks]:
    """Trace from each of T transmitters (3,) to receivers (N, 3) of its own, in a scene that is built once."""
    settings, scene_settings = checked_settings(partial, settings, scene_settings)
    ends = [checked_positions(partial, *each, settings.frequency_hz) for each in zip(tx, rx, strict=True)]
    tracer = Tracer(partial, settings, scene_settings)
    return [tracer.links(tx_m[0], rx_m, no_progress) for tx_m, rx_m in ends]


@dataclass(frozen=True)
class Tracer:
    """Finds paths in one scene, which Sionna RT loads when the first are asked for.

    Settings come from `checked_settings`, positions [m] from `checked_positions`.
    """

    partial: PartialMap
    settings: TraceSettings
    scene_settings: SceneSettings
    polarisations: int = 1

    @cached_property
    def _loaded(self) -> tuple[PlanScene | MeshScene, SceneSolver] | None:
        """The scene and the solver of its candidates; None if only rays find the paths, and a warning is logged."""
        wanted = {
            "refraction": self.settings.refraction,
            "diffuse reflection": self.settings.diffuse_reflection,
            "diffraction on a mesh": self.settings.diffraction and self.partial.mesh is not None,
        }
        names = [name for name, is_wanted in wanted.items() if is_wanted]
        if names:
            message = "%s: Sionna RT shoots %d rays for one receiver after the other, and finds most paths, not all"
            _log.warning(message, " and ".join(names), self.settings.samples_per_tx)
        if names or engine_fault():
            return None
        return load_scene(self.partial, self.settings, self.scene_settings, self.polarisations)

    def links(self, tx_m: Floats, rx_m: Floats, report: Progress, valid: Bools | None = None) -> TracedLinks:
        """Trace the links between transmitters (3,) or (T, 3) and receivers (N, 3), or those of a mask (T, N)."""
        columns = PathColumns(max(1, self.settings.max_depth), self.polarisations)
        link_state, gain_db = self.fill(columns, tx_m, rx_m, report, valid)
        found = vars(columns.paths())
        return TracedLinks(
            tx_m, rx_m, link_state, gain_db, **found, settings=self.settings, scene_settings=self.scene_settings
        )

    def fill(
        self, columns: PathColumns | PathFiles, tx_m: Floats, rx_m: Floats, report: Progress, valid: Bools | None = None
    ) -> tuple[States, Floats]:
        """Trace the same links into columns of paths; return their states and gains [dB], (N,) or (T, N)."""
        at_once = RECEIVERS_OF_PLAN if self.partial.mesh is None else RECEIVERS_OF_MESH
        sources, count = tx_m.reshape(-1, 3), len(rx_m)
        valid = np.ones((len(sources), count), dtype=bool) if valid is None else valid
        power, is_direct = np.zeros(valid.shape), np.zeros(valid.shape, dtype=bool)
        blocks = [
            (tx, chosen[start : start + at_once].astype(np.int32))
            for tx, chosen in enumerate(map(np.flatnonzero, valid))
            for start in range(0, len(chosen), at_once)
        ]
        for number, (tx, chosen) in enumerate(blocks):
            ends = (0.1 + 0.9 * (number + each) / len(blocks) for each in (0, 1))
            block = self.paths(sources[tx], rx_m[chosen], part_of(report, *ends))
            parts = [paths.between(tx, chosen) for paths in block]
            columns.append(parts)
            for paths in parts:
                np.add.at(power[tx], paths.path_rx, np.abs(paths.a) ** 2)
                is_direct[tx, paths.path_rx[paths.is_direct]] = True
        link_state, gain_db = link_summary(power, is_direct)
        link_state[~valid], gain_db[~valid] = NO_RECEIVER, np.nan
        shape = (*tx_m.shape[:-1], count)
        return link_state.reshape(shape), gain_db.reshape(shape)

    def require_memory(self, tx_m: Floats, rx_m: Floats, memory_gb: float | None, valid: Bools) -> None:
        """Log how much memory the paths of a large job take, estimated from some of its receivers.

        Raises a MemoryLimitError if that is more than `memory_gb`.
        """
        if valid.sum() <= RECEIVERS_OF_PLAN:
            return
        source = int(valid.sum(axis=1).argmax())
        all_m = rx_m[valid[source]]
        some = all_m[np.linspace(0, len(all_m) - 1, min(len(all_m), SAMPLE)).astype(int)]
        found = sum(len(paths.a) for paths in self.paths(tx_m[source], some, no_progress))
        count = round(found / len(some) * valid.sum())
        size_gb = 2 * count * path_bytes(max(1, self.settings.max_depth), self.polarisations) / 1e9
        _log.info("about %d paths, which take %.1f GB", count, size_gb)
        if memory_gb is not None and size_gb > memory_gb:
            raise MemoryLimitError(
                f"memory_gb = {memory_gb:g} is too little for about {count:,} paths, which take {size_gb:.1f} GB: give "
                "a folder for the paths, fewer receivers, or more memory_gb."
            )

    def paths(self, tx_m: Floats, rx_m: Floats, report: Progress) -> Iterator[SolvedPaths]:
        """Find all paths between a transmitter (3,) and receivers (N, 3), some paths at a time."""
        shift_m = np.array([*self.partial.origin_m, 0.0])
        for paths in self._paths(tx_m - shift_m, rx_m - shift_m, report):
            if len(paths.a):
                yield replace(paths, vertices_m=paths.vertices_m + shift_m)
        report(1.0, "traced")

    def _paths(self, tx_m: Floats, rx_m: Floats, report: Progress) -> Iterator[SolvedPaths]:
        """Find the same paths in scene coordinates."""
        if self._loaded is not None:
            scene, solver = self._loaded
            yield from (found.paths for found in scene.paths(solver, tx_m, rx_m, report))
            return
        with temporary_folder() as folder:
            scene = write_scene_of(self.partial, folder, self.settings, self.scene_settings)
            found_by_rays = stock_paths(scene.xml, self.settings, tx_m, rx_m, self.polarisations)
            for number, paths in enumerate(found_by_rays, start=1):
                report(number / len(rx_m), f"shooting rays to {len(rx_m)} receivers")
                if isinstance(scene, PlanScene):
                    paths = paths.take(diffracted_as_exact(scene.wedges, paths, self.settings.diffraction_walls))
                yield paths


def load_scene(
    partial: PartialMap, settings: TraceSettings, scene_settings: SceneSettings, polarisations: int = 1
) -> tuple[PlanScene | MeshScene, SceneSolver]:
    """Let Sionna RT load the scene of a map; settings come from `checked_settings`."""
    with temporary_folder() as folder:
        scene = write_scene_of(partial, folder, settings, scene_settings)
        return scene, SceneSolver(scene.xml, scene.shapes, settings, polarisations)


def checked_settings(
    partial: PartialMap, settings: TraceSettings | None, scene_settings: SceneSettings | None
) -> tuple[TraceSettings, SceneSettings]:
    """Put defaults in place of None, and the map's material in place of the settings'.

    Raises a SettingsError unless all materials cover the frequency.
    """
    settings = settings_or_default("trace_settings", settings, TraceSettings)
    scene_settings = scene_settings_of(partial, scene_settings)
    default = scene_settings.material
    for material in {default} if partial.mesh is None else partial.mesh.used_materials(default):
        material.require_frequency(settings.frequency_hz)
    if settings.diffraction is None:
        settings = replace(settings, diffraction=partial.mesh is None)
    return settings, scene_settings


def nearest_m(frequency_hz: float) -> float:
    """Shortest distance of a link [m]: Sionna RT takes none of 1 cm, and Friis' formula is above 0 dB nearer by."""
    return max(SHORTEST_M, SPEED_OF_LIGHT_M_S / frequency_hz / (4.0 * math.pi))


def clear_of_walls(partial: PartialMap, points_m: Floats) -> Bools:
    """Whether receivers can be at points (..., 3) [m]: in no wall, and not within 1.1 cm of one."""
    clear: Bools = partial.state_at(points_m) != CellState.WALL
    for corner in itertools.product((-SHORTEST_M, SHORTEST_M), repeat=2):
        clear &= partial.state_at(points_m[..., :2] + corner) != CellState.WALL
    return clear


def checked_positions(partial: PartialMap, tx: ArrayLike, rx: ArrayLike, frequency_hz: float) -> tuple[Floats, Floats]:
    """Check the positions and give the transmitters as (T, 3), the receivers as (N, 3)."""
    tx_m, rx_m = partial.require_positions("tx", tx), _receivers(rx)
    partial.require_positions("rx", rx_m)
    tx_m, limit_m = tx_m.reshape(-1, 3), nearest_m(frequency_hz)
    for source_m in tx_m:
        distance_m = np.linalg.norm(rx_m - source_m, axis=1)
        if distance_m.min(initial=math.inf) < limit_m:
            index = int(distance_m.argmin())
            raise PositionError(
                f"rx[{index}] = {tuple(rx_m[index].tolist())} is {distance_m[index]:.3g} m from the transmitter, where "
                f"the path gain has no meaning: leave out receivers nearer than {limit_m:.3g} m."
            )
    return tx_m, rx_m


def valid_links(partial: PartialMap, tx: ArrayLike, rx: ArrayLike, frequency_hz: float) -> tuple[Floats, Floats, Bools]:
    """Return transmitters (T, 3) and receivers (N, 3) [m], and whether `checked_positions` takes each link (T, N)."""
    tx_m, rx_m = partial.require_positions("tx", tx).reshape(-1, 3), _receivers(rx)
    far = np.linalg.norm(rx_m - tx_m[:, None], axis=-1) >= nearest_m(frequency_hz)
    return tx_m, rx_m, far & partial.radios_can_stand(rx_m)


def _receivers(rx: ArrayLike) -> Floats:
    with suppress(ValueError):  # nested lists of unequal lengths have no size
        rx = np.zeros((0, 3)) if np.size(rx) == 0 else rx
    return position_array("rx", rx).reshape(-1, 3)


def path_gain_db(power: Floats) -> Floats:
    """Omnidirectional path gain [dB], at least -150, of links whose paths have |a|^2 in sum (paper, eq. 5)."""
    with np.errstate(divide="ignore"):
        return np.maximum(10.0 * np.log10(power), GAIN_FLOOR_DB)


def link_summary(power: Floats, is_direct: Bools) -> tuple[States, Floats]:
    """Link state and path gain [dB] of links, from the sum of |a|^2 and whether one path has no interaction."""
    gain_db = path_gain_db(power)
    link_state = np.where(gain_db > GAIN_FLOOR_DB, LinkState.NLOS, LinkState.OUTAGE).astype(np.uint8)
    link_state[is_direct] = LinkState.LOS
    return link_state, gain_db


def stock_paths(
    scene_xml: Path, settings: TraceSettings, tx_m: Floats, rx_m: Floats, polarisations: int = 1
) -> Iterator[SolvedPaths]:
    """Find paths of every enabled kind from a transmitter (3,) to receivers (N, 3) by Sionna RT's public path solver.

    Positions and paths are in scene coordinates. Most paths are found, not all: the more rays, the more. Sionna RT
    counts the sequences of surfaces that rays meet in a hash table which all receivers of a call share, where a
    collision drops a path: each receiver has a call of its own, and its paths do not depend on the others. Sionna RT
    2.2 takes paths that are reflected after a diffraction, and have fewer than `max_depth` interactions, for longer
    than they are, and some dB too weak. Raises a BackendError if LLVM or Sionna RT cannot be used.
    """
    if len(rx_m) == 0:
        return
    rt = load_sionna()
    try:
        scene = open_scene(scene_xml, settings.frequency_hz, polarisations)
        receiver = rt.Receiver("rx", position=_point(rx_m[0]))
        scene.add(rt.Transmitter("tx", position=_point(tx_m)))
        scene.add(receiver)
        solver = rt.PathSolver(deterministic=True)
        for index, position_m in enumerate(rx_m):
            receiver.position = _point(position_m)
            yield _read_paths(solver(scene, **_options(settings)), max(1, settings.max_depth), index, tx_m, rx_m)
    except Exception as error:
        raise BackendError(
            f"Sionna RT {metadata.version('sionna-rt')} cannot solve the paths ({error!r}): lower samples_per_tx if "
            "memory ran out, or run pip install sionna-partial again."
        ) from error


def _point(position_m: Floats) -> Any:
    """Position as an array on the device: Dr.Jit would compile a literal into its kernels, anew for each receiver."""
    import mitsuba as mi

    return mi.Point3f(*(mi.Float([float(value)]) for value in position_m))


def _options(settings: TraceSettings) -> dict[str, Any]:
    """Arguments of Sionna RT's path solver."""
    diffraction, rays = settings.diffraction is True, settings.samples_per_tx
    every_ray = 1 + rays * settings.max_depth if settings.diffuse_reflection else 0
    return {
        "max_depth": settings.max_depth,
        "max_num_paths_per_src": max(TABLE_SIZE, every_ray),
        "samples_per_src": rays,
        "los": True,
        "specular_reflection": True,
        "diffuse_reflection": settings.diffuse_reflection,
        "refraction": settings.refraction,
        "diffraction": diffraction,
        "edge_diffraction": diffraction,
        "seed": settings.seed,
    }


def _read_paths(found: Any, depth: int, index: int, tx_m: Floats, rx_m: Floats) -> SolvedPaths:
    """Copy the valid paths of one receiver out of Dr.Jit, each once."""
    real, imaginary = (np.transpose(part.numpy()[0, :, 0], (2, 0, 1)) for part in found.a)
    transfer = real + 1j * imaginary
    valid = np.flatnonzero(found.valid.numpy().ravel() & (transfer[:, 0, 0] != 0.0))
    interactions = found.interactions.numpy().reshape(depth, -1)[:, valid].T.astype(np.uint8)
    vertices_m = np.moveaxis(found.vertices.numpy().reshape(depth, -1, 3)[:, valid], 0, 1)
    kept = ~listed_before(interactions, vertices_m)
    return SolvedPaths.of_vertices(
        path_rx=np.full(kept.sum(), index, np.int32),
        transfer=transfer[valid][kept].astype(np.complex128),
        delay_s=found.tau.numpy().ravel()[valid].astype(np.float64)[kept],
        interactions=interactions[kept],
        vertices_m=vertices_m[kept],
        tx_m=tx_m,
        rx_m=rx_m,
    )


def listed_before(interactions: States, vertices_m: NDArray[np.floating[Any]]) -> Bools:
    """Find the paths (P,) of one receiver that repeat an earlier one: the same interactions at the same points.

    Sionna RT identifies sequences by hashes of rounded planes, and rounding can give one plane two hashes. Paths with
    a diffuse reflection are samples of a rough surface, however close, and never repeats.
    """
    repeated = np.zeros(len(interactions), dtype=bool)
    exact = np.flatnonzero((interactions != DIFFUSE).all(axis=1))
    points = np.where(interactions[exact, :, None] > 0, vertices_m[exact], 0.0)
    tree = cKDTree(points.reshape(len(exact), 3 * interactions.shape[1]))
    pairs = tree.query_pairs(SAME_POINT_M, p=np.inf, output_type="ndarray")
    first, second = exact[pairs].T
    repeated[second[(interactions[first] == interactions[second]).all(axis=1)]] = True
    return repeated


def diffracted_as_exact(wedges: Wedges, paths: SolvedPaths, walls_a_side: int) -> Bools:
    """Whether each path (P,) is diffracted as exact candidates are, if it is at all.

    Sionna RT's rays are diffracted at the rims of floor and ceiling and at junctions of walls as well, and with any
    number of reflections around it.
    """
    diffracted = (paths.interactions == DIFFRACTION).any(axis=1)
    kept = ~diffracted
    if diffracted.any() and len(wedges.edge_m):
        which = (paths.interactions == DIFFRACTION).argmax(axis=1)
        x, y, z = paths.vertices_m[np.arange(len(diffracted)), which][diffracted].T
        beside = cKDTree(wedges.edge_m).query(np.column_stack([x, y]))[0] < SAME_EDGE_M
        reflected = paths.interactions[diffracted] == REFLECTION
        height_m = paths.vertices_m[diffracted, :, 2]
        at_walls = reflected & (height_m > SAME_EDGE_M) & (height_m < wedges.height_m - SAME_EDGE_M)
        before = np.arange(reflected.shape[1]) < which[diffracted, None]
        few = reflected.sum(axis=1) <= MAX_REFLECTIONS
        few &= ((at_walls & before).sum(axis=1) <= walls_a_side) & ((at_walls & ~before).sum(axis=1) <= walls_a_side)
        kept[diffracted] = few & beside & (z > SAME_EDGE_M) & (z < wedges.height_m - SAME_EDGE_M)
    return kept
