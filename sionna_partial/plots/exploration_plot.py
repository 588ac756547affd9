"""Figures of explorations and next poses."""

from __future__ import annotations

import io
import math
import os
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Wedge
from matplotlib.path import Path as MarkerPath
from numpy.typing import ArrayLike
from PIL import Image

from sionna_partial.arrays import Floats, States
from sionna_partial.checks import require, require_type
from sionna_partial.constants import CellState
from sionna_partial.coverage.job import predict_map
from sionna_partial.exploration.explore import Exploration
from sionna_partial.exploration.next_views import NextView, NextViews
from sionna_partial.files import atomic_write, output_path
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.panel import extent_m
from sionna_partial.plots.style import (
    BLUE,
    RED,
    STAR,
    UNKNOWN,
    WALL,
    YELLOW,
    Figure,
    corners_m,
    draw_map,
    figure_png,
    legend_below,
    sheet_columns,
    window_m,
)
from sionna_partial.worlds.camera import view_corners_m

FRAME_MS, LAST_FRAME_MS = 100, 2500
"""Duration of a frame and of the last one [ms]."""

MAX_PANELS = 12
"""Largest number of steps in one figure."""

_FREE, _UNSEEN_WALL = "white", "0.68"
_VIEW_OPACITY = 0.35
_WIDTH_IN, _DPI, _VIEWS_DPI = 8.0, 165, 130
_AROUND_M, _VIEW_M, _VIEW_DEG = 1.5, 0.9, 60.0
_FRAME_IN, _FRAME_DPI = 5.6, 90
_MIXED_COLOURS, _NEAR = 128, 16
_MAX_COVERAGE = Image.Quantize.MAXCOVERAGE
_SPACING_M, _PALEST = 0.3, 0.35
_PREDICTED = {
    "gain_mean_db": ("predicted path gain [dB]", "viridis", -150.0, -50.0),
    "gain_std_db": ("its standard deviation [dB]", "magma_r", 0.0, 40.0),
}


def plot_exploration(exploration: Exploration) -> Figure:
    """Draw the robot's map at each step, with trajectory and field of view.

    Parameters
    ----------
    exploration : Exploration
        At most `MAX_PANELS` steps are drawn.

    Raises
    ------
    SettingsError
        For anything but an Exploration.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> exploration = sp.explore_trajectory(sp.make_home(3), steps=(10, 50), seed=0)
    >>> figure = sp.plots.plot_exploration(exploration)
    >>> figure.savefig("exploration.png")
    """
    require_type("exploration", exploration, Exploration, "give what explore_trajectory returned.")
    count = min(len(exploration.steps), MAX_PANELS)
    shown = np.linspace(len(exploration.steps) - 1, 0, count).astype(np.intp)[::-1]
    x0, x1, y0, y1 = _window_m(exploration)
    columns = sheet_columns(count, (x1 - x0) / (y1 - y0))
    rows = math.ceil(count / columns)
    width = _WIDTH_IN / max(columns, 2)
    size = (width * columns, rows * ((width - 0.4) * (y1 - y0) / (x1 - x0) + 0.3) + 1.25)
    figure = Figure(figsize=size, dpi=_DPI, layout="compressed")
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for panel in axes.flat[count:]:
        panel.set_axis_off()
    for index, panel in zip(shown, axes.flat[:count], strict=True):
        _draw(panel, exploration, int(index))
        panel.label_outer()
    _add_legend(figure, exploration)
    return figure


