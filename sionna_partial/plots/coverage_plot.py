"""Figures of coverage maps."""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from sionna_partial.checks import require
from sionna_partial.constants import LinkState
from sionna_partial.coverage import WALL_PARTS, require_coverage
from sionna_partial.plots.style import STAR, STATE_COLOURS, Figure, legend_below, shade

_WIDTH_IN, _DPI, _MAX_PIXELS = 12.0, 150, 3000
_STACKED_ASPECT = 1.8
_HATCH, _HATCH_COLOUR = "////", (0.75, 0.75, 0.75, 0.8)
_UNSEEN_OPACITY = 0.45
_STAR: dict[str, Any] = STAR | {"markersize": 13}


@dataclass(frozen=True)
class _Layer:
    """One quantity of a panel: its picture (ny, nx) or (ny, nx, 3), and the colour scale of the former."""

    title: str
    picture: Callable[[xr.Dataset], NDArray[np.float64]]
    norm: Normalize | None = None
    cmap: str | None = None
    unit: str = ""


def mix_state_colours(p_los: ArrayLike, p_nlos: ArrayLike, p_outage: ArrayLike) -> NDArray[np.float64]:
    """Mix the colours of the three link states by their probabilities (paper, Section IV-C): (..., 3) in [0, 1]."""
    colours = np.array([to_rgb(STATE_COLOURS[state]) for state in (LinkState.LOS, LinkState.NLOS, LinkState.OUTAGE)])
    return np.stack([p_los, p_nlos, p_outage], axis=-1).astype(np.float64) @ colours


LINK_STATE = _Layer("Link state", lambda data: mix_state_colours(data["p_los"], data["p_nlos"], data["p_outage"]))
_MEAN, _STD = "Mean path gain", "Standard deviation of the path gain"
GAIN = _Layer(_MEAN, lambda data: data["gain_mean_db"].to_numpy(), Normalize(-150.0, -60.0), "viridis", "mean [dB]")
STD = _Layer(_STD, lambda data: data["gain_std_db"].to_numpy(), Normalize(0.0, 40.0), "magma_r", "std. dev. [dB]")


def plot_coverage(coverage: xr.Dataset) -> Figure:
    """Draw link state, mean gain and its standard deviation.

    The link state is shown as the colours of the three states mixed by their probabilities. Walls are black, the
    unobserved area is hatched, the transmitter is a star. On a complete map the outside is left blank.

    Parameters
    ----------
    coverage : xarray.Dataset
        From `predict_map`, or read from its NetCDF file.

    Returns
    -------
    matplotlib.figure.Figure
        Not registered with pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        For a Dataset that is no coverage map.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> import xarray as xr
    >>> coverage = xr.load_dataset("coverage.nc")  # or directly from predict_map
    >>> figure = sp.plot_coverage(coverage)
    >>> figure.savefig("coverage.png")
    """
    require_coverage(coverage)
    aspect = coverage.sizes["x"] / coverage.sizes["y"]
    wide = aspect > _STACKED_ASPECT
    layers = [LINK_STATE, GAIN, STD]
    rows = [[layer] for layer in layers] if wide else [layers]
    figure, axes = _panels(rows, aspect, keys_right=wide)
    for axis, layer in zip(itertools.chain(*axes), layers, strict=True):
        _draw(axis, coverage, layer)
        axis.set_title(layer.title)
    figure.suptitle(_headline(coverage))
    _add_legend(figure, unseen_walls=False)
    return figure


def plot_comparison(coverages: Mapping[str, xr.Dataset]) -> Figure:
    """Draw link state (above) and mean gain (below) of several coverage maps of one area by title (paper, Fig. 5).

    The walls of the first are drawn grey in the others where these do not contain them.
    """
    require(len(coverages) > 0, "coverages", dict(coverages), "give at least one coverage map.")
    for coverage in coverages.values():
        require_coverage(coverage)
    first = next(iter(coverages.values()))
    rows = [[layer] * len(coverages) for layer in (LINK_STATE, GAIN)]
    figure, axes = _panels(rows, first.sizes["x"] / first.sizes["y"], keys_right=True)
    for row, layer in zip(axes, (LINK_STATE, GAIN), strict=True):
        for axis, coverage in zip(row, coverages.values(), strict=True):
            _draw(axis, coverage, layer, first)
        row[0].set_ylabel(f"{layer.title}\n\ny [m]")
    for axis, title in zip(axes[0], coverages, strict=True):
        axis.set_title(title)
    figure.suptitle(_headline(first))
    _add_legend(figure, unseen_walls=True)
    return figure


