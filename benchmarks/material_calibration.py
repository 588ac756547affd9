"""Hidden materials recovered from noisy gains, on procedural homes that were not used for development.

Each home gets hidden materials. Their gains are traced on the complete home at positions that are free on the map, with
noise, and `calibrate_materials` gets the map (complete or half explored) and the noisy gains. Errors are of the loss
of a reflection at angles of incidence from 0 to 75 degrees, where the loss is below 30 dB; "te" is the
polarisation of vertical antennas at walls; "in 90 %" is the fraction of true losses in the central 90 % interval. Gains
of links that were not measured are compared with their truth. Hidden materials named random1, random2, ... have a
permittivity of 1.5 to 8 and a conductivity of 0.005 to 1 S/m. Run

    python benchmarks/material_calibration.py
    python benchmarks/material_calibration.py --homes 10 --first 50000 --hidden random1 random2 random3 random4
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from stock import timed

import sionna_partial as sp
from sionna_partial.calibration.calibration import MaterialCalibration
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.tracing.power import reflection_loss_db

HIDDEN = {
    "drywall": sp.Material(),
    "plasterboard": sp.Material(2.73, 0.195),
    "brick": sp.Material(3.91, 0.041),
    "concrete": sp.Material(5.24, 0.626),
    "glass": sp.Material(6.31, 0.312),
    "wood": sp.Material(1.99, 0.167),
    "lossless": sp.Material(2.94, 0.0),
}
ANGLES_DEG = (0.0, 30.0, 45.0, 60.0, 75.0)
LARGEST_LOSS_DB = 30.0


@dataclass(frozen=True)
class Trial:
    """One calibration: errors [dB] and truth in the 90 % interval (2, 5), by polarisation and angle."""

    hidden: str
    stage: str
    error_db: NDArray[np.float64]
    held: NDArray[np.float64]
    rmse_db: dict[str, float]
    seconds: float


def main() -> None:
    """Calibrate, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=3, help="number of homes")
    parser.add_argument("--first", type=int, default=40_000, help="seed of the first home")
    parser.add_argument("--stages", nargs="+", default=["complete", "step100"])
    parser.add_argument("--hidden", nargs="+", default=list(HIDDEN))
    parser.add_argument("--links", type=int, default=200, help="measured links")
    parser.add_argument("--transmitters", type=int, default=8)
    parser.add_argument("--noise", type=float, default=3.0, help="standard deviation of the noise [dB]")
    arguments = parser.parse_args()
    done = []
    for trial in trials(arguments):
        done.append(trial)
        print(line(f"{trial.hidden}, {trial.stage}", [trial]), flush=True)
    print(f"\n{HEADER}")
    for stage in arguments.stages:
        chosen = [each for each in done if each.stage == stage]
        for hidden in arguments.hidden:
            print(line(f"{hidden}, {stage}", [each for each in chosen if each.hidden == hidden]))
        print(line(f"all, {stage}", chosen))


def trials(arguments: argparse.Namespace) -> Iterator[Trial]:
    """Calibrate each home, stage and hidden material."""
    for seed in range(arguments.first, arguments.first + arguments.homes):
        home = sp.make_home(seed)
        for stage in arguments.stages:
            known = home if stage == "complete" else sp.explore(home, steps=(int(stage.removeprefix("step")),))[0]
            for hidden in arguments.hidden:
                yield trial(home, known, stage, hidden, seed, arguments)


