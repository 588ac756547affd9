"""Partial map -> ranked poses of the robot for a better coverage map."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, overload

import numpy as np
import xarray as xr
import yaml
from numpy.typing import ArrayLike
from scipy.cluster.vq import kmeans2
from scipy.spatial.distance import cdist
from scipy.special import entr

from sionna_partial.arrays import Floats, largest_part, read_only
from sionna_partial.checks import (
    Progress,
    float_array,
    no_progress,
    require_choice,
    require_number,
    require_whole,
    settings_or_default,
    shown,
    with_height,
)
from sionna_partial.constants import GAIN_FLOOR_DB, CellState
from sionna_partial.coverage.dataset import ANTENNA, TX_COORDINATES, probability_above
from sionna_partial.coverage.job import POSITIONS, predict_map, transmitter_positions
from sionna_partial.display import Pictured, Shown, part_of, reporting
from sionna_partial.errors import MapError, PositionError
from sionna_partial.files import atomic_write
from sionna_partial.link_model import LinkModel, link_model_of
from sionna_partial.maps.grid import cell_centres_m, unknown_pockets
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.localisation import TransmitterPosterior
from sionna_partial.measurements.measurements import Measurements, measurements_of
from sionna_partial.measurements.selection import SAME_TX_M
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.prediction.unobserved import GRAZE, in_cells, line_fractions, map_line_fractions
from sionna_partial.settings import SceneSettings, SensorSettings, TraceSettings, takes_settings
from sionna_partial.tracing.positions import clear_of_walls
from sionna_partial.tracing.simulation import Simulation
from sionna_partial.worlds.camera import unknown_in_view
from sionna_partial.worlds.robot import (
    FORWARD_M,
    ROBOT_RADII_M,
    Choice,
    Frontier,
    Robot,
    find_frontiers,
    wide_frontiers,
)

GOALS = ("coverage", "state", "area")

MOST_VIEWS, MOST_TRANSMITTERS = 100, 20
"""Largest numbers of returned poses and of predicted transmitters."""

SPACING_M, MOST_RECEIVERS = 0.5, 1500
"""Spacing of predicted receivers [m], larger on large maps, and their approximate largest number."""

POSSIBLE_TRANSMITTERS = 3
"""Number of positions that represent an unknown transmitter."""

LOOK_M = 1.25
"""Driving distance that takes as long as choosing a view and turning towards it [m]."""

_HEADINGS_DEG = np.arange(0.0, 360.0, 15.0)


@read_only
@dataclass(frozen=True, eq=False)
class NextView(Shown):
    """A pose from which a robot sees unknown cells.

    Parameters
    ----------
    position_m : (2,) float64 array
        World x and y [m], in a free cell.
    heading_deg : float
        From x towards y [degree].
    path_length_m : float
        Length of the shortest safe path from the start [m].
    gain : float
        Expected information gain, summed over receivers, one per square metre [bit], mean over transmitters; for the
        goal "area" the unknown area in view [m^2].
    gain_per_m : float
        `gain` per metre driven, with 1.25 m added to the path. Views are ranked by it.
    path_m : (K, 2) float64 array
        From the start to the pose [m].
    frontier_m : (F, 2) float64 array
        Centres of the free cells of the frontier [m].

    Examples
    --------
    >>> import sionna_partial as sp
    >>> partial = sp.map_from_array([[1] * 5, *[[1, 0, 0, 0, 2]] * 3, [1] * 5], resolution_m=0.5)
    >>> sp.next_views(partial, goal="area")[0].gain > 0.0
    True
    """

    position_m: Floats
    heading_deg: float
    path_length_m: float
    gain: float
    gain_per_m: float
    path_m: Floats
    frontier_m: Floats


@read_only
@dataclass(frozen=True, eq=False)
class NextViews(Sequence[NextView], Pictured, plot="plots.exploration_plot:plot_next_views"):
    """Poses to drive to, the best first: a sequence of `NextView`.

    Parameters
    ----------
    views : tuple of NextView
        Empty if nothing unknown can be reached.
    partial : PartialMap
    start_m : (2,) float64 array
        Start of the paths [m].
    tx_m : (T, 3) float64 array
        Predicted transmitters [m]; none for the goal "area".
    uncertainty : xarray.DataArray
        Entropy of links on (tx, y, x) [bit], times P(indoor) and, for an unknown transmitter, the relative probability
        of its position.
    goal : {"coverage", "state", "area"}
    sensor : SensorSettings
    """

    views: tuple[NextView, ...]
    partial: PartialMap
    start_m: Floats
    tx_m: Floats
    uncertainty: xr.DataArray = field(repr=False)
    goal: str
    sensor: SensorSettings

    def __len__(self) -> int:
        return len(self.views)

    @overload
    def __getitem__(self, index: int) -> NextView: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[NextView]: ...
    def __getitem__(self, index: int | slice) -> NextView | Sequence[NextView]:
        return self.views[index]

    def poses(self) -> list[dict[str, dict[str, float]]]:
        """Return the poses as `geometry_msgs/Pose`, in nested dictionaries."""
        return [_pose(view) for view in self]

    def to_yaml(self) -> str:
        """Return YAML with `header` and `poses` of a geometry_msgs/PoseArray, and the expected gains.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> partial = sp.map_from_array([[1] * 5, *[[1, 0, 0, 0, 2]] * 3, [1] * 5], resolution_m=0.5)
        >>> print(sp.next_views(partial, goal="area").to_yaml().splitlines()[0])
        header: {frame_id: map}
        """
        expected = ("heading_deg", "path_length_m", "gain", "gain_per_m")
        record = {
            "header": {"frame_id": "map"},
            "poses": self.poses(),
            "goal": self.goal,
            "views": [{name: round(float(getattr(view, name)), 3) for name in expected} for view in self],
        }
        return yaml.safe_dump(record, sort_keys=False, default_flow_style=None)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write `to_yaml` to a file.

        Raises
        ------
        OutputError
            If writing fails.
        """
        with atomic_write(path, "w") as stream:
            stream.write(self.to_yaml())


