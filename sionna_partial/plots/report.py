"""A report of one page: maps, covered areas, uncertainty and materials of walls."""

import io
import json
import math
import os
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from numpy.typing import ArrayLike, NDArray

from sionna_partial.arrays import Floats, States
from sionna_partial.checks import require
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.coverage.dataset import probability_above, transmitters_of
from sionna_partial.coverage.grid import named_transmitter
from sionna_partial.coverage.radio import FLOORS
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.layers import Layer, headline
from sionna_partial.plots.logo import read_logo
from sionna_partial.plots.panel import Outline, draw_layer, draw_named_walls, draw_names
from sionna_partial.plots.style import Figure, server_colours
from sionna_partial.settings import Material, material_name

LIKELY = 0.9
"""Probability at which an area counts as covered."""

_REPORTED_DB = np.arange(20.0, -11.0, -10.0)
"""Rows of the table relative to the threshold [dB]."""

_A4_IN, _LINE_IN, _LOGO_IN = (8.27, 11.69), 0.14, (1.8, 0.55)
"""Sizes of the page, and height of a line of text [inch]."""

_BESIDE_IN, _BELOW_IN = (1.1, 0.45), (0.5, 1.0)
"""Width and height beside a panel whose colour bar is beside or below it [inch]."""

_TITLE_WIDTH, _TITLE_BESIDE_LOGO, _TEXT_WIDTH, _ROW_NAME = 90, 62, 124, 16
"""Lengths of lines and names [characters]."""

_MOST_ROOMS = 12
_ONLY = "tx"
"""Name of an only transmitter."""

_STEPS = 2**20
"""Steps of the layout in a page."""


class _Reported(NamedTuple):
    """Coverage (tx, y, x) and its maps by transmitter, powers (T,) [dBm], threshold [dBm], and the scene."""

    coverage: xr.Dataset
    maps: Mapping[str, xr.Dataset]
    powers_dbm: Floats
    threshold_dbm: float
    scene: PartialMap | None


def report_pdf(coverage: xr.Dataset, **given: Any) -> bytes:
    """Return `plot_report` as PDF; equal arguments give equal bytes."""
    figure, stream = plot_report(coverage, **given), io.BytesIO()
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axis in figure.axes:  # the last bits of the layout depend on memory addresses
        axis.set_position(np.round(np.multiply(axis.get_position(original=True).bounds, _STEPS)) / _STEPS)
    figure.savefig(stream, format="pdf", metadata={"CreationDate": None, "Title": "Radio coverage"})
    return stream.getvalue()


def plot_report(
    coverage: xr.Dataset,
    *,
    eirp_dbm: ArrayLike,
    threshold_dbm: float,
    heading: Sequence[str] = (),
    scene: PartialMap | None = None,
    logo: str | os.PathLike[str] | bytes | None = None,
) -> Figure:
    """Draw a report of one page: maps, covered area of transmitters and rooms, uncertainty, materials of walls.

    Parameters
    ----------
    coverage : xarray.Dataset
        From `predict_map`, of up to about ten transmitters.
    eirp_dbm : float or (T,) array-like
        Power of each transmitter, with its antenna [dBm].
    threshold_dbm : float
        Received power that a receiver needs [dBm].
    heading : sequence of str
        Parts of the title, such as a name and a date.
    scene : PartialMap, optional
        The map, which has the materials of walls.
    logo : path-like or bytes, optional
        PNG or JPEG of up to 1 MB, for the upper right corner.

    Raises
    ------
    SettingsError
        For anything but a coverage map, a wrong number of powers, or a file that is no such logo.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(3)
    >>> coverage = sp.predict_map(home, {"hall": (2.0, 3.0, 1.5)}, spacing_m=0.5)
    >>> figure = sp.plots.plot_report(coverage, eirp_dbm=23.0, threshold_dbm=-67.0, scene=home)
    >>> figure.savefig("report.pdf")
    """
    maps, picture = transmitters_of(coverage), None if logo is None else read_logo(logo)
    if "tx" not in coverage.dims:
        maps = {_ONLY: next(iter(maps.values()))}
        coverage = named_transmitter(coverage, _ONLY)
    count = np.size(eirp_dbm)
    require(count in (1, len(maps)), "eirp_dbm", eirp_dbm, f"give one power, or {len(maps)}.")
    powers_dbm = np.broadcast_to(np.asarray(eirp_dbm, dtype=np.float64), len(maps))
    reported = _Reported(coverage, maps, powers_dbm, threshold_dbm, scene)
    notes = (textwrap.fill(note, _TEXT_WIDTH) for note in _notes(coverage, scene))
    text = "\n\n".join([_table(reported), *notes])
    text_in = _LINE_IN * (text.count("\n") + 2)
    figure = Figure(figsize=_A4_IN, layout="constrained")
    parts: Any = figure.subfigures(2, 1, height_ratios=(_A4_IN[1] - text_in, text_in))
    _draw_panels(parts[0], reported, _A4_IN[1] - text_in - 0.6)
    lines = " \N{MIDDLE DOT} ".join(["Radio coverage", *heading]), headline("Prediction", maps)
    width = _TITLE_WIDTH if picture is None else _TITLE_BESIDE_LOGO
    look: dict[str, Any] = {} if picture is None else {"x": 0.02, "ha": "left"}
    title = "\n".join(textwrap.fill(line, width) for line in lines)
    figure.suptitle(title, fontsize="medium", parse_math=False, **look)
    if picture is not None:
        _draw_logo(figure, picture)
    axis = parts[1].subplots()
    axis.set_axis_off()
    axis.text(0.02, 1.0, text, va="top", family="monospace", fontsize=7.5, parse_math=False, transform=axis.transAxes)
    return figure


