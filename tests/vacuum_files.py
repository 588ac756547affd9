"""Small files of vacuum robots: a ValetudoMap, and a recording of Valeronoi on it."""

import json
from pathlib import Path
from typing import Any

import numpy as np

ROOMS = """
##############
#kkkkk#bbbbbb#
#kkkkk#bbbbbb#
#kkkkk#bbbbbb#
#kkkkkfbbbbbb#
#kkkkk#bbbbbb#
##############"""
"""Layers of a map, the smallest y of the file first: a kitchen, a bedroom, floor in a door, walls."""

NAMES = {"k": "kitchen", "b": "bedroom"}

PIXEL_CM, SIZE_CM, LEFT, TOP = 50, 2000, 10, 20
"""Edge of a pixel and of the area [cm], and the first pixel of the map in x and y."""

POINTS = [{"bssid": f"00:11:22:33:44:{end}", "ssid": "home", "signal": -50} for end in ("aa", "bb")]


def valetudo_map(rows: str = ROOMS, *, compressed: bool = True, pixel_cm: int = PIXEL_CM) -> dict[str, Any]:
    cells = np.array([[*row] for row in rows.split()])
    layers = []
    for mark in np.unique(cells):
        y, x = np.nonzero(cells == mark)
        pixels = np.column_stack([x + LEFT, y + TOP])
        first = np.flatnonzero(np.r_[True, (np.diff(y) != 0) | (np.diff(x) != 1)])
        runs = np.column_stack([pixels[first], np.diff(np.r_[first, len(pixels)])])
        data = {"segmentId": mark, "name": NAMES[mark]} if mark in NAMES else {}
        kind = {"#": "wall", "f": "floor", ".": "unknown"}.get(mark, "segment")
        content = {"compressedPixels": runs.ravel().tolist()} if compressed else {"pixels": pixels.ravel().tolist()}
        layers.append({"__class": "MapLayer", "type": kind, "metaData": data} | content)
    charger = {"type": "charger_location", "points": [pixel_cm * (LEFT + 1.5), pixel_cm * (TOP + 1.5)]}
    forbidden = {"type": "no_go_area", "points": [600, 1050, 700, 1050, 700, 1150, 600, 1150]}
    return {
        "__class": "ValetudoMap",
        "metaData": {"version": 2 if compressed else 1},
        "size": {"x": SIZE_CM, "y": SIZE_CM},
        "pixelSize": pixel_cm,
        "layers": layers,
        "entities": [charger, forbidden],
    }


def recording() -> dict[str, Any]:
    """Return a recording of Valeronoi as its JSON has it: two access points, and rows of none."""
    x_cm, y_cm = np.arange(575, 1150, 25), 1125
    rows = [
        {"x": int(x), "y": y_cm, "wifi": number % 3 and 1, "data": [-50 - number, -52 - number]}
        for number, x in enumerate(x_cm)
    ]
    rows += [{"x": 575, "y": y_cm, "wifi": -1, "data": [-60]}, {"x": 575, "y": y_cm, "wifi": 0, "data": []}]
    return {"version": 1, "map": valetudo_map(), "measurements": rows, "wifis": POINTS}


def write_json(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def write_recording(path: Path) -> Path:
    return write_json(path, recording())