@takes_settings
def next_views(
    scene: PartialMap | str | Path | Simulation | LinkModel,
    tx: ArrayLike | None = None,
    measurements: Any = None,
    goal: str = GOALS[0],
    count: int = 5,
    *,
    start: ArrayLike | None = None,
    threshold_db: float = -100.0,
    sensor: SensorSettings | None = None,
    predictor: Predictor | str | Path | None = None,
    scene_settings: SceneSettings | None = None,
    trace_settings: TraceSettings | None = None,
    progress: Progress | bool | None = None,
) -> NextViews:
    """Rank poses by the expected decrease of a coverage map's uncertainty per metre.

    Poses are in the middle of frontiers and face the largest unknown area. A view of a fraction of the unobserved part
    of a link's direct line is expected to lower its uncertainty by that fraction. Unknown cells count as free; unknown
    pockets that no robot fits into are ignored.

    Parameters
    ----------
    scene : PartialMap or path
        The map, or a file for `load_map`.
    tx : (3,), (2,), (T, 3) or (T, 2) array-like, optional
        Transmitters [m]; by default as in the measurements or located by them, and without measurements the mean over
        positions in free cells.
    measurements : Measurements, mapping, data frame or path, optional
        Measured gains, as for `predict_map`.
    goal : {"coverage", "state", "area"}
        Learn whether the path gain exceeds the threshold, the link state, or the map alone, without prediction.
    count : int
        Largest number of poses.
    start : (2,) array-like, optional
        Position of the robot [m]; by default the middle of the largest free part.
    threshold_db : float
        Path gain of a covered receiver [dB].
    sensor : SensorSettings, optional
    predictor, scene_settings, trace_settings, progress
        As for `predict_map`.

    Raises
    ------
    MapError
        If the map cannot be read, or has no free cell.
    PositionError
        For a start outside free cells, or a transmitter outside the map or in a wall.
    SettingsError
        For another goal, or a count or threshold out of range.
    MeasurementError
        If the measurements cannot be read, or none is usable.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> partial = sp.explore(sp.make_home(3), steps=(60,), seed=0)[0]
    >>> views = sp.next_views(partial, goal="area", count=3)
    >>> len(views), views[0].gain_per_m >= views[1].gain_per_m
    (3, True)
    """
    model = link_model_of(scene, predictor, trace_settings, scene_settings)
    partial = model.partial
    require_choice("goal", goal, GOALS)
    require_whole("count", count, 1, MOST_VIEWS)
    require_number("threshold_db", threshold_db, GAIN_FLOOR_DB, 0.0)
    sensor = settings_or_default("sensor", sensor, SensorSettings)
    cell = _start_cell(partial, start)
    measured = None if measurements is None else measurements_of(measurements)
    of = None if goal == "state" else threshold_db
    with reporting(progress) as report:
        predicting = part_of(report, 0.0, 0.7)
        if goal != "area" and tx is None and measured is not None and not measured.tx_known.any():
            tx_m, uncertainty = _located(model, measured, of, predicting)
        else:
            tx_m = np.zeros((0, 3)) if goal == "area" else _transmitters(partial, tx, measured)
            uncertainty = _uncertainty(model, tx_m, measured, of, predicting)
        frontiers = _frontiers(partial, cell)
        gains = _gains(partial, frontiers, tx_m, uncertainty, sensor, part_of(report, 0.7, 1.0))
        report(1.0, "done")
    views = [_view(partial, *row) for row in zip(frontiers, *gains, strict=True)]
    views.sort(key=lambda view: -view.gain_per_m)
    start_m = cell_centres_m(partial, np.array(cell)) if start is None else np.asarray(start, dtype=np.float64)
    return NextViews(tuple(views[:count]), partial, start_m, tx_m, uncertainty, goal, sensor)