def _draw_logo(figure: Figure, picture: States) -> None:
    """Draw a logo in the upper right corner, beside the title."""
    rows, columns = picture.shape[:2]
    scale = min(_LOGO_IN[0] / columns, _LOGO_IN[1] / rows)
    width, height = columns * scale / _A4_IN[0], rows * scale / _A4_IN[1]
    axis = figure.add_axes((0.98 - width, 0.99 - height, width, height))
    axis.set_in_layout(False)
    axis.imshow(picture, aspect="auto", interpolation="antialiased")
    axis.set_axis_off()


def _grid(most: int, aspect: float, height_in: float) -> tuple[int, int]:
    """Return the number of panels, two or more, and the columns that give them most of the page.

    Colour bars are beside the panels of one column, else below each panel.
    """

    def area(grid: tuple[int, int]) -> float:
        count, columns = grid
        more_in = _BESIDE_IN if columns == 1 else _BELOW_IN
        width_in = min(_A4_IN[0] / columns - more_in[0], aspect * (height_in / math.ceil(count / columns) - more_in[1]))
        return count * max(width_in, 0.0) ** 2

    return max(((count, columns) for count in range(2, most + 1) for columns in (1, 2, count)), key=area)


def _layers(of: _Reported) -> tuple[list[Layer], Outline]:
    """Return the layers of the panels, and the line around the area that is probably covered."""
    power = of.coverage.radio.power(eirp_dbm=of.powers_dbm)["power_mean_dbm"].to_numpy()
    strongest = np.nan_to_num(power, nan=-np.inf).argmax(axis=0)
    thresholds_db = np.clip(of.threshold_dbm - of.powers_dbm, GAIN_FLOOR_DB, 0.0)
    above = np.fmax.reduce(
        [probability_above(*pair) for pair in zip(of.maps.values(), thresholds_db.tolist(), strict=True)]
    )
    spread = _taken(of.coverage["gain_std_db"].to_numpy(), strongest)
    limit, level = f"{of.threshold_dbm:g} dBm", Normalize(of.threshold_dbm - 30.0, of.threshold_dbm + 40.0)
    servers = Normalize(-0.5, len(of.maps) - 0.5), ListedColormap(server_colours(len(of.maps)))
    layers = [
        Layer("Mean received power", lambda _: _taken(power, strongest), level, "viridis", "dBm"),
        Layer(f"P(received power > {limit})", lambda _: above, Normalize(0.0, 1.0), "cividis", "probability"),
        Layer("Strongest transmitter", lambda _: strongest.astype(float), *servers),
        Layer("Standard deviation", lambda _: spread, Normalize(0.0, 30.0), "magma", "dB"),
    ]
    if len(of.maps) == 1:
        del layers[2]
    return layers, Outline(above, LIKELY, f"P = {LIKELY:g}", f"P(> {limit}) < {LIKELY:g}")


def _draw_panels(pictures: Any, of: _Reported, height_in: float) -> None:
    layers, outline = _layers(of)
    count, columns = _grid(len(layers), of.coverage.sizes["x"] / of.coverage.sizes["y"], height_in)
    axes = pictures.subplots(math.ceil(count / columns), columns, squeeze=False).ravel()
    one = next(iter(of.maps.values()))
    for axis, layer in zip(axes[:count], layers, strict=False):
        draw_layer(axis, one, layer, halo=True)
        handles = [*draw_named_walls(axis, of.scene), *outline.draw(axis, one)]
        draw_names(axis, of.coverage)
        axis.set_title(layer.title, fontsize="medium")
        where = {"location": "right" if columns == 1 else "bottom", "shrink": 0.9}
        bar = pictures.colorbar(ScalarMappable(layer.norm, layer.cmap), ax=axis, label=layer.label, **where)
        if not layer.label:
            bar.set_ticks(range(len(of.maps)), labels=[name[:_ROW_NAME] for name in of.maps])
    for axis in axes[count:]:
        axis.set_axis_off()
    if handles:
        pictures.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, fontsize="small")


def _taken(values: Floats, index: NDArray[np.integer[Any]]) -> Floats:
    return np.take_along_axis(values, index[None], axis=0)[0]


