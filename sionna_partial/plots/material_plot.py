"""Figure of a calibration of materials: the search, the fit before and after, and the material found."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from sionna_partial.calibration.calibration import MaterialCalibration
from sionna_partial.checks import require_type
from sionna_partial.plots.style import BLUE, RED, Figure
from sionna_partial.settings import Material
from sionna_partial.tracing.power import reflection_loss_db

ANGLES_DEG = np.linspace(0.0, 85.0, 171)
"""Angles of incidence at which reflections are drawn [degrees]."""

LARGEST_LOSS_DB = 30.0
"""Largest loss of a reflection that is drawn [dB]."""

_LINE: dict[str, Any] = {"linewidth": 1.6}


def plot_calibration(calibration: MaterialCalibration) -> Figure:
    """Draw a calibration of materials.

    Left the loss after each step; in the middle the measured gains against those that are traced with the material of
    the start and with the calibrated one; right the loss of a reflection at walls, with two standard deviations to
    either side, and that of the start: a panel for each material of a mesh.

    Parameters
    ----------
    calibration : MaterialCalibration

    Returns
    -------
    matplotlib.figure.Figure
        Not registered with pyplot: it need not be closed.

    Raises
    ------
    SettingsError
        For something else than a MaterialCalibration.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1, 1], [1, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 1], [1, 0, 0, 0, 0, 1], [1, 1, 1, 1, 1, 1]]
    >>> room, tx = sp.map_from_array(cells, resolution_m=1.0), (1.5, 1.5, 1.5)
    >>> rx = [(x, y, 1.5) for x in (2.2, 2.9, 3.6, 4.3) for y in (1.7, 2.4, 3.1)]
    >>> measured = sp.Measurements(tx, rx, sp.trace_links(room, tx, rx).gain_db)
    >>> found = sp.calibrate_materials(room, measured)
    >>> sp.plot_calibration(found).savefig("calibration.png")
    """
    require_type("calibration", calibration, MaterialCalibration, "give what calibrate_materials returned.")
    count = len(calibration.materials)
    figure = Figure(figsize=(4.2 * (2 + count), 3.9), dpi=150, layout="constrained")
    axes = figure.subplots(1, 2 + count)
    loss = calibration.loss
    axes[0].plot(np.arange(len(loss)), loss, marker="o", markersize=4, color=BLUE, **_LINE)
    axes[0].set(xlabel="step (0 is the start)", ylabel="negative log posterior per link", title="Search")
    axes[0].xaxis.set_major_locator(MaxNLocator(integer=True))
    axes[0].grid(alpha=0.3)
    _draw_gains(axes[1], calibration)
    for which in range(count):
        _draw_reflection(axes[2 + which], calibration, which)
    undetermined = ", ".join(calibration.undetermined)
    note = f"; the measurements cannot determine {undetermined}" if undetermined else ""
    used, count = int(calibration.used.sum()), len(calibration.used)
    figure.suptitle(f"Material from {used} of {count} measured links, noise {calibration.noise_db:.1f} dB{note}")
    return figure


def _draw_gains(axis: Axes, calibration: MaterialCalibration) -> None:
    used = calibration.used
    measured = calibration.gain_db[used]
    pairs = (("start", calibration.gain_before_db, RED), ("calibrated", calibration.gain_after_db, BLUE))
    for name, traced_db, colour in pairs:
        rmse_db = float(np.sqrt(np.mean((traced_db[used] - measured) ** 2)))
        style: dict[str, Any] = {"s": 9, "alpha": 0.6, "linewidths": 0, "color": colour}
        axis.scatter(measured, traced_db[used], label=f"{name}, RMSE {rmse_db:.1f} dB", **style)
    limits = [float(np.min(measured)) - 5.0, float(np.max(measured)) + 5.0]
    axis.plot(limits, limits, color="0.3", linewidth=0.9, linestyle="--")
    axis.set(xlabel="measured gain [dB]", ylabel="traced gain [dB]", title="Links", xlim=limits)
    axis.legend(loc="upper left", fontsize="small")
    axis.grid(alpha=0.3)


def _draw_reflection(axis: Axes, calibration: MaterialCalibration, which: int) -> None:
    start, found = calibration.start[which], calibration.materials[which]
    loss_db, std_db = calibration.reflection_loss_db(ANGLES_DEG, which=which)
    slab = (start.relative_permittivity, start.conductivity_s_m, start.thickness_m)
    before_db = reflection_loss_db(*slab, calibration.trace_settings.frequency_hz, ANGLES_DEG)
    axis.fill_between(ANGLES_DEG, loss_db - 2.0 * std_db, loss_db + 2.0 * std_db, color=BLUE, alpha=0.2, linewidth=0)
    axis.plot(ANGLES_DEG, before_db, color=RED, label=f"start: {_words(start)}", **_LINE)
    axis.plot(ANGLES_DEG, loss_db, color=BLUE, label=f"calibrated: {_words(found)}", **_LINE)
    title = "Reflection at walls" if len(calibration.materials) == 1 else f"Material {which}"
    axis.set(xlabel="angle of incidence [degrees]", ylabel="loss of a reflection [dB]", title=title)
    axis.set(xlim=(0.0, 85.0), ylim=(min(LARGEST_LOSS_DB, 1.15 * float(max(loss_db.max(), before_db.max()))), 0.0))
    axis.legend(loc="lower right", fontsize="small")
    axis.grid(alpha=0.3)


def _words(material: Material) -> str:
    return f"{material.relative_permittivity:.3g}, {material.conductivity_s_m:.2g} S/m"
