"""Placement of a transmitter: positions are compared by visibility, traced and predicted, and the best are refined."""

import json
import math
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from sionna_partial.arrays import Bools, Floats, read_only
from sionna_partial.checks import Progress
from sionna_partial.constants import DEFAULT_HEIGHT_M, GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S
from sionna_partial.display import Pictured
from sionna_partial.files import atomic_write
from sionna_partial.link_model import LinkModel, link_model_of
from sionna_partial.maps.partial_map import PartialMap, require_height
from sionna_partial.placement.area import PlacementArea, placement_area
from sionna_partial.prediction.predictor import LinkPrediction, Predictor
from sionna_partial.progress import reporting
from sionna_partial.settings import Objective, PlacementSettings, SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.simulation import Simulation, nearest_m

RECEIVERS = 120
"""Largest number of receivers during the search; the final positions are compared at all receivers."""

STARTS, REFINED = (6, 16, 3.5), (1, 4, 25.0)
"""Number of positions that are traced first, and of those that are refined: fewest, most, and area for each [m^2].
Fewer than 6 starts would miss the best room of a small home."""

STEPS_M = (0.6, 0.25)
"""Distances at which the refinement tries neighbours, in turn [m]."""

OUTAGE = {column.name: GAIN_FLOOR_DB if column.name.endswith("mean_db") else 0.0 for column in fields(LinkPrediction)}
OUTAGE["p_outage"] = 1.0
"""Prediction of an outage that is certain."""

_DIRECTIONS = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])

SIMILARITY_PENALTY = 0.6
"""Loss of score of a start that sees the same receivers as one that is chosen already."""

FULL_FRACTION, LAST_FRACTION = 0.05, 0.15
"""Of the receivers, sorted by gain, the worst 5 % count in full, and linearly less up to 15 %."""


@read_only
@dataclass(frozen=True, eq=False)
class TransmitterPlacement(Pictured, plot="plots.placement_plot:plot_placement"):
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

    Examples
    --------
    >>> import sionna_partial as sp
    >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
    >>> partial = sp.map_from_array(cells, resolution_m=1.0)
    >>> found = sp.place_transmitter(partial)
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
    """Find the transmitter position that covers a partly known building best, as predicted from what is known.

    Positions all over the free cells are compared by visibility, without tracing. The best of them that see different
    receivers are traced and predicted, as `predict_map` does. Around the best of these, neighbours at 0.6 and 0.25 m
    are tried; what they find is compared at all receivers. Larger maps get more of all that.

    A transmitter stands in a free cell, at least 10 cm from known walls. Receivers are 0.5 m apart wherever
    `predict_map` has some; one in a free cell has weight 1, one in an unknown cell its probability of being indoors,
    which does not depend on the transmitter.

    Parameters
    ----------
    scene : PartialMap, path, Simulation or LinkModel
        The map, or whatever `load_map` reads.
    objective : {"coverage", "percentile"}
        Quantity that is maximised: the mean probability that the path gain exceeds the threshold, or the mean predicted
        gain of the worst tenth of the receivers.
    threshold_db : float
        Path gain above which a receiver is covered [dB].
    tx_height_m, rx_height_m : float
        Heights of transmitter and receivers [m].
    seed : int
        Of the positions that are compared.
    predictor : None, "map", "paper", path or Predictor
        As for `predict_map`.
    scene_settings : SceneSettings, optional
    trace_settings : TraceSettings, optional
    progress : bool or callable, optional
        As in `predict_map`.

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
        start_scores = search.scores(starts_m, some)
        routes = _refined(search, some, starts_m, start_scores, report)
        report(0.9, "evaluating the best positions")
        values = [search.values(trajectory_m[-1:], area)[0] for trajectory_m, _ in routes]
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
    """Settings, link model and area of a search for transmitters."""

    settings: PlacementSettings
    model: LinkModel
    area: PlacementArea

    @classmethod
    def on(
        cls,
        model: LinkModel,
        settings: PlacementSettings,
    ) -> "Search":
        """Check the settings against a map."""
        for name in ("tx_height_m", "rx_height_m"):
            require_height(model.partial, name, getattr(settings, name))
        heights_m = float(settings.tx_height_m), float(settings.rx_height_m)
        frequency_hz = model.simulation.trace_settings.frequency_hz
        area = placement_area(model.partial, *heights_m, model.predictor_of_map, frequency_hz)
        return cls(settings, model, area)

    def starts(self, area: PlacementArea, count: int) -> Floats:
        """Choose positions (S, 3) [m] by visibility; what others see as well counts less."""
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

    def links(self, positions_m: Floats, area: PlacementArea) -> tuple[LinkPrediction, Bools]:
        """Predict the links (P, N) from positions (P, 3) [m], and which are long enough; a short one is an outage."""
        frequency_hz = self.model.simulation.trace_settings.frequency_hz
        far = np.linalg.norm(area.rx_m - positions_m[:, None], axis=2) >= nearest_m(frequency_hz)
        ends_m = [(tx_m, area.rx_m[kept]) for tx_m, kept in zip(positions_m, far, strict=True)]
        _, found, _ = self.model.predict_each(ends_m)
        columns = {}
        for column in fields(LinkPrediction):
            columns[column.name] = np.full(far.shape, OUTAGE[column.name])
            columns[column.name][far] = getattr(found, column.name)
        return LinkPrediction(**columns), far

    def values(self, positions_m: Floats, area: PlacementArea) -> Floats:
        """Values (P, N) of receivers for positions (P, 3) [m]; one at the transmitter is covered, with 0 dB."""
        links, far = self.links(positions_m, area)
        return np.where(far, link_values(links, self.settings), 1.0 if self.settings.objective == "coverage" else 0.0)

    def scores(self, positions_m: Floats, area: PlacementArea) -> Floats:
        """Return the scores (P,) of positions (P, 3) [m]; P may be 0."""
        if not len(positions_m):
            return np.zeros(0)
        values = self.values(positions_m, area)
        return np.array([placement_score(each, area.weight, self.settings) for each in values])


def link_values(prediction: LinkPrediction, settings: PlacementSettings) -> Floats:
    """Return what the objective counts of each link (N,): P(gain > threshold), or the mean gain [dB]."""
    if settings.objective == "percentile":
        return prediction.gain_mean_db
    return prediction.probability_above(settings.threshold_db)


def placement_score(values: Floats, weight: Floats, settings: PlacementSettings) -> float:
    """Return the objective of receivers' values (N,) and weights (N,), rounded: threads change the last bits."""
    fraction = weight / weight.sum()
    if settings.objective == "coverage":
        return round(float(values @ fraction), 5)
    order = np.argsort(values, kind="stable")
    ends = np.concatenate([[0.0], np.cumsum(fraction[order])])
    return round(float(values[order] @ np.diff(_counted(ends)) / _counted(np.ones(1))[0]), 3)