def _table(of: _Reported) -> str:
    """Return the covered fractions of transmitters at powers around the threshold, and of rooms."""
    rows = [f"Observed floor / all floor above, with P = {LIKELY:g}"]
    for (name, one), power_dbm in zip(of.maps.items(), of.powers_dbm, strict=True):
        x, y, z = one.attrs["transmitter_m"]
        rows.append(f"{name[:_ROW_NAME]} at ({x:z.2f}, {y:z.2f}, {z:z.2f}) m, {power_dbm:g} dBm")
    rows += ["any transmitter"] if len(of.maps) > 1 else []
    rows = [row.ljust(max(map(len, rows))) for row in rows]
    given: dict[str, Any] = {"probability": LIKELY, "eirp_dbm": of.powers_dbm}
    for level_dbm in of.threshold_dbm + _REPORTED_DB:
        area = of.coverage.radio.area(level_dbm, **given)["fraction"].to_numpy().T
        together = of.coverage.radio.area(level_dbm, any_transmitter=True, **given)["fraction"].to_numpy()
        cells = [f"{seen:.0%} /{every:>4.0%}" for seen, every, *_ in (*area, together)]
        rows = [row + cell.rjust(13) for row, cell in zip(rows, [f"{level_dbm:g} dBm", *cells], strict=False)]
    rooms = room_fractions(of.coverage, of.threshold_dbm, of.powers_dbm)[:_MOST_ROOMS]
    if rooms:
        each = ", ".join(f"{name} {fraction:.0%}" for name, fraction in rooms)
        of_rooms = f"Rooms above {of.threshold_dbm:g} dBm, the least covered first: {each}"
        rows += ["", textwrap.fill(of_rooms, _TEXT_WIDTH)]
    return "\n".join(rows)


def room_fractions(coverage: xr.Dataset, threshold_dbm: float, powers_dbm: ArrayLike) -> list[tuple[str, float]]:
    """Return the rooms of a map of named transmitters and their covered fractions, the least covered first."""
    area = coverage.radio.area(threshold_dbm, probability=LIKELY, eirp_dbm=powers_dbm, any_transmitter=True)
    of_rooms = area["fraction"].isel(floor=slice(len(FLOORS), None))
    rooms = zip(map(str, of_rooms["floor"].to_numpy()), of_rooms.to_numpy().tolist(), strict=True)
    return sorted([room for room in rooms if np.isfinite(room[1])], key=lambda room: room[1])


def _notes(coverage: xr.Dataset, partial: PartialMap | None) -> list[str]:
    attributes = coverage.attrs
    notes = [
        f"Receivers are {attributes['rx_height_m']:g} m high and {attributes['spacing_m']:g} m apart. Axes are in m. "
        f"{attributes['map_observed_fraction']:.0%} of the map is observed. Predictor: {attributes['predictor']}. "
        f"The hatched side of a line is not above the threshold with a probability of {LIKELY:g}. Unobserved floor "
        "counts with the probability that it is indoors."
    ]
    if "measured_links" in attributes:
        notes[0] += f" {attributes['measured_links']:,} measured powers correct the prediction."
    std_db = coverage["gain_std_db"].to_numpy()
    observed = np.broadcast_to(coverage["observed"].to_numpy() == 1, std_db.shape) & np.isfinite(std_db)
    spreads = [
        f"{std_db[where].mean():.1f} dB on the {what} floor"
        for what, where in (("observed", observed), ("unobserved", ~observed & np.isfinite(std_db)))
        if where.any() and not (attributes["map_complete"] and what == "unobserved")
    ]
    uncertainty = f"Uncertainty: the mean standard deviation of the path gain is {', '.join(spreads)}. "
    if attributes["map_complete"]:
        uncertainty += (
            "The map is complete, and rays were traced in it: errors of the map, and furniture that it lacks, "
        )
        uncertainty += f"are {'' if 'wall_material' in attributes else 'not '}in that deviation."
    else:
        uncertainty += (
            "Rays were traced in the observed part; the rest is a distribution learned from other buildings. "
        )
        uncertainty += "An area counts where that distribution exceeds the power with the probability above."
    fractions = {} if partial is None else partial.wall_fractions
    named = [f"{material_name(each)} ({part:.0%} of the walls)" for each, part in fractions.items() if each]
    if "wall_material" in attributes:
        walls = f"{'others ' if named else ''}not known; probabilities: {attributes['wall_material']}. That is part of "
        walls = ", ".join([*named, walls + "the deviation"])
    else:
        material = Material(**json.loads(attributes["scene_settings"])["material"])
        walls = ", ".join([*named, material_name(material) if None in fractions or not named else "no others"])
        walls += "" if partial else ", except walls whose material the map has"
        walls += "; no path passes through walls" if attributes.get("walls") == "opaque walls" else ""
    return [*notes, uncertainty, f"Material of the walls: {walls}."]
