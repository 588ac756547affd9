"""Placement of a transmitter by visibility, prediction and refinement."""

import json
import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sionna_partial.arrays import Bools, Floats, read_only
from sionna_partial.checks import Progress, no_progress
from sionna_partial.constants import DEFAULT_HEIGHT_M, GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S
from sionna_partial.display import Pictured, part_of, reporting
from sionna_partial.files import atomic_write
from sionna_partial.link_model import LinkModel, link_model_of
from sionna_partial.maps.partial_map import PartialMap, require_height
from sionna_partial.placement.area import PlacementArea, placement_area
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.settings import Objective, PlacementSettings, SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.positions import nearest_m
from sionna_partial.tracing.simulation import Simulation

RECEIVERS = 120
"""Largest number of receivers during the search."""

STARTS, REFINED = (6, 16, 3.5), (1, 4, 25.0)
"""Number of traced and refined positions: fewest, most, and area for each [m^2]."""

STEPS_M = (0.6, 0.25)
"""Distances of neighbours in the refinement [m]."""

OUTAGE = {name: GAIN_FLOOR_DB if name.endswith("mean_db") else 0.0 for name in LinkPrediction.COLUMNS}

OUTAGE["p_outage"] = 1.0
"""Prediction of a certain outage."""

_DIRECTIONS = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])

SIMILARITY_PENALTY = 0.6
"""Loss of score of a start that covers the same receivers as a chosen one."""

FULL_FRACTION, LAST_FRACTION = 0.05, 0.15
"""The worst 5 % of the receivers count fully, others linearly less up to 15 %."""


@read_only
@dataclass(frozen=True, eq=False)
class TransmitterPlacement(Pictured, plot="plots.result_plots:plot_placement"):
    """A transmitter position, and the search that found it.

    Parameters
    ----------
    position_m : (3,) float64 array
        Best position [m].
    score : float
        Objective at all receivers: mean predicted coverage in [0, 1], or gain of the worst tenth [dB].
    trajectory_m : (K, 3) float64 array
        Route of the refinement that led there [m].
    scores : (K,) float64 array
        Objective along the route at some of the receivers, increasing.
    starts_m : (S, 3) float64 array
        Starts of the search [m].
    start_scores : (S,) float64 array
        Objective of the starts at some of the receivers.
    rx_m : (N, 3) float64 array
        Receivers [m].
    weight : (N,) float64 array
        1 in free cells, P(indoor) in unknown ones.
    values : (N,) float64 array
        P(gain > threshold), or mean gain [dB], of each receiver.
    spacing_m : float
        Distance between receivers [m].
    partial : PartialMap
    settings : PlacementSettings
    provenance : dict
        Predictor and settings.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> found = sp.place_transmitter(sp.make_home(7), objective="coverage", threshold_db=-100.0)
    >>> found.position_m.shape, found.values.shape == found.weight.shape
    ((3,), True)
    """

    position_m: Floats
    score: float
    trajectory_m: Floats
    scores: Floats
    starts_m: Floats
    start_scores: Floats
    rx_m: Floats
    weight: Floats
    values: Floats
    spacing_m: float
    partial: PartialMap
    settings: PlacementSettings
    provenance: dict[str, Any]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write position, score, search and settings as JSON; equal placements give equal files.

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


