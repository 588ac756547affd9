"""Loss of walls: of each material as a table; of thin, thick and hollow walls, blocks and furniture as a picture.

The picture has straight paths alone at 5 GHz through brick, from a transmitter before each part, for three depths of
one wall (`TraceSettings.wall_depth_m`).

    python benchmarks/walls.py [--out docs/one_wall.png]
"""

import argparse

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.constants import SPEED_OF_LIGHT_M_S, CellState
from sionna_partial.errors import SettingsError
from sionna_partial.scene.scene import constants_of
from sionna_partial.settings import WALL_MATERIALS
from sionna_partial.tracing.power import transmission_coefficients

CELL_M, WIDTH_M, DEPTH_M, FACE_M, HEIGHT_M = 0.1, 15.0, 6.0, 2.5, 1.5
BANDS_GHZ = 2.4, 5.0, 28.0, 60.0
FREQUENCY_HZ, DEPTHS_M = 5e9, (0.0, 0.3, 0.6)
PARTS = {
    "thin wall\n0.1 m": (0.5, 0.1, None),
    "thick wall\n0.5 m": (3.0, 0.5, None),
    "hollow wall\n0.5 m, unseen": (5.5, 0.5, CellState.UNKNOWN),
    "two walls\n0.5 m, free": (8.0, 0.5, CellState.FREE),
    "block\n1 m, unseen": (10.5, 1.0, CellState.UNKNOWN),
    "table\n0.75 m high": (13.0, 0.5, None),
}
"""Start of each part along x and its depth [m], and the state between its faces; None for more wall."""

LONG_M, STRIP_M = 1.5, 2.5
"""Length of each part, and width of the strip that it and its own transmitter have to themselves [m]."""


def parts_map() -> sp.PartialMap:
    """Return a map with all parts side by side."""
    state = np.zeros((round(DEPTH_M / CELL_M), round(WIDTH_M / CELL_M)), np.uint8)
    first = round(FACE_M / CELL_M)
    for left_m, deep_m, within in PARTS.values():
        columns = slice(round(left_m / CELL_M), round((left_m + LONG_M) / CELL_M))
        rows = slice(first, first + round(deep_m / CELL_M))
        state[rows, columns] = CellState.WALL
        if within is not None:
            state[rows.start + 1 : rows.stop - 1, columns.start + 1 : columns.stop - 1] = within
            if within == CellState.FREE:  # open at its sides
                state[rows.start + 1 : rows.stop - 1, [columns.start, columns.stop - 1]] = within
    partial = sp.PartialMap(state, CELL_M, material=sp.Material.named("brick"))
    table = np.zeros(partial.shape, dtype=bool)
    table[:, round(PARTS["table\n0.75 m high"][0] / CELL_M) :] = True
    return partial.with_obstacle_height(0.75, table)


def transmitter_of(left_m: float) -> NDArray[np.float64]:
    """Return the position of the transmitter before a part."""
    return np.array([left_m + LONG_M / 2, 0.4, HEIGHT_M])


def losses_db(partial: sp.PartialMap, left_m: float, rx: NDArray[np.float64], depth_m: float) -> NDArray[np.float64]:
    """Return the loss (N,) of straight paths from a part's transmitter to receivers (N, 3) behind it [dB]."""
    settings = sp.TraceSettings(FREQUENCY_HZ, max_depth=0, diffraction=False, wall_depth_m=depth_m)
    tx, scene = transmitter_of(left_m), sp.SceneSettings(floor_extent="none")
    links = sp.trace_links(partial, tx, rx, trace_settings=settings, scene_settings=scene, invalid="nan")
    distance_m = np.linalg.norm(rx - tx, axis=1)
    return 20 * np.log10(SPEED_OF_LIGHT_M_S / FREQUENCY_HZ / (4 * np.pi * distance_m)) - links.gain_db


def show(axes: Axes, partial: sp.PartialMap, depth_m: float) -> object:
    """Draw the losses for one depth, and write those behind the middle of each part."""
    x, y = (np.arange(CELL_M / 2, end_m, CELL_M) for end_m in (STRIP_M, DEPTH_M))
    extent, strips = (0.0, WIDTH_M, 0.0, DEPTH_M), []
    for name, (left_m, deep_m, _) in PARTS.items():
        grid = np.meshgrid(x + left_m - (STRIP_M - LONG_M) / 2, y)
        points = np.stack([*grid, np.full((len(y), len(x)), HEIGHT_M)], axis=-1).reshape(-1, 3)
        strips.append(losses_db(partial, left_m, points, depth_m).reshape(len(y), -1))
        middle_m, end_m = left_m + LONG_M / 2, FACE_M + deep_m
        own_db = abs(losses_db(partial, left_m, np.array([[middle_m, end_m + 1.0, HEIGHT_M]]), depth_m)[0])
        text = {"ha": "center", "color": "white" if own_db > 5 else "black"}
        axes.annotate(f"{own_db:.1f} dB", (middle_m, end_m + 0.9), weight="bold", **text)
        axes.annotate(name, (middle_m, FACE_M - 0.2), ha="center", va="top", fontsize=8)
        axes.plot(*transmitter_of(left_m)[:2], "*", color="crimson", markersize=10)
        print(f"wall_depth_m {depth_m:g}  {' '.join(name.split()):28s} {own_db:5.1f} dB")
    image = axes.imshow(np.hstack(strips), origin="lower", extent=extent, cmap="viridis_r", vmin=0.0, vmax=10.0)
    walls = np.ma.masked_where(partial.state != CellState.WALL, partial.state)
    axes.imshow(walls, origin="lower", extent=extent, cmap="gray_r", vmin=0.0, vmax=1.0)
    stock = " (each face a slab, as stock Sionna RT has it)" * (depth_m == 0.0)
    axes.set(ylabel="y [m]", title=f"wall_depth_m = {depth_m:g}{stock}")
    return image


def print_losses() -> None:
    """Print the loss of walls at normal incidence, of the materials that `Material.named` has."""
    print(f"| material | thickness [cm] | {' | '.join(f'{band:g} GHz' for band in BANDS_GHZ)} |")
    print("|---|---|---|---|---|---|")
    for name, material in WALL_MATERIALS.items():
        losses = []
        for band in BANDS_GHZ:
            try:
                material.require_frequency(band * 1e9)
            except SettingsError:
                losses.append("no model")
                continue
            constants = *constants_of(material, band * 1e9), material.thickness_m
            te, _ = transmission_coefficients(*constants, band * 1e9, 1.0)  # type: ignore[call-arg]
            loss_db = -20.0 * np.log10(max(float(np.abs(te)), 1e-10))
            losses.append(f"{loss_db:.1f}" if loss_db < 150.0 else "> 150")
        print(f"| {name} | {100.0 * material.thickness_m:g} | {' | '.join(losses)} |")


def main() -> None:
    """Print the table, and draw all depths."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", default="docs/one_wall.png")
    out, partial = parser.parse_args().out, parts_map()
    print_losses()
    figure, rows = plt.subplots(len(DEPTHS_M), 1, figsize=(9, 11), layout="constrained", sharex=True)
    images = [show(axes, partial, depth_m) for axes, depth_m in zip(rows, DEPTHS_M, strict=True)]
    rows[-1].set_xlabel("x [m]")
    figure.colorbar(images[0], ax=rows, label="loss of straight paths at 5 GHz, brick [dB]", shrink=0.5)  # type: ignore[arg-type]
    figure.savefig(out, dpi=80)


if __name__ == "__main__":
    main()