def animate_exploration(exploration: Exploration, path: str | os.PathLike[str], tx: ArrayLike | None = None) -> None:
    """Write a GIF of an exploration, with a frame for each of its `steps`.

    With a transmitter, each frame takes a prediction and has path gain and uncertainty beside the map.

    Parameters
    ----------
    exploration : Exploration
    path : path-like
        A `.gif` file. Equal explorations give equal bytes.
    tx : (3,) or (2,) array-like, optional
        Transmitter [m].

    Raises
    ------
    SettingsError
        For anything but an Exploration, or another suffix.
    PositionError
        For a transmitter outside the map or in a wall.
    OutputError
        If the file cannot be written.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> exploration = sp.explore_trajectory(sp.make_home(3), steps=range(0, 21, 10), seed=0)
    >>> sp.plots.animate_exploration(exploration, "exploration.gif")
    """
    require_type("exploration", exploration, Exploration, "give what explore_trajectory returned.")
    target = output_path(path)
    require(target.suffix.lower() == ".gif", "path", str(target), "give a name that ends with .gif.")
    x0, x1, y0, y1 = _window_m(exploration)
    longest = max(x1 - x0, y1 - y0)
    size = _FRAME_IN * (x1 - x0) / longest + 0.6, _FRAME_IN * (y1 - y0) / longest + 0.7
    frames = [_frame(exploration, index, size) for index in range(len(exploration.steps))]
    if tx is not None:
        frames = [
            _beside(frame, _predicted(partial, tx, (x0, x1, y0, y1), size))
            for frame, partial in zip(frames, exploration.maps, strict=True)
        ]
    palette = _palette(frames[-1]) if tx is None else _beside(frames[0], frames[-1]).quantize(256, _MAX_COVERAGE)
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    times_ms = [FRAME_MS] * len(others) + [LAST_FRAME_MS]
    with atomic_write(target) as stream:
        first.save(stream, format="GIF", save_all=True, append_images=others, duration=times_ms, loop=0)


def _frame(exploration: Exploration, index: int, size: tuple[float, float]) -> Image.Image:
    figure = Figure(figsize=size, dpi=_FRAME_DPI)
    panel = figure.add_axes((0.3 / size[0], 0.3 / size[1], 1 - 0.6 / size[0], 1 - 0.7 / size[1]))
    _draw(panel, exploration, index)
    panel.set(xticks=[], yticks=[], xlabel="", ylabel="")
    return Image.open(io.BytesIO(figure_png(figure))).convert("RGB")


def _predicted(
    partial: PartialMap, tx: ArrayLike, window: tuple[float, float, float, float], size: tuple[float, float]
) -> Image.Image:
    coverage = predict_map(partial, tx, spacing_m=_SPACING_M, progress=False)
    width, height, wide = size[0] - 0.6, size[1] - 0.7, 2 * size[0] + 1.0
    figure = Figure(figsize=(wide, size[1]), dpi=_FRAME_DPI)
    alpha = coverage.p_indoor.fillna(0.0).clip(_PALEST, 1.0).to_numpy()
    for column, (name, (title, colours, least, most)) in enumerate(_PREDICTED.items()):
        left = 0.1 + column * (size[0] + 0.5)
        panel = figure.add_axes((left / wide, 0.3 / size[1], width / wide, height / size[1]))
        draw_map(panel, partial)
        limits: dict[str, Any] = {"vmin": least, "vmax": most, "extent": extent_m(coverage), "origin": "lower"}
        picture = panel.imshow(coverage[name], cmap=colours, alpha=alpha, zorder=2.0, **limits)
        panel.plot(*np.ravel(tx)[:2], markersize=15, zorder=5, **STAR)
        panel.set(xlim=window[:2], ylim=window[2:], aspect="equal", xticks=[], yticks=[])
        panel.set_title(title, fontsize=11)
        bar = figure.add_axes(((left + width + 0.08) / wide, 0.3 / size[1], 0.12 / wide, height / size[1]))
        figure.colorbar(ScalarMappable(picture.norm, colours), cax=bar)
    return Image.open(io.BytesIO(figure_png(figure))).convert("RGB")


def _beside(left: Image.Image, right: Image.Image) -> Image.Image:
    both = Image.new("RGB", (left.width + right.width, max(left.height, right.height)), "white")
    both.paste(left, (0, 0))
    both.paste(right, (left.width, 0))
    return both


