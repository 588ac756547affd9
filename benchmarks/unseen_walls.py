"""Gains through walls that were not seen: the mean loss of walls against the trace, on procedural homes.

A robot has explored each home for 0, 50, 100 and 200 steps; links are anywhere indoors, the truth is the trace of the
complete home. The table has the root mean square error [dB] of the traced gain, of the traced gain less a loss for each
unobserved metre (fitted to these links, which no one can do beforehand), and of the prediction, and how often its 90 %
interval holds the truth.

    python benchmarks/unseen_walls.py --frequency-ghz 2.4 --material brick
"""

import argparse
from collections import defaultdict

import numpy as np

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import cell_centres_m

STEPS = (0, 50, 100, 200)
LINKS, TRANSMITTERS, NEAREST_M = 100, 2, 0.3
WITHIN_90 = 1.6449


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=91_000)
    parser.add_argument("--frequency-ghz", type=float, default=5.0)
    parser.add_argument("--material", default="drywall")
    arguments = parser.parse_args()
    trace_settings = sp.TraceSettings(1e9 * arguments.frequency_ghz)
    settings = trace_settings, sp.SceneSettings(material=arguments.material)
    rows = defaultdict(list)
    for seed in range(arguments.first_seed, arguments.first_seed + arguments.homes):
        home = sp.make_home(seed)
        models = [sp.LinkModel(each, None, *settings) for each in sp.explore(home, steps=STEPS, seed=0)]
        truth, rng = sp.Simulation(home, *settings), np.random.default_rng(seed)
        points_m = cell_centres_m(home, np.argwhere(home.state == CellState.FREE))
        points_m = np.column_stack([points_m, np.full(len(points_m), 1.5)])
        points_m = points_m[home.radios_can_stand(points_m)]
        for _ in range(TRANSMITTERS):
            tx_m, *rx = rng.permutation(points_m)[: LINKS + 1]
            rx_m = np.array([each for each in rx if np.linalg.norm(each - tx_m) > NEAREST_M])
            true_db = truth.links(tx_m, rx_m).gain_db
            for step, model in zip(STEPS, models, strict=True):
                stands = model.partial.radios_can_stand(rx_m)
                if model.partial.radios_can_stand(tx_m[None]).all() and stands.any():
                    phi, found = model.features(tx_m, rx_m[stands]), model.predict(tx_m, rx_m[stands])
                    columns = phi.gain_db, phi.unobserved_distance_m, found.gain_mean_db, found.gain_std_db
                    rows[step].append(np.stack([true_db[stands], *columns], axis=1))
    print("| steps | links | trace | trace - fitted loss a metre | prediction | its mean std | 90 % interval |")
    print("|---|---|---|---|---|---|---|")
    for step, parts in rows.items():
        true_db, traced_db, unseen_m, mean_db, std_db = np.concatenate(parts).T
        loss_db = unseen_m @ (traced_db - true_db) / max(unseen_m @ unseen_m, 1e-9)
        errors = (each - true_db for each in (traced_db, traced_db - loss_db * unseen_m, mean_db))
        figures = [f"{np.sqrt(np.mean(error**2)):.2f}" for error in errors]
        holds = np.mean(np.abs(mean_db - true_db) <= WITHIN_90 * std_db)
        print(f"| {step} | {len(true_db)} | {' | '.join(figures)} | {std_db.mean():.2f} | {holds:.2f} |")


if __name__ == "__main__":
    main()
