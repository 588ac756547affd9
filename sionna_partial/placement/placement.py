"""Where to put a transmitter: gradient ascent with restarts over the free cells of a partial map."""

import math
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.checkpoint import Checkpoint, run_fingerprint, write_json
from sionna_partial.constants import DEFAULT_HEIGHT_M, SPEED_OF_LIGHT_M_S
from sionna_partial.differentiable.scene import DifferentiableScene
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.placement.area import PlacementArea, placement_area
from sionna_partial.placement.climb import Climb, climb_on, smoothed_slope
from sionna_partial.placement.objective import PlacementObjective
from sionna_partial.placement.state import PlacementState
from sionna_partial.placement.views import PlacementViews
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import Objective, SceneSettings, TraceSettings, is_whole, require, require_number
from sionna_partial.tracing.trace import Progress

RECEIVERS = 120
"""Largest number of receivers that the search looks at; the places that it ends at are judged by all of them."""

SOFTNESS_DB = 6.0
"""Spread of the gain that the search adds where the map is complete and the gain certain [dB]."""

APART_M = 1.1
"""Least distance between places that are looked at, or climbed from [m]."""

ALIKE = 0.6
"""What a place loses that sees the same as one that is looked at already: much, so that those looked at differ."""

STARTS, CLIMBS, STEPS = (6, 16), (1, 4), (1, 4)
"""Between how many places a search looks at before it climbs, climbs, and steps of a climb.

Fewer than 6 places would miss the best room of a small home, though 6 take more than a tenth of its exhaustive search.
"""

_CELL_M2 = 0.25
"""Area of a place of an exhaustive search [m^2]."""

_SHARE, _LOOKS_OF_STEP = 0.085, 6.0
"""Share of an exhaustive search that a search may take, and how many looks a step takes."""

_LOOK_OF_ALL, _RECEIVERS_OF_LOOK = 0.7, 400.0
"""A look at n receivers takes 0.7 + n / 400 times as long as one at `RECEIVERS`."""


