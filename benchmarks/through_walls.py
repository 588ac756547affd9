"""Paths through walls: their time, weak paths that are left out, the loss of one mapped wall, and plans as meshes.

    python benchmarks/through_walls.py ../shared/gibson/*/map.yaml

takes some minutes for a map on two cores. Without maps it takes procedural homes. `--only wall`, for instance, runs one
part.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from stock import given_homes

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.prediction.wall_materials import COMMON
from sionna_partial.tracing.select import Limits

CASES = {"drywall": 28e9, "brick": 5e9}


def main() -> None:
    """Measure, and print a table for each part."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", type=Path, nargs="*")
    parser.add_argument("--only", choices=PARTS)
    parser.add_argument("--made", type=int, default=3, help="number of procedural homes without maps")
    arguments = parser.parse_args()
    maps = dict(given_homes(arguments.maps, arguments.made))
    for name, part in PARTS.items():
        if arguments.only in (None, name):
            part(maps)


def ends(partial: sp.PartialMap, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Draw a transmitter and receivers (N, 3) anywhere in free cells."""
    rng = np.random.default_rng(seed)
    row, column = np.nonzero(partial.state == CellState.FREE)
    cell = rng.permutation(len(row))[: 3 * count + 10]
    points = np.stack([column[cell], row[cell]], axis=1) + rng.uniform(0.2, 0.8, (len(cell), 2))
    points_m = np.column_stack([partial.origin_m + points * partial.resolution_m, np.full(len(cell), 1.5)])
    points_m = points_m[partial.radios_can_stand(points_m)][: count + 1]
    return points_m[0], points_m[1:]


def as_meshes(maps: dict[str, sp.PartialMap]) -> None:
    """Trace maps as meshes as well, and compare links."""
    print("\n| map | case | receivers | as mesh - as plan [dB]: 5, 50, 95 % | within 0.5 dB | time, opaque mesh = 1 |")
    print("|---|---|---|---|---|---|")
    for name, partial in maps.items():
        for material, frequency_hz in CASES.items():
            mesh = _as_mesh(partial)
            tx_m, rx_m = ends(partial, 500, 0)
            rx_m = rx_m[mesh.radios_can_stand(rx_m)]
            gains, seconds = [], []
            for scene, refraction in ((partial, True), (mesh, False), (mesh, True)):
                settings = sp.TraceSettings(frequency_hz, refraction=refraction, diffraction=False)
                simulation = sp.Simulation(scene, settings, sp.SceneSettings(material=material))
                simulation.links(tx_m, rx_m)
                start = time.perf_counter()
                gains.append(simulation.links(tx_m, rx_m).gain_db)
                seconds.append(time.perf_counter() - start)
            difference = gains[2] - gains[0]
            spread = " / ".join(f"{each:+.2f}" for each in np.percentile(difference, [5, 50, 95]))
            print(
                f"| {name} | {material}, {frequency_hz / 1e9:g} GHz | {len(rx_m)} | {spread} | "
                f"{np.mean(np.abs(difference) < 0.5):.1%} | {seconds[2] / seconds[1]:.1f} |"
            )


def _as_mesh(partial: sp.PartialMap) -> sp.PartialMap:
    """Return the mesh of the scene of a plan, with the plan's cells."""
    with tempfile.TemporaryDirectory() as folder:
        scene = sp.export_scene(partial, Path(folder) / "scene")
        (scene / "map.yaml").unlink()
        mesh = sp.load_map(scene / "scene.xml").mesh
    assert mesh is not None
    return replace(partial, mesh=replace(mesh, materials=(None,) * len(mesh.materials)))


def relative_time(maps: dict[str, sp.PartialMap]) -> None:
    """Compare warm traces of up to 3,000 receivers with opaque walls and through walls."""
    print("\n| map | case | receivers | opaque [s] | through walls, times as long | outages gain (median) [dB] |")
    print("|---|---|---|---|---|---|")
    for name, partial in maps.items():
        for material, frequency_hz in CASES.items():
            tx_m, rx_m = ends(partial, 3000, 0)
            seconds, gains = [], []
            for refraction in (False, True):
                settings = sp.TraceSettings(frequency_hz, refraction=refraction)
                simulation = sp.Simulation(partial, settings, sp.SceneSettings(material=material))
                simulation.links(tx_m, rx_m)
                start = time.perf_counter()
                links = simulation.links(tx_m, rx_m)
                seconds.append(time.perf_counter() - start)
                gains.append(links.gain_db)
            opaque = gains[0] <= -150.0
            gain = f"{np.median(gains[1][opaque] - gains[0][opaque]):.0f}" if opaque.any() else "none"
            print(
                f"| {name} | {material}, {frequency_hz / 1e9:g} GHz | {len(rx_m)} | {seconds[0]:.1f} | "
                f"{seconds[1] / seconds[0]:.1f} | {gain} |"
            )


def unknown_material(maps: dict[str, sp.PartialMap]) -> None:
    """Compare the time of predictions with walls of an unknown material and of named ones, and gains under each."""
    print("\n| map | GHz | material | receivers | named [s] | unknown, times as long |", end="")
    print(" nearest candidate is off [dB] | change of the mean by coarse limits [dB]: 50, 90 % |")
    print("|---|---|---|---|---|---|---|---|")
    for name, partial in maps.items():
        for frequency_hz in (2.4e9, 5e9):
            tx_m, rx_m = ends(partial, 1000, 0)
            found = {}
            for material in (None, *COMMON, "usual limits"):
                named = {"material": material} if material in COMMON else {}
                model = sp.LinkModel(partial, None, sp.TraceSettings(frequency_hz), sp.SceneSettings(**named))
                if material == "usual limits":
                    usual = replace(model.simulation._finder, material_unknown=False)
                    vars(model.simulation)["_finder"] = usual
                model.predict(tx_m, rx_m)  # compiles kernels
                start = time.process_time()
                found[material] = model.predict(tx_m, rx_m), time.process_time() - start
            (unknown, seconds), (usual, _) = found.pop(None), found.pop("usual limits")
            change_db = np.percentile(np.abs(unknown.gain_mean_db - usual.gain_mean_db), [50, 90])
            for material, (prediction, named_s) in found.items():
                off = [np.mean((each.gain_mean_db - prediction.gain_mean_db) ** 2) for each in unknown.by_material[0]]
                print(
                    f"| {name} | {frequency_hz / 1e9:g} | {material} | {len(rx_m)} | {named_s:.2f} | "
                    f"{seconds / named_s:.2f} | {np.sqrt(min(off)):.1f} | {change_db[0]:.2f}, {change_db[1]:.2f} |"
                )


def left_out(maps: dict[str, sp.PartialMap]) -> None:
    """Print what links of 200 receivers lack of their gain with the limits of weak paths, against much lower ones."""
    usual = Limits.of
    print("\n| map | case | paths | paths with low limits | missing [dB]: 50, 90, 99 %, most |")
    print("|---|---|---|---|---|")
    for name, partial in maps.items():
        tx_m, rx_m = ends(partial, 200, 0)
        for material, frequency_hz in (*CASES.items(), ("drywall", 2.4e9)):
            links = []
            for changes, tolerance_db in (({}, 0.1), ({"weakest": 1e-5, "discount": 1.0}, 0.01)):
                settings = sp.TraceSettings(frequency_hz, refraction=True, power_tolerance_db=tolerance_db)

                def limits(*given: Any, changes: dict[str, float] = changes, **options: bool) -> Limits:
                    return usual(*given, **options)._replace(**changes)

                with patch.object(Limits, "of", limits):
                    simulation = sp.Simulation(partial, settings, sp.SceneSettings(material=material))
                    links.append(simulation.links(tx_m, rx_m))
            missing_db = np.percentile(links[1].gain_db - links[0].gain_db, [50, 90, 99, 100])
            print(
                f"| {name} | {material}, {frequency_hz / 1e9:g} GHz | {len(links[0].a)} | {len(links[1].a)} | "
                f"{' / '.join(f'{each:.2f}' for each in missing_db)} |"
            )


def one_wall(maps: dict[str, sp.PartialMap]) -> None:
    """Print the loss of one wall of other depths, angles and turns of the grid, seen from one side and from both."""
    print("\nLoss of one straight wall [dB], brick of 10 cm at 5 GHz, beyond that of its slab")
    print("| turned by | angle of incidence | 1 cell | 3 cells | 8 cells | of 8 cells only the front seen |")
    print("|---|---|---|---|---|---|")
    for turned_deg in (0.0, 17.0, 45.0):
        for angle_deg in (0.0, 30.0, 60.0):
            losses = [_wall_loss_db(turned_deg, angle_deg, *case) for case in ((1, 1), (3, 3), (8, 8), (8, 2))]
            slab = _wall_loss_db(0.0, angle_deg, 3, 3)
            print(f"| {turned_deg:g} | {angle_deg:g} | {' | '.join(f'{each - slab:+.2f}' for each in losses)} |")


def _wall_loss_db(turned_deg: float, angle_deg: float, cells: int, seen: int) -> float:
    """Loss of a link through the middle of a field with a wall of so many cells, of which the robot has seen some."""
    resolution_m, size = 0.05, 240
    y, x = (np.indices((size, size)) + 0.5 - size / 2) * resolution_m
    turn = np.radians(turned_deg)
    depth = x * np.cos(turn) + y * np.sin(turn) + 0.5 * cells * resolution_m
    state = np.zeros((size, size), dtype=np.uint8)
    state[(depth >= 0.0) & (depth < cells * resolution_m)] = CellState.UNKNOWN
    state[(depth >= 0.0) & (depth < seen * resolution_m)] = CellState.WALL
    along = turn + np.radians(angle_deg)
    tx, rx = (np.array([sign * 2.0 * np.cos(along), sign * 2.0 * np.sin(along)]) for sign in (-1, 1))
    settings = sp.TraceSettings(5e9, 0, diffraction=False)
    scene_settings = sp.SceneSettings(material=sp.Material(3.91, 0.031, 0.1), floor_extent="none")
    corner = -0.5 * size * resolution_m
    partial = sp.PartialMap(state, resolution_m, (corner, corner))
    links = sp.trace_links(partial, [*tx, 1.5], [[*rx, 1.5]], trace_settings=settings, scene_settings=scene_settings)
    return float(-links.gain_db[0] + 20.0 * np.log10(299792458.0 / 5e9 / (4.0 * np.pi * 4.0)))


PARTS: dict[str, Callable[[dict[str, sp.PartialMap]], None]] = {
    "time": relative_time,
    "material": unknown_material,
    "weak": left_out,
    "wall": one_wall,
    "mesh": as_meshes,
}

if __name__ == "__main__":
    main()