def _frontiers(partial: PartialMap, cell: tuple[int, int]) -> list[Frontier]:
    none = np.zeros(partial.shape, dtype=bool)
    radius, pockets = ROBOT_RADII_M[0] / partial.resolution_m, unknown_pockets(partial.state, partial.resolution_m)
    state = np.where(pockets, CellState.WALL, partial.state).astype(np.uint8)
    frontiers = find_frontiers(state, cell, partial.resolution_m, radius, none, none)
    return wide_frontiers(frontiers, partial.resolution_m)


def coverage_choice(home: PartialMap, corner: tuple[int, int], tx: ArrayLike | None, sensor: SensorSettings) -> Choice:
    """Return a choice of frontiers for coverage; `corner` is the first cell of the robot's map."""
    if tx is not None:
        _transmitters(home, tx, None)

    def choose(robot: Robot, frontiers: list[Frontier]) -> int:
        if len(frontiers) == 1:
            return 0
        area = home.window(*corner, robot.seen.shape, CellState.UNKNOWN)
        partial = replace(area, state=robot.seen.copy(), interior_cells=None)
        tx_m = _transmitters(partial, tx, None)
        gains, _ = _gains(partial, frontiers, tx_m, _uncertainty(LinkModel(partial), tx_m, None, None), sensor)
        return int(np.argmax(np.array(gains) / [robot.steps_to(goal) + LOOK_M / FORWARD_M for goal in frontiers]))

    return choose


def _gains(
    partial: PartialMap,
    frontiers: list[Frontier],
    tx_m: Floats,
    uncertainty: xr.DataArray,
    sensor: SensorSettings,
    report: Progress = no_progress,
) -> tuple[list[float], list[float]]:
    """Return gains of frontiers, and headings with the largest unknown area in view [degree]."""
    x, y = np.meshgrid(uncertainty.x, uncertainty.y)
    rx = in_cells(partial, np.stack([x.ravel(), y.ravel()], axis=1))
    each_m2 = uncertainty.attrs["spacing_m"] ** 2 / max(1, len(tx_m))
    links = []
    for tx, bits in zip(in_cells(partial, tx_m), uncertainty.to_numpy(), strict=True):
        starts = np.broadcast_to(tx, rx.shape)
        unobserved = map_line_fractions(partial, starts, rx)[:, CellState.UNKNOWN]
        counts = (unobserved > GRAZE) & (bits.ravel() > 0.0)
        links.append((starts[counts], rx[counts], bits.ravel()[counts] / unobserved[counts] * each_m2))
    gains, headings_deg = [], []
    for number, frontier in enumerate(frontiers):
        report(number / len(frontiers), f"comparing poses, {number + 1} of {len(frontiers)}")
        in_view = unknown_in_view(partial.state, frontier.route[-1], _HEADINGS_DEG, partial.resolution_m, sensor)
        best = int(np.argmax([len(cells) for cells in in_view]))
        headings_deg.append(float(_HEADINGS_DEG[best]))
        gain = len(in_view[best]) * partial.resolution_m**2 if not links else 0.0
        view = np.full(partial.shape, np.uint8(CellState.FREE))
        view[tuple(in_view[best].T)] = CellState.UNKNOWN
        for starts, ends, bits in links:
            gain += float(line_fractions(view, starts, ends)[:, CellState.UNKNOWN] @ bits)
        gains.append(gain)
    return gains, headings_deg


def _view(partial: PartialMap, frontier: Frontier, gain: float, heading_deg: float) -> NextView:
    path_m = cell_centres_m(partial, frontier.route)
    length_m = float(np.linalg.norm(np.diff(path_m, axis=0), axis=1).sum())
    frontier_m = cell_centres_m(partial, frontier.cells)
    return NextView(path_m[-1], heading_deg, length_m, gain, gain / (length_m + LOOK_M), path_m, frontier_m)


def _start_cell(partial: PartialMap, start: ArrayLike | None) -> tuple[int, int]:
    free = partial.state == CellState.FREE
    if not free.any():
        raise MapError("the map has 0 free cells: a robot needs somewhere to stand; give a map with free cells.")
    if start is None:
        cells = np.argwhere(largest_part(free))
        near = cells - cells.mean(axis=0)
    else:
        remedy = "give x and y of the robot in metres, in a free cell."
        start_m = float_array("start", start, PositionError, remedy)
        stands = start_m.shape == (2,) and np.isfinite(start_m).all() and partial.state_at(start_m) == CellState.FREE
        if not stands:
            raise PositionError(f"start = {shown(start)} is not in a free cell: {remedy}")
        cells = np.argwhere(free)
        near = cell_centres_m(partial, cells) - start_m
    row, column = cells[np.hypot(*near.T).argmin()]
    return int(row), int(column)


