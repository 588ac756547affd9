"""Benefit of next views: accuracy of predictions while robots explore with different choices of frontiers.

In every home robots with the same camera and start explore for 300 steps. They differ in the frontier that they choose:
one at random (`explore`), the nearest, the one that shows the largest unknown area per action, or as
`explore(policy="coverage")` does. Prediction and truth are compared on the same links every 25 steps; changes are
paired, from the nearest frontier. Run it with

    python benchmarks/next_views.py ../shared/gibson/*/map.yaml
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stock import drawn_points_m, given_homes

import sionna_partial as sp
from sionna_partial.exploration.next_views import coverage_choice
from sionna_partial.settings import SensorSettings
from sionna_partial.worlds.camera import unknown_in_view
from sionna_partial.worlds.robot import Choice, Frontier, Robot

STEPS, EVERY = 300, 25
DECISION_STEPS = 5.0
HEADINGS_DEG = np.arange(0.0, 360.0, 45.0)
ACCURACIES = (0.80, 0.85)
DIGITS = (0, 0, 3, 2)
SENSOR = SensorSettings()


class Home:
    """A complete home, and links whose truth is known."""

    def __init__(self, home: sp.PartialMap, transmitters: int, receivers: int, rng: np.random.Generator) -> None:
        self.home = home
        self.tx_m, self.rx_m = (drawn_points_m(home, home, count, rng) for count in (transmitters, receivers))
        truth = sp.trace_links(home, self.tx_m, self.rx_m, invalid="nan")
        self.valid = truth.valid
        self.state, self.gain_db = truth.link_state[self.valid], truth.gain_db[self.valid]
        self.model = sp.Predictor.load()
        self.truth = np.pad(home.state, 1, constant_values=sp.CellState.UNKNOWN)

    def map_of(self, robot: Robot) -> sp.PartialMap:
        """Return the map of a robot."""
        state = robot.seen[1:-1, 1:-1]
        return sp.PartialMap(state.copy(), self.home.resolution_m, self.home.origin_m, self.home.wall_height_m)

    def errors(self, partial: sp.PartialMap) -> tuple[float, float]:
        """Return accuracy and RMSE [dB] of the prediction."""
        phi = sp.link_features(partial, sp.trace_links(partial, self.tx_m, self.rx_m, invalid="nan"))
        found = self.model.predict(phi)
        state, mean = found.link_state[self.valid], found.gain_mean_db[self.valid]
        return float((state == self.state).mean()), float(np.sqrt(((mean - self.gain_db) ** 2).mean()))


def best_view(robot: Robot, frontier: Frontier, cell_m: float) -> NDArray[np.intp]:
    """Return the unknown cells (N, 2) of the largest view from the end of a route."""
    return max(unknown_in_view(robot.seen, frontier.route[-1], HEADINGS_DEG, cell_m, SENSOR), key=len)


def rate(robot: Robot, values: NDArray[np.float64], frontiers: list[Frontier]) -> NDArray[np.float64]:
    """Values per action."""
    return values / (np.array([robot.steps_to(each) for each in frontiers]) + DECISION_STEPS)


def nearest(robot: Robot, frontiers: list[Frontier]) -> int:
    """Return the frontier that takes the fewest actions."""
    return int(np.argmin([robot.steps_to(each) for each in frontiers]))


def policies(home: Home) -> dict[str, Choice | None]:
    """Return ways to choose a frontier."""

    def area(robot: Robot, frontiers: list[Frontier]) -> int:
        shown = [len(best_view(robot, each, home.home.resolution_m)) for each in frontiers]
        return int(np.argmax(rate(robot, np.array(shown, float), frontiers)))

    ours = coverage_choice(home.home, (-1, -1), home.tx_m, SENSOR)
    return {"random": None, "nearest": nearest, "largest unknown area in view": area, "ours": ours}


def curve(home: Home, seed: int, choose: Choice | None) -> NDArray[np.float64]:
    """Return accuracy and RMSE [dB] after every `EVERY` steps (S, 2)."""
    robot = Robot(home.truth, home.home.resolution_m, seed, SENSOR, choose)
    values, seen = [], -1
    for step in range(STEPS + 1):
        if step:
            robot.act()
        if step % EVERY == 0:
            known = int((robot.seen == sp.CellState.FREE).sum())
            done = robot.is_finished and known == seen
            values.append(values[-1] if done else home.errors(home.map_of(robot)))
            seen = known
    return np.array(values)


def main() -> None:
    """Explore all homes, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="*", type=Path, help="complete maps")
    parser.add_argument("--made", type=int, default=12, help="number of procedural homes without maps")
    parser.add_argument("--transmitters", type=int, default=3)
    parser.add_argument("--receivers", type=int, default=120)
    arguments = parser.parse_args()
    rows: dict[str, list[list[float]]] = {}
    for seed, (name, complete) in enumerate(given_homes(arguments.maps, arguments.made)):
        home = Home(complete, arguments.transmitters, arguments.receivers, np.random.default_rng(seed))
        for policy, choose in policies(home).items():
            accuracy, rmse_db = curve(home, seed, choose).T
            steps = [steps_to(accuracy, level) for level in ACCURACIES]
            rows.setdefault(policy, []).append([*steps, accuracy.mean(), rmse_db.mean()])
        print(name, "done", flush=True)
    print("\n".join(table({policy: np.array(each) for policy, each in rows.items()})))


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


def table(rows: dict[str, NDArray[np.float64]]) -> Iterator[str]:
    """Lines of a table, as Markdown: means over homes (H, 4), and paired changes with their standard errors."""
    yield "| frontier | homes | steps to 0.80 | steps to 0.85 | mean accuracy | mean RMSE [dB] |"
    yield "|---|---|---|---|---|---|"
    for name, values in rows.items():
        change = values - rows["nearest"]
        errors = change.std(axis=0, ddof=min(1, len(values) - 1)) / np.sqrt(len(values))
        cells = [f"{mean:.{digits}f}" for mean, digits in zip(values.mean(axis=0), DIGITS, strict=True)]
        if name != "nearest":
            paired = zip(change.mean(axis=0), errors, DIGITS, strict=True)
            cells = [
                f"{cell} ({mean:+.{digits}f} ± {error:.{digits}f})"
                for cell, (mean, error, digits) in zip(cells, paired, strict=True)
            ]
        yield f"| {name} | {len(values)} | {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
