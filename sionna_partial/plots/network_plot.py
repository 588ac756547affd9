"""Figure of a network: best server, SINR and rate."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from sionna_partial.coverage_map import TX_COORDINATES
from sionna_partial.network import require_network
from sionna_partial.plots.coverage_plot import extent_m, wall_cells
from sionna_partial.plots.style import STAR, Figure, legend_below, server_colours, shade

_WIDTH_IN, _DPI = 10.0, 130


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
    require_network(network)
    aspect = network.sizes["x"] / network.sizes["y"]
    height = min(max((_WIDTH_IN / 2 - 1.2) / aspect, 2.0), 9.0)
    figure = Figure(figsize=(_WIDTH_IN, 2 * height + 1.6), dpi=_DPI, layout="constrained")
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    names = [str(name) for name in network["tx"].to_numpy()]
    servers = ListedColormap(server_colours(len(names)))
    best, norm = network["best_server"].to_numpy(), Normalize(-0.5, len(names) - 0.5)
    _draw(axes[0, 0], network, np.where(best >= 0, best, np.nan), servers, norm)
    axes[0, 0].set_title("Likeliest best server")
    bar = figure.colorbar(ScalarMappable(norm, servers), ax=axes[0, 0], ticks=range(len(names)))
    bar.ax.set_yticklabels(names, parse_math=False)
    threshold_db = float(network.attrs["sinr_threshold_db"])
    top_bit_s = float(np.nanmax(network["rate_bit_s"])) / 1e6 if np.isfinite(network["rate_bit_s"]).any() else 1.0
    layers = (
        (axes[0, 1], "sinr_mean_db", 1.0, Normalize(-20.0, 40.0), "Mean SINR [dB]"),
        (axes[1, 0], "p_sinr_above", 1.0, Normalize(0.0, 1.0), f"P(SINR > {threshold_db:g} dB)"),
        (axes[1, 1], "rate_bit_s", 1e-6, Normalize(0.0, top_bit_s), "Mean Shannon rate [Mbit/s]"),
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
