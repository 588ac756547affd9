"""Messages to a robot: grids of costs on the cells of its map, positions of transmitters, next views."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats
from sionna_partial.constants import CellState
from sionna_partial.coverage.dataset import cost_grid
from sionna_partial.exploration.next_views import NextViews
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.localisation import likely_region


class LiveGrid(NamedTuple):
    """The coverage of one transmitter on one map.

    Parameters
    ----------
    name : str
    map_number : int
        Number of the predicted map, from 1.
    is_final : bool
        False for the coarse answer, whose costs are upper bounds.
    coverage : xarray.Dataset
        From `predict_map`.
    cost : (ny, nx) int8 array
        P(path gain <= threshold) [percent], at most `LiveSettings.max_cost`, on the cells of the newest map; -1 in
        walls and unknown cells.
    unknown_cost : (ny, nx) int8 array
        Values of the unknown cells; -1 in all others.
    header, info : dict
        Fields of the `nav_msgs/OccupancyGrid` of the newest map.
    age_s : float
        Time since the predicted map arrived [s].
    """

    name: str
    map_number: int
    is_final: bool
    coverage: xr.Dataset
    cost: NDArray[np.int8]
    unknown_cost: NDArray[np.int8]
    header: dict[str, Any]
    info: dict[str, Any]
    age_s: float

    def message(self, *, unknown: bool = False) -> dict[str, Any]:
        """Return a `nav_msgs/OccupancyGrid` of `cost` or `unknown_cost` as a dict."""
        data = self.unknown_cost if unknown else self.cost
        return {"header": self.header, "info": self.info, "data": data.ravel().tolist()}


class LiveTransmitter(NamedTuple):
    """Position of a transmitter that was located by measured powers.

    Parameters
    ----------
    name : str
    position_m : (3,) array
        Position with the smallest expected distance [m].
    x_m, y_m : (nx,) and (ny,) arrays
        Centres of cells [m].
    probability : (ny, nx) array
        Probability of each cell.
    header : dict
        Header of the newest map.
    """

    name: str
    position_m: Floats
    x_m: Floats
    y_m: Floats
    probability: Floats
    header: dict[str, Any]

    @property
    def region(self) -> Bools:
        """The smallest set of cells (ny, nx) with 90 % probability."""
        return likely_region(self.probability)

    @property
    def area_m2(self) -> float:
        """Area of the region [m2]."""
        return float(self.region.sum()) * self._step_m**2

    @property
    def _step_m(self) -> float:
        return next((float(axis_m[1] - axis_m[0]) for axis_m in (self.x_m, self.y_m) if len(axis_m) > 1), 1.0)

    def message(self) -> dict[str, Any]:
        """Return a `geometry_msgs/PoseWithCovarianceStamped` as a dict."""
        apart_m = np.stack(np.meshgrid(self.x_m, self.y_m), axis=-1) - self.position_m[:2]
        covariance = np.zeros((6, 6))
        covariance[:2, :2] = np.einsum("yx,yxi,yxj->ij", self.probability, apart_m, apart_m)
        pose = {"position": _named(*self.position_m.tolist()), "orientation": _named(0.0, 0.0, 0.0, 1.0)}
        return {"header": self.header, "pose": {"pose": pose, "covariance": covariance.ravel().tolist()}}

    def region_message(self) -> dict[str, Any]:
        """Return a `nav_msgs/OccupancyGrid` as a dict: 100 in the region, 0 around it."""
        step_m = self._step_m
        origin = (float(self.x_m[0]) - step_m / 2, float(self.y_m[0]) - step_m / 2, 0.0)
        info = _grid_info(self.probability.shape, step_m, origin, self.header["stamp"])
        return {"header": self.header, "info": info, "data": (100 * self.region).ravel().tolist()}


class LiveViews(NamedTuple):
    """Next views on one map."""

    views: NextViews
    header: dict[str, Any]

    def message(self) -> dict[str, Any]:
        """Return a `geometry_msgs/PoseArray` as a dict."""
        return {"header": self.header, "poses": self.views.poses()}


LiveAnswer: TypeAlias = LiveGrid | LiveTransmitter | LiveViews


@dataclass(frozen=True, eq=False)
class MapMessage:
    """A map as it came: percent (ny, nx), geometry, frame and stamp, its number and time, and the map."""

    percent: NDArray[np.integer[Any]]
    resolution_m: float
    origin: tuple[float, float, float]
    frame: str
    stamp: tuple[int, int]
    partial: PartialMap
    number: int
    came_s: float

    @property
    def key(self) -> tuple[object, ...]:
        """Content and geometry: repeated maps have the same."""
        return self.percent.tobytes(), self.percent.shape, self.resolution_m, self.origin

    @property
    def header(self) -> dict[str, Any]:
        """Header of a message about this map."""
        return {"stamp": dict(zip(("sec", "nanosec"), self.stamp, strict=True)), "frame_id": self.frame}

    @property
    def info(self) -> dict[str, Any]:
        """Geometry of a grid on the cells of this map."""
        return _grid_info(self.percent.shape, self.resolution_m, self.origin, self.header["stamp"])

    def costs(
        self, axes_m: tuple[Floats, Floats], spacing_m: float, p_below: Floats, max_cost: int
    ) -> tuple[NDArray[np.int8], NDArray[np.int8]]:
        """Return the costs of free and of unknown cells as `cost_grid`, -1 elsewhere."""
        x, y, yaw = self.origin
        rows, columns = ((np.arange(n) + 0.5) * self.resolution_m for n in self.percent.shape)
        x_m = x + math.cos(yaw) * columns - math.sin(yaw) * rows[:, None]
        y_m = y + math.sin(yaw) * columns + math.cos(yaw) * rows[:, None]
        points_m = np.stack([x_m, y_m], axis=-1)
        cost = cost_grid(axes_m, spacing_m, p_below, points_m, max_cost)
        state = self.partial.state_at(points_m)
        state[(self.percent < 0) | (self.percent > 100)] = CellState.UNKNOWN
        free, unknown = (np.where(state == kind, cost, np.int8(-1)) for kind in (CellState.FREE, CellState.UNKNOWN))
        return free, unknown


def _named(*values: float) -> dict[str, float]:
    return dict(zip("xyzw", values, strict=False))


def _grid_info(
    shape: tuple[int, ...], resolution_m: float, origin: tuple[float, float, float], stamp: dict[str, int]
) -> dict[str, Any]:
    x, y, yaw = origin
    pose = {"position": _named(x, y, 0.0), "orientation": _named(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))}
    sizes = {"resolution": resolution_m, "width": shape[1], "height": shape[0]}
    return {"map_load_time": stamp, **sizes, "origin": pose}
