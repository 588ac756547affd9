"""Stock Sionna RT for the benchmarks: its path solver on tiles of receivers, and what it finds."""

import multiprocessing
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.tracing.engine import load_sionna
from sionna_partial.tracing.interactions import DIFFRACTION
from sionna_partial.tracing.plan.edges import MAX_REFLECTIONS
from sionna_partial.tracing.stock import listed_before

Paths = dict[str, NDArray[Any]]
"""Paths of one receiver: `a` and `delay_s` (P,), `interactions` (P, D), `vertices_m` (P, D, 3), NaN where none is."""

TRUTH_RAYS = 1_000_000
TRUTH_TABLE = 30_000_000
TILE = 100


def isolated(function: Callable[..., dict], *arguments: object, **options: object) -> dict:
    """Run a measurement in a fresh process, so that memory and warm-up are its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments, options)


def trace_stock(
    folder: str,
    tx: NDArray[np.float64],
    rx: NDArray[np.float64],
    *,
    tile: int = TILE,
    rays: int = TRUTH_RAYS,
    table: int = TRUTH_TABLE,
    max_depth: int = 6,
    diffraction: bool = False,
    cores: int | None = None,
) -> dict:
    """Run stock `PathSolver` on tiles of receivers: seconds, peak memory, and each receiver's paths, each once."""
    limit_cores(cores)
    rt = load_sionna()
    start = time.perf_counter()
    paths: list[Paths] = []
    repeats = 0
    for first in range(0, len(rx), tile):
        part = rx[first : first + tile]
        found = rt.PathSolver()(
            stock_scene(rt, folder, tx, part),
            max_depth=max_depth,
            refraction=False,
            diffraction=diffraction,
            edge_diffraction=diffraction,
            samples_per_src=rays,
            max_num_paths_per_src=table,
        )
        for index in range(len(part)):
            each, twice = receiver_paths(found, index, len(part), max(1, max_depth))
            paths.append(each)
            repeats += twice
    return {"seconds": time.perf_counter() - start, "memory_gb": peak_memory_gb(), "paths": paths, "repeats": repeats}


def true_paths(folder: str, tx: NDArray[np.float64], rx: NDArray[np.float64], **options: Any) -> dict:
    """Run `trace_stock` for the truth: with diffraction, each diffracted path is taken from a run of just its depth.

    Sionna RT 2.2 counts a part of the length twice where a path is reflected after its diffraction and has fewer
    interactions than the largest depth allows: it is some dB too weak.
    """
    result = trace_stock(folder, tx, rx, **options)
    if not options["diffraction"]:
        return result
    whole = [{name: values[~is_bent(paths)] for name, values in paths.items()} for paths in result["paths"]]
    for depth in range(1, min(1 + MAX_REFLECTIONS, options["max_depth"]) + 1):
        for index, paths in enumerate(trace_stock(folder, tx, rx, **{**options, "max_depth": depth})["paths"]):
            kept = is_bent(paths) & (paths["interactions"] > 0).all(axis=1)
            whole[index] = _joined(whole[index], {name: values[kept] for name, values in paths.items()})
    return result | {"paths": whole}


def is_bent(paths: Paths) -> NDArray[np.bool_]:
    """Whether each path diffracts."""
    return (paths["interactions"] == DIFFRACTION).any(axis=1)


def _joined(deep: Paths, other: Paths) -> Paths:
    """Paths of both, the second with no more interactions than the first."""
    missing = deep["interactions"].shape[1] - other["interactions"].shape[1]
    kinds = np.pad(other["interactions"], ((0, 0), (0, missing)))
    vertices_m = np.pad(other["vertices_m"], ((0, 0), (0, missing), (0, 0)), constant_values=np.nan)
    padded = {**other, "interactions": kinds, "vertices_m": vertices_m}
    return {name: np.concatenate([values, padded[name]]) for name, values in deep.items()}


def receiver_paths(found: Any, index: int, receivers: int, depth: int) -> tuple[Paths, int]:
    """Paths of one receiver, each once, and how many were listed again."""
    valid = np.flatnonzero(found.valid.numpy().reshape(receivers, -1)[index])
    real, imaginary = (part.numpy().reshape(receivers, -1)[index, valid].astype(float) for part in found.a)
    interactions = found.interactions.numpy().reshape(depth, receivers, -1)[:, index, valid].T.astype(np.uint8)
    vertices_m = np.moveaxis(found.vertices.numpy().reshape(depth, receivers, -1, 3)[:, index, valid], 0, 1)
    once = ~listed_before(interactions, vertices_m)
    paths = {
        "a": real + 1j * imaginary,
        "delay_s": found.tau.numpy().reshape(receivers, -1)[index, valid].astype(float),
        "interactions": interactions,
        "vertices_m": np.where(interactions[:, :, None] > 0, vertices_m.astype(float), np.nan),
    }
    return {name: values[once] for name, values in paths.items()}, int((~once).sum())


def stock_scene(rt: Any, folder: str, tx: NDArray[np.float64], rx: NDArray[np.float64]) -> Any:
    """Stock scene with isotropic antennas at the given positions."""
    scene = rt.load_scene(f"{folder}/scene.xml")
    scene.frequency = 28e9
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, vertical_spacing=0.5, horizontal_spacing=0.5, pattern="iso", polarization="V"
    )
    scene.add(rt.Transmitter("tx", position=[float(value) for value in tx]))
    for index, position in enumerate(rx):
        scene.add(rt.Receiver(f"rx{index}", position=[float(value) for value in position]))
    return scene


def limit_cores(cores: int | None) -> None:
    """Keep this process, which has not started Dr.Jit, on so many cores."""
    if cores is not None:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])


def peak_memory_gb() -> float:
    """Largest resident memory of this process so far [GB]; `getrusage` would count the parent's at the fork."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(re.search(r"VmHWM:\s+(\d+) kB", status)[1]) / 1e6
