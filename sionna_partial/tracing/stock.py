"""Paths and radio maps by Sionna RT's public solvers, which shoot rays and find most paths of any kind."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.checks import require
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.errors import BackendError, SettingsError
from sionna_partial.llvm import load_sionna
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.engine import set_antennas
from sionna_partial.tracing.interactions import DIFFRACTION, DIFFUSE, INTERACTIONS, REFLECTION
from sionna_partial.tracing.paths import SolvedPaths, Wedges
from sionna_partial.tracing.plan.edges import MAX_REFLECTIONS

TABLE_SIZE = 3_000_000
"""Smallest size of the hash table: larger ones lose fewer paths with refraction, and take more memory."""

SAME_POINT_M = 0.03
"""Paths of the same interactions at points closer than this are one path [m]."""

SAME_EDGE_M = 1e-3
"""Distance from an edge within which a diffraction is at that edge [m]."""


_MARKER_M = 0.15
"""Radius of the ball of a transmitter in previews and renderings [m]."""


def stock_paths(scene: Any, settings: TraceSettings, tx_m: Floats, rx_m: Floats) -> Iterator[SolvedPaths]:
    """Find paths of every enabled kind from a transmitter (3,) to receivers (N, 3) by Sionna RT's public path solver.

    Positions and paths are in the coordinates of `scene`, from `open_scene`. Each receiver has its own call: Sionna RT
    counts sequences of surfaces in a hash table shared by a call's receivers, where a collision drops a path. Sionna RT
    2.2 computes paths reflected after a diffraction, with fewer than `max_depth` interactions, too long and some dB too
    weak.
    """
    if len(rx_m) == 0:
        return
    rt = load_sionna()
    try:
        receiver = rt.Receiver("rx", position=_point(rx_m[0]))
        for device in (rt.Transmitter("tx", position=_point(tx_m)), receiver):
            scene.remove(device.name)
            scene.add(device)
        solver = rt.PathSolver(deterministic=True)
        for index, position_m in enumerate(rx_m):
            receiver.position = _point(position_m)
            yield _read_paths(solver(scene, **_options(settings)), max(1, settings.max_depth), index, tx_m, rx_m)
    except Exception as error:
        raise BackendError(
            f"Sionna RT {metadata.version('sionna-rt')} cannot solve the paths ({error!r}): lower samples_per_tx if "
            "memory ran out, or install sionna-partial again."
        ) from error


def _point(position_m: Floats) -> Any:
    """Return a position on the device: Dr.Jit would compile a literal into a kernel for each receiver."""
    import mitsuba as mi

    return mi.Point3f(*(mi.Float([float(value)]) for value in position_m))


def _options(settings: TraceSettings) -> dict[str, Any]:
    rays = settings.samples_per_tx
    every_ray = 1 + rays * settings.max_depth if settings.diffuse_reflection else 0
    return {
        "max_depth": settings.max_depth,
        "max_num_paths_per_src": max(TABLE_SIZE, every_ray),
        "samples_per_src": rays,
        "los": True,
        "seed": settings.seed,
        **_switches(settings),
    }


def _switches(settings: TraceSettings) -> dict[str, bool]:
    return {argument: kind.is_on(settings) for kind in INTERACTIONS for argument in kind.arguments}


def _read_paths(found: Any, depth: int, index: int, tx_m: Floats, rx_m: Floats) -> SolvedPaths:
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
    """Mark the paths (P,) of one receiver that repeat an earlier one: the same interactions at the same points.

    Sionna RT identifies sequences by hashes of rounded planes, where one plane can have two. Diffuse reflections are
    samples of a rough surface and never repeats.
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
    """Return whether each path (P,) is a candidate of a plan, if it is diffracted at all.

    Sionna RT's rays are also diffracted at the rims of floor and ceiling and at junctions of walls, with any number of
    reflections.
    """
    diffracted = (paths.interactions == DIFFRACTION).any(axis=1)
    kept = ~diffracted
    if diffracted.any() and len(wedges.edge_m):
        which = (paths.interactions == DIFFRACTION).argmax(axis=1)
        x, y, z = paths.vertices_m[np.arange(len(diffracted)), which][diffracted].T
        distance_m, edge = cKDTree(wedges.edge_m).query(np.column_stack([x, y]))
        beside, top_m = distance_m < SAME_EDGE_M, wedges.height_m[edge]
        reflected = paths.interactions[diffracted] == REFLECTION
        height_m = paths.vertices_m[diffracted, :, 2]
        at_walls = reflected & (height_m > SAME_EDGE_M) & (height_m < wedges.height_m.max() - SAME_EDGE_M)
        before = np.arange(reflected.shape[1]) < which[diffracted, None]
        few = reflected.sum(axis=1) <= MAX_REFLECTIONS
        few &= ((at_walls & before).sum(axis=1) <= walls_a_side) & ((at_walls & ~before).sum(axis=1) <= walls_a_side)
        kept[diffracted] = few & beside & (z > SAME_EDGE_M) & (z < top_m - SAME_EDGE_M)
    return kept


