"""Placement of several transmitters: joint draws, greedy choice, swaps."""

from __future__ import annotations

import itertools
import json
import math
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Bools, Floats, read_only
from sionna_partial.channels.joint import JointLatents
from sionna_partial.checks import Progress, require_number, require_whole
from sionna_partial.constants import DEFAULT_HEIGHT_M
from sionna_partial.display import Pictured, reporting
from sionna_partial.files import atomic_write
from sionna_partial.link_model import LinkModel, link_model_of
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.placement.area import PlacementArea
from sionna_partial.placement.placement import RECEIVERS, Search
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import PlacementSettings, SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.simulation import Simulation

MOST_TRANSMITTERS = 16

CANDIDATES = 24
"""Number of candidates, at least twice the number of transmitters."""

DRAWS = 100
_SWAPS = 20


@read_only
@dataclass(frozen=True, eq=False)
class NetworkPlacement(Pictured, plot="plots.result_plots:plot_network_placement"):
    """Positions of several transmitters, and the search that found them.

    Parameters
    ----------
    positions_m : (K, 3) float64 array
        Transmitters [m]; each adds most to those before it.
    score : float
        Mean of `values`, in [0, 1].
    scores : (K,) float64 array
        Scores of the first, the first two etc.; the last is `score`.
    candidates_m : (C, 3) float64 array
    rx_m : (N, 3) float64 array
        Receivers [m].
    weight : (N,) float64 array
        Weights of receivers, as in `TransmitterPlacement`.
    values : (N,) float64 array
        Probability that at least one path gain exceeds the threshold.
    spacing_m : float
        Distance between receivers [m].
    partial : PartialMap
    settings : PlacementSettings

    Examples
    --------
    >>> import sionna_partial as sp
    >>> found = sp.place_transmitters(sp.make_home(7), count=2, threshold_db=-90.0)
    >>> found.positions_m.shape, 0.0 <= found.score <= 1.0
    ((2, 3), True)
    """

    positions_m: Floats
    score: float
    scores: Floats
    candidates_m: Floats
    rx_m: Floats
    weight: Floats
    values: Floats
    spacing_m: float
    partial: PartialMap
    settings: PlacementSettings

    @property
    def added(self) -> Floats:
        """Score (K,) that each transmitter adds to those before it."""
        return np.diff(self.scores, prepend=0.0)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write positions, scores and settings as JSON; equal placements give equal files.

        Raises
        ------
        OutputError
            If writing fails.
        """
        arrays = {name: getattr(self, name).tolist() for name in ("positions_m", "scores", "candidates_m")}
        record = arrays | {"score": self.score, "settings": asdict(self.settings)}
        with atomic_write(path, "w") as stream:
            stream.write(json.dumps(record, indent=1, sort_keys=True) + "\n")


@takes_settings
def place_transmitters(
    scene: PartialMap | str | Path | Simulation | LinkModel,
    count: int = 2,
    *,
    goal: float | None = None,
    rx: ArrayLike | None = None,
    threshold_db: float = -100.0,
    tx_height_m: float = DEFAULT_HEIGHT_M,
    rx_height_m: float = DEFAULT_HEIGHT_M,
    seed: int = 0,
    predictor: Predictor | str | Path | None = None,
    scene_settings: SceneSettings | None = None,
    trace_settings: TraceSettings | None = None,
    progress: Progress | bool | None = None,
) -> NetworkPlacement:
    """Find positions of several transmitters with the best joint coverage of a partly known building.

    Candidates cover different receivers. Their links are drawn jointly (`JointLatents`), because transmitters behind
    one unseen wall are correlated. Transmitters are chosen greedily, then swapped for other candidates while that
    increases the score, the mean probability that a receiver has a gain above the threshold.

    Parameters
    ----------
    count : int
        Number of transmitters K, up to 16; with `goal` the largest.
    goal : float, optional
        Score in [0, 1] that is wanted, such as 0.95: K is the smallest number for which it is found.
    rx : (N, 3) array-like, optional
        Receivers [m] with equal weights; by default as in `place_transmitter`.
    scene, threshold_db, tx_height_m, rx_height_m, seed, predictor, scene_settings, trace_settings, progress
        As in `place_transmitter`.

    Raises
    ------
    MapError, PositionError, SettingsError, PredictorError, BackendError
        As `place_transmitter`.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> home = sp.make_home(7)
    >>> found = sp.place_transmitters(home, count=2, threshold_db=-90.0)
    >>> found.positions_m.shape, bool(found.scores[1] >= found.scores[0])
    ((2, 3), True)
    >>> few = sp.place_transmitters(home, count=6, goal=0.5, threshold_db=-90.0)  # how many access points?
    >>> len(few.added) <= 6, few.score >= 0.5
    (True, True)
    """
    require_whole("count", count, 1, MOST_TRANSMITTERS)
    if goal is not None:
        require_number("goal", goal, 0.0, 1.0)
    settings = PlacementSettings("coverage", threshold_db, tx_height_m, rx_height_m, seed)
    search = Search.on(link_model_of(scene, predictor, trace_settings, scene_settings), settings)
    area, partial = search.area, search.model.partial
    if rx is not None:
        rx_m = partial.require_positions("rx", rx).reshape(-1, 3)
        area = replace(area, rx_m=rx_m, weight=np.ones(len(rx_m)))
    some = area.thinned(2 * RECEIVERS)
    with reporting(progress) as report:
        report(0.0, "predicting candidates")
        candidates_m = _candidates(search, some, max(CANDIDATES, 2 * count))
        covered = _covered(search, some, candidates_m)
        weight = some.weight / some.weight.sum()
        chosen, scores = _greedy(covered, weight, count)
        needed = len(chosen)
        if goal is not None:
            needed = min(1 + int(np.searchsorted(scores, goal)), needed)
        report(0.8, "evaluating the best positions")
        while True:
            best = _swapped(covered, weight, chosen[:needed])
            of_best = _covered(search, area, candidates_m[best])
            order, scores = _greedy(of_best, area.weight / area.weight.sum(), needed)
            if goal is None or scores[-1] >= goal or needed == len(chosen):
                break
            needed += 1
            report(0.9, f"evaluating {needed} transmitters")
        report(1.0, "done")
    return NetworkPlacement(
        positions_m=candidates_m[best][order],
        score=scores[-1],
        scores=np.array(scores),
        candidates_m=candidates_m,
        rx_m=area.rx_m,
        weight=area.weight,
        values=of_best.any(axis=1).mean(axis=0),
        spacing_m=area.spacing_m,
        partial=partial,
        settings=settings,
    )


def _candidates(search: Search, area: PlacementArea, count: int) -> Floats:
    """Return positions (C, 3) [m]: half good alone, others far from those before."""
    chosen_m, positions_m = search.starts(area, count // 2), area.positions(search.settings.seed)
    apart_m = np.linalg.norm(positions_m[:, None] - chosen_m, axis=2).min(axis=1)
    while len(chosen_m) < count and apart_m.max() > 0.0:
        farthest_m = positions_m[apart_m.argmax()]
        chosen_m = np.vstack([chosen_m, farthest_m])
        apart_m = np.minimum(apart_m, np.linalg.norm(positions_m - farthest_m, axis=1))
    return chosen_m


def _covered(search: Search, area: PlacementArea, candidates_m: Floats) -> Bools:
    """Return whether candidates cover receivers in draws (n, C, N) of all links."""
    links, far = search.links(candidates_m, area)
    latents = JointLatents(area.partial)
    gain_db = latents.draw(links, candidates_m, area.rx_m, DRAWS, [search.settings.seed])[1]
    return (gain_db > search.settings.threshold_db) | ~far


def _score(covered: Bools, weight: Floats, chosen: list[int]) -> float:
    return float(covered[:, chosen].any(axis=1).mean(axis=0) @ weight)


def _greedy(covered: Bools, weight: Floats, count: int) -> tuple[list[int], list[float]]:
    chosen: list[int] = []
    scores = []
    for _ in range(min(count, covered.shape[1])):
        added = [
            -math.inf if number in chosen else _score(covered, weight, [*chosen, number])
            for number in range(covered.shape[1])
        ]
        chosen.append(int(np.argmax(added)))
        scores.append(max(added))
    return chosen, scores


def _swapped(covered: Bools, weight: Floats, chosen: list[int]) -> list[int]:
    best = _score(covered, weight, chosen)
    for _ in range(_SWAPS):
        others = [
            [*chosen[:index], number, *chosen[index + 1 :]]
            for index, number in itertools.product(range(len(chosen)), range(covered.shape[1]))
            if number not in chosen
        ]
        scores = [_score(covered, weight, each) for each in others]
        if not scores or max(scores) <= best + 1e-12:
            break
        best, chosen = max(scores), others[int(np.argmax(scores))]
    return chosen
