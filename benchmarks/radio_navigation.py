"""What a predicted radio map is good for: a robot that must stay connected drives to a goal through unseen rooms.

In every home a transmitter, a start with a link above the threshold, and goals far from it are drawn. A robot with a
camera that sees all around drives to each goal, and plans anew after every metre: the cheapest route over cells that
are not known walls, where a metre costs one, and more by the probability that the path gain is not above the threshold:

- `map`: nothing more;
- `gp`: by a Gaussian process over the gains measured on the way, on path loss fitted to them;
- `radio`: by the coverage predicted on the map seen so far, with its uncertainty.

Printed are seconds in outage at 0.5 m/s and lengths of the ways, means over homes, and their paired differences from
`gp` with standard errors over homes. Run it with

    python benchmarks/radio_navigation.py ../shared/gibson/*/map.yaml
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr

import sionna_partial as sp
from sionna_partial.settings import SensorSettings
from sionna_partial.simulation.camera import Camera
from sionna_partial.simulation.robot import _Router
from sionna_partial.tracing.simulation import clear_of_walls

THRESHOLD_DB, FLOOR_DB, NOISE_DB = -100.0, -130.0, 2.0
SPEED_M_S, RADIUS_M, PLAN_M, LEAST_M = 0.5, 0.15, 1.0, 4.0
OUTAGE_COST, UNKNOWN_COST = 4.0, 1.5
GP_STD_DB, GP_RANGE_M, SPACING_M, LONGEST_M = 12.0, 1.5, 0.6, 80.0
SENSOR = SensorSettings(field_of_view_deg=360.0)

Floats = NDArray[np.float64]
Probability = Callable[[sp.PartialMap, Floats, Floats], Floats]
"""P(no link) (ny, nx) from the map and the positions (N, 3) and gains (N,) measured so far."""


class Home:
    """A home, a transmitter, and where a robot can be."""

    def __init__(self, home: sp.PartialMap, rng: np.random.Generator) -> None:
        self.home, self.simulation = home, sp.Simulation(home)
        distance_m = ndimage.distance_transform_edt(home.state == sp.CellState.FREE) * home.resolution_m
        regions, _ = ndimage.label(distance_m > RADIUS_M)
        self.roomy = regions == np.bincount(regions[regions > 0]).argmax()
        cells = rng.permutation(np.argwhere(self.roomy))[:400]
        self.tx_m, cells = self.at(cells[:1])[0], cells[1:]
        covered = self.gains_db(cells) > THRESHOLD_DB
        self.start = cells[covered][0]
        far = self.route(np.ones(home.shape), self.roomy, self.start).costs[tuple(cells.T)]
        self.goals = cells[np.isfinite(far) & (far * home.resolution_m > LEAST_M)]

    def at(self, cells: NDArray[np.intp]) -> Floats:
        """Positions (N, 3) of cells (N, 2) [m]."""
        return np.insert((cells[:, ::-1] + 0.5) * self.home.resolution_m + self.home.origin_m, 2, 1.5, axis=1)

    def gains_db(self, cells: NDArray[np.intp]) -> Floats:
        """Return the true path gains (N,) [dB]; 0 where no receiver can stand, as at the transmitter."""
        links = self.simulation.links(self.tx_m, self.at(cells), polarisations=1, invalid="nan", progress=False)
        gain_db = links.gain_db
        return np.where(np.isnan(gain_db), 0.0, gain_db)

    @staticmethod
    def route(cost: Floats, allowed: NDArray[np.bool_], at: NDArray[np.intp]) -> _Router:
        """Routes over cells that are allowed, and the one where the robot is."""
        allowed = allowed.copy()
        allowed[tuple(at)] = True
        return _Router(np.where(allowed, cost, 0.0), tuple(at))


def drive(home: Home, goal: NDArray[np.intp], probability: Probability, seed: int) -> tuple[float, float] | None:
    """Return the seconds in outage and the length [m] of a drive; None where the goal is not reached."""
    partial, cell_m = home.home, home.home.resolution_m
    camera = Camera(partial.state, cell_m, SENSOR, np.random.default_rng(seed))
    at, way = home.start, [home.start]
    measured_m, measured_db = np.zeros((0, 3)), np.zeros(0)
    rng, seconds, length_m = np.random.default_rng(seed), 0.0, 0.0
    while not np.array_equal(at, goal) and length_m < LONGEST_M:
        for row, column in way[:: max(1, round(0.25 / cell_m))]:
            camera.look(column + 0.5, row + 0.5, 0.0, (0.0, 0.0), np.array([[row, column]]))
        seen = sp.PartialMap(camera.seen.copy(), cell_m, partial.origin_m, partial.wall_height_m)
        clear_m = ndimage.distance_transform_edt(seen.state != sp.CellState.WALL) * cell_m
        cost = np.where(seen.state == sp.CellState.UNKNOWN, UNKNOWN_COST, 1.0)
        cost = cost + OUTAGE_COST * probability(seen, measured_m, measured_db)
        allowed = (clear_m > RADIUS_M) & (home.roomy | (seen.state == sp.CellState.UNKNOWN))
        routes = Home.route(cost, allowed, at)
        if not np.isfinite(routes.costs[tuple(goal)]):
            return None
        route = routes.path_to(goal)
        steps = np.linalg.norm(np.diff(route, axis=0), axis=1) * cell_m
        free = np.cumprod(home.roomy[tuple(route[1:].T)]).astype(bool)
        count = int((free & (np.cumsum(steps) <= PLAN_M)).sum())
        if count == 0:  # a wall that the camera has not told from the unknown
            camera.look(at[1] + 0.5, at[0] + 0.5, 0.0, (0.0, 0.0), at[None])
            camera.seen[tuple(route[1])] = sp.CellState.WALL
            length_m += cell_m
            way = [at]
            continue
        way = [*route[1 : count + 1]]
        gain_db = home.gains_db(np.array(way))
        seconds += float(steps[:count][gain_db <= THRESHOLD_DB].sum()) / SPEED_M_S
        length_m, at = length_m + float(steps[:count].sum()), way[-1]
        heard_db = np.maximum(gain_db[::5] + NOISE_DB * rng.standard_normal(len(gain_db[::5])), FLOOR_DB)
        measured_m = np.concatenate([measured_m, home.at(np.array(way))[::5]])
        measured_db = np.concatenate([measured_db, heard_db])
    return (seconds, length_m) if np.array_equal(at, goal) else None


def by_map(partial: sp.PartialMap, measured_m: Floats, measured_db: Floats) -> Floats:
    """Nothing is known of the radio."""
    return np.zeros(partial.shape)


def by_process(home: Home) -> Probability:
    """Return that of a Gaussian process over the measurements, on path loss with the logarithm of the distance."""

    def probability(partial: sp.PartialMap, measured_m: Floats, measured_db: Floats) -> Floats:
        if len(measured_db) < 3:
            return np.zeros(partial.shape)
        rows, columns = np.meshgrid(*(np.arange(0, size, 4) for size in partial.shape), indexing="ij")
        grid_m = home.at(np.column_stack([rows.ravel(), columns.ravel()]))
        apart_m = [np.linalg.norm(each[:, None] - measured_m, axis=2) for each in (measured_m, grid_m)]
        logs = [np.log10(np.maximum(np.linalg.norm(each - home.tx_m, axis=1), 0.3)) for each in (measured_m, grid_m)]
        slope = min(-20.0, float(np.polyfit(logs[0], measured_db, 1)[0]))
        level_db = float(np.mean(measured_db - slope * logs[0]))
        own, other = (GP_STD_DB**2 * np.exp(-each / GP_RANGE_M) for each in apart_m)
        solved = np.linalg.solve(own + NOISE_DB**2 * np.eye(len(own)), other.T)
        mean_db = level_db + slope * logs[1] + (measured_db - level_db - slope * logs[0]) @ solved
        std_db = np.sqrt(np.maximum(GP_STD_DB**2 - np.sum(other * solved.T, axis=1), 1.0))
        coarse = ndtr((THRESHOLD_DB - mean_db) / std_db).reshape(rows.shape)
        return np.repeat(np.repeat(coarse, 4, axis=0), 4, axis=1)[: partial.shape[0], : partial.shape[1]]

    return probability


def by_radio_map(home: Home) -> Probability:
    """Return that of the predicted coverage of the map seen so far."""
    models: list[sp.LinkModel] = []

    def probability(partial: sp.PartialMap, measured_m: Floats, measured_db: Floats) -> Floats:
        if not clear_of_walls(partial, home.tx_m[None])[0]:
            return np.zeros(partial.shape)
        if not models:
            models.append(sp.LinkModel(partial))
        models[0].update(partial)
        coverage = models[0].coverage(home.tx_m, spacing_m=SPACING_M, progress=False)
        above = coverage.radio.probability_above(THRESHOLD_DB).to_numpy()
        nearest = ndimage.distance_transform_edt(np.isnan(above), return_distances=False, return_indices=True)
        y, x = (((np.arange(size) + 0.5) * partial.resolution_m / SPACING_M).astype(int) for size in partial.shape)
        filled = 1.0 - above[tuple(nearest)]
        return filled[np.ix_(np.minimum(y, len(filled) - 1), np.minimum(x, filled.shape[1] - 1))]

    return probability


def main() -> None:
    """Drive in all homes, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="+", type=Path, help="complete maps")
    parser.add_argument("--goals", type=int, default=2, help="in each home")
    arguments = parser.parse_args()
    found: dict[str, list[Floats]] = {"map": [], "gp": [], "radio": []}
    for seed, path in enumerate(arguments.maps):
        home = Home(sp.load_map(path), np.random.default_rng(seed))
        methods = dict(zip(found, (by_map, by_process(home), by_radio_map(home)), strict=True))
        goals = home.goals[: arguments.goals]
        drives = [{name: drive(home, goal, each, seed) for name, each in methods.items()} for goal in goals]
        reached = [each for each in drives if all(each.values())]
        for name, values in found.items():
            if reached:
                values.append(np.mean([each[name] for each in reached], axis=0))
        text = ", ".join(f"{name} {values[-1].round(1)}" for name, values in found.items() if reached)
        print(f"{path.parent.name}: {len(reached)} of {len(drives)} goals reached by all: {text}", flush=True)
    print("\n| planned on | outage [s] | way [m] | outage - gp [s] | way - gp [m] |\n|---|---|---|---|---|")
    for name, values in found.items():
        mean, apart = np.mean(values, axis=0), np.subtract(values, found["gp"])
        error = apart.std(axis=0, ddof=1) / np.sqrt(len(apart))
        paired = " | ".join(f"{each:+.1f} ± {std:.1f}" for each, std in zip(apart.mean(axis=0), error, strict=True))
        print(f"| {name} | {mean[0]:.1f} | {mean[1]:.1f} | {paired} |")


if __name__ == "__main__":
    main()