def _palette(frame: Image.Image) -> Image.Image:
    """Return the colours of the last frame and their mixtures, for all frames."""
    drawn = np.array([to_rgb(colour) for colour in (_FREE, WALL, UNKNOWN, _UNSEEN_WALL, YELLOW, RED, BLUE)])
    exact = np.rint(255 * drawn).astype(int)
    mixed = np.reshape(frame.quantize(_MIXED_COLOURS, dither=Image.Dither.NONE).getpalette() or [], (-1, 3))
    apart = np.abs(mixed[:, None] - exact).max(axis=2).min(axis=1) > _NEAR
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate([exact, mixed[apart]]).ravel().tolist())
    return palette


def _draw(panel: Axes, exploration: Exploration, index: int) -> None:
    home, step = exploration.home, exploration.steps[index]
    x0, y0, x1, y1 = home.bounds_m
    picture = _picture(exploration.states[index], home.state)
    panel.imshow(picture, extent=(x0, x1, y0, y1), origin="lower", interpolation="nearest")
    true, believed = exploration.poses[: step + 1], exploration.believed_poses[: step + 1]
    if _drifts(exploration):
        panel.plot(true[:, 0], true[:, 1], color=BLUE, linewidth=1.0, linestyle=":")
    panel.plot(believed[:, 0], believed[:, 1], color=BLUE, linewidth=1.4)
    panel.plot(*believed[0, :2], "o", color=BLUE, markersize=4)
    x, y, heading_deg = believed[-1]
    if step:
        view = view_corners_m(home, true[-1], exploration.sensor) + believed[-1, :2] - true[-1, :2]
        panel.add_patch(Polygon(view, color=YELLOW, alpha=_VIEW_OPACITY, linewidth=0))
    panel.plot(x, y, marker=_arrow(heading_deg), color=RED, markersize=10, markeredgecolor="white")
    window = _window_m(exploration)
    panel.set(xlim=window[:2], ylim=window[2:], aspect="equal", facecolor=UNKNOWN, xlabel="x [m]", ylabel="y [m]")
    panel.set_title(f"step {step}: {exploration.observed_fractions[index]:.0%} seen", fontsize=11)


def _arrow(heading_deg: float) -> MarkerPath:
    angles = np.radians(heading_deg + np.array([0.0, 140.0, 220.0, 0.0]))
    return MarkerPath(np.stack([np.cos(angles), np.sin(angles)], axis=1), closed=True)


def _picture(state: States, truth: States) -> Floats:
    """Return the colours (ny, nx, 3), with walls that are not on the map."""
    picture = np.array([to_rgb(colour) for colour in (_FREE, WALL, UNKNOWN)])[state]
    picture[(state == CellState.UNKNOWN) & (truth == CellState.WALL)] = to_rgb(_UNSEEN_WALL)
    return picture


def _window_m(exploration: Exploration) -> tuple[float, float, float, float]:
    home = exploration.home
    known = (home.state != CellState.UNKNOWN) | (exploration.states[-1] != CellState.UNKNOWN)
    return window_m(corners_m(known, home.origin_m, home.resolution_m))


def _drifts(exploration: Exploration) -> bool:
    return not np.array_equal(exploration.poses, exploration.believed_poses)


def _add_legend(figure: Figure, exploration: Exploration) -> None:
    unseen, walls = exploration.states == CellState.UNKNOWN, exploration.home.state == CellState.WALL
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=BLUE, marker="o", markersize=4, markevery=[0], label="trajectory"),
        Line2D([], [], color=RED, marker=_arrow(0.0), markersize=10, linestyle="none", label="robot"),
        *([Patch(color=YELLOW, alpha=_VIEW_OPACITY, label="field of view")] if any(exploration.steps) else []),
        Patch(color=WALL, label="wall, seen"),
        *([Patch(color=_UNSEEN_WALL, label="wall, not seen")] if (unseen & walls).any() else []),
        Patch(color=UNKNOWN, label="not seen"),
    ]
    if _drifts(exploration):
        handles[0].set_label("estimated trajectory")
        handles.insert(1, Line2D([], [], color=BLUE, linewidth=1.0, linestyle=":", label="true trajectory"))
    legend_below(figure, handles, 3)