def _counted(fraction: Floats) -> Floats:
    """Integral of what the worst receivers count, from 0 to a fraction of them."""
    falling = np.clip(fraction, FULL_FRACTION, LAST_FRACTION) - FULL_FRACTION
    width = LAST_FRACTION - FULL_FRACTION
    return np.minimum(fraction, FULL_FRACTION) + falling - falling**2 / (2.0 * width)


def _refined(
    search: Search, area: PlacementArea, starts_m: Floats, start_scores: Floats, report: Progress
) -> list[tuple[Floats, Floats]]:
    """Move the best starts to better neighbours: positions (K, 3) [m] and scores (K,) of each route."""
    best = np.argsort(-start_scores, kind="stable")[: _per_area(area, *REFINED)]
    routes = [([starts_m[index]], [start_scores[index]]) for index in best]
    for number, step_m in enumerate(STEPS_M):
        report(0.4 + 0.5 * number / len(STEPS_M), f"refining, step {number + 1} of {len(STEPS_M)}")
        neighbours_m = np.array([route_m[-1] for route_m, _ in routes])[:, None] + step_m * _DIRECTIONS
        neighbours_m[..., :2] = np.round(neighbours_m[..., :2], 3)
        stands = area.stands(neighbours_m)
        scores = np.full(stands.shape, -math.inf)
        scores[stands] = search.scores(neighbours_m[stands], area)
        for (route_m, route_scores), around_m, around_scores in zip(routes, neighbours_m, scores, strict=True):
            if around_scores.max() > route_scores[-1]:
                route_m.append(around_m[around_scores.argmax()])
                route_scores.append(around_scores.max())
    return [(np.array(route_m), np.array(route_scores)) for route_m, route_scores in routes]


def _per_area(area: PlacementArea, fewest: int, most: int, each_m2: float) -> int:
    return min(max(round(area.size_m2 / each_m2), fewest), most)
