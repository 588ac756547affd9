"""Make the homes that ship with the package: complete, and as a robot has seen them after so many steps.

usage: python scenes/make_scenes.py [FOLDER]

Writes FOLDER/<home>/complete and FOLDER/<home>/step<steps> as scene folders, FOLDER/homes.json, and FOLDER/README.md;
FOLDER/measured.csv, FOLDER/scan.ply and FOLDER/vacuum, which the pages of the documentation read. Running it again
gives the same bytes.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy import ndimage

from sionna_partial.arrays import row_runs
from sionna_partial.constants import CellState
from sionna_partial.exploration.explore import explore
from sionna_partial.files import atomic_write
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.export import export_scene
from sionna_partial.settings import Material, SceneSettings, TraceSettings
from sionna_partial.tracing.trace import trace_links
from sionna_partial.worlds.homes import make_home

STEPS = (50, 100, 150, 200)

ROOMS = {
    "living": (2, 82, 122, 178),
    "kitchen": (124, 112, 200, 178),
    "hall": (2, 56, 200, 80),
    "bedroom": (2, 2, 80, 54),
    "bath": (82, 2, 128, 54),
    "study": (130, 2, 200, 54),
}
"""Rooms of the home of the vacuum robot [pixels]: x0, y0, x1, y1 with y down. The door of the study is closed."""

DOORS = ((40, 80, 58, 82), (122, 136, 124, 154), (30, 54, 46, 56), (100, 54, 114, 56))
PIXEL_CM, HOME_CELLS, ROUTER_M, ROUTER_DBM = 5, (180, 202), (0.8, 0.7, 1.5), 0.0
"""Pixel [cm], rows and columns of that home, position of its access point, and received power less path gain."""

HOMES: dict[str, dict[str, Any]] = {
    "apartment": {"kind": "apartment", "seed": 3, "exploration_seed": 3, "transmitter": [7.0, 9.8, 1.5]},
    "house": {"kind": "house", "seed": 65, "exploration_seed": 2, "transmitter": [4.5, 11.0, 1.5]},
    "office": {"kind": "office", "seed": 57, "exploration_seed": 0, "transmitter": [13.5, 14.8, 1.5]},
}
"""How each home is made, and where a transmitter stands [m] that the robot has passed within 50 steps."""

README = """# Homes

Procedural homes without locked rooms, written by `make_scenes.py` from the seeds below. `complete` holds the whole
home, `step050` to `step200` what a simulated robot has observed after that many steps. Each is a scene folder:
`scene.xml` loads in stock `sionna.rt.load_scene`, and `map.yaml` is a ROS map. `homes.json` holds the same as this
table, for programs.

`measured.csv` holds path gains of 60 links in the apartment, all from its transmitter to positions that the robot had
seen after 100 steps: those of walls of concrete, with 2 dB of noise. `scan.ply` is the mesh of two rooms with a door
between them and a table. `vacuum` holds a synthetic home as a vacuum robot maps it (`home.json`, ValetudoMap) and a
recording of its Wi-Fi (`home.vwm`, Valeronoi): 2.44 GHz, walls of brick, 3 dB of noise, the access point in the living
room at (0.8, 0.7, 1.5) m, and a study whose door was closed.

