"""Received powers that were measured on real floors, predicted from a few of them.

Each FOLDER holds map.yaml (others with --map) and measurements.csv with the columns tx, tx_x ... rx_z, frequency_hz and
power_dbm, as ../shared/measured/bleflat does. Of each transmitter 60 random points are taken, N of them are given, and
the powers at the others are predicted, 20 times; the offset of powers is not known. The table has the root mean square
error [dB], averaged over transmitters, how often the 90 % interval of the prediction holds the power, and how many of
the points, which all received, it calls likelier in outage than not.

    python benchmarks/reality.py ../shared/measured/bleflat

Baselines: path loss with fitted exponent; multi-wall (COST 231), whose loss per wall comes from the other transmitters
of the floor; a Gaussian process about the path loss (Matern 3/2 over the receiver's position).
"ours, alone" does without the links of the floor's other transmitters.
"""

import argparse
import csv
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.constants import SPEED_OF_LIGHT_M_S, CellState
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.prediction.unobserved import walled_lengths_m
from sionna_partial.tracing.simulation import clear_of_walls

Floats = NDArray[np.float64]
NUMBERS, DRAWS, POINTS = (5, 10, 20), 20, 60
EXPONENT, EXPONENT_STD, NOISE_DB, OFFSET_STD_DB = 2.0, 0.5, 6.0, 8.0
COLUMNS = "tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z", "power_dbm"
WITHIN_90 = 1.6449


