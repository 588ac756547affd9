"""The demo: what a half-explored home that ships with the package tells, beside the truth."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial as bind
from os import PathLike
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sionna_partial.constants import CellState
from sionna_partial.coverage import predict_map
from sionna_partial.errors import SceneError
from sionna_partial.export import FORMATS, save_coverage
from sionna_partial.files import atomic_files, atomic_write
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.coverage_plot import plot_comparison
from sionna_partial.plots.style import figure_png
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.resources import demo_homes, scenes_folder
from sionna_partial.tracing.trace import Progress

TRUTH, NOTHING, PARTIAL = "truth", "nothing observed", "partial map"
"""Titles of the three coverage maps that are compared (paper, Fig. 5)."""


@dataclass(frozen=True)
class DemoResult:
    """What the demo made.

    Parameters
    ----------
    files : dict of str to pathlib.Path
        File name and place of every file.
    table : str
        Accuracy and error of the predictions, as text.
    """

    files: dict[str, Path]
    table: str


def run_demo(
    out: str | PathLike[str],
    progress: Progress | None = None,
    *,
    home: str = "apartment",
    step: int = 100,
) -> DemoResult:
    """Predict the coverage of a shipped home after some steps of exploration, and compare it with the truth.

    Written are `coverage` in every format, `comparison.png` (truth, nothing observed, partial map) and `table.txt`.

    Parameters
    ----------
    out : path-like
        Folder for the files. Files of these names are replaced.
    progress : callable, optional
        Called as ``progress(share_done, message)``.
    home : str
        Name of a shipped home.
    step : int
        Stage of exploration.

    Returns
    -------
    DemoResult

    Raises
    ------
    SceneError
        If there is no such home or stage.
    OutputError
        If writing fails.
    """
    report = progress or (lambda share, message: None)
    complete, known, tx = demo_scene(home, step)
    nothing = replace(complete, state=np.full_like(complete.state, CellState.UNKNOWN))
    report(0.0, "loading the predictor")
    predictor = Predictor.load()
    coverages = {}
    for index, (title, scene) in enumerate({TRUTH: complete, NOTHING: nothing, PARTIAL: known}.items()):
        advance = bind(_report_part, report, 0.1 + 0.25 * index, 0.25, title)
        coverages[title] = predict_map(scene, tx, predictor=predictor, progress=advance)
    table = comparison_table(coverages)
    report(0.85, "writing")
    files = _write(coverages, table, Path(out))
    report(1.0, "done")
    return DemoResult(files, table)


def demo_scene(home: str, step: int) -> tuple[PartialMap, PartialMap, tuple[float, ...]]:
    """Load a shipped home.

    Parameters
    ----------
    home : str
    step : int

    Returns
    -------
    complete, known : PartialMap
        The whole home, and what the robot knows of it.
    tx : tuple of float
        Transmitter position [m].

    Raises
    ------
    SceneError
        If there is no such home or stage.
    """
    scenes, homes = scenes_folder(), demo_homes()
    if home not in homes:
        raise SceneError(f"home = {home!r} is not in '{scenes}': choose one of {', '.join(homes)}.")
    stages = sorted(int(folder.name.removeprefix("step")) for folder in (scenes / home).glob("step*"))
    if step not in stages:
        raise SceneError(f"step = {step!r} is not in '{scenes / home}': choose one of {', '.join(map(str, stages))}.")
    folder = scenes / home
    return load_map(folder / "complete"), load_map(folder / f"step{step:03d}"), homes[home]["transmitter"]


def comparison_table(coverages: Mapping[str, xr.Dataset]) -> str:
    """Tabulate link-state accuracy and gain error (root mean square) at the receivers inside the home.

    Parameters
    ----------
    coverages : mapping
        Coverage maps of one grid, by `TRUTH`, `NOTHING` and `PARTIAL`.

    Returns
    -------
    str
    """
    truth, known = coverages[TRUTH], coverages[PARTIAL]
    inside = truth["valid"] & known["valid"] & (truth["cell_state"] == CellState.FREE)
    areas = {"everywhere": inside, "observed": inside & known["observed"], "not observed": inside & ~known["observed"]}
    answers = {
        NOTHING: (coverages[NOTHING]["link_state"], coverages[NOTHING]["gain_mean_db"]),
        "partial trace alone": (known["partial_link_state"], known["partial_gain_db"]),
        PARTIAL: (known["link_state"], known["gain_mean_db"]),
    }
    lines = [
        "Link-state accuracy and RMSE of the path gain against the trace of the complete home",
        "",
        " " * 22 + "".join(f"{f'{name} ({int(mask.sum())})':>22}" for name, mask in areas.items()),
    ]
    for name, (state, gain_db) in answers.items():
        scores = (_score(truth, state, gain_db, mask.to_numpy()) for mask in areas.values())
        lines.append(f"{name:<22}" + "".join(f"{score:>22}" for score in scores))
    return "\n".join(lines) + "\n"


def _score(truth: xr.Dataset, state: xr.DataArray, gain_db: xr.DataArray, mask: NDArray[np.bool_]) -> str:
    if not mask.any():
        return "-"
    accuracy = (state == truth["link_state"]).to_numpy()[mask].mean()
    error_db = (gain_db - truth["gain_mean_db"]).to_numpy()[mask].astype(np.float64)
    return f"{100 * accuracy:.1f} %  {np.sqrt(np.mean(error_db**2)):5.1f} dB"


def _report_part(report: Progress, start: float, length: float, title: str, share: float, message: str) -> None:
    report(start + length * share, f"{title}: {message}")


def _write(coverages: Mapping[str, xr.Dataset], table: str, out: Path) -> dict[str, Path]:
    names = (*(f"coverage{suffix}" for suffix in FORMATS), "comparison.png", "table.txt")
    with atomic_files(out) as folder:
        for suffix in FORMATS:
            save_coverage(coverages[PARTIAL], folder / f"coverage{suffix}")
        with atomic_write(folder / "comparison.png") as stream:
            stream.write(figure_png(plot_comparison(coverages)))
        with atomic_write(folder / "table.txt", "w") as stream:
            stream.write(table)
    return {name: out / name for name in names}
