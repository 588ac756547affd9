"""Received powers that were measured on real floors, predicted from a few of them.

Each FOLDER holds map.yaml and measurements.csv with the columns tx, tx_x ... rx_z, frequency_hz and power_dbm, as
../shared/measured/bleflat does. Of each transmitter 60 random points are taken, N of them are given, and the powers at
the others are predicted; the offset of powers is not known. The table has the root mean square error (RMSE), averaged
over transmitters [dB], and the fraction of powers in the central 90 % interval of our prediction; the last one the
residual spread about the trace.

    python benchmarks/reality.py ../shared/measured/bleflat ../shared/measured/ble_floor

Without a FOLDER, buildings are procedural: their powers are traced with other walls (`BUILDINGS`), and have a spatial
process of 4 dB, fading of 4 dB and an offset of each transmitter. With --repeats, these are drawn several times, and
mean and scatter of the fraction of powers in the 90 % interval without given powers are printed instead.

Baselines: multi-wall (COST 231), whose loss per wall comes from the other transmitters of the floor; a Gaussian process
(Matern 3/2 over the receiver's position) about it, and about path loss with fitted exponent. Without given powers
(N = 0), their constants are the means of the other transmitters.

With --locate, the position of each transmitter is unknown instead, and estimated from 40 of its 60 random powers, drawn
several times; the 12 transmitters of procedural buildings have the same 60 receivers, and other errors in each draw.
"""

import argparse
import csv
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtr
from through_walls import ends

import sionna_partial as sp
from sionna_partial import link_model
from sionna_partial.checks import no_progress
from sionna_partial.constants import DEFAULT_HEIGHT_M, SPEED_OF_LIGHT_M_S, CellState
from sionna_partial.coverage.grid import GridArea, grid_receivers
from sionna_partial.coverage.job import CoverageJob, Transmitter
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.measurements.localisation import MOST_POSITIONS, likely_region
from sionna_partial.prediction.unobserved import walled_lengths_m
from sionna_partial.tracing.antennas import Antenna

Floats = NDArray[np.float64]
NUMBERS, POINTS, LOCATE_POINTS = (0, 5, 10, 20), 60, 40
EXPONENT, EXPONENT_STD, NOISE_DB, OFFSET_STD_DB = 2.0, 0.5, 6.0, 8.0
COLUMNS = "tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z", "power_dbm"
NO_INFORMATION_DB = 30.0
BUILDINGS = {
    "office of brick": ("office", 11, 2.4e9, ("brick", "brick", "brick")),
    "office of concrete": ("office", 1, 2.4e9, ("concrete", "concrete", "concrete")),
    "office, outer concrete, inner brick": ("office", 3, 5.2e9, ("concrete", "brick", "brick")),
    "floor, glass, plasterboard, concrete core": ("floor", 2, 1.9e9, ("glass", "drywall", "concrete")),
    "house of drywall": ("house", 12, 5.2e9, ("drywall", "drywall", "drywall")),
    "office, thick outer walls and core of concrete": ("office", 5, 2.4e9, ("concrete", "drywall", "concrete"), 0.1),
}
"""Procedural buildings: kind, seed, frequency [Hz], the materials of outer walls, inner walls and core, and the depth
added to each side of outer walls and core [m].
"""
OUTER_M, CORE, BUILDING_TRANSMITTERS, LOCATE_TRANSMITTERS = 1.0, 0.7, 4, 12
PROCESS_DB, PROCESS_M, FADING_DB, OFFSET_DB, SENSITIVITY_DBM = 4.0, 4.0, 4.0, (-30.0, 4.0), -125.0


