"""Placement of a transmitter by visibility, prediction and refinement."""

import json
import math
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from sionna_partial.arrays import Bools, Floats, Indices, read_only
from sionna_partial.checks import Progress, no_progress
from sionna_partial.constants import DEFAULT_HEIGHT_M, GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S, CellState, LinkState
from sionna_partial.display import Pictured, part_of, reporting
from sionna_partial.errors import PositionError
from sionna_partial.files import atomic_write
from sionna_partial.link_model import LinkModel, link_model_of
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.maps.partial_map import PartialMap, require_height
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.predictor import AnyPredictor, Predictor
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.prediction.unobserved import unobserved_lengths_m, walled_lengths_m
from sionna_partial.settings import Objective, PlacementSettings, SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.positions import clear_of_walls, nearest_m
from sionna_partial.tracing.simulation import Simulation

CLEARANCE_M, FINEST_M = 0.1, 0.05
"""Smallest distance from known walls, and largest cells that keep it [m]."""

RECEIVER_SPACING_M, MAX_RECEIVERS = 0.5, 4000
POSITION_SPACING_M, MAX_POSITIONS = 0.25, 500
"""Spacings of receivers and positions [m], and largest numbers, beyond which spacings grow."""

NEGLIGIBLE = 0.02
"""Probability of being indoors below which a receiver is omitted."""

_INDOOR_POSITIONS = 8

_UNSEEN_LENGTH_M, _WALL_LENGTH_M, _WALL_FACTOR = 4.0, 4.0, 0.8
"""Visibility is exp(-u / 4 m) with the unobserved length u, and 0.8 exp(-d / 4 m) of it at distance d behind walls.
Fitted to predicted coverage at -100 dB."""

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


@dataclass(frozen=True, eq=False)
class PlacementArea:
    """Possible positions of a transmitter, and weighted receivers.

    A receiver in a free cell has weight 1, in an unknown cell P(indoor), averaged over transmitter positions: no
    position gains by making the building seem larger.

    Parameters
    ----------
    height_m : height of the transmitter
    room : FREE where the transmitter may be, UNKNOWN elsewhere
    rx_m : (N, 3)
    weight : (N,), above 0
    spacing_m : distance between receivers
    """

    partial: PartialMap
    height_m: float
    room: PartialMap
    rx_m: Floats
    weight: Floats
    spacing_m: float

    @property
    def size_m2(self) -> float:
        """Area of transmitter positions [m^2]."""
        return float((self.room.state == CellState.FREE).sum()) * self.room.resolution_m**2

    def stands(self, positions_m: Floats) -> Bools:
        """Return whether a transmitter may be at positions (..., 3) [m]."""
        return self.room.state_at(positions_m) == CellState.FREE

    def positions(self, seed: int) -> Floats:
        """Return positions (C, 3) [m] on a randomly offset grid, or else cell centres."""
        rng = np.random.default_rng(seed)
        spacing_m = max(POSITION_SPACING_M, math.sqrt(self.size_m2 / MAX_POSITIONS))
        x0, y0, x1, y1 = self.room.bounds_m
        start = rng.uniform(0.0, spacing_m, 2)
        grid_m = np.round(grid_positions((x0 + start[0], x1), (y0 + start[1], y1), spacing_m, self.height_m), 3)
        grid_m = grid_m[self.stands(grid_m)]
        if len(grid_m):
            return grid_m
        cells = np.argwhere(self.room.state == CellState.FREE)
        chosen = cells[np.sort(rng.choice(len(cells), min(len(cells), MAX_POSITIONS), replace=False))]
        return np.column_stack([cell_centres_m(self.room, chosen), np.full(len(chosen), self.height_m)])

    def thinned(self, count: int) -> "PlacementArea":
        """Return the area with at most `count` receivers, drawn evenly by weight."""
        if len(self.rx_m) <= count:
            return self
        order = _boustrophedon(self.rx_m)
        fraction = np.cumsum(self.weight[order]) / self.weight.sum()
        picks = np.searchsorted(fraction, (np.arange(count) + 0.5) / count)
        weight = np.bincount(order[np.minimum(picks, len(order) - 1)], minlength=len(order)).astype(np.float64)
        return replace(self, rx_m=self.rx_m[weight > 0.0], weight=weight[weight > 0.0])

    def visibility(self, positions_m: Floats, range_m: float = math.inf) -> Floats:
        """Return the visibility (C, N) in [0, 1] of receivers from positions (C, 3), 0 beyond `range_m`."""
        walled, unobserved_m, distance_m = _lines(self.partial, positions_m, self.rx_m)
        seen = np.exp(-unobserved_m / _UNSEEN_LENGTH_M)
        seen *= np.where(walled, _WALL_FACTOR * np.exp(-distance_m / _WALL_LENGTH_M), distance_m <= range_m)
        return seen.reshape(len(positions_m), len(self.rx_m))


