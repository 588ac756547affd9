"""Outages of a robot that must stay connected and drives to a goal through unseen rooms, with a predicted radio map.

The transmitter of a home is the one of 12 random positions whose coverage is nearest to half of the floor. Starts and
goals are random covered positions at least 4 m of driving apart between which outage matters and can be avoided: the
shortest route on the complete map is in outage for at least 1 m, the best one for at most half of it.
A robot with a camera that sees all around drives from start to goal, and plans anew after every metre: the cheapest
route over cells that are not known walls, where a metre costs one, and four more by the probability that the path gain
is not above the threshold:

- `map`: nothing more;
- `gp`: by a Gaussian process over the gains measured during the drive, on path loss fitted to them;
- `radio`: by the coverage predicted on the map seen so far, with its uncertainty;
- `best`: nothing is driven; the route on the complete map with the true gains.

Printed are seconds in outage at 0.5 m/s and lengths of the routes, means over homes, and their paired differences from
`gp` with standard errors over homes. Run it with

    python benchmarks/radio_navigation.py ../shared/gibson/*/map.yaml
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr

import sionna_partial as sp
from sionna_partial.settings import SensorSettings
from sionna_partial.worlds.camera import Camera
from sionna_partial.worlds.robot import _Router

THRESHOLD_DB, FLOOR_DB, NOISE_DB = -100.0, -130.0, 2.0
SPEED_M_S, RADIUS_M, PLAN_M, LEAST_M = 0.5, 0.15, 1.0, 4.0
OUTAGE_COST, UNKNOWN_COST = 4.0, 1.5
GP_STD_DB, GP_RANGE_M, SPACING_M, LONGEST_M = 12.0, 1.5, 0.3, 80.0
SENSOR = SensorSettings(field_of_view_deg=360.0)

POSITIONS, TRIES, EVERY, LEAST_OUTAGE_S = 12, 20, 2, 2.0

Floats, Indices = NDArray[np.float64], NDArray[np.intp]
Probability = Callable[[sp.PartialMap, Floats, Floats], Floats]
"""P(no link) (ny, nx) from the map and the positions (N, 3) and gains (N,) measured so far."""


class Drive(NamedTuple):
    """A start and a goal, and the seconds in outage and the length [m] of the best route."""

    start: Indices
    goal: Indices
    best: tuple[float, float]


class Home:
    """A home, a transmitter, where a robot can be, and the true path gains there."""

    def __init__(self, home: sp.PartialMap, rng: np.random.Generator) -> None:
        self.home, self.simulation, self.rng = home, sp.Simulation(home), rng
        distance_m = ndimage.distance_transform_edt(home.state == sp.CellState.FREE) * home.resolution_m
        regions, _ = ndimage.label(distance_m > RADIUS_M)
        self.roomy = regions == np.bincount(regions[regions > 0]).argmax()
        cells = rng.permutation(np.argwhere(self.roomy))
        sources_m = self.at(cells[:POSITIONS])
        above = [self._gains_db(each_m, cells[POSITIONS : POSITIONS + 300]) > THRESHOLD_DB for each_m in sources_m]
        self.tx_m = sources_m[int(np.abs(np.mean(above, axis=1) - 0.5).argmin())]
        self.gain_db = np.full(home.shape, np.nan)
        some = np.argwhere(self.roomy & (np.indices(home.shape) % EVERY == 0).all(axis=0))
        self.gain_db[tuple(some.T)] = self._gains_db(self.tx_m, some)
        nearest = ndimage.distance_transform_edt(np.isnan(self.gain_db), return_distances=False, return_indices=True)
        self.gain_db = self.gain_db[tuple(nearest)]

    def at(self, cells: Indices) -> Floats:
        """Positions (N, 3) of cells (N, 2) [m]."""
        return np.insert((cells[:, ::-1] + 0.5) * self.home.resolution_m + self.home.origin_m, 2, 1.5, axis=1)

    def _gains_db(self, tx_m: Floats, cells: Indices) -> Floats:
        """Return the true path gains (N,) [dB]; 0 where no receiver can stand, as at the transmitter."""
        links = self.simulation.links(tx_m, self.at(cells), polarisations=1, invalid="nan", progress=False)
        return np.where(np.isnan(links.gain_db), 0.0, links.gain_db)

    def drives(self, count: int) -> list[Drive]:
        """Draw starts and goals between which outage matters and can be avoided, at most `count`."""
        is_outage, cell_m, found = self.gain_db <= THRESHOLD_DB, self.home.resolution_m, list[Drive]()
        covered = self.rng.permutation(np.argwhere(self.roomy & ~is_outage))
        for start, goals in zip(
            covered[:TRIES], covered[TRIES:].reshape(-1, 2)[: TRIES * 50].reshape(TRIES, -1, 2), strict=True
        ):
            shortest, best = (
                self.route(cost, self.roomy, start)
                for cost in (np.ones(is_outage.shape), 1.0 + OUTAGE_COST * is_outage)
            )
            for goal in goals[shortest.costs[tuple(goals.T)] * cell_m > LEAST_M]:
                outage_s, _ = self.cost_of(shortest.path_to(goal))
                least = self.cost_of(best.path_to(goal))
                if outage_s >= LEAST_OUTAGE_S and least[0] <= 0.5 * outage_s:
                    found.append(Drive(start, goal, least))
                    break
            if len(found) == count:
                break
        return found

    def cost_of(self, route: Indices) -> tuple[float, float]:
        """Return the seconds in outage and the length [m] of a route (N, 2)."""
        steps_m = np.linalg.norm(np.diff(route, axis=0), axis=1) * self.home.resolution_m
        return float(steps_m[self.gain_db[tuple(route[1:].T)] <= THRESHOLD_DB].sum()) / SPEED_M_S, float(steps_m.sum())

    @staticmethod
    def route(cost: Floats, allowed: NDArray[np.bool_], at: Indices) -> _Router:
        """Routes over cells that are allowed, and the one where the robot is."""
        allowed = allowed.copy()
        allowed[tuple(at)] = True
        return _Router(np.where(allowed, cost, 0.0), tuple(at))


def drive(home: Home, start: Indices, goal: Indices, probability: Probability, seed: int) -> tuple[float, float] | None:
    """Return the seconds in outage and the length [m] of a drive; None where the goal is not reached."""
    partial, cell_m = home.home, home.home.resolution_m
    camera = Camera(partial.state, cell_m, SENSOR, np.random.default_rng(seed))
    at, leg = start, start[None]
    measured_m, measured_db = np.zeros((0, 3)), np.zeros(0)
    rng, seconds, length_m = np.random.default_rng(seed), 0.0, 0.0
    while not np.array_equal(at, goal) and length_m < LONGEST_M:
        for row, column in leg[:: max(1, round(0.25 / cell_m))]:
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
        steps_m = np.linalg.norm(np.diff(route, axis=0), axis=1) * cell_m
        free = np.cumprod(home.roomy[tuple(route[1:].T)]).astype(bool)
        count = int((free & (np.cumsum(steps_m) <= PLAN_M)).sum())
        if count == 0:  # a wall that the camera has not distinguished from the unknown
            camera.look(at[1] + 0.5, at[0] + 0.5, 0.0, (0.0, 0.0), at[None])
            camera.seen[tuple(route[1])] = sp.CellState.WALL
            length_m += cell_m
            leg = at[None]
            continue
        more = home.cost_of(route[: count + 1])
        seconds, length_m = seconds + more[0], length_m + more[1]
        leg, at = route[1 : count + 1], route[count]
        gain_db = home.gain_db[tuple(leg[::5].T)]
        received_db = np.maximum(gain_db + NOISE_DB * rng.standard_normal(len(gain_db)), FLOOR_DB)
        measured_m = np.concatenate([measured_m, home.at(leg[::5])])
        measured_db = np.concatenate([measured_db, received_db])
    return (seconds, length_m) if np.array_equal(at, goal) else None


def by_map(partial: sp.PartialMap, measured_m: Floats, measured_db: Floats) -> Floats:
    """Nothing is known of the radio."""
    return np.zeros(partial.shape)


def by_process(home: Home) -> Probability:
    """Return the probability by a Gaussian process over the measurements, on path loss fitted to them."""

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
    """Return the probability by the predicted coverage of the map seen so far."""
    models: list[sp.LinkModel] = []

    def probability(partial: sp.PartialMap, measured_m: Floats, measured_db: Floats) -> Floats:
        if not partial.radios_can_stand(home.tx_m[None])[0]:
            return np.zeros(partial.shape)
        if not models:
            models.append(sp.LinkModel(partial))
        models[0].update(partial)
        coverage = sp.predict_map(models[0], home.tx_m, spacing_m=SPACING_M, progress=False)
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
    parser.add_argument("--drives", type=int, default=2, help="in each home")
    arguments = parser.parse_args()
    found: dict[str, list[Floats]] = {"map": [], "gp": [], "radio": [], "best": []}
    for seed, path in enumerate(arguments.maps):
        home = Home(sp.load_map(path), np.random.default_rng(seed))
        methods = {"map": by_map, "gp": by_process(home), "radio": by_radio_map(home)}
        rows = []
        for each in home.drives(arguments.drives):
            row = {name: drive(home, each.start, each.goal, method, seed) for name, method in methods.items()}
            if all(row.values()):
                rows.append({**row, "best": each.best})
        for name, values in found.items():
            if rows:
                values.append(np.mean([row[name] for row in rows], axis=0))
        text = ", ".join(f"{name} {values[-1].round(1)}" for name, values in found.items() if rows)
        print(f"{path.parent.name}: {len(rows)} drives: {text}", flush=True)
    print(f"\n{len(found['gp'])} homes\n\n| planned on | outage [s] | length [m] | outage - gp [s] | length - gp [m] |")
    print("|---|---|---|---|---|")
    for name, values in found.items():
        mean, apart = np.mean(values, axis=0), np.subtract(values, found["gp"])
        error = apart.std(axis=0, ddof=1) / np.sqrt(len(apart))
        paired = " | ".join(f"{each:+.1f} ± {std:.1f}" for each, std in zip(apart.mean(axis=0), error, strict=True))
        print(f"| {name} | {mean[0]:.1f} | {mean[1]:.1f} | {paired} |")


if __name__ == "__main__":
    main()
