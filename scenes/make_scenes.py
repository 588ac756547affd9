"""Make the homes that ship with the package: complete, and as a robot has seen them after so many steps.

usage: python scenes/make_scenes.py [FOLDER]

Writes FOLDER/<home>/complete and FOLDER/<home>/step<steps> as scene folders, FOLDER/homes.json, and FOLDER/README.md.
Running it again gives the same bytes.
"""

import json
import sys
from pathlib import Path
from typing import Any

from sionna_partial.files import atomic_write
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.scene import export_scene
from sionna_partial.simulation.explore import explore
from sionna_partial.simulation.homes import make_home

STEPS = (50, 100, 150, 200)

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


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent)
