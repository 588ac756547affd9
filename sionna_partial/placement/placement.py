"""Where to put a transmitter: positions compared by visibility, then traced and predicted, the best ones refined."""

import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from sionna_partial.constants import SPEED_OF_LIGHT_M_S
from sionna_partial.files import atomic_write, temporary_folder
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.placement.area import PlacementArea, placement_area
from sionna_partial.prediction.features import LinkFeatures, features_of_paths
from sionna_partial.prediction.predictor import LinkPrediction, Predictor
from sionna_partial.settings import (
    PlacementSettings,
    SceneSettings,
    TraceSettings,
    require,
    require_number,
    settings_or_default,
)
from sionna_partial.tracing.trace import Progress, Tracer, checked_settings, nearest_m

RECEIVERS = 120
"""Largest number of receivers during the search; the final positions are compared at all receivers."""

STEPS_M = (0.6, 0.25)
"""Steps of the refinement [m]: neighbours at these distances are tried in turn."""

FEWEST_STARTS, MOST_STARTS, AREA_PER_START_M2 = 6, 16, 3.5
"""Number of positions that are traced first, one for each 3.5 m^2. Fewer than 6 would miss the best room of a home."""

FEWEST_REFINED, MOST_REFINED, AREA_PER_REFINED_M2 = 1, 4, 25.0
"""Number of starts that are refined, one for each 25 m^2."""

SIMILARITY_PENALTY = 0.6
"""How much a start loses that sees the same receivers as one that is chosen already."""

FULL_FRACTION, LAST_FRACTION = 0.05, 0.15
"""Of the receivers, sorted by gain, the worst 5 % count in full, and linearly less up to 15 %."""

Evaluate = Callable[[NDArray[np.float64], PlacementArea], list[NDArray[np.float64]]]
"""Returns the values of the receivers of an area for each of the transmitter positions (P, 3) [m]."""


