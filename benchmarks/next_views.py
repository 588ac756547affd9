"""Where a robot that is to predict coverage should drive: an oracle, and what can be computed without it.

In every home robots with the same camera and start explore for 300 steps. They differ in which frontier they choose:
one at random (`explore`), the nearest, the one that shows the largest unknown area per action, the most uncertainty of
receivers (`entropy`), or the most uncertain lines to receivers (`lines`, as `next_views`). The oracle (`--oracle`)
tries frontiers in simulation, and takes the one whose views lower the error of the prediction most per action; the far
oracle goes on for 40 actions. Prediction and truth are compared on the same links every 25 steps. Run it with

    python benchmarks/next_views.py ../shared/gibson/*/map.yaml --oracle --out views.jsonl
    python benchmarks/next_views.py --table views.jsonl
"""

import argparse
import copy
import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from measurements import points
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.settings import SensorSettings
from sionna_partial.tracing.positions import clear_of_walls
from sionna_partial.worlds.camera import unknown_in_view
from sionna_partial.worlds.robot import Choice, Frontier, Robot

STEPS, EVERY = 300, 25
CANDIDATES = 4
HORIZON = 40
GRID_M, AROUND_M = 0.8, 3.0
DECISION_STEPS = 5.0
HEADINGS_DEG = np.arange(0.0, 360.0, 45.0)
ACCURACIES = (0.80, 0.85)
DIGITS = (0, 0, 3, 2, 3)
SENSOR = SensorSettings()


class Home:
    """A complete home, and links whose truth is known."""

    def __init__(self, home: sp.PartialMap, transmitters: int, receivers: int, rng: np.random.Generator) -> None:
        self.home = home
        self.tx_m, self.rx_m = (points(home, home, count, rng) for count in (transmitters, receivers))
        truth = sp.trace_links(home, self.tx_m, self.rx_m, invalid="nan")
        self.valid = truth.valid
        self.state, self.gain_db = truth.link_state[self.valid], truth.gain_db[self.valid]
        self.model = sp.Predictor.load()
        self.truth = np.pad(home.state, 1, constant_values=sp.CellState.UNKNOWN)

    def map_of(self, robot: Robot) -> sp.PartialMap:
        """Return what a robot has seen."""
        state = robot.seen[1:-1, 1:-1]
        return sp.PartialMap(state.copy(), self.home.resolution_m, self.home.origin_m, self.home.wall_height_m)

    def errors(self, partial: sp.PartialMap) -> tuple[float, float, float]:
        """Accuracy, RMSE [dB] and Brier score of the prediction."""
        phi = sp.link_features(partial, sp.trace_links(partial, self.tx_m, self.rx_m, invalid="nan"))
        found = self.model.predict(phi)
        state, mean = found.link_state[self.valid], found.gain_mean_db[self.valid]
        p = np.stack([found.p_outage, found.p_los, found.p_nlos], axis=-1)[self.valid]
        brier = ((p - np.eye(3)[self.state]) ** 2).sum(axis=1).mean()
        return float((state == self.state).mean()), float(np.sqrt(((mean - self.gain_db) ** 2).mean())), float(brier)


def best_view(robot: Robot, frontier: Frontier, cell_m: float) -> NDArray[np.intp]:
    """Unknown cells (N, 2) of the largest view from the end of a route, as far as walls are known."""
    return max(unknown_in_view(robot.seen, frontier.route[-1], HEADINGS_DEG, cell_m, SENSOR), key=len)


def rate(robot: Robot, values: NDArray[np.float64], frontiers: list[Frontier]) -> NDArray[np.float64]:
    """Values per action."""
    return values / (np.array([robot.steps_to(each) for each in frontiers]) + DECISION_STEPS)


def nearest(robot: Robot, frontiers: list[Frontier]) -> int:
    """Return the frontier that takes the fewest actions."""
    return int(np.argmin([robot.steps_to(each) for each in frontiers]))


def areas(home: Home, robot: Robot, frontiers: list[Frontier]) -> NDArray[np.float64]:
    """Unknown area that each frontier shows, per action."""
    shown = [len(best_view(robot, each, home.home.resolution_m)) for each in frontiers]
    return rate(robot, np.array(shown, float), frontiers)