@dataclass(frozen=True, eq=False)
class TransmitterPlacement:
    """Where a transmitter should be, and how that was found.

    Parameters
    ----------
    position_m : (3,) float64 array
        The best place that was found [m].
    score : float
        The objective there, at all receivers: the mean predicted coverage in [0, 1], or the gain of the worst tenth
        [dB].
    trajectory_m : (K, 3) float64 array
        The way of the climb that led there [m].
    scores : (K,) float64 array
        The objective along it, as the search saw it: at some of the receivers, softened where the map is complete.
    climbs : tuple of Climb
        All climbs, in the order of their starts, from the best to the worst.
    climb_scores : (C,) float64 array
        The objective where each ended, at all receivers.
    starts_m : (S, 3) float64 array
        Places that were looked at to choose where climbs start [m].
    start_scores : (S,) float64 array
        The objective there, as the search saw it.
    objective : PlacementObjective
    rx_m : (N, 3) float64 array
        All receivers [m].
    weight : (N,) float64 array
        How much each counts: 1 in free cells, the probability of being indoors in unknown ones.
    values : (N,) float64 array
        P(gain > threshold) of each with the transmitter at `position_m`, or its mean gain [dB].
    spacing_m : float
        Distance between receivers [m].
    partial : PartialMap
    settings : mapping
        What the search was asked for, as plain data.
    """

    position_m: NDArray[np.float64]
    score: float
    trajectory_m: NDArray[np.float64]
    scores: NDArray[np.float64]
    climbs: tuple[Climb, ...]
    climb_scores: NDArray[np.float64]
    starts_m: NDArray[np.float64]
    start_scores: NDArray[np.float64]
    objective: PlacementObjective
    rx_m: NDArray[np.float64]
    weight: NDArray[np.float64]
    values: NDArray[np.float64]
    spacing_m: float
    partial: PartialMap
    settings: dict[str, Any]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write position, score, ways and settings as JSON; equal placements give equal files.

        Parameters
        ----------
        path : path-like

        Raises
        ------
        OutputError
            If writing fails.
        """
        record = {
            "position_m": self.position_m.tolist(),
            "score": self.score,
            "objective": self.objective.name,
            "threshold_db": self.objective.threshold_db,
            "trajectory_m": self.trajectory_m.tolist(),
            "scores": self.scores.tolist(),
            "climbs": [climb.record for climb in self.climbs],
            "climb_scores": self.climb_scores.tolist(),
            "starts_m": self.starts_m.tolist(),
            "start_scores": self.start_scores.tolist(),
            "settings": self.settings,
        }
        write_json(path, record)


def place_transmitter(
    scene: PartialMap | str | Path,
    *,
    objective: Objective = "coverage",
    threshold_db: float = -100.0,
    height_m: float = DEFAULT_HEIGHT_M,
    seed: int = 0,
    rx_height_m: float = DEFAULT_HEIGHT_M,
    edge_smoothing_m: float = 0.25,
    predictor: Predictor | str | Path | None = None,
    scene_settings: SceneSettings | None = None,
    trace_settings: TraceSettings | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: Progress | None = None,
) -> TransmitterPlacement:
    """Find where a transmitter covers a partly known building best, as far as can be told from what is known.

    Places all over the free cells are compared by sight, without tracing. The best of them that see different things
    are traced, and from the best of those climbs go along the slope of the objective; where one ends, another begins.
    Each new place is traced again. What they find is judged at all receivers. Larger maps get more of all that.

    A transmitter stands in a free cell, at least 10 cm from known walls, and the way of a climb crosses neither walls
    nor unknown cells. Receivers are 0.5 m apart wherever `predict_map` has some; one in a free cell counts 1, one in an
    unknown cell the probability that it is indoors, which does not depend on the transmitter's place.

    The gradient of the differentiable pipeline (`DifferentiableScene`) does not see paths appear and vanish, such as
    the line of sight through a door. The slope of an objective that is averaged over `edge_smoothing_m` to each side
    does: it comes from traces at both ends. The places that are tried along a slope, up to 1.5 m away, are traced, too.

    Parameters
    ----------
    scene : PartialMap or path
        The map, or whatever `load_map` reads.
    objective : {"coverage", "percentile"}
        What is maximised, see `PlacementObjective`: the mean probability that the path gain exceeds `threshold_db`, or
        the mean predicted gain of the worst tenth of the receivers [dB].
    threshold_db : float
        Path gain above which a receiver is covered [dB], in (-150, 0].
    height_m : float
        Height of the transmitter [m].
    seed : int
        Of the places that are compared. The same seed gives the same bytes.
    rx_height_m : float
        Height of the receivers [m].
    edge_smoothing_m : float
        How far to each side the objective is averaged for its slope, so that edges of visibility have one [m]. With 0
        the slope is the gradient of the differentiable pipeline, which does not see them.
    predictor : None, "map", "paper", path or Predictor
        As for `predict_map`.
    scene_settings : SceneSettings, optional
    trace_settings : TraceSettings, optional
        Refraction and diffuse reflection must be off: such paths have no gradients.
    checkpoint : path-like, optional
        JSON file that is written after every step. A run that was stopped goes on from there when it is called again
        with the same arguments, and ends with the same bytes; with others the file is refused.
    progress : callable, optional
        Called as ``progress(share_done, message)``.

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
        For another objective, a threshold, height, seed or frequency out of range, or paths that only rays find.
    PredictorError
        If the predictor cannot be read.
    BackendError
        If LLVM or Sionna RT cannot be used.
    OutputError
        If the checkpoint cannot be written, or is of another search.
    """
    wanted = PlacementObjective(objective, threshold_db)
    partial = scene if isinstance(scene, PartialMap) else load_map(scene)
    require(is_whole(seed), "seed", seed, "give a whole number of 0 or more.")
    require_number("edge_smoothing_m", edge_smoothing_m, 0.0, 10.0)
    for name, value in (("height_m", height_m), ("rx_height_m", rx_height_m)):
        _require_height(name, value, partial)
    report = progress or (lambda share, message: None)
    report(0.0, "building the scene")
    differentiable = DifferentiableScene(
        partial, predictor=predictor, trace_settings=trace_settings, scene_settings=scene_settings
    )
    report(0.05, "looking over the map")
    model = None if partial.is_complete else differentiable.predictor
    area = placement_area(partial, float(height_m), float(rx_height_m), model)
    settings = {
        "objective": wanted.name,
        "threshold_db": float(wanted.threshold_db),
        "height_m": float(height_m),
        "seed": int(seed),
        "rx_height_m": float(rx_height_m),
        "edge_smoothing_m": float(edge_smoothing_m),
        "predictor": "none: the map is complete, the trace is the answer" if model is None else model.name,
        "predictor_sha256": "" if model is None else model.fingerprint,
        "scene_settings": asdict(differentiable.paths.scene_settings),
        "trace_settings": asdict(differentiable.paths.settings),
    }
    state = PlacementState(Checkpoint(checkpoint, run_fingerprint(partial, settings)))
    return _Search(differentiable, area, wanted).run(int(seed), settings, state, report)


def _require_height(name: str, height_m: float, partial: PartialMap) -> None:
    low_m, high_m = partial.height_range_m
    require_number(name, height_m, low_m, high_m, open_low=True)
    require(height_m < high_m, name, height_m, f"stay below the ceiling at {high_m:g} m.")


@dataclass(frozen=True)
class Effort:
    """How much is tried.

    An exhaustive search on a grid of 0.5 m looks at a place for every quarter of a square metre, and from each at all
    receivers. All looks of a search together shall take a tenth of that or less; a step takes about six. Areas that
    are too small for six starts and a step get them all the same.

    Parameters
    ----------
    starts : int
        Places that are looked at.
    climbs : int
        Climbs at a time, from the best of them. Where one ends, another begins at the next best.
    steps : int
        Number of steps of all together.
    """

    starts: int
    climbs: int
    steps: int

    @classmethod
    def of_area(cls, area_m2: float, receivers: int) -> "Effort":
        """Choose it for an area where a transmitter may stand [m^2], and a number of receivers."""
        judging = _LOOK_OF_ALL + receivers / _RECEIVERS_OF_LOOK
        looks = _SHARE * area_m2 / _CELL_M2 * judging - judging - 1.0
        climbs = _between(looks / 30.0, CLIMBS)
        return cls(_between(0.4 * looks, STARTS), climbs, _between(0.6 * looks / _LOOKS_OF_STEP / climbs, STEPS))


def _between(value: float, limits: tuple[int, int]) -> int:
    return min(max(round(value), limits[0]), limits[1])


@dataclass(frozen=True, eq=False)
class _Search:
    """One search: what it looks at, and what it looks for."""

    scene: DifferentiableScene
    area: PlacementArea
    objective: PlacementObjective

    def run(self, seed: int, settings: dict[str, Any], state: PlacementState, report: Progress) -> TransmitterPlacement:
        """Look, climb and judge."""
        thinned, effort = self.area.thinned(RECEIVERS), Effort.of_area(self.area.size_m2, len(self.area.rx_m))
        softness_db = SOFTNESS_DB if self.scene.partial.is_complete else 0.0
        views = PlacementViews(self.scene, thinned, replace(self.objective, softness_db=softness_db))
        reach_m = settings["edge_smoothing_m"]
        slope = smoothed_slope(self.area, views.scores, reach_m) if reach_m > 0.0 else views.slope
        report(0.1, "comparing places")
        if not len(state.starts_m):
            starts_m = self._starts(seed, thinned, effort.starts)
            state.keep(starts_m, views.scores(starts_m), [], 0)
        while state.steps < effort.steps:
            report(0.3 + 0.6 * state.steps / effort.steps, f"climbing, step {state.steps + 1} of {effort.steps}")
            climbs = climb_on(self.area, _restarted(state, effort.climbs), views.scores, slope)
            state.keep(state.starts_m, state.start_scores, climbs, state.steps + 1)
        report(0.9, "judging what was found")
        everyone = PlacementViews(self.scene, self.area, self.objective)
        found = self._judge(state, settings, views if views.sees_as(everyone) else everyone)
        report(1.0, "done")
        return found

    def _starts(self, seed: int, thinned: PlacementArea, count: int) -> NDArray[np.float64]:
        """Choose the best places (S, 3) by sight that are some way apart [m]."""
        places_m = self.area.places(seed)
        reach_m = math.inf
        if self.objective.name == "coverage":  # by Friis' formula
            loss = 10.0 ** (-self.objective.threshold_db / 20.0)
            reach_m = SPEED_OF_LIGHT_M_S / self.scene.paths.settings.frequency_hz / (4.0 * math.pi) * loss
        seen = thinned.sight(places_m, reach_m)
        scores = np.array([self.objective.score(values, thinned.weight) for values in seen])
        return places_m[_best_that_differ(scores, seen, thinned.weight / thinned.weight.sum(), count)]

    def _judge(self, state: PlacementState, settings: dict[str, Any], views: PlacementViews) -> TransmitterPlacement:
        """Compare where the climbs ended, at all receivers."""
        ends_m = np.stack([climb.trajectory_m[-1] for climb in state.climbs])
        scores = views.scores(ends_m)
        best = int(np.argmax(scores))
        return TransmitterPlacement(
            position_m=ends_m[best],
            score=float(scores[best]),
            trajectory_m=state.climbs[best].trajectory_m,
            scores=state.climbs[best].scores,
            climbs=tuple(state.climbs),
            climb_scores=scores,
            starts_m=state.starts_m,
            start_scores=state.start_scores,
            objective=self.objective,
            rx_m=self.area.rx_m,
            weight=self.area.weight,
            values=views.values(ends_m[[best]])[0],
            spacing_m=self.area.spacing_m,
            partial=self.area.partial,
            settings=settings,
        )


def _restarted(state: PlacementState, wanted: int) -> list[Climb]:
    """Return the climbs, with new ones from the next best starts in place of those that have ended."""
    starts = _best_apart(state.starts_m, state.start_scores, len(state.starts_m))
    missing = wanted - sum(not climb.ended for climb in state.climbs)
    new = starts[len(state.climbs) : len(state.climbs) + missing]
    return [*state.climbs, *(Climb(state.starts_m[[index]], state.start_scores[[index]]) for index in new)]


def _best_that_differ(
    scores: NDArray[np.float64], seen: NDArray[np.float64], share: NDArray[np.float64], count: int
) -> list[int]:
    """Return the indices of good places of which each sees something else, at most `count`, the best first.

    From the score of a place is taken off how much its view `seen` (C, N) is like one that was chosen already, in
    units of the scores' spread.
    """
    chosen = [int(np.argmax(scores))]
    alike = np.zeros(len(scores))
    while len(chosen) < min(count, len(scores)):
        alike = np.maximum(alike, 1.0 - np.abs(seen - seen[chosen[-1]]) @ share)
        left = scores - ALIKE * alike
        left[chosen] = -math.inf
        chosen.append(int(np.argmax(left)))
    return chosen


def _best_apart(places_m: NDArray[np.float64], scores: NDArray[np.float64], count: int) -> list[int]:
    """Return the indices of the best places `APART_M` from each other, at most `count`, the best first."""
    chosen: list[int] = []
    for index in np.argsort(-scores, kind="stable"):
        if all(np.linalg.norm(places_m[index] - places_m[other]) >= APART_M for other in chosen):
            chosen.append(int(index))
        if len(chosen) == count:
            break
    return chosen