def plot_next_views(views: NextViews) -> Figure:
    """Draw map, predicted uncertainty, and ranked poses with their paths and frontiers.

    Parameters
    ----------
    views : NextViews
        From `next_views`.

    Raises
    ------
    SettingsError
        For anything but NextViews.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> partial = sp.explore(sp.make_home(3), steps=(60,), seed=0)[0]
    >>> figure = sp.plots.plot_next_views(sp.next_views(partial, goal="area"))
    >>> figure.savefig("next_views.png")
    """
    require_type("views", views, NextViews, "give what next_views returned.")
    partial = views.partial
    known_m = corners_m(partial.state != CellState.UNKNOWN, partial.origin_m, partial.resolution_m)
    low, high = np.array(partial.bounds_m).reshape(2, 2)
    shown_m = [np.clip(known_m + side, low, high) for side in (-_AROUND_M, _AROUND_M)]
    x0, x1, y0, y1 = window_m(np.vstack([*shown_m, views.tx_m[:, :2]]))
    height = min(max((_WIDTH_IN - 1.8) * (y1 - y0) / (x1 - x0), 3.0), 12.0)
    figure = Figure(figsize=(_WIDTH_IN, height + 1.2), dpi=_VIEWS_DPI, layout="constrained")
    axis = figure.add_subplot()
    draw_map(axis, partial)
    if len(views.tx_m):
        _draw_uncertainty(figure, axis, views)
    for rank, view in reversed([*enumerate(views, start=1)]):
        _draw_view(axis, rank, view, views.sensor.field_of_view_deg >= 360.0)
    axis.plot(*views.start_m, marker="o", color=BLUE, markersize=7, markeredgecolor="white", zorder=5)
    axis.plot(*views.tx_m[:, :2].T, markersize=15, zorder=5, **STAR)
    axis.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axis.set_title(f"{len(views)} next views, the best first", fontsize="medium")
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=BLUE, marker="o", markevery=[0], label="start and path"),
        Line2D([], [], color=RED, linewidth=3, label="frontier"),
        Patch(color=YELLOW, label="next view"),
        Patch(color=WALL, label="wall"),
    ]
    if len(views.tx_m):
        handles.insert(0, Line2D([], [], label="transmitter", markersize=13, **STAR))
    legend_below(figure, handles)
    return figure


def _draw_uncertainty(figure: Figure, axis: Axes, views: NextViews) -> None:
    style: dict[str, Any] = {"extent": extent_m(views.uncertainty), "origin": "lower", "zorder": 0.7}
    most = 1.0 if views.goal == "coverage" else math.log2(3)
    picture = axis.imshow(views.uncertainty.mean("tx"), cmap="Purples", vmin=0.0, vmax=most, alpha=0.85, **style)
    figure.colorbar(picture, ax=axis, label="uncertainty of the link [bit]", shrink=0.8)


def _draw_view(axis: Axes, rank: int, view: NextView, sees_all: bool) -> None:
    axis.plot(*view.path_m.T, color=BLUE, linewidth=1.0, alpha=0.7, zorder=3.5)
    axis.plot(*view.frontier_m.T, color=RED, marker="s", markersize=2, linestyle="none", zorder=3.6)
    ends_deg = (0.0, 360.0) if sees_all else view.heading_deg + np.array([-0.5, 0.5]) * _VIEW_DEG
    alpha = 0.3 if sees_all else 0.8
    axis.add_patch(Wedge(tuple(view.position_m), _VIEW_M, *ends_deg, color=YELLOW, alpha=alpha, linewidth=0, zorder=4))
    label = {"boxstyle": "circle,pad=0.2", "facecolor": "white", "edgecolor": "black", "linewidth": 0.8}
    x, y = view.position_m.tolist()
    axis.text(x, y, str(rank), fontsize=8, ha="center", va="center", bbox=label, zorder=6)
