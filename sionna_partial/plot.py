"""Every figure of the package."""

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from sionna_partial.constants import LinkState
from sionna_partial.coverage import WALL_PARTS, require_coverage
from sionna_partial.settings import require

STATE_COLOURS = {LinkState.LOS: "#ddaa33", LinkState.NLOS: "#bb5566", LinkState.OUTAGE: "#004488"}
"""Paul Tol's high-contrast colours: told apart with any colour vision and in grey, the better the brighter."""

_WIDTH_IN = 12.0
_KEY_IN = 1.0
_DPI = 150
_WIDE = 1.8


@dataclass(frozen=True)
class _Layer:
    """One quantity of a panel: its picture (ny, nx) or (ny, nx, 3), and the colour scale of the former."""

    title: str
    picture: Callable[[xr.Dataset], NDArray[np.float64]]
    scale: ScalarMappable | None = None
    extend: str = "neither"


def mix_state_colours(p_los: ArrayLike, p_nlos: ArrayLike, p_outage: ArrayLike) -> NDArray[np.float64]:
    """Mix the colours of the three link states by their probabilities (paper, Section IV-C).

    Parameters
    ----------
    p_los, p_nlos, p_outage : (...) array-like
        Probabilities that sum to 1.

    Returns
    -------
    (..., 3) array
        Red, green and blue in [0, 1]; NaN where the probabilities are NaN.
    """
    colours = np.array([to_rgb(STATE_COLOURS[state]) for state in (LinkState.LOS, LinkState.NLOS, LinkState.OUTAGE)])
    return np.stack([p_los, p_nlos, p_outage], axis=-1).astype(np.float64) @ colours


LINK_STATE = _Layer("Link state", lambda data: mix_state_colours(data["p_los"], data["p_nlos"], data["p_outage"]))
GAIN = _Layer(
    "Path gain, mean",
    lambda data: data["gain_mean_db"].to_numpy(),
    ScalarMappable(Normalize(-150.0, -60.0), "viridis"),
    "max",
)
DEVIATION = _Layer(
    "Path gain, standard deviation",
    lambda data: data["gain_std_db"].to_numpy(),
    ScalarMappable(Normalize(0.0, 40.0), "cividis"),
    "max",
)


def plot_coverage(coverage: xr.Dataset) -> Figure:
    """Draw link state, mean gain and its standard deviation.

    The link state is shown as the colours of the three states mixed by their probabilities. Walls are black, the area
    that the map does not know is hatched, the transmitter is a star.

    Parameters
    ----------
    coverage : xarray.Dataset
        From `predict_map`, or read from its NetCDF file.

    Returns
    -------
    matplotlib.figure.Figure
        Not known to pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        For a Dataset that is no coverage map.
    """
    require_coverage(coverage)
    wide = _aspect(coverage) > _WIDE
    layers = np.array([[LINK_STATE, GAIN, DEVIATION]])
    layers = layers.T if wide else layers
    figure, axes = _panels(layers, _aspect(coverage), keys_right=wide)
    for axis, layer in zip(axes.flat, layers.flat, strict=True):
        _draw(axis, coverage, layer)
        axis.set_title(layer.title)
    figure.suptitle(_headline(coverage))
    return figure


def plot_comparison(coverages: Mapping[str, xr.Dataset]) -> Figure:
    """Draw link state (above) and mean gain (below) of several coverage maps side by side (paper, Fig. 5).

    Parameters
    ----------
    coverages : mapping of str to xarray.Dataset
        Title and coverage map of each column, all of one area. The walls of the first are drawn grey in the others
        where these do not know them.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    SettingsError
        If there is nothing to compare, or for a Dataset that is no coverage map.
    """
    require(len(coverages) > 0, "coverages", dict(coverages), "give at least one coverage map.")
    for coverage in coverages.values():
        require_coverage(coverage)
    first = next(iter(coverages.values()))
    layers = np.array([[LINK_STATE] * len(coverages), [GAIN] * len(coverages)])
    figure, axes = _panels(layers, _aspect(first), keys_right=True)
    for row, column in np.ndindex(axes.shape):
        title, coverage = list(coverages.items())[column]
        _draw(axes[row, column], coverage, layers[row, column], first)
        if row == 0:
            axes[row, column].set_title(title)
    figure.suptitle(_headline(first))
    return figure


