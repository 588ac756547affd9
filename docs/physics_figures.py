"""Draw the figures of docs/physics.md: `python docs/physics_figures.py` from the root of the repository."""

import itertools
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.scene.scene import constants_of
from sionna_partial.tracing.interactions import DIFFRACTION
from sionna_partial.tracing.power import reflection_coefficients, transmission_coefficients

WALL, PATH, IMAGE = "#555555", "#bb5566", "#004488"
BRICK = sp.Material.named("brick")


def main() -> None:
    """Write all figures beside this script."""
    mpl.rcParams.update({"svg.hashsalt": "physics", "font.size": 9})
    for name, draw in (("slab", slab), ("image", image), ("wedge", wedge), ("wall", wall)):
        figure = Figure(figsize=(8.4, 2.9 if name != "wall" else 1.9), layout="constrained")
        draw(figure)
        figure.savefig(Path(__file__).with_name(f"physics_{name}.svg"), metadata={"Date": None})


def plain(axis: Axes, x: tuple[float, float], y: tuple[float, float]) -> Axes:
    """Make an axis a drawing without ticks."""
    axis.set(xlim=x, ylim=y, aspect="equal", xticks=[], yticks=[])
    axis.set_frame_on(False)
    return axis


def arrow(axis: Axes, *points: tuple[float, float], colour: str = PATH, style: str = "-") -> None:
    """Draw a path through points."""
    for start, end in itertools.pairwise(points):
        line = {"arrowstyle": "->", "color": colour, "linestyle": style, "shrinkA": 0, "shrinkB": 0}
        axis.annotate("", end, start, arrowprops=line)


def slab(figure: Figure) -> None:
    """Draw a slab with internal reflections, and its losses by angle."""
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.3])
    plain(left, (-2.2, 3.4), (-2.3, 2.1))
    left.add_patch(Rectangle((0, -2.2), 1, 4.2, color="#dddddd"))
    arrow(left, (-1.6, -2.1), (0, -0.9), (1, -0.6), (2.6, 0.6))
    arrow(left, (1, -0.6), (0, -0.3), (1, 0.0), (2.6, 1.2))
    arrow(left, (1, 0.0), (0, 0.3), (1, 0.6))
    for y in (-0.9, -0.3, 0.3):
        arrow(left, (0, y), (-1.6, y + 1.2))
    left.plot([-1.2, 0], [-0.9, -0.9], ":", color=WALL)
    left.text(-0.85, -1.25, r"$\theta$")
    left.text(0.35, 1.65, "$h$")
    left.text(-2.15, 0.9, "$R$")
    left.text(2.75, 0.9, "$T$")
    angle = np.linspace(0.0, 89.0, 300)
    constants = (*constants_of(BRICK, 5e9), BRICK.thickness_m, 5e9, np.cos(np.radians(angle)))
    for name, found, style in (
        ("reflected", reflection_coefficients(*constants), "-"),
        ("transmitted", transmission_coefficients(*constants), "--"),
    ):
        for polarisation, coefficient, colour in zip(("TE", "TM"), found, (PATH, IMAGE), strict=True):
            loss_db = -20.0 * np.log10(np.abs(coefficient))
            right.plot(angle, loss_db, style, color=colour, label=f"{name}, {polarisation}")
    right.set(xlabel="angle of incidence [degrees]", ylabel="loss [dB]", ylim=(40, 0), title="brick, 11 cm, 5 GHz")
    right.legend(fontsize=7, loc="lower left", ncols=2)
    right.grid(alpha=0.3)


def image(figure: Figure) -> None:
    """Draw a beam from an image of the transmitter, and unfolded heights."""
    left, right = figure.subplots(1, 2)
    plain(left, (-0.6, 7.4), (-2.4, 3.0))
    left.plot([1.5, 5.0], [0, 0], color=WALL, linewidth=3)
    source, receiver = (2.0, -2.0), (5.0, 2.0)
    for end in (1.5, 5.0):
        left.plot([source[0], source[0] + 2.3 * (end - source[0])], [-2.0, 2.6], ":", color=IMAGE)
    arrow(left, source, receiver, colour=IMAGE, style="--")
    arrow(left, (2.0, 2.0), (3.5, 0.0), receiver)
    for text, x, y in (("tx", 1.5, 2.0), ("rx", 5.2, 2.0), ("A", 1.2, 0.25), ("B", 4.7, 0.25), ("image S", 2.2, -2.3)):
        left.text(x, y, text)
    left.text(5.2, -0.35, "window AB, $r = 1$")
    plain(right, (-0.3, 7.8), (-2.9, 6.1))
    for height, label in ((0.0, "floor"), (2.5, "ceiling")):
        right.axhline(height, color=WALL)
        right.text(6.9, height + 0.15, label)
    arrow(right, (0.4, 1.0), (2.24, 2.5), (5.3, 0.0), (6.5, 0.98))
    arrow(right, (0.4, 1.0), (6.5, 5.98), colour=IMAGE, style="--")
    for text, x, y in (("tx", 0.0, 0.4), ("rx", 6.6, 0.9), ("rx, two images away", 3.5, 5.6)):
        right.text(x, y, text)


