"""Rules of nav2_costmap_2d (read from its sources): a layered costmap that grids resize, and a keepout filter."""

from typing import Any

import numpy as np

FREE_SPACE, INSCRIBED, LETHAL, NO_INFORMATION = 0, 253, 254, 255


def geometry(message: Any) -> tuple[Any, ...]:
    """Return size, resolution and corner of an OccupancyGrid."""
    info = message["info"]
    position = info["origin"]["position"]
    return info["height"], info["width"], info["resolution"], position["x"], position["y"]


def cells(message: Any) -> Any:
    """Return the values (ny, nx)."""
    return np.asarray(message["data"]).reshape(geometry(message)[:2])


class StaticLayer:
    """A layer that resizes the master costmap to each grid of another geometry, and forgets its own when resized."""

    def __init__(self, master: "Costmap") -> None:
        self.master, self.buffer, self.received = master, None, False
        self.match_size()

    def take(self, message: Any) -> None:
        """As `incomingMap`: the first grid at once, later ones before the next update."""
        if self.received:
            self.buffer = message
        else:
            self._process(message)
            self.received = True

    def match_size(self) -> None:
        """As `matchSize`: the costs become free space, whatever they were."""
        self.costs = np.full(self.master.costs.shape, FREE_SPACE, dtype=np.int64)

    def _process(self, message: Any) -> None:
        if geometry(message) != self.master.geometry:
            self.master.resize(geometry(message))
        value = cells(message)
        costs = np.where(value >= 100, LETHAL, value * LETHAL // 100)  # trinary_costmap: false
        self.costs = np.where(value < 0, NO_INFORMATION, costs)

    def update_bounds(self) -> None:
        """As `updateBounds`: the newest grid is processed."""
        if self.buffer is not None:
            self._process(self.buffer)
            self.buffer = None

    def update_costs(self) -> None:
        """As `updateWithMax`: use_maximum: true."""
        old, new = self.master.costs, self.costs
        raised = (new != NO_INFORMATION) & ((old == NO_INFORMATION) | (old < new))
        self.master.costs = np.where(raised & self.received, new, old)


class KeepoutFilter:
    """A filter that raises costs by its mask, cell by cell in world coordinates, and never resizes."""

    def __init__(self, master: "Costmap") -> None:
        self.master, self.mask = master, None

    def take(self, message: Any) -> None:
        """As `maskCallback`."""
        self.mask = message

    def match_size(self) -> None:
        """Filters have no costs of their own."""

    def update_bounds(self) -> None:
        """Filters enlarge the updated area at most."""

    def update_costs(self) -> None:
        """As `process`."""
        if self.mask is None:
            return
        ny, nx, resolution_m, x, y = self.master.geometry
        rows, columns, mask_m, mask_x, mask_y = geometry(self.mask)
        row = np.floor((y + (np.arange(ny) + 0.5) * resolution_m - mask_y) / mask_m).astype(int)
        column = np.floor((x + (np.arange(nx) + 0.5) * resolution_m - mask_x) / mask_m).astype(int)
        inside = ((row >= 0) & (row < rows))[:, None] & ((column >= 0) & (column < columns))
        value = cells(self.mask)[np.ix_(np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1))]
        new, old = np.rint(value * LETHAL / 100).astype(int), self.master.costs
        raised = inside & (value >= 0) & ((new > old) | (old == NO_INFORMATION))
        self.master.costs = np.where(raised, new, old)


class Costmap:
    """A LayeredCostmap: /map in a static layer, and the radio costs in another layer or filter."""

    def __init__(self, kind: type[StaticLayer] | type[KeepoutFilter]) -> None:
        self.costs, self.geometry, self.layers = np.zeros((1, 1), dtype=np.int64), (1, 1, 0.05, 0.0, 0.0), []
        self.layers = [StaticLayer(self), kind(self)]
        self.static, self.radio = self.layers

    def resize(self, new: tuple[Any, ...]) -> None:
        """As `resizeMap`: every layer matches the size."""
        self.geometry, self.costs = new, np.full(new[:2], NO_INFORMATION)
        for layer in self.layers:
            layer.match_size()

    def update(self) -> Any:
        """As `updateMap`; return the costs."""
        for layer in self.layers:
            layer.update_bounds()
        self.costs = np.full(self.geometry[:2], NO_INFORMATION)  # track_unknown_space: true
        for layer in self.layers:
            layer.update_costs()
        return self.costs