def main() -> None:
    """Measure, and print a table for each floor, and the residual spreads."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--locate", action="store_true", help="estimate positions of transmitters instead")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=0, help="of the errors of procedural buildings")
    parser.add_argument("--only", default="", help="part of the names of the procedural buildings")
    arguments = parser.parse_args()
    buildings = {name: source for name, source in BUILDINGS.items() if arguments.only in name}
    if arguments.locate:
        print("| | trials | median error [m] | mean error [m] | truth in the 90 % region |\n|---|---|---|---|---|")
    spreads = {}
    for name, source in ({folder.name: folder for folder in arguments.folders} or buildings).items():
        shared = arguments.locate
        partial, links, frequency_hz = (
            read_floor(source) if isinstance(source, Path) else procedural(*source, shared=shared)
        )
        simulation = sp.Simulation(partial, sp.TraceSettings(frequency_hz))
        if arguments.locate:
            print_located(name, locate(sp.LinkModel(simulation), links, arguments.draws))
            continue
        floor = Floor(partial, links, simulation)
        if arguments.repeats:
            inside = floor.inside(arguments.repeats)
            print(f"{name}: in 90 % {np.mean(inside):.2f}, of single draws {np.std(inside):.2f}", flush=True)
            continue
        spreads[name] = floor.residual_stds_db()
        print_table(f"{name}, {frequency_hz / 1e9:g} GHz, {len(links)} transmitters", floor.table(arguments.draws))
    if spreads:
        print("\n| residual spread [dB] | process | fading | both |\n|---|---|---|---|")
    for name, stds in spreads.items():
        print(f"| {name} | {stds[0]:.1f} | {stds[1]:.1f} | {np.hypot(*stds):.1f} |")


def locate(model: sp.LinkModel, links: dict[str, Floats], draws: int) -> Floats:
    """Return error [m] and whether the 90 % region holds the truth (D, 2), of each transmitter and draw."""
    link_model.KEPT_BLOCKS = POINTS
    area = GridArea(DEFAULT_HEIGHT_M, 1.0)
    job, found = CoverageJob(model, area, block=MOST_POSITIONS), []
    nowhere = grid_receivers(model.simulation, np.empty((0, 3)), area)
    for number, rows in enumerate(links.values()):
        rows, tx_m = rows[np.random.default_rng(0).permutation(len(rows))[:POINTS]], rows[0, :3]
        for draw in range(draws):
            rng = np.random.default_rng([number, draw])
            power = rows[:, 7] + drawn_errors_db(rows[:, 3:6], rng) if rows.shape[1] > len(COLUMNS) else rows[:, 6]
            given = rng.permutation(np.flatnonzero(power > SENSITIVITY_DBM))[:LOCATE_POINTS]
            measured = sp.Measurements((np.nan, np.nan, tx_m[2]), rows[given, 3:6], power[given])
            posterior = job.located(Transmitter("", None, Antenna(), nowhere, measured), no_progress)
            probability, apart_m = posterior.probability.ravel(), np.linalg.norm(posterior.points_m - tx_m, axis=1)
            inside = likely_region(probability)[np.where(probability > 0.0, apart_m, np.inf).argmin()]
            found.append((np.linalg.norm(posterior.position_m - tx_m), inside))
    return np.array(found)


def print_located(name: str, found: Floats) -> None:
    """Print a row of the table of `locate`."""
    errors_m = f"{np.median(found[:, 0]):.2f} | {np.mean(found[:, 0]):.2f}"
    print(f"| {name} | {len(found)} | {errors_m} | {np.mean(found[:, 1]):.2f} |", flush=True)


def print_table(title: str, table: dict[str, Floats]) -> None:
    """Print the figures (N,) of each method."""
    print(f"\n{title}\n\n| RMSE [dB] | {' | '.join(f'N = {number}' for number in NUMBERS)} |\n|---|---|---|---|---|")
    for method, figures in table.items():
        print(f"| {method} | {' | '.join(f'{value:.2f}' for value in figures)} |", flush=True)


def read_floor(folder: Path) -> tuple[sp.PartialMap, dict[str, Floats], float]:
    """Return the map, the rows (N, 7) of each transmitter, and the frequency [Hz]."""
    partial = sp.load_map(folder / "map.yaml")
    with (folder / "measurements.csv").open(encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["tx_x"]]
    of_tx = defaultdict(list)
    for row in rows:
        of_tx[row.get("tx") or row["sensor"]].append([float(row[column]) for column in COLUMNS])
    links = {}
    for tx, values in ((tx, np.array(values)) for tx, values in of_tx.items()):
        stands = partial.radios_can_stand(values[:, 3:6]) & (partial.state_at(values[0, :3]) != CellState.WALL)
        if stands.sum() >= POINTS:
            links[tx] = values[stands]
    return partial, links, float((rows and rows[0].get("frequency_hz")) or 2.44e9)


def procedural(
    kind: str,
    seed: int,
    frequency_hz: float,
    materials: tuple[str, str, str],
    thicker_m: float = 0.0,
    *,
    shared: bool = False,
) -> tuple[sp.PartialMap, dict[str, Floats], float]:
    """Return a building without its materials, with powers that were traced with them, as `read_floor`.

    With `shared`, more transmitters have the same receivers.
    """
    partial, rng = sp.make_home(seed, kind), np.random.default_rng(seed)
    inside = ndimage.binary_fill_holes(partial.state != CellState.UNKNOWN)
    depth_m = ndimage.distance_transform_edt(inside) * partial.resolution_m
    zone = np.digitize(depth_m, [OUTER_M, CORE * depth_m.max()])
    if thicker_m:
        walls = (partial.state == CellState.WALL) & (zone != 1)
        walls = ndimage.binary_dilation(walls, iterations=round(thicker_m / partial.resolution_m))
        partial = replace(partial, state=np.where(walls, np.uint8(CellState.WALL), partial.state))
    truth = partial
    for number, material in enumerate(materials):
        truth = truth.with_wall_material(material, (partial.state == CellState.WALL) & (zone == number))
    simulation, links = sp.Simulation(truth, sp.TraceSettings(frequency_hz)), {}
    for number in range(LOCATE_TRANSMITTERS if shared else BUILDING_TRANSMITTERS):
        tx_m, rx_m = ends(partial, 2 * POINTS, 100 * seed + number)
        rx_m = ends(partial, POINTS, 100 * seed)[1] if shared else rx_m
        errors_db, gain_db = drawn_errors_db(rx_m, rng), simulation.links(tx_m, rx_m).gain_db
        power = gain_db + errors_db
        rows = np.column_stack([np.tile(tx_m, (len(rx_m), 1)), rx_m, power, gain_db])
        links[f"{number}"] = rows[shared | (power > SENSITIVITY_DBM)]
    return partial, {tx: rows for tx, rows in links.items() if len(rows) >= POINTS}, frequency_hz


def drawn_errors_db(rx_m: Floats, rng: np.random.Generator) -> Floats:
    """Draw a spatial process, fading and an offset (N,) [dB]."""
    apart_m = np.linalg.norm(rx_m[:, None] - rx_m, axis=-1)
    process = np.linalg.cholesky(np.exp(-apart_m / PROCESS_M) + 1e-9 * np.eye(len(rx_m))) @ rng.normal(size=len(rx_m))
    errors_db: Floats = PROCESS_DB * process + FADING_DB * rng.normal(size=len(rx_m)) + rng.normal(*OFFSET_DB)
    return errors_db


class Floor:
    """All that the methods need of one floor, computed once."""

    def __init__(self, partial: sp.PartialMap, links: dict[str, Floats], simulation: sp.Simulation) -> None:
        self.partial, self.links = partial, links
        self.frequency_hz = simulation.trace_settings.frequency_hz
        self.through_walls = simulation.trace_settings.through_walls
        model = sp.LinkModel(simulation)
        self.free_db, self.walls, self.prior = {}, {}, {}
        for tx, rows in links.items():
            tx_m, rx_m = rows[0, :3], rows[:, 3:6]
            distance_m = np.maximum(np.linalg.norm(rx_m - tx_m, axis=1), 0.1)
            self.free_db[tx] = 20.0 * np.log10(SPEED_OF_LIGHT_M_S / self.frequency_hz / (4.0 * np.pi * distance_m))
            self.walls[tx] = walls_between(partial, tx_m, rx_m)
            self.prior[tx] = model.predict(tx_m, rx_m)
        self.fitted = {tx: self.fit(tx, np.arange(len(rows))) for tx, rows in links.items()}

    def residual_stds_db(self) -> Floats:
        """Return the root mean square of the standard deviations of process and fading (2,), all powers given [dB]."""
        fits = [fit for fitted in self.fitted.values() for fit in fitted._fits if fit is not None]
        squares: Floats = np.mean([(fit.kind.trace_std_db**2, fit.fading_db**2) for fit in fits], axis=0)
        return np.sqrt(squares)

    def table(self, draws: int) -> dict[str, Floats]:
        """Return the mean RMSE over transmitters (N,) of each method, and how often our interval holds the power."""
        found: dict[str, Floats] = defaultdict(lambda: np.zeros((len(NUMBERS), len(self.links), draws)))
        for column, (tx, rows) in enumerate(self.links.items()):
            for row, number in enumerate(NUMBERS):
                for draw in range(draws):
                    order = np.random.default_rng(draw).permutation(len(rows))[:POINTS]
                    known, rest = order[:number], order[number:]
                    error_db, holds = self.ours(tx, known, rest)
                    errors = {name: power - rows[rest, 6] for name, power in self.baselines(tx, known, rest).items()}
                    for method, off_db in {**errors, "ours": error_db}.items():
                        found[method][row, column, draw] = np.sqrt(np.mean(off_db**2))
                    found["ours, in 90 %"][row, column, draw] = np.mean(holds)
        return {method: values.mean(axis=(1, 2)) for method, values in found.items()}

    def inside(self, repeats: int) -> list[float]:
        """Return the fraction of powers in the 90 % interval without given powers, for errors drawn again and again."""
        found, traced = [], self.links
        for rng in map(np.random.default_rng, range(repeats)):
            powers = {tx: rows[:, 7] + drawn_errors_db(rows[:, 3:6], rng) for tx, rows in traced.items()}
            self.links = {tx: np.column_stack([rows[:, :6], powers[tx]]) for tx, rows in traced.items()}
            self.fitted = {tx: self.fit(tx, np.arange(len(rows))) for tx, rows in self.links.items()}
            none = np.zeros(0, dtype=np.int64)
            held = [self.ours(tx, none, np.arange(len(rows)))[1] for tx, rows in self.links.items()]
            found.append(float(np.mean([each.mean() for each in held])))
        self.links = traced
        return found

    def others(self, tx: str) -> list[str]:
        """Return the other transmitters of the floor; this one if there are none."""
        return [other for other in self.links if other != tx] or [tx]

    def loss_elsewhere(self, tx: str) -> float:
        """Fit the loss of a wall to the other transmitters [dB]."""
        walls = np.concatenate([self.walls[other] - self.walls[other].mean() for other in self.others(tx)])
        rest = [self.links[other][:, 6] - self.free_db[other] for other in self.others(tx)]
        centred = np.concatenate([values - values.mean() for values in rest])
        return max(0.0, -float(walls @ centred) / max(float(walls @ walls), 1e-9))

    def baselines(self, tx: str, known: NDArray[np.int64], rest: NDArray[np.int64]) -> dict[str, Floats]:
        """Return the powers that each baseline predicts [dBm]."""
        power, rx_m, loss_db = self.links[tx][:, 6], self.links[tx][:, 3:6], self.loss_elsewhere(tx)
        fits = [path_loss(self.free_db[o], self.links[o][:, 6], (-30.0, EXPONENT / 2.0)) for o in self.others(tx)]
        slope = path_loss(self.free_db[tx][known], power[known], np.mean(fits, axis=0))
        path_loss_db = slope[0] + slope[1] * self.free_db[tx]
        through = {each: self.free_db[each] - loss_db * self.walls[each] for each in self.links}
        mean_db = float(np.mean([np.mean(self.links[o][:, 6] - through[o]) for o in self.others(tx)]))
        multi_wall_db = through[tx] + offset(power[known] - through[tx][known], mean_db)
        predicted = {"multi-wall": multi_wall_db}
        for name, without_db in (("path loss", path_loss_db), ("multi-wall", multi_wall_db)):
            residual_db = process(rx_m[known], (power - without_db)[known], rx_m)
            predicted[f"{name} + Gaussian process"] = without_db + residual_db
        return {name: values[rest] for name, values in predicted.items()}

    def ours(self, tx: str, known: NDArray[np.int64], rest: NDArray[np.int64]) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the errors [dB] of our prediction, and whether its 90 % intervals hold the powers."""
        power = self.links[tx][rest, 6]
        fitted = self.fit(tx, known, [self.fitted[other] for other in self.others(tx) if other != tx])
        after = fitted.update(self.links[tx][rest, 3:6], self.prior[tx].take(rest))
        weights, means_db, stds_db = after.by_state
        below = (weights * ndtr((power - fitted.offset_db - means_db) / np.maximum(stds_db, 1e-9))).sum(axis=0)
        return after.gain_mean_db + fitted.offset_db - power, (below >= 0.05) & (below <= 0.95)

    def fit(self, tx: str, known: NDArray[np.int64], others: Sequence[Assimilation] = ()) -> Assimilation:
        """Assimilate some powers of a transmitter; without any, one of a standard deviation that says nothing."""
        rows, std_db = self.links[tx], None if len(known) else NO_INFORMATION_DB
        known = known if len(known) else np.zeros(1, dtype=np.int64)
        return Assimilation.fit(
            self.partial,
            rows[0, :3],
            sp.Measurements(rows[0, :3], rows[known, 3:6], rows[known, 6], std_db),
            self.prior[tx].take(known),
            frequency_hz=self.frequency_hz,
            through_walls=self.through_walls,
            others=others,
        )


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


def path_loss(free_db: Floats, power: Floats, mean: Floats | tuple[float, float]) -> Floats:
    """Fit offset [dB] and exponent / 2 by least squares, regularised by their prior means."""
    design = np.stack([np.ones(len(power)), free_db], axis=1) / NOISE_DB
    prior = np.diag([1.0 / OFFSET_STD_DB, 2.0 / EXPONENT_STD])
    target = prior @ mean
    solved: Floats = np.linalg.lstsq(np.vstack([design, prior]), np.append(power / NOISE_DB, target), rcond=None)[0]
    return solved


def offset(residual_db: Floats, mean_db: float) -> float:
    """Return the offset's posterior mean [dB]."""
    weight, prior = 1.0 / NOISE_DB**2, 1.0 / OFFSET_STD_DB**2
    return float((weight * residual_db.sum() + mean_db * prior) / (weight * len(residual_db) + prior))


def process(known_m: Floats, residual_db: Floats, points_m: Floats) -> Floats:
    """Return the mean of a Gaussian process with the length, signal and noise that the residuals make most probable."""

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