@takes_settings
def place_transmitter(
    scene: PartialMap | str | Path | Simulation | LinkModel,
    *,
    objective: Objective = "coverage",
    threshold_db: float = -100.0,
    tx_height_m: float = DEFAULT_HEIGHT_M,
    rx_height_m: float = DEFAULT_HEIGHT_M,
    seed: int = 0,
    predictor: Predictor | str | Path | None = None,
    scene_settings: SceneSettings | None = None,
    trace_settings: TraceSettings | None = None,
    progress: Progress | bool | None = None,
) -> TransmitterPlacement:
    """Find the transmitter position with the best predicted coverage of a partly known building.

    Positions in free cells, at least 10 cm from known walls, are compared by visibility without tracing. The best that
    cover different receivers are predicted. Around the best of these, neighbours at 0.6 and 0.25 m are tried; the
    results are compared at all receivers. Larger maps get more positions and steps.

    Receivers are as in `predict_map`, 0.5 m apart, with weights as in `TransmitterPlacement`.

    Parameters
    ----------
    scene : PartialMap, path, Simulation or LinkModel
        A map, or a file that `load_map` reads.
    objective : {"coverage", "percentile"}
        Mean P(gain > threshold), or mean predicted gain of the worst tenth of the receivers.
    threshold_db : float
        Path gain of a covered receiver [dB].
    tx_height_m, rx_height_m : float
        Heights of transmitter and receivers [m].
    seed : int
        Seed of the compared positions.
    predictor, scene_settings, trace_settings, progress
        As in `predict_map`.

    Raises
    ------
    MapError, PredictorError, BackendError
        As `predict_map`.
    PositionError
        If transmitter or receivers have no possible position.
    SettingsError
        For another objective, or a threshold, height, seed or frequency out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(7)
    >>> found = sp.place_transmitter(home, objective="coverage", threshold_db=-100.0)
    >>> bool(home.state_at(found.position_m) == sp.CellState.FREE)
    True
    """
    settings = PlacementSettings(objective, threshold_db, tx_height_m, rx_height_m, seed)
    search = Search.on(link_model_of(scene, predictor, trace_settings, scene_settings), settings)
    area, simulation, model = search.area, search.model.simulation, search.model.predictor_of_map
    some = area.thinned(RECEIVERS)
    with reporting(progress) as report:
        report(0.0, "comparing positions")
        starts_m = search.starts(some, _per_area(some, *STARTS))
        start_scores = search.scores(starts_m, some, part_of(report, 0.0, 0.4))
        routes = _refined(search, some, starts_m, start_scores, report)
        ends_m = np.array([trajectory_m[-1] for trajectory_m, _ in routes])
        values = search.values(ends_m, area, part_of(report, 0.9, 1.0))
        report(1.0, "done")
    scores = [placement_score(each, area.weight, settings) for each in values]
    best = int(np.argmax(scores))
    return TransmitterPlacement(
        position_m=routes[best][0][-1],
        score=scores[best],
        trajectory_m=routes[best][0],
        scores=routes[best][1],
        starts_m=starts_m,
        start_scores=start_scores,
        rx_m=area.rx_m,
        weight=area.weight,
        values=values[best],
        spacing_m=area.spacing_m,
        partial=area.partial,
        settings=settings,
        provenance={
            "predictor": "none: the map is complete, the trace is the answer" if model is None else model.name,
            "predictor_sha256": "" if model is None else model.fingerprint,
            **{name: asdict(settings) for name, settings in simulation.resolved._asdict().items()},
        },
    )


@dataclass(frozen=True, eq=False)
class Search:
    """Settings, link model and area of a search."""

    settings: PlacementSettings
    model: LinkModel
    area: PlacementArea

    @classmethod
    def on(cls, model: LinkModel, settings: PlacementSettings) -> "Search":
        """Check the settings against a map."""
        for name in ("tx_height_m", "rx_height_m"):
            require_height(model.partial, name, getattr(settings, name))
        heights_m = float(settings.tx_height_m), float(settings.rx_height_m)
        frequency_hz = model.simulation.trace_settings.frequency_hz
        area = placement_area(model.partial, *heights_m, model.predictor_of_map, frequency_hz)
        return cls(settings, model, area)

    def starts(self, area: PlacementArea, count: int) -> Floats:
        """Return starts (S, 3) [m] by visibility; receivers that other starts cover count less."""
        positions_m, range_m = area.positions(self.settings.seed), math.inf
        if self.settings.objective == "coverage":  # by Friis' formula
            loss = 10.0 ** (-self.settings.threshold_db / 20.0)
            range_m = SPEED_OF_LIGHT_M_S / self.model.simulation.trace_settings.frequency_hz / (4.0 * math.pi) * loss
        seen = area.visibility(positions_m, range_m)
        scores = np.array([placement_score(values, area.weight, self.settings) for values in seen])
        fraction = area.weight / area.weight.sum()
        chosen, similarity = [int(np.argmax(scores))], np.zeros(len(scores))
        while len(chosen) < min(count, len(scores)):
            similarity = np.maximum(similarity, 1.0 - np.abs(seen - seen[chosen[-1]]) @ fraction)
            left = scores - SIMILARITY_PENALTY * similarity
            left[chosen] = -math.inf
            chosen.append(int(np.argmax(left)))
        return positions_m[chosen]

    def links(
        self, positions_m: Floats, area: PlacementArea, report: Progress = no_progress
    ) -> tuple[LinkPrediction, Bools]:
        """Predict links (P, N) from positions (P, 3) [m]; return also which are long enough, not outages."""
        frequency_hz = self.model.simulation.trace_settings.frequency_hz
        far = np.linalg.norm(area.rx_m - positions_m[:, None], axis=2) >= nearest_m(frequency_hz)
        ends_m = [(tx_m, area.rx_m[kept]) for tx_m, kept in zip(positions_m, far, strict=True)]
        _, found, _ = self.model.predict_each(ends_m, report)

        def placed(links: LinkPrediction) -> LinkPrediction:
            def column(name: str) -> Floats:
                values = np.full(far.shape, OUTAGE[name])
                values[far] = getattr(links, name)
                return values

            return LinkPrediction.of_columns(column)

        return found.mapped(placed), far

    def values(self, positions_m: Floats, area: PlacementArea, report: Progress = no_progress) -> Floats:
        """Return values (P, N) for positions (P, 3) [m]; a receiver at the transmitter has 0 dB."""
        links, far = self.links(positions_m, area, report)
        return np.where(far, link_values(links, self.settings), 1.0 if self.settings.objective == "coverage" else 0.0)

    def scores(self, positions_m: Floats, area: PlacementArea, report: Progress = no_progress) -> Floats:
        """Return the scores (P,) of positions (P, 3) [m]; P may be 0."""
        if not len(positions_m):
            return np.zeros(0)
        values = self.values(positions_m, area, report)
        return np.array([placement_score(each, area.weight, self.settings) for each in values])


