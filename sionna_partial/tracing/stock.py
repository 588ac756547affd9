"""Paths by Sionna RT's public path solver, which shoots rays and finds most paths of any kind, not all."""

from collections.abc import Iterator
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sionna_partial.arrays import Bools, Floats, States
from sionna_partial.errors import BackendError
from sionna_partial.settings import TraceSettings
from sionna_partial.tracing.engine import load_sionna
from sionna_partial.tracing.interactions import DIFFRACTION, DIFFUSE, INTERACTIONS, REFLECTION
from sionna_partial.tracing.paths import SolvedPaths, Wedges
from sionna_partial.tracing.plan.edges import MAX_REFLECTIONS

TABLE_SIZE = 3_000_000
"""Entries of the hash table, at least: more lose fewer paths where refraction makes many, and take more memory."""

SAME_POINT_M = 0.03
"""Paths of the same interactions at points closer than this are one path [m]."""

SAME_EDGE_M = 1e-3
"""Distance from an edge within which a diffraction is at that edge [m]."""


def stock_paths(scene: Any, settings: TraceSettings, tx_m: Floats, rx_m: Floats) -> Iterator[SolvedPaths]:
    """Find paths of every enabled kind from a transmitter (3,) to receivers (N, 3) by Sionna RT's public path solver.

    `scene` comes from `open_scene`; positions and paths are in its coordinates. Most paths are found, not all: the more
    rays, the more. Sionna RT counts the sequences of surfaces that rays meet in a hash table which all receivers of a
    call share, where a collision drops a path: each receiver has a call of its own, and its paths do not depend on the
    others. Sionna RT 2.2 takes paths that are reflected after a diffraction, and have fewer than `max_depth`
    interactions, for longer than they are, and some dB too weak. Raises a BackendError if LLVM or Sionna RT cannot be
    used.
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
    """Position as an array on the device: Dr.Jit would compile a literal into its kernels, anew for each receiver."""
    import mitsuba as mi

    return mi.Point3f(*(mi.Float([float(value)]) for value in position_m))


def _options(settings: TraceSettings) -> dict[str, Any]:
    """Arguments of Sionna RT's path solver."""
    rays = settings.samples_per_tx
    every_ray = 1 + rays * settings.max_depth if settings.diffuse_reflection else 0
    return {
        "max_depth": settings.max_depth,
        "max_num_paths_per_src": max(TABLE_SIZE, every_ray),
        "samples_per_src": rays,
        "los": True,
        "seed": settings.seed,
        **{argument: kind.is_on(settings) for kind in INTERACTIONS for argument in kind.arguments},
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
    """Return whether each path (P,) is diffracted as exact candidates are, if it is at all.

    Sionna RT's rays are diffracted at the rims of floor and ceiling and at junctions of walls as well, and with any
    number of reflections around it.
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
