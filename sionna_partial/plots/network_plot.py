"""Figures of networks: best server, SINR and rate, and where to put several transmitters."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import PercentFormatter
from numpy.typing import NDArray

from sionna_partial.checks import require
from sionna_partial.coverage import TX_COORDINATES
from sionna_partial.placement.several import NetworkPlacement
from sionna_partial.plots.coverage_plot import extent_m, wall_cells
from sionna_partial.plots.map_plot import draw_map
from sionna_partial.plots.style import STAR, Figure, legend_below, shade

_WIDTH_IN, _DPI = 10.0, 130
_SERVERS = "tab20"


def plot_network(network: xr.Dataset) -> Figure:
    """Draw best server, mean SINR, probability of enough SINR, and mean rate of a network.

    Parameters
    ----------
    network : xarray.Dataset
        From `network_map`.

    Returns
    -------
    matplotlib.figure.Figure
        Not registered with pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        For something else than a network map.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> coverage = sp.predict_map(sp.make_home(7), {"a": (3.0, 4.0, 2.2), "b": (6.0, 3.0, 1.0)}, spacing_m=0.5)
    >>> figure = sp.plot_network(sp.network_map(coverage))
    >>> figure.savefig("network.png")
    """
    is_network = isinstance(network, xr.Dataset) and "best_server" in network
    require(is_network, "network", type(network).__name__, "give what network_map returned.")
    aspect = network.sizes["x"] / network.sizes["y"]
    height = min(max((_WIDTH_IN / 2 - 1.2) / aspect, 2.0), 9.0)
    figure = Figure(figsize=(_WIDTH_IN, 2 * height + 1.6), dpi=_DPI, layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    names = [str(name) for name in network["tx"].to_numpy()]
    servers = ListedColormap([_colour(number) for number in range(len(names))])
    best = network["best_server"].to_numpy()
    _draw(axes[0, 0], network, np.where(best >= 0, best, np.nan), servers, Normalize(-0.5, len(names) - 0.5))
    axes[0, 0].set_title("likeliest best server")
    norm = Normalize(-0.5, len(names) - 0.5)
    bar = figure.colorbar(ScalarMappable(norm, servers), ax=axes[0, 0], ticks=range(len(names)))
    bar.ax.set_yticklabels(names)
    threshold_db = float(network.attrs["sinr_threshold_db"])
    top_bit_s = float(np.nanmax(network["rate_bit_s"])) / 1e6 if np.isfinite(network["rate_bit_s"]).any() else 1.0
    layers = (
        (axes[0, 1], "sinr_mean_db", 1.0, Normalize(-20.0, 40.0), "mean SINR [dB]"),
        (axes[1, 0], "p_sinr_above", 1.0, Normalize(0.0, 1.0), f"P(SINR > {threshold_db:g} dB)"),
        (axes[1, 1], "rate_bit_s", 1e-6, Normalize(0.0, top_bit_s), "mean Shannon rate [Mbit/s]"),
    )
    for axis, name, scale, norm, title in layers:
        _draw(axis, network, scale * network[name].to_numpy(), "viridis", norm)
        figure.colorbar(ScalarMappable(norm, "viridis"), ax=axis)
        axis.set_title(title)
    for axis in axes.flat:
        axis.label_outer()
    seen = Line2D([], [], color="0.7", label="border of the observed part")
    legend_below(figure, [Line2D([], [], label="transmitter", markersize=12, **STAR), seen])
    bandwidth_mhz = float(network.attrs["bandwidth_hz"]) / 1e6
    figure.suptitle(f"Network of {len(names)} transmitters, {bandwidth_mhz:g} MHz, load {network.attrs['load']:g}")
    return figure


def plot_network_placement(placement: NetworkPlacement) -> Figure:
    """Draw the transmitters that `place_transmitters` chose, the candidates, and the receivers that they cover.

    Parameters
    ----------
    placement : NetworkPlacement

    Returns
    -------
    matplotlib.figure.Figure
        Not registered with pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        For something else than a NetworkPlacement.
    """
    kind = type(placement).__name__
    require(isinstance(placement, NetworkPlacement), "placement", kind, "give what place_transmitters returned.")
    partial, norm, size = placement.partial, Normalize(0.0, 1.0), placement.spacing_m
    ny, nx = partial.shape
    figure = Figure(figsize=(9.0, min(max(7.0 * ny / nx, 3.0), 14.0) + 1.2), dpi=_DPI, layout="constrained")
    axis = figure.add_subplot()
    draw_map(axis, partial)
    patches = [Rectangle((x - size / 2, y - size / 2), size, size) for x, y in placement.rx_m[:, :2]]
    squares = PatchCollection(patches, cmap="viridis", norm=norm, linewidths=0.0, zorder=1)
    squares.set_array(placement.values)
    squares.set_alpha((0.15 + 0.75 * np.clip(placement.weight, 0.0, 1.0)).tolist())
    axis.add_collection(squares)
    axis.plot(*placement.candidates_m[:, :2].T, "o", markerfacecolor="white", markeredgecolor="black", markersize=5)
    axis.plot(*placement.positions_m[:, :2].T, zorder=6, **STAR | {"markersize": 15})
    title = f"{len(placement.positions_m)} transmitters, predicted coverage {placement.score:.1%}"
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    label = f"probability that one is above {placement.settings.threshold_db:g} dB"
    bar = figure.colorbar(ScalarMappable(norm, "viridis"), ax=axis, label=label, shrink=0.8)
    bar.ax.yaxis.set_major_formatter(PercentFormatter(1.0))
    candidate = {"marker": "o", "linestyle": "none", "markerfacecolor": "white", "markeredgecolor": "black"}
    handles = [
        Line2D([], [], label="transmitter", markersize=12, **STAR),
        Line2D([], [], label="candidate", **candidate),  # type: ignore[arg-type]
    ]
    legend_below(figure, handles)
    return figure


def _colour(number: int) -> str:
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return to_hex(colormaps[_SERVERS](number % 20))


def _draw(
    axis: Axes, network: xr.Dataset, picture: NDArray[np.float64], cmap: str | ListedColormap, norm: Normalize
) -> None:
    """Draw a layer, the walls and the transmitters."""
    extent = extent_m(network)
    shown = np.ma.masked_invalid(picture)
    axis.imshow(shown, extent=extent, origin="lower", interpolation="nearest", norm=norm, cmap=cmap)
    axis.imshow(shade(wall_cells(network)), extent=extent, origin="lower", zorder=3)
    unseen = ~network["observed"].to_numpy().astype(bool)
    axis.contour(network["x"], network["y"], unseen, levels=[0.5], colors="0.7", linewidths=0.8)
    x, y, _ = (network[name].to_numpy() for name in TX_COORDINATES)
    axis.plot(x, y, zorder=4, **STAR | {"markersize": 12})
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