def link_values(prediction: LinkPrediction, settings: PlacementSettings) -> Floats:
    """Return the values (N,) of links: P(gain > threshold), or mean gain [dB]."""
    if settings.objective == "percentile":
        return prediction.gain_mean_db
    return prediction.probability_above(settings.threshold_db)


def placement_score(values: Floats, weight: Floats, settings: PlacementSettings) -> float:
    """Return the objective, rounded because threads change the last bits."""
    fraction = weight / weight.sum()
    if settings.objective == "coverage":
        return round(float(values @ fraction), 5)
    order = np.argsort(values, kind="stable")
    ends = np.concatenate([[0.0], np.cumsum(fraction[order])])
    return round(float(values[order] @ np.diff(_counted(ends)) / _counted(np.ones(1))[0]), 3)


def _counted(fraction: Floats) -> Floats:
    """Return the integral of the weights of the worst receivers."""
    falling = np.clip(fraction, FULL_FRACTION, LAST_FRACTION) - FULL_FRACTION
    width = LAST_FRACTION - FULL_FRACTION
    return np.minimum(fraction, FULL_FRACTION) + falling - falling**2 / (2.0 * width)


def _refined(
    search: Search, area: PlacementArea, starts_m: Floats, start_scores: Floats, report: Progress
) -> list[tuple[Floats, Floats]]:
    best = np.argsort(-start_scores, kind="stable")[: _per_area(area, *REFINED)]
    routes = [([starts_m[index]], [start_scores[index]]) for index in best]
    for number, step_m in enumerate(STEPS_M):
        part = part_of(report, *(0.4 + 0.5 * np.array([number, number + 1]) / len(STEPS_M)))
        neighbours_m = np.array([route_m[-1] for route_m, _ in routes])[:, None] + step_m * _DIRECTIONS
        neighbours_m[..., :2] = np.round(neighbours_m[..., :2], 3)
        stands = area.stands(neighbours_m)
        scores = np.full(stands.shape, -math.inf)
        scores[stands] = search.scores(neighbours_m[stands], area, part)
        for (route_m, route_scores), around_m, around_scores in zip(routes, neighbours_m, scores, strict=True):
            if around_scores.max() > route_scores[-1]:
                route_m.append(around_m[around_scores.argmax()])
                route_scores.append(around_scores.max())
    return [(np.array(route_m), np.array(route_scores)) for route_m, route_scores in routes]


def _per_area(area: PlacementArea, fewest: int, most: int, each_m2: float) -> int:
    return min(max(round(area.size_m2 / each_m2), fewest), most)