def wedge(figure: Figure) -> None:
    """Draw a wedge from above, and the field around a corner of brick as traced."""
    left, right = figure.subplots(1, 2, width_ratios=[1, 1.3])
    plain(left, (-3.6, 3.8), (-3.2, 3.2))
    left.fill([0, 3.4, 3.4, 0], [0, 0, -3, -3], color="#dddddd")
    arrow(left, (1.9, 2.3), (0, 0), (-2.6, -1.4))
    for degrees, text, at in ((130.0, "reflection\nboundary", (-3.4, 2.2)), (230.0, "shadow\nboundary", (-1.4, -2.9))):
        x, y = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        left.plot([0, 2.7 * x], [0, 2.7 * y], ":", color=IMAGE)
        left.text(*at, text, fontsize=7)
    for text, x, y in (
        ("tx", 2.0, 2.4),
        ("0-face, $\\varphi = 0$", 1.5, 0.15),
        ("n-face", 0.15, -2.8),
        ("rx", -3.2, -1.6),
    ):
        left.text(x, y, text)
    left.text(0.5, 0.15, r"$\varphi'$")
    angle_deg, total_db, direct_db = corner(np.arange(2.0, 268.0, 1.0) + 0.13)
    right.plot(angle_deg, direct_db, "--", color=IMAGE, label="direct and reflected")
    right.plot(angle_deg, total_db, color=PATH, label="with diffraction")
    right.set(xlabel=r"$\varphi$ [degrees]", ylabel="field [dB]", ylim=(-40, 12), title="corner of brick, 2.4 GHz")
    right.legend(fontsize=7, loc="lower left")
    right.grid(alpha=0.3)


def corner(angle_deg: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Trace receivers 3 m around a corner; return angles, and the coherent field relative to 6 m of free space."""
    state = np.zeros((280, 280), np.uint8)
    state[[0, -1]] = state[:, [0, -1]] = state[:140, 140:] = sp.CellState.WALL
    phi = np.radians(angle_deg)
    at = np.column_stack([7.0 + 3.0 * np.cos(phi), 7.0 + 3.0 * np.sin(phi), np.full(len(phi), 1.5)])
    tx = (7.0 + 3.0 * np.cos(np.radians(50.0)), 7.0 + 3.0 * np.sin(np.radians(50.0)), 1.5)
    settings = sp.TraceSettings(frequency_hz=2.4e9, max_depth=1, refraction=False, power_tolerance_db=0.0)
    room = sp.PartialMap(state, 0.05, (0.0, 0.0), 3.0)
    links = sp.trace_links(
        room, tx, at, trace_settings=settings, scene_settings=sp.SceneSettings(material="brick"), invalid="nan"
    )
    kind, (x, y, z) = links.interactions[:, 0], links.vertices_m[:, 0].T
    on_block = ((np.abs(y - 7.0) < 0.1) & (x > 6.9) | (np.abs(x - 7.0) < 0.1) & (y < 7.1)) & (np.abs(z - 1.5) < 0.01)
    levels = []
    for counted in ((kind == 0) | on_block, (kind == 0) | on_block & (kind != DIFFRACTION)):
        field = np.zeros(len(phi), complex)
        np.add.at(field, links.path_rx[counted], links.a[counted])
        with np.errstate(divide="ignore"):
            levels.append(20.0 * np.log10(np.abs(field) * 4.0 * np.pi * 6.0 * 2.4e9 / 299792458.0))
    return angle_deg, *levels


def wall(figure: Figure) -> None:
    """Draw the faces on a leg, and the walls that they make."""
    axis = plain(figure.subplots(), (-0.3, 16.3), (-1.3, 1.5))
    faces = "two faces,\none wall"
    for start, width, text in ((2.0, 1.2, faces), (6.0, 0.6, faces), (9.5, 0.08, "one face,\none wall")):
        axis.add_patch(Rectangle((start, -1.0), width, 1.6, color=WALL))
        axis.text(start - 0.4, 0.75, text, fontsize=7)
    for start in (12.0, 14.2):
        axis.add_patch(Rectangle((start, -1.0), 0.08, 1.6, color=WALL))
    axis.text(11.9, 0.75, "deeper than wall_depth_m:\ntwo walls", fontsize=7)
    arrow(axis, (0.3, -0.6), (15.6, 0.2))
    axis.text(-0.2, -0.75, "tx")
    axis.text(15.7, 0.15, "rx")


if __name__ == "__main__":
    main()
