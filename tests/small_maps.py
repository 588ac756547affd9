"""Two maps with clutter and noise, as robots make them; `python tests/small_maps.py` makes them again from buildings.

`house` is one that slam_toolbox has mapped, as a ROS map; `vacuum` an apartment that a vacuum robot has, as JSON.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from PIL import Image
from vacuum_files import valetudo_map

import sionna_partial as sp
from sionna_partial.maps.map_files import save_map

FOLDER = Path(__file__).with_name("maps")
HOUSE, VACUUM = FOLDER / "house.yaml", FOLDER / "vacuum.json"
ERRORS = {"range_noise_m": 0.02, "drift_m_per_m": 0.001, "missed_wall_fraction": 0.03, "missed_return_fraction": 0.02}


def states(partial: sp.PartialMap, *points: tuple[float, float]) -> list[int]:
    return partial.state_at(np.array(points)).tolist()


def furnished(home: sp.PartialMap, seed: int, pieces: int = 40) -> sp.PartialMap:
    rng, state = np.random.default_rng(seed), home.state.copy()
    for row, column in rng.permutation(np.argwhere(home.state == sp.CellState.FREE))[:pieces]:
        part = state[row : row + rng.integers(1, 12), column : column + rng.integers(1, 12)]
        part[part == sp.CellState.FREE] = sp.CellState.WALL
    return replace(home, state=state)


def explored(seed: int, kind: str, fusion: str) -> sp.PartialMap:
    home = furnished(sp.make_home(seed, kind, locked_rooms=False), seed)
    sensor = sp.SensorSettings(**ERRORS, field_of_view_deg=360.0, range_m=8.0, heading_noise_deg=0.3, fusion=fusion)
    return sp.explore(home, steps=(0.95,), seed=seed, sensor=sensor)[0]


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    save_map(explored(2, "house", "slam_toolbox"), HOUSE)
    picture = HOUSE.with_suffix(".pgm")
    Image.open(picture).save(picture.with_suffix(".png"), optimize=True)
    picture.unlink()
    HOUSE.write_text(yaml.safe_dump(yaml.safe_load(HOUSE.read_text()) | {"image": "house.png"}, sort_keys=False))
    robot = explored(1, "apartment", "vacuum")
    rows = np.array([*"f#."])[robot.state[::-1]]
    content = valetudo_map("\n".join(map("".join, rows)), pixel_cm=5)
    content["layers"] = [layer for layer in content["layers"] if layer["type"] != "unknown"]
    VACUUM.write_text(json.dumps(content, separators=(",", ":")), encoding="utf-8")


if __name__ == "__main__":
    main()