def placement_area(
    partial: PartialMap,
    height_m: float,
    rx_height_m: float,
    model: AnyPredictor | None,
    frequency_hz: float | None = None,
) -> PlacementArea:
    """Return possible transmitter positions, and receivers as in `predict_map`; a PositionError if there are none.

    `model` predicts which unknown cells are indoors; without one all are outdoors.
    """
    x0, y0, x1, y1 = partial.bounds_m
    spacing_m = max(RECEIVER_SPACING_M, math.sqrt((x1 - x0) * (y1 - y0) / MAX_RECEIVERS))
    spacing_m = min(spacing_m, x1 - x0, y1 - y0)
    rx_m = grid_positions((x0 + spacing_m / 2, x1), (y0 + spacing_m / 2, y1), spacing_m, rx_height_m)
    rx_m = rx_m[clear_of_walls(partial, rx_m)]
    area = PlacementArea(partial, height_m, _room(partial), rx_m, np.ones(len(rx_m)), spacing_m)
    weight = _weights(area, model, frequency_hz)
    kept = weight > NEGLIGIBLE
    if not kept.any():
        raise PositionError(
            f"no receiver can stand anywhere: all positions of a grid of {spacing_m:g} m are in walls or outside. Give "
            "a map with more free cells."
        )
    return replace(area, rx_m=rx_m[kept], weight=weight[kept])


def _room(partial: PartialMap) -> PartialMap:
    fine = max(1, math.ceil(partial.resolution_m / FINEST_M - 1e-9))
    fine = max(1, min(fine, int(math.sqrt(4e6 / partial.state.size))))
    state = partial.state.repeat(fine, axis=0).repeat(fine, axis=1)
    cell_m = partial.resolution_m / fine
    around = 2 * math.ceil(CLEARANCE_M / cell_m - 1e-9) + 1
    stands = (state == CellState.FREE) & ~ndimage.maximum_filter(state == CellState.WALL, size=around)
    if not stands.any():
        free = int((partial.state == CellState.FREE).sum())
        raise PositionError(
            f"a transmitter can stand nowhere: the map has {free} free cells, and none of their area is {CLEARANCE_M:g}"
            " m away from all walls. Give a map with more free cells, such as one of a longer exploration."
        )
    room = np.where(stands, CellState.FREE, CellState.UNKNOWN).astype(np.uint8)
    return PartialMap(room, cell_m, partial.origin_m, partial.wall_height_m)


def _weights(area: PlacementArea, model: AnyPredictor | None, frequency_hz: float | None) -> Floats:
    weight = (area.partial.state_at(area.rx_m) == CellState.FREE).astype(np.float64)
    if model is None or weight.all():
        return weight
    positions_m = area.positions(0)
    some_m = positions_m[np.unique(np.linspace(0, len(positions_m) - 1, _INDOOR_POSITIONS).astype(np.intp))]
    walled, unobserved_m, distance_m = _lines(area.partial, some_m, area.rx_m[weight == 0.0])
    phi = LinkFeatures(
        link_state=np.where(walled, LinkState.NLOS, LinkState.LOS).astype(np.uint8),
        unobserved_distance_m=np.minimum(unobserved_m, distance_m),
        distance_m=distance_m,
        gain_db=np.full(len(distance_m), GAIN_FLOOR_DB),
        frequency_hz=frequency_hz,
    )
    weight[weight == 0.0] = model.predict_indoor(phi).reshape(len(some_m), -1).mean(axis=0)
    return weight


def grid_positions(x_m: tuple[float, float], y_m: tuple[float, float], spacing_m: float, z_m: float) -> Floats:
    """Return positions (N, 3) on a grid at one height [m]."""
    x, y = np.meshgrid(np.arange(*x_m, spacing_m), np.arange(*y_m, spacing_m))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z_m)])


def _lines(partial: PartialMap, start_m: Floats, end_m: Floats) -> tuple[Bools, Floats, Floats]:
    """Return for lines (A B,) if they meet a wall, unobserved lengths and lengths [m]."""
    start_m, end_m = np.repeat(start_m, len(end_m), axis=0), np.tile(end_m, (len(start_m), 1))
    walled = walled_lengths_m(partial, start_m, end_m) > 1e-6
    return walled, unobserved_lengths_m(partial, start_m, end_m), np.linalg.norm(end_m - start_m, axis=1)


def _boustrophedon(points_m: Floats) -> Indices:
    """Order points (N, 3) along stripes of four rows, in alternating directions."""
    x, y = points_m[:, 0], points_m[:, 1]
    rows = np.unique(np.round(y, 6), return_inverse=True)[1]
    stripe = rows // 4
    return np.lexsort((rows, np.round(np.where(stripe % 2 == 0, x, -x), 6), stripe))


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