def _transmitters(partial: PartialMap, tx: ArrayLike | None, measured: Measurements | None) -> Floats:
    if tx is None and measured is not None:
        measured.require_transmitters()
        tx = np.unique(measured.tx, axis=0)
    tx_m = transmitter_positions(partial, _possible_m(partial) if tx is None else tx)[1]
    if len(tx_m) > MOST_TRANSMITTERS:
        raise PositionError(f"tx has {len(tx_m)} transmitters: give at most {MOST_TRANSMITTERS}.")
    return tx_m


def _possible_m(partial: PartialMap) -> Floats:
    cells_m = with_height(cell_centres_m(partial, np.argwhere(partial.state == CellState.FREE)))
    cells_m = cells_m[clear_of_walls(partial, cells_m)]
    if not len(cells_m):
        raise PositionError("tx can be in no free cell clear of walls: give a transmitter.")
    count = min(POSSIBLE_TRANSMITTERS, len(cells_m))
    middles_m, _ = kmeans2(cells_m, cells_m[np.linspace(0, len(cells_m) - 1, count).astype(np.intp)], minit="matrix")
    return cells_m[[np.linalg.norm(cells_m - middle_m, axis=1).argmin() for middle_m in middles_m]]


def _uncertainty(
    model: LinkModel,
    tx_m: Floats,
    measured: Measurements | None,
    threshold_db: float | None,
    report: Progress = no_progress,
) -> xr.DataArray:
    spacing_m = _spacing_m(model.partial)
    if not len(tx_m):
        none = xr.DataArray(np.zeros((0, 1, 1)), {"y": [0.0], "x": [0.0]}, ("tx", "y", "x"))
        return _described(none, spacing_m)
    near = measured is not None and (cdist(measured.tx, tx_m) <= SAME_TX_M).any()
    used = measured if near or len(tx_m) == 1 else None
    coverage = predict_map(model, tx_m, spacing_m=spacing_m, measurements=used, progress=report)
    return _described(_entropy(coverage, threshold_db).drop_vars(("tx", ANTENNA, *TX_COORDINATES)), spacing_m)


def _located(
    model: LinkModel, measured: Measurements, threshold_db: float | None, report: Progress
) -> tuple[Floats, xr.DataArray]:
    """Return possible transmitter positions (T, 3) [m], and their contributions to the uncertainty."""
    spacing_m = _spacing_m(model.partial)
    coverage = predict_map(model, None, spacing_m=spacing_m, measurements=measured, progress=report)
    x_m, y_m, probability = (coverage[name].to_numpy() for name in ("tx_x", "tx_y", "p_transmitter"))
    posterior = TransmitterPosterior(x_m, y_m, float(coverage.attrs["transmitter_m"][2]), probability)
    tx_m, weights, _ = posterior.draw(POSITIONS)
    relative = xr.DataArray(weights * len(weights), dims="tx")
    return tx_m, _described(relative * _entropy(coverage, threshold_db), spacing_m)


def _entropy(coverage: xr.Dataset, threshold_db: float | None) -> xr.DataArray:
    """Return the entropy of coverage or link state, times P(indoor) [bit]."""
    if threshold_db is None:
        p = np.stack([coverage[name].to_numpy() for name in ("p_los", "p_nlos", "p_outage")])
    else:
        above = probability_above(coverage, threshold_db)
        p = np.stack([above, 1.0 - above])
    return (entr(p).sum(axis=0) / math.log(2.0) * coverage["p_indoor"]).fillna(0.0)


def _spacing_m(partial: PartialMap) -> float:
    x0, y0, x1, y1 = partial.bounds_m
    return min(max(SPACING_M, math.sqrt((x1 - x0) * (y1 - y0) / MOST_RECEIVERS)), x1 - x0, y1 - y0)


def _described(uncertainty: xr.DataArray, spacing_m: float) -> xr.DataArray:
    attributes = {"long_name": "uncertainty of the link", "units": "bit", "spacing_m": spacing_m}
    return uncertainty.rename("uncertainty").assign_attrs(attributes)


def _pose(view: NextView) -> dict[str, dict[str, float]]:
    x, y = view.position_m.round(3)
    half = math.radians(view.heading_deg) / 2.0
    return {
        "position": {"x": float(x), "y": float(y), "z": 0.0},
        "orientation": {"x": 0.0, "y": 0.0, "z": round(math.sin(half), 6), "w": round(math.cos(half), 6)},
    }
