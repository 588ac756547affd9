"""Powers that real radios measured on an office floor, predicted from a few of them.

FOLDER holds the floor's map.yaml and measurements.csv with the columns day, sensor, tx_x ... rx_z and power_dbm; each
sensor stands as a transmitter. Of the first day, N random powers per sensor are given, and the others are predicted
(20 draws): by path loss fitted to them, by the trace and one offset, and by `Assimilation` with the trace as the prior.
The table has the root mean square error [dB], averaged over sensors and draws. Run it with

    python benchmarks/measured_floor.py ../shared/measured/ble_floor
"""

import argparse
import csv
from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.tracing.simulation import clear_of_walls

NUMBERS, DRAWS = (5, 10, 20, 40), 20
TRACE = sp.TraceSettings(frequency_hz=2.44e9, max_depth=4)


def main() -> None:
    """Measure, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    partial = sp.load_map(folder / "map.yaml")
    with (folder / "measurements.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    sensors = defaultdict(list)
    for row in rows:
        if row["day"] == rows[0]["day"]:
            sensors[row["sensor"]].append([float(row[name]) for name in COLUMNS])
    errors: dict[str, list[list[float]]] = defaultdict(list)
    for values in map(np.array, sensors.values()):
        for method, of_numbers in sensor_errors(partial, values).items():
            errors[method].append(of_numbers)
    print("| measured | " + " | ".join(map(str, NUMBERS)) + " |\n" + "|---" * (len(NUMBERS) + 1) + "|")
    for method, of_sensors in errors.items():
        print(f"| {method} | " + " | ".join(f"{error:.2f}" for error in np.mean(of_sensors, axis=0)) + " |")


COLUMNS = ("tx_x", "tx_y", "tx_z", "rx_x", "rx_y", "rx_z", "power_dbm")


def sensor_errors(partial: sp.PartialMap, values: NDArray[np.float64]) -> dict[str, list[float]]:
    """Root mean square errors [dB] of each method, by how many powers are given."""
    values = values[clear_of_walls(partial, values[:, 3:6])]
    tx_m, rx_m, power_dbm = values[0, :3], values[:, 3:6], values[:, 6]
    links = sp.trace_links(partial, tx_m, rx_m, trace_settings=TRACE, progress=False)
    prior, log_m = sp.LinkPrediction.of_trace(sp.link_features(partial, links)), np.log10(links_m(tx_m, rx_m))
    found: dict[str, list[float]] = defaultdict(list)
    for number in NUMBERS:
        squares = defaultdict(list)
        for draw in range(DRAWS):
            order = np.random.default_rng(draw).permutation(len(rx_m))
            known, rest = order[:number], order[number:]
            fitted = Assimilation.fit(
                partial,
                tx_m,
                sp.Measurements(tx_m, rx_m[known], power_dbm[known]),
                prior.take(known),
                frequency_hz=TRACE.frequency_hz,
            )
            guesses = {
                "path loss, fitted": np.polyval(np.polyfit(log_m[known], power_dbm[known], 1), log_m[rest]),
                "trace and one offset": links.gain_db[rest] + (power_dbm - links.gain_db)[known].mean(),
                "assimilated": fitted.update(rx_m[rest], prior.take(rest)).gain_mean_db + fitted.offset_db,
            }
            for method, guess_dbm in guesses.items():
                squares[method].append(np.sqrt(np.mean((guess_dbm - power_dbm[rest]) ** 2)))
        for method, each in squares.items():
            found[method].append(float(np.mean(each)))
    return found


def links_m(tx_m: NDArray[np.float64], rx_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths of links [m]."""
    return np.linalg.norm(rx_m - tx_m, axis=1)


if __name__ == "__main__":
    main()