def policies(home: Home, *, oracle: bool) -> dict[str, Choice | None]:
    """Ways to choose a frontier."""

    def area(robot: Robot, frontiers: list[Frontier]) -> int:
        return int(np.argmax(areas(home, robot, frontiers)))

    def uncertain(lines: bool) -> Choice:
        def choose(robot: Robot, frontiers: list[Frontier]) -> int:
            if len(frontiers) == 1:
                return 0
            return int(np.argmax(rate(robot, uncertainty_shown(home, robot, frontiers, lines), frontiers)))

        return choose

    chosen: dict[str, Choice | None] = {"random": None, "nearest": nearest, "area": area}
    chosen |= {"entropy": uncertain(False), "lines": uncertain(True)}
    if oracle:
        chosen |= {"oracle": oracle_of(home, 0), "far oracle": oracle_of(home, HORIZON)}
    return chosen


def uncertainty_shown(home: Home, robot: Robot, frontiers: list[Frontier], lines: bool) -> NDArray[np.float64]:
    """Entropy of the link states of receivers that each frontier shows, or of the fraction of their lines shown."""
    partial = home.map_of(robot)
    rows, columns = (np.flatnonzero((partial.state != sp.CellState.UNKNOWN).any(axis=axis)) for axis in (1, 0))
    cell_m, (x0, y0) = partial.resolution_m, partial.origin_m
    bounds = np.array(partial.bounds_m)
    low = np.maximum(bounds[:2] + 0.1, [x0 + columns[0] * cell_m - AROUND_M, y0 + rows[0] * cell_m - AROUND_M])
    high = np.minimum(bounds[2:], [x0 + columns[-1] * cell_m + AROUND_M, y0 + rows[-1] * cell_m + AROUND_M])
    x, y = np.meshgrid(np.arange(low[0], high[0], GRID_M), np.arange(low[1], high[1], GRID_M))
    rx_m = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.5)])
    rx_m = rx_m[clear_of_walls(partial, rx_m)]
    phi = sp.link_features(partial, sp.trace_links(partial, home.tx_m, rx_m, invalid="nan"))
    found = home.model.predict(phi)
    p = np.stack([found.p_outage, found.p_los, found.p_nlos])
    free = partial.state_at(rx_m) == sp.CellState.FREE
    weight = np.where(free, 1.0, home.model.predict_indoor(phi))
    entropy = np.nan_to_num(-(p * np.log(np.maximum(p, 1e-12))).sum(axis=0) * weight)
    values = []
    for frontier in frontiers:
        shown = np.zeros(robot.seen.shape, dtype=bool)
        shown[tuple(best_view(robot, frontier, cell_m).T)] = True
        shown = shown[1:-1, 1:-1]
        if not lines:
            at = np.floor((rx_m[:, :2] - partial.origin_m) / cell_m).astype(int)
            values.append((entropy * shown[at[:, 1], at[:, 0]]).sum())
            continue
        only = sp.PartialMap(np.where(shown, 2, 0).astype(np.uint8), cell_m, partial.origin_m, partial.wall_height_m)
        gained = 0.0
        for tx_m, of_tx, unobserved_m in zip(home.tx_m, entropy, phi.unobserved_distance_m, strict=True):
            revealed = np.minimum(unobserved_lengths_m(only, np.broadcast_to(tx_m, rx_m.shape), rx_m), unobserved_m)
            gained += (of_tx * revealed / np.maximum(unobserved_m, 1e-3)).sum()
        values.append(gained)
    return np.array(values)


class _ChoosesAgain(Exception):
    pass


def oracle_of(home: Home, horizon: int) -> Choice:
    """Choose the frontier whose views, on the way and there, lower the error most per action.

    With a horizon, the frontier after which, and then the largest areas, the error is lowest after so many actions.
    """

    def again(robot: Robot, frontiers: list[Frontier]) -> int:
        raise _ChoosesAgain

    def largest(robot: Robot, frontiers: list[Frontier]) -> int:
        return int(np.argmax(areas(home, robot, frontiers)))

    def loss(robot: Robot) -> float:
        _, rmse_db, brier = home.errors(home.map_of(robot))
        return brier + (rmse_db / 20.0) ** 2

    def choose(robot: Robot, frontiers: list[Frontier]) -> int:
        if len(frontiers) == 1:
            return 0
        area = areas(home, robot, frontiers)
        tried = list(dict.fromkeys([nearest(robot, frontiers), *np.argsort(-area)]))[:CANDIDATES]
        before, scores = 0.0 if horizon else loss(robot), []
        for index in tried:
            twin = copy.deepcopy(robot)
            twin._choose, twin._route, twin._route_steps = largest if horizon else again, frontiers[index].route, 0
            steps = 0
            while steps < (horizon or STEPS):
                steps += 1
                try:
                    twin.act()
                except _ChoosesAgain:
                    break
            scores.append((before - loss(twin)) / (1.0 if horizon else steps + DECISION_STEPS) + 1e-6 * area[index])
        return int(tried[int(np.argmax(scores))])

    return choose