def _headline(coverage: xr.Dataset) -> str:
    x, y, z = coverage.attrs["transmitter_m"]
    return f"Transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m, {coverage.attrs['frequency_hz'] / 1e9:g} GHz"


def _panels(layers: list[list[_Layer]], aspect: float, *, keys_right: bool) -> tuple[Figure, list[list[Axes]]]:
    """Make a figure with a panel for each layer, and a key for each row (`keys_right`) or column."""
    rows, columns = len(layers), len(layers[0])
    key_width, key_height = (1.1, 0.0) if keys_right else (0.0, 0.85)
    width = (_WIDTH_IN - 0.8 - key_width) / columns - 0.1
    height = min(max(width / aspect, 1.2), 12.0)
    size = (_WIDTH_IN, rows * (height + 0.2) + 1.2 + key_height)
    figure = Figure(figsize=size, dpi=_DPI, layout=ConstrainedLayoutEngine(h_pad=0.08))
    grid = figure.add_gridspec(
        rows + (not keys_right),
        columns + keys_right,
        width_ratios=[width] * columns + [key_width] * keys_right,
        height_ratios=[height] * rows + [key_height] * (not keys_right),
    )
    axes = [[figure.add_subplot(grid[row, column]) for column in range(columns)] for row in range(rows)]
    for row, column in itertools.product(range(rows), range(columns)):
        lowest, leftmost = row == rows - 1, column == 0
        axes[row][column].tick_params(labelbottom=lowest, labelleft=leftmost)
        axes[row][column].set(xlabel="x [m]" if lowest else "", ylabel="y [m]" if leftmost else "")
    for index, layer in enumerate([row[0] for row in layers] if keys_right else layers[0]):
        key = figure.add_subplot(grid[index, columns] if keys_right else grid[rows, index])
        key.set_axis_off()
        _draw_key(key, layer, upright=keys_right)
    return figure, axes


def _draw_key(key: Axes, layer: _Layer, *, upright: bool) -> None:
    """Draw the colour bar of a scale, or the triangle of mixed state colours."""
    if layer.norm is None:
        _draw_triangle(key)
        return
    bounds = (0.05, 0.05, 0.17, 0.9) if upright else (0.05, 0.7, 0.9, 0.2)
    orientation = "vertical" if upright else "horizontal"
    scale = ScalarMappable(layer.norm, layer.cmap)
    bar = key.figure.colorbar(scale, cax=key.inset_axes(bounds), orientation=orientation, extend="max")
    bar.set_label(layer.unit)


def _draw_triangle(key: Axes) -> None:
    """Draw every mixture of the three states: LOS at the left, NLOS at the right, outage at the top."""
    height = 3**0.5 / 2
    x, y = np.meshgrid(np.linspace(0.0, 1.0, 200), np.linspace(0.0, 1.0, 200))
    p_nlos = x - y / 2
    picture = np.clip(mix_state_colours(1.0 - p_nlos - y, p_nlos, y), 0.0, 1.0)
    image = key.imshow(picture, extent=(0.0, 1.0, 0.0, height), origin="lower", interpolation="bilinear")
    outline = Polygon([(0.0, 0.0), (1.0, 0.0), (0.5, height)], fill=False, edgecolor="0.3", linewidth=0.6)
    key.add_patch(outline)
    image.set_clip_path(outline)
    key.set(xlim=(-0.4, 1.4), ylim=(-0.1, 1.25), aspect="equal")
    for x_text, y_text, name, align in ((-0.06, 0.0, "LOS", "right"), (1.06, 0.0, "NLOS", "left")):
        key.text(x_text, y_text, name, ha=align, va="center")
    key.text(0.5, height + 0.05, "outage", ha="center", va="bottom")