def main() -> None:
    """Measure, and print a table for each floor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--map", default="map.yaml", help="name of the map in each folder")
    parser.add_argument("--material", default="drywall")
    parser.add_argument("--opaque-walls", action="store_true")
    parser.add_argument("--half", action="store_true", help="hide each half of the plan in turn: left, right, ...")
    arguments = parser.parse_args()
    for folder in arguments.folders:
        partial, links, frequency_hz = read_floor(folder, arguments.map)
        settings = sp.TraceSettings(frequency_hz, refraction=False if arguments.opaque_walls else None)
        tables = []
        for seen in halves(partial) if arguments.half else [partial]:
            simulation = sp.Simulation(seen, settings, sp.SceneSettings(material=arguments.material))
            tables.append(Floor(seen, links, simulation).table())
        print(f"\n{folder.name}, {arguments.map}, {frequency_hz / 1e9:g} GHz, {len(links)} transmitters")
        print("| | " + " | ".join(f"N = {number}" for number in NUMBERS) + " |\n" + "|---" * (len(NUMBERS) + 1) + "|")
        for method in tables[0]:
            values = np.mean([table[method] for table in tables], axis=0)
            print(f"| {method} | " + " | ".join(f"{value:.2f}" for value in values) + " |")


def halves(partial: sp.PartialMap) -> list[sp.PartialMap]:
    """Hide the left, right, lower and upper half of what is free or wall."""
    rows, columns = np.nonzero(partial.state != CellState.UNKNOWN)
    of_cell = np.indices(partial.shape)
    hidden = [
        sign * (each - np.median(known)) > 0.0
        for each, known in zip(of_cell, (rows, columns), strict=True)
        for sign in (-1, 1)
    ]
    return [replace(partial, state=np.where(each, np.uint8(CellState.UNKNOWN), partial.state)) for each in hidden]


def read_floor(folder: Path, name: str) -> tuple[sp.PartialMap, dict[str, Floats], float]:
    """Return the map, the rows (N, 7) of each transmitter, and the frequency [Hz]."""
    partial = sp.load_map(folder / name)
    with (folder / "measurements.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    of_tx = defaultdict(list)
    for row in rows:
        of_tx[row.get("tx") or row["sensor"]].append([float(row[column]) for column in COLUMNS])
    links = {}
    for tx, values in ((tx, np.array(values)) for tx, values in of_tx.items()):
        stands = clear_of_walls(partial, values[:, 3:6]) & (partial.state_at(values[0, :3]) != CellState.WALL)
        if stands.sum() >= POINTS:
            links[tx] = values[stands]
    return partial, links, float(rows[0].get("frequency_hz") or 2.44e9)


class Floor:
    """All that the methods need of one floor, computed once."""

    def __init__(self, partial: sp.PartialMap, links: dict[str, Floats], simulation: sp.Simulation) -> None:
        self.partial, self.links, self.simulation = partial, links, simulation
        self.frequency_hz = simulation.trace_settings.frequency_hz
        self.through_walls = simulation.trace_settings.through_walls
        model = sp.LinkModel(simulation)
        self.free_db, self.walls, self.prior = {}, {}, {}
        for tx, rows in links.items():
            tx_m, rx_m = rows[0, :3], rows[:, 3:6]
            distance_m = np.maximum(np.linalg.norm(rx_m - tx_m, axis=1), 0.1)
            self.free_db[tx] = 20.0 * np.log10(SPEED_OF_LIGHT_M_S / self.frequency_hz / (4.0 * np.pi * distance_m))
            self.walls[tx] = walls_between(partial, tx_m, rx_m)
            traced = simulation.links(tx_m, rx_m)
            self.prior[tx] = model.predict(tx_m, rx_m), traced.gain_db

    def table(self) -> dict[str, list[float]]:
        """Return the mean over transmitters of each method's figures, by how many points are given."""
        sums: dict[str, list[list[float]]] = defaultdict(list)
        for tx in self.links:
            for method, values in self.errors(tx).items():
                sums[method].append(values)
        return {method: np.mean(values, axis=0).tolist() for method, values in sums.items()}

    def errors(self, tx: str) -> dict[str, list[float]]:
        """Return the figures of one transmitter."""
        loss_db, mean_offset_db = self.loss_elsewhere(tx)
        others = [self.fitted(each, np.arange(len(self.links[each]))) for each in self.links if each != tx]
        found: dict[str, list[float]] = defaultdict(list)
        for number in NUMBERS:
            draws = defaultdict(list)
            for draw in range(DRAWS):
                order = np.random.default_rng(draw).permutation(len(self.links[tx]))[:POINTS]
                for method, value in self.one_draw(tx, order, number, loss_db, mean_offset_db, others).items():
                    draws[method].append(value)
            for method, values in draws.items():
                found[method].append(float(np.mean(values)))
        return found

    def loss_elsewhere(self, tx: str) -> tuple[float, float]:
        """Fit the loss of a wall [dB], and the mean offset [dB], to the other transmitters."""
        others = [each for each in self.links if each != tx] or [tx]
        walls = np.concatenate([self.walls[each] - self.walls[each].mean() for each in others])
        rest = [self.links[each][:, 6] - self.free_db[each] for each in others]
        centred = np.concatenate([each - each.mean() for each in rest])
        loss_db = max(0.0, -float(walls @ centred) / max(float(walls @ walls), 1e-9))
        offsets = [np.mean(each + loss_db * self.walls[other]) for each, other in zip(rest, others, strict=True)]
        return loss_db, float(np.mean(offsets))

    def fitted(self, tx: str, known: NDArray[np.int64], others: Sequence[Assimilation] = ()) -> Assimilation:
        """Assimilate some of the powers of a transmitter."""
        rows, (prior, _) = self.links[tx], self.prior[tx]
        return Assimilation.fit(
            self.partial,
            rows[0, :3],
            sp.Measurements(rows[0, :3], rows[known, 3:6], rows[known, 6]),
            prior.take(known),
            frequency_hz=self.frequency_hz,
            through_walls=self.through_walls,
            others=others,
        )

    def one_draw(
        self,
        tx: str,
        order: NDArray[np.int64],
        number: int,
        loss_db: float,
        offset_db: float,
        others: Sequence[Assimilation],
    ) -> dict[str, float]:
        """Return the error of each method, and the predicted one of the prediction, with some points given."""
        known, rest = order[:number], order[number:]
        rows, free_db = self.links[tx], self.free_db[tx]
        power, rx_m = rows[:, 6], rows[:, 3:6]
        slope = path_loss(free_db[known], power[known], offset_db)
        loss = slope[0] + slope[1] * free_db
        multi_wall = free_db - loss_db * self.walls[tx]
        prior, traced_db = self.prior[tx]
        received = np.maximum(traced_db, traced_db[traced_db > -150.0].min() - 10.0)
        shifts = {"multi-wall": multi_wall, "trace": received}
        guesses = {name: each[rest] + offset(power[known] - each[known], offset_db) for name, each in shifts.items()}
        ours = {}
        for name, given in {"ours": others, "ours, alone": ()}.items():
            fitted = self.fitted(tx, known, given)
            after = fitted.update(rx_m[rest], prior.take(rest))
            ours[name] = after.gain_mean_db + fitted.offset_db, after.gain_std_db, after.p_outage
        guesses |= {
            "path loss": loss[rest],
            "path loss + Gaussian process": loss[rest] + process(rx_m[known], (power - loss)[known], rx_m[rest]),
        }
        guesses |= {name: mean_db for name, (mean_db, _, _) in ours.items()}
        errors = {name: float(np.sqrt(np.mean((each - power[rest]) ** 2))) for name, each in guesses.items()}
        for name, (mean_db, std_db, p_outage) in ours.items():
            errors[f"{name}: 90 % interval holds"] = float(np.mean(np.abs(mean_db - power[rest]) <= WITHIN_90 * std_db))
            errors[f"{name}: P(outage) > .5"] = float(np.mean(p_outage > 0.5))
        return errors


