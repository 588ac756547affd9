"""Demo: coverage predicted from a shipped, half-explored home, against the truth."""

from collections.abc import Mapping
from dataclasses import replace
from os import PathLike

import numpy as np
import xarray as xr

from sionna_partial.arrays import Bools
from sionna_partial.checks import Progress, no_progress
from sionna_partial.constants import CellState
from sionna_partial.coverage.job import predict_map
from sionna_partial.errors import SceneError
from sionna_partial.export import FORMATS, save_coverage
from sionna_partial.files import atomic_files, output_path
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.plots.coverage_plot import plot_comparison
from sionna_partial.plots.style import figure_png
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.resources import demo_homes, scenes_folder

TRUTH, NOTHING, PARTIAL = "truth", "nothing observed", "partial map"
"""Titles of the compared coverage maps (paper, Fig. 5)."""


def run_demo(
    out: str | PathLike[str], progress: Progress | None = None, *, home: str = "apartment", step: int = 100
) -> tuple[list[str], str]:
    """Predict the coverage of a shipped, partly explored home, and compare it with the truth.

    Return the names of the written files (`coverage` in every format, `comparison.png`, `table.txt`) and the table.
    """
    report = progress or no_progress
    complete, known, tx = demo_scene(home, step)
    nothing = replace(complete, state=np.full_like(complete.state, CellState.UNKNOWN))
    report(0.0, "loading the predictor")
    predictor = Predictor.load()
    coverages = {}
    for index, (title, scene) in enumerate({TRUTH: complete, NOTHING: nothing, PARTIAL: known}.items()):

        def report_part(fraction: float, message: str, index: int = index, title: str = title) -> None:
            report(0.1 + 0.25 * (index + fraction), f"{title}: {message}")

        coverages[title] = predict_map(scene, tx, predictor=predictor, progress=report_part)
    table = comparison_table(coverages)
    report(0.85, "writing")
    with atomic_files(output_path(out)) as folder:
        for suffix in FORMATS:
            save_coverage(coverages[PARTIAL], folder / f"coverage{suffix}", scene=known)
        (folder / "comparison.png").write_bytes(figure_png(plot_comparison(coverages)))
        (folder / "table.txt").write_text(table, encoding="utf-8")
    report(1.0, "done")
    return [*(f"coverage{suffix}" for suffix in FORMATS), "comparison.png", "table.txt"], table


def demo_scene(home: str, step: int) -> tuple[PartialMap, PartialMap, tuple[float, ...]]:
    """Load a shipped home: complete map, partial map and transmitter position [m]."""
    scenes, homes = scenes_folder(), demo_homes()
    if home not in homes:
        raise SceneError(f"home = {home!r} is not in '{scenes}': choose one of {', '.join(homes)}.")
    folder = scenes / home
    stages = sorted(int(each.name.removeprefix("step")) for each in folder.glob("step*"))
    if step not in stages:
        raise SceneError(f"step = {step!r} is not in '{folder}': choose one of {', '.join(map(str, stages))}.")
    return load_map(folder / "complete"), load_map(folder / f"step{step:03d}"), homes[home]["transmitter"]


def comparison_table(coverages: Mapping[str, xr.Dataset]) -> str:
    """Tabulate link-state accuracy and gain error (root mean square) at the receivers inside the home."""
    truth, known = coverages[TRUTH], coverages[PARTIAL]
    inside = truth["valid"] & known["valid"] & (truth["cell_state"] == CellState.FREE)
    areas = {"everywhere": inside, "observed": inside & known["observed"], "not observed": inside & ~known["observed"]}
    predictions = {
        NOTHING: (coverages[NOTHING]["link_state"], coverages[NOTHING]["gain_mean_db"]),
        "partial trace alone": (known["partial_link_state"], known["partial_gain_db"]),
        PARTIAL: (known["link_state"], known["gain_mean_db"]),
    }
    lines = [
        "Link-state accuracy and RMSE of the path gain against the trace of the complete home",
        "",
        " " * 22 + "".join(f"{f'{name} ({int(mask.sum())})':>22}" for name, mask in areas.items()),
    ]
    for name, (state, gain_db) in predictions.items():
        scores = (_score(truth, state, gain_db, mask.to_numpy()) for mask in areas.values())
        lines.append(f"{name:<22}" + "".join(f"{score:>22}" for score in scores))
    return "\n".join(lines) + "\n"


def _score(truth: xr.Dataset, state: xr.DataArray, gain_db: xr.DataArray, mask: Bools) -> str:
    if not mask.any():
        return "-"
    accuracy = (state == truth["link_state"]).to_numpy()[mask].mean()
    error_db = (gain_db - truth["gain_mean_db"]).to_numpy()[mask].astype(np.float64)
    return f"{100 * accuracy:.1f} %  {np.sqrt(np.mean(error_db**2)):5.1f} dB"