@dataclass(frozen=True)
class MapPlane:
    """Measurement plane of a radio map: cell centres x (nx,) and y (ny,), step and height in the scene [m]."""

    x_m: Floats
    y_m: Floats
    spacing_m: float
    height_m: float

    @property
    def arguments(self) -> dict[str, list[float]]:
        """Arguments of Sionna RT's radio maps, which round the size up to whole cells."""
        centre = [float(axis[0] + axis[-1]) / 2.0 for axis in (self.x_m, self.y_m)]
        size = [(len(axis) - 0.5) * self.spacing_m for axis in (self.x_m, self.y_m)]
        return {
            "center": [*centre, self.height_m],
            "orientation": [0.0, 0.0, 0.0],
            "size": size,
            "cell_size": [self.spacing_m, self.spacing_m],
        }


def planar_radio_map(scene: Any, plane: MapPlane, tx: Mapping[str, Floats], gain_db: Floats) -> Any:
    """Return path gains (T, ny, nx) as a PlanarRadioMap; the scene's transmitters are replaced by `tx`."""
    rt = load_sionna()
    import mitsuba as mi

    require(isinstance(scene, rt.Scene), "scene", scene, "give a scene of sionna.rt.load_scene.")
    for name in [*scene.transmitters]:
        scene.remove(name)
    for name, position_m in tx.items():
        place = [float(value) for value in position_m]
        scene.add(rt.Transmitter(name, position=place, display_radius=_MARKER_M))
    found = rt.PlanarRadioMap(scene, **plane.arguments)
    power = np.where(gain_db > GAIN_FLOOR_DB, 10.0 ** (gain_db / 10.0), 0.0)  # 0, not a floor, means no path; NaN, too
    found._pathgain_map = mi.TensorXf(power.astype(np.float32))
    return found


def stock_gain_db(scene: Any, plane: MapPlane, tx: Mapping[str, Floats], settings: TraceSettings) -> Floats:
    """Return the path gains (T, ny, nx) of Sionna RT's RadioMapSolver, -150 dB where it finds no path.

    Frequency and transmitters of the scene are replaced; it gets isotropic antennas if it has none.
    """
    level = [name for name, position_m in tx.items() if abs(position_m[2] - plane.height_m) < plane.spacing_m / 10.0]
    if level:
        raise SettingsError(
            f"rx_height_m = {plane.height_m:g} is the height of {level[0]}, and RadioMapSolver "
            "misses rays that stay in the plane of its map: predict at another height."
        )
    planar_radio_map(scene, plane, tx, np.zeros((1, 1, 1)))
    scene.frequency = settings.frequency_hz
    if scene.tx_array is None:
        set_antennas(scene, 1)
    options = {"samples_per_tx": settings.samples_per_tx, "max_depth": settings.max_depth, "seed": settings.seed}
    found = load_sionna().RadioMapSolver()(scene, **plane.arguments, **options, **_switches(settings))
    with np.errstate(divide="ignore"):
        return np.maximum(10.0 * np.log10(found.path_gain.numpy().astype(np.float64)), GAIN_FLOOR_DB)