def curve(home: Home, seed: int, choose: Choice | None) -> list[tuple[float, float, float]]:
    """Observed fraction, accuracy and RMSE [dB] after every `EVERY` steps."""
    robot = Robot(home.truth, home.home.resolution_m, seed, SENSOR, choose)
    values: list[tuple[float, float, float]] = []
    free = (home.truth == sp.CellState.FREE).sum()
    for step in range(STEPS + 1):
        if step:
            robot.act()
        if step % EVERY == 0:
            if values and robot.is_finished and values[-1][0] == (robot.seen == 0).sum() / free:
                values.append(values[-1])
                continue
            accuracy, rmse_db, _ = home.errors(home.map_of(robot))
            values.append(((robot.seen == sp.CellState.FREE).sum() / free, accuracy, rmse_db))
    return values


def main() -> None:
    """Explore all homes, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="*", type=Path, help="complete maps")
    parser.add_argument("--oracle", action="store_true", help="with the oracle, which takes most of the time")
    parser.add_argument("--transmitters", type=int, default=3)
    parser.add_argument("--receivers", type=int, default=120)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first home's links and robot")
    parser.add_argument("--out", type=Path, help="file that a line is added to for each home")
    parser.add_argument("--table", type=Path, nargs="+", help="print the table of such files only")
    arguments = parser.parse_args()
    records = [json.loads(line) for path in arguments.table or () for line in path.read_text().splitlines()]
    for seed, path in enumerate(arguments.maps, start=arguments.seed):
        rng = np.random.default_rng(seed)
        home = Home(sp.load_map(path), arguments.transmitters, arguments.receivers, rng)
        curves = {name: curve(home, seed, choose) for name, choose in policies(home, oracle=arguments.oracle).items()}
        records.append({"home": path.parent.name, "seed": seed, "curves": curves})
        print(path.parent.name, "done", flush=True)
        if arguments.out:
            with arguments.out.open("a") as stream:
                stream.write(json.dumps(records[-1]) + "\n")
    print("\n".join(table(records)))


def steps_to(accuracy: NDArray[np.float64], level: float) -> float:
    """Return the steps after which an accuracy is reached; `STEPS` where it is not."""
    reached = np.flatnonzero(accuracy >= level)
    if not len(reached):
        return float(STEPS)
    first = int(reached[0])
    if first == 0:
        return 0.0
    low, high = accuracy[first - 1 : first + 1]
    return EVERY * (first - 1 + (level - low) / (high - low))


def table(records: list[dict]) -> Iterator[str]:
    """Lines of a table, as Markdown: means over homes, in brackets paired changes from the nearest frontier."""
    values: dict[str, dict[str, list[list[float]]]] = defaultdict(lambda: defaultdict(list))
    for record in records:
        for name, each in record["curves"].items():
            seen, accuracy, rmse_db = np.array(each).T
            row = [steps_to(accuracy, level) for level in ACCURACIES] + [accuracy.mean(), rmse_db.mean(), seen.mean()]
            values[name][record["home"]].append(row)
    yield "| frontier | homes | steps to .80 | steps to .85 | mean accuracy | mean RMSE [dB] | mean observed |"
    yield "|---|---|---|---|---|---|---|"
    of_home = {name: {home: np.mean(rows, axis=0) for home, rows in homes.items()} for name, homes in values.items()}
    for name, homes in of_home.items():
        rows = np.array(list(homes.values()))
        base = np.array([of_home["nearest"][home] for home in homes])
        means = [f"{mean:.{digits}f}" for mean, digits in zip(rows.mean(axis=0), DIGITS, strict=True)]
        errors = (rows - base).std(axis=0, ddof=min(1, len(rows) - 1)) / np.sqrt(len(rows))
        changes = zip((rows - base).mean(axis=0), errors, DIGITS, strict=True)
        cells = [
            mean + (f" ({change:+.{digits}f} ± {error:.{digits}f})" if name != "nearest" else "")
            for mean, (change, error, digits) in zip(means, changes, strict=True)
        ]
        yield f"| {name} | {len(rows)} | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    main()