| home | kind | seed | robot's seed | grid [m] | free area [m2] | observed after {steps} steps | transmitter [m] |
|---|---|---|---|---|---|---|---|
{rows}
"""


def main(folder: Path) -> None:
    """Write all homes and their descriptions into `folder`."""
    rows = []
    for name, recipe in HOMES.items():
        home = make_home(recipe["seed"], recipe["kind"], locked_rooms=False)
        stages = explore(home, STEPS, seed=recipe["exploration_seed"])
        export_scene(home, folder / name / "complete")
        for steps, partial in zip(STEPS, stages, strict=True):
            export_scene(partial, folder / name / f"step{steps:03d}")
        rows.append(_row(name, recipe, home, stages))
        if name == "apartment":
            _write_measurements(home, stages[STEPS.index(100)], recipe["transmitter"], folder / "measured.csv")
    _scan().export(folder / "scan.ply")
    _write_vacuum(folder / "vacuum")
    with atomic_write(folder / "homes.json") as stream:
        stream.write((json.dumps(HOMES, indent=2) + "\n").encode())
    with atomic_write(folder / "README.md") as stream:
        stream.write(README.format(steps=" / ".join(map(str, STEPS)), rows="\n".join(rows)).encode())


def _row(name: str, recipe: dict[str, Any], home: PartialMap, stages: list[PartialMap]) -> str:
    x0, y0, x1, y1 = home.bounds_m
    area_m2 = (home.interior_cells or 0) * home.resolution_m**2
    seen = " / ".join(f"{partial.observed_fraction:.2f}" for partial in stages)
    transmitter = ", ".join(f"{value:g}" for value in recipe["transmitter"])
    cells = (name, recipe["kind"], recipe["seed"], recipe["exploration_seed"], f"{x1 - x0:.1f} x {y1 - y0:.1f}")
    return "| " + " | ".join(map(str, (*cells, f"{area_m2:.0f}", seen, transmitter))) + " |"


def _write_measurements(home: PartialMap, seen: PartialMap, tx: list[float], path: Path) -> None:
    """Write noisy path gains of a home with walls of concrete, at positions that a robot has seen."""
    rng = np.random.default_rng(0)
    cells = rng.choice(np.argwhere(seen.state == CellState.FREE), 60, replace=False)[:, ::-1] + 0.5
    rx = np.round(np.column_stack([cells * home.resolution_m + home.origin_m, np.full(len(cells), 1.5)]), 3)
    concrete = SceneSettings(material=Material(relative_permittivity=5.24, conductivity_s_m=0.626))
    gain_db = trace_links(home, tx, rx, scene_settings=concrete).gain_db + 2.0 * rng.standard_normal(len(rx))
    table = np.column_stack([np.tile(tx, (len(rx), 1)), rx, gain_db])
    header = "tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,gain_db"
    np.savetxt(path, table, delimiter=",", header=header, comments="", fmt=[*(["%.3f"] * 6), "%.1f"])


def _write_vacuum(folder: Path) -> None:
    """Write a home as ValetudoMap, and the powers of its access point as a recording of Valeronoi."""
    state, seen, layers = np.full(HOME_CELLS, CellState.WALL, np.uint8), np.zeros(HOME_CELLS, dtype=bool), []
    for name, rectangle in (*ROOMS.items(), *(("", door) for door in DOORS)):
        x0, y0, x1, y1 = rectangle
        state[y0:y1, x0:x1] = CellState.FREE
        if name != "study":
            seen[y0:y1, x0:x1] = True
            layers.append(_layer("segment" if name else "floor", [(x0, y, x1 - x0) for y in range(y0, y1)], name))
    walls = ndimage.binary_dilation(seen, iterations=2) & (state == CellState.WALL)
    walls[54:56, 160:176] = False  # the closed door, which a vacuum robot does not draw
    row, start, end = row_runs(walls)
    layers.append(_layer("wall", np.column_stack([start, row, end - start])))
    size_cm = {"x": PIXEL_CM * HOME_CELLS[1], "y": PIXEL_CM * HOME_CELLS[0]}
    home = {"__class": "ValetudoMap", "metaData": {"version": 2}, "size": size_cm, "pixelSize": PIXEL_CM}
    home |= {"layers": layers, "entities": []}
    rows, columns = np.nonzero(ndimage.binary_erosion(seen, iterations=4))
    lanes = (rows % 16 == 0) & (columns % 12 == 0)  # 0.8 m apart, a power every 0.6 m
    x_cm, y_cm = ((index[lanes] + 0.5) * PIXEL_CM for index in (columns, rows))
    rx = np.column_stack([x_cm, size_cm["y"] - y_cm, np.full(len(x_cm), 10.0)]) / 100.0
    truth, brick = PartialMap(state[::-1].copy(), PIXEL_CM / 100.0), SceneSettings(material=Material.named("brick"))
    wifi = TraceSettings(frequency_hz=2.44e9)
    gain_db = trace_links(truth, ROUTER_M, rx, trace_settings=wifi, scene_settings=brick).gain_db
    power_dbm = np.rint(gain_db + ROUTER_DBM + 3.0 * np.random.default_rng(0).standard_normal(len(rx)))
    points = zip(x_cm.tolist(), y_cm.tolist(), power_dbm.tolist(), strict=True)
    measured = [{"x": x, "y": y, "wifi": 0, "data": [round(power)]} for x, y, power in points]
    wifis = [{"bssid": "02:00:00:00:00:01", "ssid": "home", "signal": measured[-1]["data"][0]}]
    recording = {"version": 1, "map": home, "measurements": measured, "wifis": wifis}
    folder.mkdir(exist_ok=True)
    for name, content in (("home.json", home), ("home.vwm", recording)):
        with atomic_write(folder / name) as stream:
            stream.write((json.dumps(content, separators=(",", ":")) + "\n").encode())


def _layer(kind: str, runs: ArrayLike, name: str = "") -> dict[str, Any]:
    """Return a layer of a ValetudoMap, of rows of pixels: x, y and length."""
    return {"type": kind, "metaData": {"name": name} if name else {}, "compressedPixels": np.ravel(runs).tolist()}


def _scan() -> trimesh.Trimesh:
    """Two rooms of 3 x 4 m and 2.6 m, a door of 0.9 m between them, and a table."""
    boxes = {
        "floor": ((0, 0, -0.1), (6, 4, 0)),
        "ceiling": ((0, 0, 2.6), (6, 4, 2.7)),
        "west": ((-0.1, 0, 0), (0, 4, 2.6)),
        "east": ((6, 0, 0), (6.1, 4, 2.6)),
        "south": ((-0.1, -0.1, 0), (6.1, 0, 2.6)),
        "north": ((-0.1, 4, 0), (6.1, 4.1, 2.6)),
        "between": ((2.95, 0, 0), (3.05, 2.6, 2.6)),
        "beyond the door": ((2.95, 3.5, 0), (3.05, 4, 2.6)),
        "table": ((4.2, 0.8, 0), (5.4, 1.6, 0.9)),
    }
    return trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in boxes.values()])


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent)