def figure_png(figure: Figure) -> bytes:
    """Return a figure as a PNG file; equal figures give equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _aspect(coverage: xr.Dataset) -> float:
    return coverage.sizes["x"] / coverage.sizes["y"]


def _headline(coverage: xr.Dataset) -> str:
    x, y, z = coverage.attrs["transmitter_m"]
    return f"Transmitter at ({x:.2f}, {y:.2f}, {z:.2f}) m, {coverage.attrs['frequency_hz'] / 1e9:g} GHz"


def _panels(
    layers: NDArray[np.object_], aspect: float, *, keys_right: bool
) -> tuple[Figure, NDArray[np.object_]]:
    """Make a figure with a panel for each layer, and a key for each row (`keys_right`) or column."""
    rows, columns = layers.shape
    width = (_WIDTH_IN - 1.0 - (_KEY_IN if keys_right else 0.0)) / columns - 0.2
    height = min(max(width / aspect, 0.8), 12.0)
    size = (_WIDTH_IN, rows * (height + 0.45) + 0.8 + (0.0 if keys_right else _KEY_IN))
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    grid = figure.add_gridspec(
        rows + (not keys_right),
        columns + keys_right,
        width_ratios=[width] * columns + [_KEY_IN] * keys_right,
        height_ratios=[height] * rows + [_KEY_IN] * (not keys_right),
    )
    axes = np.empty(layers.shape, dtype=object)
    for place in np.ndindex(layers.shape):
        axes[place] = figure.add_subplot(grid[place], sharex=axes[0, 0], sharey=axes[0, 0])
        axes[place].label_outer()
    for axis in axes[-1]:
        axis.set_xlabel("x [m]")
    for axis in axes[:, 0]:
        axis.set_ylabel("y [m]")
    for index, layer in enumerate(layers[:, 0] if keys_right else layers[0]):
        key = figure.add_subplot(grid[index, columns] if keys_right else grid[rows, index])
        key.set_axis_off()
        _draw_key(key, layer, upright=keys_right)
    return figure, axes


def _draw_key(key: Axes, layer: _Layer, *, upright: bool) -> None:
    """Draw the colour bar of a scale, or the triangle of mixed state colours."""
    if layer.scale is None:
        _draw_triangle(key)
        return
    place = (0.1, 0.05, 0.2, 0.9) if upright else (0.05, 0.6, 0.9, 0.18)
    orientation = "vertical" if upright else "horizontal"
    bar = key.figure.colorbar(layer.scale, cax=key.inset_axes(place), orientation=orientation, extend=layer.extend)
    bar.set_label(f"{layer.title} [dB]")


def _draw_triangle(key: Axes) -> None:
    """Draw every mixture of the three states: LOS at the left, NLOS at the right, outage at the top."""
    x, y = np.meshgrid(np.linspace(0.0, 1.0, 200), np.linspace(0.0, 1.0, 200))
    p_nlos = x - y / 2
    picture = np.clip(mix_state_colours(1.0 - p_nlos - y, p_nlos, y), 0.0, 1.0)
    key.set_aspect("equal")
    key.set(xlim=(-0.5, 1.5), ylim=(-0.2, 1.1))
    image = key.imshow(picture, extent=(0.0, 1.0, 0.0, 3**0.5 / 2), origin="lower", interpolation="bilinear")
    outline = Polygon([(0.0, 0.0), (1.0, 0.0), (0.5, 3**0.5 / 2)], fill=False, edgecolor="0.3", linewidth=0.6)
    key.add_patch(outline)
    image.set_clip_path(outline)
    key.text(-0.06, 0.0, "LOS", ha="right", va="center")
    key.text(1.06, 0.0, "NLOS", ha="left", va="center")
    key.text(0.5, 0.9, "outage", ha="center", va="bottom")


def _draw(axis: Axes, coverage: xr.Dataset, layer: _Layer, reference: xr.Dataset | None = None) -> None:
    """Draw one layer, the unknown area, the walls and the transmitter."""
    extent = _extent(coverage)
    picture = _fill(layer.picture(coverage), coverage["valid"].to_numpy())
    options = {} if layer.scale is None else {"norm": layer.scale.norm, "cmap": layer.scale.cmap}
    axis.imshow(picture, extent=extent, origin="lower", interpolation="nearest", **options)
    _hatch_unknown(axis, coverage)
    if reference is not None:
        _draw_walls(axis, reference, 0.5)
    _draw_walls(axis, coverage, 1.0)
    x, y, _ = coverage.attrs["transmitter_m"]
    axis.plot(x, y, "*", markersize=13, markerfacecolor="white", markeredgecolor="black", markeredgewidth=1.0)
    axis.set(xlim=extent[:2], ylim=extent[2:], aspect="equal")


def _extent(coverage: xr.Dataset) -> tuple[float, float, float, float]:
    half = coverage.attrs["spacing_m"] / 2
    x, y = coverage["x"].to_numpy(), coverage["y"].to_numpy()
    return x[0] - half, x[-1] + half, y[0] - half, y[-1] + half


def _fill(picture: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Let cells without a receiver show their nearest neighbour, which the walls drawn over them leave bare."""
    if valid.all() or not valid.any():
        return picture
    row, column = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    return picture[row, column]


def _hatch_unknown(axis: Axes, coverage: xr.Dataset) -> None:
    unknown = np.pad(~coverage["observed"].to_numpy(), 1, mode="edge").astype(float)
    if not 0 < unknown.sum():
        return
    spacing_m = coverage.attrs["spacing_m"]
    x, y = (np.pad(coverage[name].to_numpy(), 1, mode="reflect", reflect_type="odd") for name in ("x", "y"))
    veil = axis.contourf(x, y, unknown, levels=[0.5, 1.5], colors="none", hatches=["////"])
    veil.set_edgecolor((1, 1, 1, 0.55))
    veil.set_linewidth(0.8)
    veil.set_hatch_linewidth(0.6)


def _draw_walls(axis: Axes, coverage: xr.Dataset, opacity: float) -> None:
    bits = coverage["wall_parts"].to_numpy()[:, None, :, None] >> np.arange(WALL_PARTS**2).reshape(
        1, WALL_PARTS, 1, WALL_PARTS
    )
    ny, nx = coverage.sizes["y"], coverage.sizes["x"]
    wall = (bits & 1).reshape(ny * WALL_PARTS, nx * WALL_PARTS)
    picture = np.zeros((*wall.shape, 4))
    picture[..., 3] = opacity * wall
    axis.imshow(picture, extent=_extent(coverage), origin="lower", interpolation="nearest")