@dataclass(frozen=True, eq=False)
class TransmitterPlacement:
    """A position for a transmitter, and the search that found it.

    Parameters
    ----------
    position_m : (3,) float64 array
        The best position that was found [m].
    score : float
        The objective there, at all receivers: the mean predicted coverage in [0, 1], or the gain of the worst tenth
        [dB].
    trajectory_m : (K, 3) float64 array
        Positions of the refinement that led there, from its start [m].
    scores : (K,) float64 array
        The objective along it, at some of the receivers. It rises.
    starts_m : (S, 3) float64 array
        Positions that were traced first [m].
    start_scores : (S,) float64 array
        The objective there, at some of the receivers.
    rx_m : (N, 3) float64 array
        All receivers [m].
    weight : (N,) float64 array
        Their weights: 1 in free cells, the probability of being indoors in unknown ones.
    values : (N,) float64 array
        P(gain > threshold) of each with the transmitter at `position_m`, or its mean gain [dB].
    spacing_m : float
        Distance between receivers [m].
    partial : PartialMap
    settings : PlacementSettings
    provenance : dict
        Predictor and settings of scene and trace, as plain data.
    """

    position_m: NDArray[np.float64]
    score: float
    trajectory_m: NDArray[np.float64]
    scores: NDArray[np.float64]
    starts_m: NDArray[np.float64]
    start_scores: NDArray[np.float64]
    rx_m: NDArray[np.float64]
    weight: NDArray[np.float64]
    values: NDArray[np.float64]
    spacing_m: float
    partial: PartialMap
    settings: PlacementSettings
    provenance: dict[str, Any]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write position, score, search and settings as JSON; equal placements give equal files.

        Parameters
        ----------
        path : path-like

        Raises
        ------
        OutputError
            If writing fails.
        """
        arrays = ("position_m", "trajectory_m", "scores", "starts_m", "start_scores")
        record = {name: getattr(self, name).tolist() for name in arrays} | {
            "score": self.score,
            "settings": asdict(self.settings) | self.provenance,
        }
        with atomic_write(path, "w") as stream:
            stream.write(json.dumps(record, indent=1, sort_keys=True) + "\n")


def place_transmitter(
    scene: PartialMap | str | Path,
    *,
    predictor: Predictor | str | Path | None = None,
    scene_settings: SceneSettings | None = None,
    trace_settings: TraceSettings | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> TransmitterPlacement:
    """Find the transmitter position that covers a partly known building best, as predicted from what is known.

    Positions all over the free cells are compared by visibility, without tracing. The best of them that see different
    receivers are traced and predicted, as `predict_map` does. Around the best of these, neighbours at 0.6 and 0.25 m
    are tried; what they find is compared at all receivers. Larger maps get more of all that.

    A transmitter stands in a free cell, at least 10 cm from known walls. Receivers are 0.5 m apart wherever
    `predict_map` has some; one in a free cell has weight 1, one in an unknown cell its probability of being indoors,
    which does not depend on the transmitter.

    Parameters
    ----------
    scene : PartialMap or path
        The map, or whatever `load_map` reads.
    predictor : None, "map", "paper", path or Predictor
        As for `predict_map`.
    scene_settings : SceneSettings, optional
    trace_settings : TraceSettings, optional
    progress : callable, optional
        Called as ``progress(fraction_done, message)``.
    **options
        Fields of `PlacementSettings`: `objective`, `threshold_db`, `height_m`, `rx_height_m` and `seed`.

    Returns
    -------
    TransmitterPlacement

    Raises
    ------
    MapError
        If the map cannot be read.
    PositionError
        If a transmitter or a receiver can stand nowhere.
    SettingsError
        For another objective, or a threshold, height, seed or frequency out of range.
    PredictorError
        If the predictor cannot be read.
    BackendError
        If LLVM or Sionna RT cannot be used.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(7)
    >>> found = sp.place_transmitter(home, objective="coverage", threshold_db=-100.0)
    >>> home.state_at(found.position_m) == sp.CellState.FREE
    True
    """
    settings = PlacementSettings(**options)
    partial = scene if isinstance(scene, PartialMap) else load_map(scene)
    trace_settings = settings_or_default("trace_settings", trace_settings, TraceSettings)
    scene_settings = settings_or_default("scene_settings", scene_settings, SceneSettings)
    trace_settings, scene_settings = checked_settings(partial, trace_settings, scene_settings)
    low_m, high_m = partial.height_range_m
    for name in ("height_m", "rx_height_m"):
        height_m = getattr(settings, name)
        require_number(name, height_m, low_m, high_m, open_low=True)
        require(height_m < high_m, name, height_m, f"stay below the ceiling at {high_m:g} m.")
    report = progress or (lambda fraction, message: None)
    report(0.0, "building the scene")
    model = None
    if not partial.is_complete:
        model = predictor if isinstance(predictor, Predictor) else Predictor.load(predictor)
    area = placement_area(partial, float(settings.height_m), float(settings.rx_height_m), model)
    with temporary_folder() as folder:
        tracer = Tracer(partial, folder, trace_settings, scene_settings)
        starts_m = _starts(area, settings, trace_settings.frequency_hz)

        def evaluate(positions_m: NDArray[np.float64], seen_by: PlacementArea) -> list[NDArray[np.float64]]:
            return _values(positions_m, seen_by, tracer, model, settings)

        found = _search(area, settings, starts_m, evaluate, report)
    report(1.0, "done")
    provenance = {
        "predictor": "none: the map is complete, the trace is the answer" if model is None else model.name,
        "predictor_sha256": "" if model is None else model.fingerprint,
        "scene_settings": asdict(scene_settings),
        "trace_settings": asdict(trace_settings),
    }
    return TransmitterPlacement(
        **found,
        rx_m=area.rx_m,
        weight=area.weight,
        spacing_m=area.spacing_m,
        partial=partial,
        settings=settings,
        provenance=provenance,
    )


def link_values(prediction: LinkPrediction, settings: PlacementSettings) -> NDArray[np.float64]:
    """Return what the objective counts of each link (N,): P(gain > threshold), or the mean gain [dB]."""
    if settings.objective == "percentile":
        return prediction.gain_mean_db
    covered = np.zeros(len(prediction.p_los))
    for probability, mean_db, std_db in (
        (prediction.p_los, prediction.gain_los_mean_db, prediction.gain_los_std_db),
        (prediction.p_nlos, prediction.gain_nlos_mean_db, prediction.gain_nlos_std_db),
    ):
        above_db = mean_db - settings.threshold_db
        spread = ndtr(above_db / np.where(std_db > 0.0, std_db, 1.0))
        covered += probability * np.where(std_db > 0.0, spread, above_db > 0.0)
    return covered


def placement_score(values: NDArray[np.float64], weight: NDArray[np.float64], settings: PlacementSettings) -> float:
    """Return the objective of receivers' values (N,) and weights (N,), rounded: threads change the last bits."""
    fraction = weight / weight.sum()
    if settings.objective == "coverage":
        return round(float(values @ fraction), 5)
    order = np.argsort(values, kind="stable")
    ends = np.concatenate([[0.0], np.cumsum(fraction[order])])
    return round(float(values[order] @ np.diff(_counted(ends)) / _counted(np.ones(1))[0]), 3)