def _draw(axis: Axes, coverage: xr.Dataset, layer: _Layer, reference: xr.Dataset | None = None) -> None:
    """Draw one layer, the unknown area, the walls and the transmitter."""
    extent = _extent(coverage)
    wall = _walls(coverage)
    picture = _fill(layer.picture(coverage), coverage["valid"].to_numpy(), wall)
    axis.imshow(picture, extent=extent, origin="lower", interpolation="nearest", norm=layer.norm, cmap=layer.cmap)
    axis.imshow(shade(_outside(coverage), grey=255), extent=extent, origin="lower", interpolation="nearest")
    _hatch_unknown(axis, coverage)
    if reference is not None:
        axis.imshow(
            shade(_walls(reference), opacity=_UNSEEN_OPACITY), extent=_extent(reference), origin="lower", zorder=3
        )
    axis.imshow(shade(wall), extent=extent, origin="lower", zorder=3)
    x, y, _ = coverage.attrs["transmitter_m"]
    axis.plot(x, y, zorder=4, **_STAR)
    axis.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")


def _extent(coverage: xr.Dataset) -> tuple[float, float, float, float]:
    half = coverage.attrs["spacing_m"] / 2
    x, y = coverage["x"].to_numpy(), coverage["y"].to_numpy()
    return x[0] - half, x[-1] + half, y[0] - half, y[-1] + half


def _walls(coverage: xr.Dataset) -> NDArray[np.bool_]:
    """Where walls are, in up to 6 x 6 parts of a cell: as fine as a picture can show."""
    bits = coverage["wall_parts"].to_numpy()
    fine = next((parts for parts in (6, 3, 2) if max(bits.shape) * parts <= _MAX_PIXELS), 1)
    merge = WALL_PARTS // fine
    wall = np.zeros((bits.shape[0], fine, bits.shape[1], fine), dtype=bool)
    for row, column in np.ndindex(WALL_PARTS, WALL_PARTS):
        wall[:, row // merge, :, column // merge] |= (bits >> (WALL_PARTS * row + column) & 1).astype(bool)
    return wall.reshape(bits.shape[0] * fine, bits.shape[1] * fine)


def _outside(coverage: xr.Dataset) -> NDArray[np.bool_]:
    """Where nobody can be: the unknown cells of a complete map."""
    return ~coverage["observed"].to_numpy() & bool(coverage.attrs.get("map_complete", 0))


def _fill(picture: NDArray[np.float64], valid: NDArray[np.bool_], wall: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Refine a picture to the size of `wall`, and fill cells without receiver from their nearest neighbour.

    A wall thinner than a cell leaves a strip of cells without receiver bare; this is for the eye alone.
    """
    fine = wall.shape[0] // valid.shape[0]
    bare = ~valid.repeat(fine, axis=0).repeat(fine, axis=1)
    row, column = np.indices(bare.shape)
    if bare.any() and not bare.all():
        row, column = distance_transform_edt(bare, return_distances=False, return_indices=True)
    return picture[row // fine, column // fine]


def _hatch_unknown(axis: Axes, coverage: xr.Dataset) -> None:
    """Hatch the unobserved cells that a receiver may be in."""
    hatched = ~coverage["observed"].to_numpy() & ~_outside(coverage)
    unknown = np.pad(hatched, 1, mode="edge").astype(float)
    if not unknown.any():
        return
    step = coverage.attrs["spacing_m"] * np.array([-1.0, 1.0])
    x, y = (np.r_[axis_m[0] + step[0], axis_m, axis_m[-1] + step[1]] for axis_m in (coverage["x"], coverage["y"]))
    area = axis.contourf(x, y, unknown, levels=[0.5, 1.5], colors="none", hatches=[_HATCH], zorder=2)
    area.set_edgecolor(_HATCH_COLOUR)
    area.set_linewidth(0.8)
    area.set_hatch_linewidth(0.6)


def _add_legend(figure: Figure, *, unseen_walls: bool) -> None:
    handles: list[Line2D | Patch] = [
        Line2D([], [], label="transmitter", **_STAR),
        Patch(facecolor="black", label="wall"),
        Patch(facecolor="0.5", hatch=_HATCH, edgecolor=_HATCH_COLOUR, label="not observed"),
    ]
    if unseen_walls:
        handles.insert(2, Patch(facecolor="black", alpha=_UNSEEN_OPACITY, label="wall, not observed"))
    legend_below(figure, handles)
