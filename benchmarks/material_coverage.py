"""Whether the 90 % interval of a reflection's loss holds the truth, over random materials, maps and noise.

Each home gets random materials, permittivity 1.5 to 8 and conductivity 0.005 to 1 S/m. Gains are measured as in
`material_calibration.py`; an outage stays one. Run

    python benchmarks/material_coverage.py
    python benchmarks/material_coverage.py --first 51000 --homes 12 --materials 2 --steps 100
"""

import argparse

import numpy as np
from material_calibration import ANGLES_DEG, LARGEST_LOSS_DB, free_positions, gains_db
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.tracing.power import reflection_loss_db


def main() -> None:
    """Calibrate each case, and print the coverage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=10, help="number of homes")
    parser.add_argument("--materials", type=int, default=4, help="number of random materials in each home")
    parser.add_argument("--first", type=int, default=50_000, help="seed of the first home")
    parser.add_argument("--steps", type=int, default=0, help="steps of exploration; 0 for complete maps")
    parser.add_argument("--links", type=int, default=200)
    parser.add_argument("--noise", type=float, default=3.0, help="standard deviation of the noise [dB]")
    arguments = parser.parse_args()
    done = []
    for seed in range(arguments.first, arguments.first + arguments.homes):
        home = sp.make_home(seed)
        known = sp.explore(home, steps=(arguments.steps,))[0] if arguments.steps else home
        for number in range(arguments.materials):
            done.append(case(home, known, np.random.default_rng([seed, number]), arguments))
            print(line(f"home {seed}", done[-1:]), flush=True)
    print(line("all", done))


def case(
    home: sp.PartialMap, known: sp.PartialMap, rng: np.random.Generator, arguments: argparse.Namespace
) -> NDArray[np.float64]:
    """Return the error, the stated deviation, and whether the interval holds the truth, by polarisation and angle."""
    permittivity, conductivity_s_m = np.exp(rng.uniform(np.log([1.5, 0.005]), np.log([8.0, 1.0])))
    hidden = sp.Material(float(permittivity), float(conductivity_s_m))
    tx = free_positions(known, 8, rng)
    rx = [free_positions(known, arguments.links // 8, rng) for _ in tx]
    gain_db = gains_db(home, tx, rx, hidden)
    gain_db += np.where(gain_db > GAIN_FLOOR_DB, arguments.noise * rng.standard_normal(len(gain_db)), 0.0)
    measured = {"tx": np.repeat(tx, len(rx[0]), axis=0), "rx": np.concatenate(rx), "gain_db": gain_db}
    found = sp.calibrate_materials(known, measured)
    print(f"hidden {hidden}: {found.materials[0]}, noise {found.noise_db:.2f} dB, {found.used.sum()} links")
    rows = []
    for polarisation in ("te", "tm"):
        rest = hidden.thickness_m, found.trace_settings.frequency_hz, np.array(ANGLES_DEG), polarisation
        true_db = reflection_loss_db(hidden.relative_permittivity, hidden.conductivity_s_m, *rest)
        found_db, std_db = found.reflection_loss_db(ANGLES_DEG, polarisation)
        posterior = found.posteriors[0]
        others_db = reflection_loss_db(posterior.permittivity[:, None], posterior.conductivity_s_m[:, None], *rest)
        low_db, high_db = np.transpose([posterior.interval(column, 0.9) for column in others_db.T])
        inside = (low_db <= true_db) & (true_db <= high_db)
        rows.append(np.where(true_db < LARGEST_LOSS_DB, [found_db - true_db, std_db, inside], np.nan))
    return np.array(rows)


def line(name: str, chosen: list[NDArray[np.float64]]) -> str:
    """Line of the table: median error and coverage, TE and TM, and the largest error in stated deviations."""
    error, std, inside = np.moveaxis(np.array(chosen), 2, 0)
    medians = [float(np.nanmedian(np.abs(error[:, row]))) for row in (0, 1)]
    covered = [float(np.nanmean(inside[:, row])) for row in (0, 1)]
    worst = float(np.nanmax(np.abs(error) / np.maximum(std, 1e-3)))
    return (
        f"{name}: median |error| {medians[0]:.2f} TE, {medians[1]:.2f} TM dB; 90 % interval holds {covered[0]:.0%} TE, "
        f"{covered[1]:.0%} TM; largest error {worst:.1f} std"
    )


if __name__ == "__main__":
    main()