def _counted(fraction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integral of what the worst receivers count, from 0 to a fraction of them."""
    falling = np.clip(fraction, FULL_FRACTION, LAST_FRACTION) - FULL_FRACTION
    width = LAST_FRACTION - FULL_FRACTION
    return np.minimum(fraction, FULL_FRACTION) + falling - falling**2 / (2.0 * width)


def _starts(area: PlacementArea, settings: PlacementSettings, frequency_hz: float) -> NDArray[np.float64]:
    """Choose positions (S, 3) that see much, each something else, the best first [m].

    A position's score is lowered by how much it sees what one chosen before sees.
    """
    thinned, positions_m = area.thinned(RECEIVERS), area.positions(int(settings.seed))
    range_m = math.inf
    if settings.objective == "coverage":  # by Friis' formula
        loss = 10.0 ** (-settings.threshold_db / 20.0)
        range_m = SPEED_OF_LIGHT_M_S / frequency_hz / (4.0 * math.pi) * loss
    seen = thinned.visibility(positions_m, range_m)
    scores = np.array([placement_score(values, thinned.weight, settings) for values in seen])
    fraction = thinned.weight / thinned.weight.sum()
    chosen, similarity = [int(np.argmax(scores))], np.zeros(len(scores))
    count = _per_area(area, AREA_PER_START_M2, FEWEST_STARTS, MOST_STARTS)
    while len(chosen) < min(count, len(scores)):
        similarity = np.maximum(similarity, 1.0 - np.abs(seen - seen[chosen[-1]]) @ fraction)
        left = scores - SIMILARITY_PENALTY * similarity
        left[chosen] = -math.inf
        chosen.append(int(np.argmax(left)))
    return positions_m[chosen]


def _per_area(area: PlacementArea, each_m2: float, fewest: int, most: int) -> int:
    return min(max(round(area.size_m2 / each_m2), fewest), most)


def _search(
    area: PlacementArea,
    settings: PlacementSettings,
    starts_m: NDArray[np.float64],
    evaluate: Evaluate,
    report: Progress,
) -> dict[str, Any]:
    """Evaluate the starts, refine the best of them, and compare the results at all receivers."""
    thinned = area.thinned(RECEIVERS)

    def scores_of(positions_m: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([placement_score(each, thinned.weight, settings) for each in evaluate(positions_m, thinned)])

    report(0.1, "comparing positions")
    start_scores = scores_of(starts_m)
    count = _per_area(area, AREA_PER_REFINED_M2, FEWEST_REFINED, MOST_REFINED)
    best = np.argsort(-start_scores, kind="stable")[:count]
    routes = [(starts_m[[index]], start_scores[[index]]) for index in best]
    for number, step_m in enumerate(STEPS_M):
        report(0.4 + 0.5 * number / len(STEPS_M), f"refining, step {number + 1} of {len(STEPS_M)}")
        around_m = [_neighbours(area, trajectory_m[-1], step_m) for trajectory_m, _ in routes]
        around_scores = np.split(scores_of(np.vstack(around_m)), np.cumsum([len(each) for each in around_m])[:-1])
        for route, (trajectory_m, scores) in enumerate(routes):
            if around_scores[route].max(initial=-math.inf) > scores[-1]:
                to = int(np.argmax(around_scores[route]))
                trajectory_m = np.vstack([trajectory_m, around_m[route][to]])
                routes[route] = trajectory_m, np.append(scores, around_scores[route][to])
    report(0.9, "evaluating the best positions")
    values = evaluate(np.stack([trajectory_m[-1] for trajectory_m, _ in routes]), area)
    final_scores = [placement_score(each, area.weight, settings) for each in values]
    best_route = int(np.argmax(final_scores))
    trajectory_m, scores = routes[best_route]
    return {
        "position_m": trajectory_m[-1],
        "score": final_scores[best_route],
        "trajectory_m": trajectory_m,
        "scores": scores,
        "starts_m": starts_m,
        "start_scores": start_scores,
        "values": values[best_route],
    }


def _neighbours(area: PlacementArea, position_m: NDArray[np.float64], step_m: float) -> NDArray[np.float64]:
    """Positions (K, 3) at a step along the axes where a transmitter may stand [m]."""
    around_m = position_m + step_m * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    around_m[:, :2] = np.round(around_m[:, :2], 3)
    return around_m[area.stands(around_m)]


def _values(
    positions_m: NDArray[np.float64],
    area: PlacementArea,
    tracer: Tracer,
    model: Predictor | None,
    settings: PlacementSettings,
) -> list[NDArray[np.float64]]:
    """Trace and predict from each of the positions (P, 3): values (N,) of the receivers.

    A receiver at the transmitter is covered, with a gain of 0 dB.
    """
    if not len(positions_m):
        return []
    at_transmitter = 1.0 if settings.objective == "coverage" else 0.0
    limit_m = nearest_m(tracer.settings.frequency_hz)
    far = [np.linalg.norm(area.rx_m - tx_m, axis=1) >= limit_m for tx_m in positions_m]
    features = [
        features_of_paths(area.partial, tx_m, area.rx_m[kept], tracer.paths(tx_m, area.rx_m[kept], _quiet))
        for tx_m, kept in zip(positions_m, far, strict=True)
    ]
    phi = LinkFeatures.concatenate(features)
    of_links = link_values(LinkPrediction.of_trace(phi) if model is None else model.predict(phi), settings)
    values = [np.full(len(area.rx_m), at_transmitter) for _ in positions_m]
    parts = np.split(of_links, np.cumsum([kept.sum() for kept in far])[:-1])
    for each, kept, part in zip(values, far, parts, strict=True):
        each[kept] = part
    return values


def _quiet(fraction: float, message: str) -> None:
    """Report nothing."""