def trial(
    home: sp.PartialMap,
    known: sp.PartialMap,
    stage: str,
    hidden: str,
    seed: int,
    arguments: argparse.Namespace,
) -> Trial:
    """Measure with noise, calibrate, and compare."""
    rng = np.random.default_rng([seed, *hidden.encode()])
    count, material = arguments.transmitters, HIDDEN.get(hidden) or random_material(rng)
    positions = free_positions(known, count, rng)
    each = [free_positions(known, 2 * arguments.links // count, rng) for _ in range(count)]
    truth = gains_db(home, positions, each, material)
    tx = np.repeat(positions, len(each[0]), axis=0)
    rx = np.concatenate(each)
    measured = np.arange(len(rx)) % 2 == 0
    noisy = np.where(truth > GAIN_FLOOR_DB, truth + arguments.noise * rng.standard_normal(len(truth)), truth)
    gains = {"tx": tx[measured], "rx": rx[measured], "gain_db": noisy[measured]}
    result, seconds = timed(lambda: sp.calibrate_materials(known, gains))
    held = ~measured & (truth > -140.0)
    rmse = {}
    for name, scene in (("default", known), ("calibrated", result.scene), ("hidden", known)):
        traced = gains_db(scene, positions, each, material if name == "hidden" else None)
        rmse[name] = float(np.sqrt(np.mean((traced - truth)[held & (traced > -150.0)] ** 2)))
    error, within = loss_errors(result, material)
    return Trial(hidden, stage, error, within, rmse, seconds)


def random_material(rng: np.random.Generator) -> sp.Material:
    """Draw a material, log-uniform."""
    permittivity, conductivity_s_m = np.exp(rng.uniform(np.log([1.5, 0.005]), np.log([8.0, 1.0])))
    return sp.Material(float(permittivity), float(conductivity_s_m))


def loss_errors(result: MaterialCalibration, hidden: sp.Material) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors of the loss of a reflection (2, 5) [dB], and truth in its interval; NaN where hardly any is reflected."""
    errors, held, posterior = [], [], result.posteriors[0]
    for polarisation in ("te", "tm"):
        rest = hidden.thickness_m, result.trace_settings.frequency_hz, np.array(ANGLES_DEG), polarisation
        true = reflection_loss_db(hidden.relative_permittivity, hidden.conductivity_s_m, *rest)
        found, _ = result.reflection_loss_db(ANGLES_DEG, polarisation)
        others = reflection_loss_db(posterior.permittivity[:, None], posterior.conductivity_s_m[:, None], *rest)
        low, high = np.transpose([posterior.interval(column, 0.9) for column in others.T])
        errors.append(np.where(true < LARGEST_LOSS_DB, found - true, np.nan))
        held.append(np.where(true < LARGEST_LOSS_DB, (low <= true) & (true <= high), np.nan))
    return np.array(errors), np.array(held)


def gains_db(
    scene: sp.PartialMap, tx: NDArray[np.float64], rx: list[NDArray[np.float64]], material: sp.Material | None
) -> NDArray[np.float64]:
    """Traced gains of all links [dB], with the scene's own material for None."""
    settings = None if material is None else sp.SceneSettings(material=material)
    simulation = sp.Simulation(scene, scene_settings=settings)
    return np.concatenate([simulation.links(*each).gain_db for each in zip(tx, rx, strict=True)])


def free_positions(partial: sp.PartialMap, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Places in free cells, 1.5 m high."""
    cells = np.argwhere(partial.state == sp.CellState.FREE)
    chosen = cells[rng.choice(len(cells), count)] + rng.uniform(0.2, 0.8, (count, 2))
    return np.column_stack([chosen[:, ::-1] * partial.resolution_m + partial.origin_m, np.full(count, 1.5)])


HEADER = (
    f"{'hidden, map':30}{'median |error| te':>19}{'tm':>7}{'within 0.5 dB te':>18}{'tm':>6}"
    f"{'in 90 %: te':>13}{'tm':>6}{'RMSE default':>14}{'calib.':>8}{'hidden':>8}{'s':>6}"
)


def line(name: str, chosen: list[Trial]) -> str:
    """Line of a table."""
    error = np.abs(np.stack([each.error_db for each in chosen], axis=1))
    held = np.nanmean(np.stack([each.held for each in chosen], axis=1), axis=(1, 2))
    medians = np.nanmedian(error, axis=(1, 2))
    within = [np.mean(each[np.isfinite(each)] <= 0.5) for each in error]
    rmse = [np.mean([each.rmse_db[key] for each in chosen]) for key in ("default", "calibrated", "hidden")]
    return (
        f"{name:30}{medians[0]:>19.2f}{medians[1]:>7.2f}{within[0]:>18.0%}{within[1]:>6.0%}{held[0]:>13.0%}{held[1]:>6.0%}"
        f"{rmse[0]:>14.2f}{rmse[1]:>8.2f}{rmse[2]:>8.2f}{np.mean([each.seconds for each in chosen]):>6.0f}"
    )


if __name__ == "__main__":
    main()