def walls_between(partial: sp.PartialMap, tx_m: Floats, rx_m: Floats) -> Floats:
    """Count the runs of wall cells of 4 cm or more on straight lines (N,)."""
    if not walled_lengths_m(partial, np.broadcast_to(tx_m, rx_m.shape), rx_m).any():
        return np.zeros(len(rx_m))
    counts = np.zeros(len(rx_m))
    for index, end_m in enumerate(rx_m):
        steps = max(2, int(np.linalg.norm(end_m - tx_m) / 0.01))
        wall = partial.state_at(np.linspace(tx_m, end_m, steps)) == CellState.WALL
        edges = np.flatnonzero(np.diff(np.concatenate([[0], wall.astype(int), [0]])))
        counts[index] = np.sum(edges[1::2] - edges[::2] >= 4)
    return counts


def path_loss(free_db: Floats, power: Floats, offset_db: float) -> Floats:
    """Fit offset and exponent / 2 by regularised least squares."""
    design = np.stack([np.ones(len(power)), free_db], axis=1) / NOISE_DB
    prior = np.diag([1.0 / OFFSET_STD_DB, 2.0 / EXPONENT_STD])
    target = prior @ [offset_db, EXPONENT / 2.0]
    solved: Floats = np.linalg.lstsq(np.vstack([design, prior]), np.append(power / NOISE_DB, target), rcond=None)[0]
    return solved


def offset(residual_db: Floats, mean_db: float) -> float:
    """Return the offset's posterior mean [dB]."""
    weight = len(residual_db) / NOISE_DB**2
    return float((weight * residual_db.mean() + mean_db / OFFSET_STD_DB**2) / (weight + 1.0 / OFFSET_STD_DB**2))


def process(known_m: Floats, residual_db: Floats, points_m: Floats) -> Floats:
    """Return the mean of a Gaussian process with the length, signal and noise that the residuals make likeliest."""

    def kernel(first: Floats, second: Floats, length_m: float) -> Floats:
        apart = np.sqrt(3.0) * np.linalg.norm(first[:, None] - second[None], axis=-1) / length_m
        correlation: Floats = (1.0 + apart) * np.exp(-apart)
        return correlation

    best, mean = -np.inf, np.zeros(len(points_m))
    for length_m in (1.0, 2.0, 4.0):
        for signal_db, noise_db in ((2.0, 3.0), (4.0, 3.0), (6.0, 3.0), (3.0, 5.0)):
            covariance = signal_db**2 * kernel(known_m, known_m, length_m) + noise_db**2 * np.eye(len(known_m))
            weights = np.linalg.solve(covariance, residual_db)
            evidence = -0.5 * residual_db @ weights - 0.5 * np.linalg.slogdet(covariance)[1]
            if evidence > best:
                best, mean = evidence, signal_db**2 * kernel(points_m, known_m, length_m) @ weights
    return mean


if __name__ == "__main__":
    main()
