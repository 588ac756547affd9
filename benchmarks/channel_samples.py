"""Scores of drawn channels on partial maps of homes that nothing was trained on.

In every home a robot explores; links between random points indoors are traced in the whole home, and drawn on the
partial map. Scores of the draws of each link, by ends in observed cells: energy score over gain, delay spread and
azimuth spreads (in units of 10 dB, 5 ns and 20 degrees; no paths count -150 dB and 0), continuous ranked probability
score (CRPS) of each, and how often the 90 % interval holds the truth. Opponents: the trace of the partial map alone,
and draws of TR 38.901 InH-office (table 7.5-6, 28 GHz) at the distance of the link, with link states as predicted. The
best of 64 x 16 pairs of beams (DFT codebooks of 8 x 8 and 4 x 4 antennas) is looked for among the 1, 3, 6 and 16 that
are most often the best of a draw. Printed as well is the probability that all transmitters fail. Run

    python benchmarks/channel_samples.py ../shared/gibson/*/map.yaml
"""

import argparse
import dataclasses
from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from stock import drawn_points_m, given_homes

import sionna_partial as sp
from sionna_partial.channels.samples import ChannelSamples
from sionna_partial.lab.baselines import indoor_gain_db
from sionna_partial.tracing.antennas import planar_array

STEPS, TRANSMITTERS, RECEIVERS, DRAWS, NEAREST_M = (0, 50, 100, 200), 3, 40, 100, 0.15
UNITS = np.array([10.0, 5.0, 20.0, 20.0])
NUMBERS = (1, 3, 6, 16)
"""Numbers of most probable pairs of beams among which the best one is looked for."""
COLUMNS = ("gain [dB]", "delay spread [ns]", "ASD [deg]", "ASA [deg]")
METHODS = ("draws", "trace of the partial map", "TR 38.901 InH-office")
Floats = NDArray[np.float64]


def main() -> None:
    """Score all homes, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="*", type=Path, help="complete maps")
    parser.add_argument("--made", type=int, default=12, help="number of procedural homes without maps")
    arguments = parser.parse_args()
    scores: dict[tuple[str, str], list[Floats]] = defaultdict(list)
    failures: list[Floats] = []
    for seed, (name, home) in enumerate(given_homes(arguments.maps, arguments.made)):
        of_home, of_maps = score_home(home, seed)
        failures.extend(of_maps)
        for key, mean in of_home.items():
            scores[key].append(mean)
        print(f"{name} done", flush=True)
    print_links(scores)
    joint, independent, true = np.mean(failures, axis=0)
    print(f"\nall transmitters fail: joint draws {joint:.3f}, independent draws {independent:.3f}, truth {true:.3f}")


def score_home(home: sp.PartialMap, seed: int) -> tuple[dict[tuple[str, str], Floats], list[Floats]]:
    """Return mean scores over the links of a home by group and method, and how often all transmitters fail."""
    rng = np.random.default_rng(seed)
    scores: dict[tuple[str, str], list[Floats]] = defaultdict(list)
    failures = []
    for partial in sp.explore(home, STEPS, seed):
        tx_m, rx_m = (drawn_points_m(home, partial, count, rng) for count in (TRANSMITTERS, RECEIVERS))
        rx_m = rx_m[np.linalg.norm(rx_m[:, None] - tx_m, axis=2).min(axis=1) > NEAREST_M]
        failures.append(score_map(home, partial, tx_m, rx_m, seed, scores))
    return {key: np.nanmean(np.concatenate(rows), axis=0) for key, rows in scores.items()}, failures


def score_map(
    home: sp.PartialMap,
    partial: sp.PartialMap,
    tx_m: Floats,
    rx_m: Floats,
    seed: int,
    scores: dict[tuple[str, str], list[Floats]],
) -> Floats:
    """Score the links of one partial map; return how often all transmitters fail: joint, independent, true (3,)."""
    true, known = (sp.trace_links(each, tx_m, rx_m, progress=False) for each in (home, partial))
    samples = sp.channels.sample_channels(partial, tx_m, rx_m, DRAWS, seed, progress=False)
    truth, trace = values(true)[0], values(known)[0]
    drawn = values(samples.drawn, DRAWS)
    distance_m = np.linalg.norm(rx_m - tx_m[:, None], axis=2).ravel()
    states = samples.link_state.reshape(DRAWS, -1)
    rng = np.random.default_rng(seed)
    standard = indoor_office(distance_m, states, rng)
    seen = [partial.state_at(end_m) == sp.CellState.FREE for end_m in (tx_m, rx_m)]
    both = seen[0][:, None] + 2 * seen[1][None]
    groups = np.array(["no end seen", "transmitter seen", "receiver seen", "both seen"])[both.ravel()]
    best, received = best_pairs(true)[0], true.link_state.ravel() != sp.LinkState.OUTAGE
    clusters = indoor_office_paths(samples, standard, rng)
    pairs = {
        METHODS[0]: best_pairs(samples.drawn, DRAWS),
        METHODS[1]: ranked_pairs(known),
        METHODS[2]: best_pairs(clusters, DRAWS),
    }
    for method, draws in zip(METHODS, (drawn, trace[None], standard), strict=True):
        hits = among_likeliest(pairs[method], best, received)
        rows = np.array([[*score(draws[:, link], truth[link]), *hits[link]] for link in range(len(truth))])
        for group in ("all links", *np.unique(groups)):
            scores[group, method].append(rows[(groups == group) | (group == "all links")])
    fails = samples.link_state == sp.LinkState.OUTAGE
    true_fails = (true.link_state == sp.LinkState.OUTAGE).all(axis=0)
    return np.array([fails.all(axis=1).mean(), fails.mean(axis=0).prod(axis=0).mean(), true_fails.mean()])


def values(links: sp.TracedLinks, draws: int = 1) -> Floats:
    """Gain [dB], delay spread [ns] and azimuth spreads [deg] (draws, L, 4) of links; nothing where there is no path."""
    spreads = links.spreads()
    angles = [np.degrees(spreads[f"azimuth_{end}_spread_rad"].to_numpy()) for end in ("departure", "arrival")]
    columns = [links.gain_db, 1e9 * spreads["delay_spread_s"].to_numpy(), *angles]
    return np.nan_to_num(np.stack([column.ravel() for column in columns], axis=1)).reshape(draws, -1, len(columns))


def indoor_office(distance_m: Floats, states: NDArray[np.uint8], rng: np.random.Generator) -> Floats:
    """Draws (n, L, 4) of TR 38.901 InH-office at 28 GHz given link states (n, L)."""
    distance_m, log = np.maximum(distance_m, 1.0), np.log10(29.0)
    los = states == sp.LinkState.LOS
    z = rng.standard_normal((*states.shape, 4))
    mean_db = indoor_gain_db(distance_m, 28e9)
    gain_db = np.where(los, mean_db[sp.LinkState.LOS] + 3.0 * z[..., 0], mean_db[sp.LinkState.NLOS] + 8.03 * z[..., 0])
    spread_ns = 1e9 * 10.0 ** np.where(
        los, -0.01 * log - 7.692 + 0.18 * z[..., 1], -0.28 * log - 7.173 + (0.10 * log + 0.055) * z[..., 1]
    )
    departure = 10.0 ** np.where(los, 1.60 + 0.18 * z[..., 2], 1.62 + 0.25 * z[..., 2])
    arrival = 10.0 ** np.where(
        los,
        -0.19 * log + 1.781 + (0.12 * log + 0.119) * z[..., 3],
        -0.11 * log + 1.863 + (0.12 * log + 0.059) * z[..., 3],
    )
    drawn = np.stack([gain_db, spread_ns, np.minimum(departure, 104.0), np.minimum(arrival, 104.0)], axis=-1)
    drawn[states == sp.LinkState.OUTAGE] = [-150.0, 0.0, 0.0, 0.0]
    return drawn


def indoor_office_paths(samples: ChannelSamples, drawn: Floats, rng: np.random.Generator) -> sp.TracedLinks:
    """Make paths of these draws (n, L, 4): 20 clusters about the direct line, and a K-factor in LOS."""
    links, clusters = samples.drawn, 20
    states = links.link_state.ravel()
    link = np.repeat(np.flatnonzero(states != sp.LinkState.OUTAGE), clusters)
    tx, rx = np.divmod(link, len(links.rx))
    along_m = links.rx[rx] - links.tx[tx]
    direct = np.arange(len(link)) % clusters == 0
    power = rng.exponential(1.0, len(link)) * 10.0 ** (-0.3 * rng.standard_normal(len(link)))
    k_factor = 10.0 ** ((7.0 + 4.0 * rng.standard_normal(len(states))) / 10.0)[link]
    is_los = states[link] == sp.LinkState.LOS
    total = np.bincount(link, power, minlength=len(states))[link]
    power = np.where(direct & is_los, k_factor * total, power)
    power *= 10.0 ** (drawn.reshape(-1, 4)[link, 0] / 10.0) / np.bincount(link, power, minlength=len(states))[link]
    azimuth_rad = np.arctan2(along_m[:, 1], along_m[:, 0])
    angles = []
    for column, turn, zenith_std in ((2, 0.0, 0.2), (3, np.pi, 0.2)):
        off = np.radians(drawn.reshape(-1, 4)[link, column]) * rng.standard_normal(len(link)) * ~(direct & is_los)
        zenith = np.pi / 2 + zenith_std * rng.standard_normal(len(link)) * ~(direct & is_los)
        angles.append(np.stack([zenith, azimuth_rad + turn + off], axis=1))
    phase = np.exp(2j * np.pi * rng.random(len(link)))
    return dataclasses.replace(
        links,
        path_tx=tx.astype(np.int32),
        path_rx=rx.astype(np.int32),
        transfer=(np.sqrt(power) * phase)[:, None, None] * np.diag([1.0, -1.0]),
        delay_s=np.linalg.norm(along_m, axis=1) / 3e8,
        departure_rad=angles[0],
        arrival_rad=angles[1],
        interactions=np.ones((len(link), 1), np.uint8),
        vertices_m=np.full((len(link), 1, 3), np.nan),
    )


def beams(links: sp.TracedLinks) -> Floats:
    """Gain (L, 16 x 64) of all pairs of beams."""
    arrays = {"tx_array": planar_array(8, 8), "rx_array": planar_array(4, 4)}
    found = links.beam_gains(sp.channels.dft_codebook(8, 8), sp.channels.dft_codebook(4, 4), memory_gb=8.0, **arrays)
    return found.gain_db.to_numpy().reshape(links.gain_db.size, -1)


def best_pairs(links: sp.TracedLinks, draws: int = 1) -> NDArray[np.intp]:
    """Return the number of the best pair (draws, L), -1 in an outage."""
    gain_db = beams(links)
    return np.where(gain_db.max(axis=1) > -150.0, gain_db.argmax(axis=1), -1).reshape(draws, -1)


def ranked_pairs(links: sp.TracedLinks) -> NDArray[np.intp]:
    """Pairs (16, L) in order of their gain; each counts less than the one before."""
    order = np.argsort(-beams(links), axis=1, kind="stable")[:, : max(NUMBERS)]
    return np.concatenate([np.repeat(order[:, [rank]].T, max(NUMBERS) - rank, axis=0) for rank in range(max(NUMBERS))])


def among_likeliest(drawn: NDArray[np.intp], best: NDArray[np.intp], received: NDArray[np.bool_]) -> Floats:
    """Return whether the best pair of each link (L,) is among the k most frequent ones (L, 4); NaN in an outage."""
    hits = np.full((len(best), len(NUMBERS)), np.nan)
    for link in np.flatnonzero(received):
        pairs, count = np.unique(drawn[drawn[:, link] >= 0, link], return_counts=True)
        likeliest = pairs[np.argsort(-count, kind="stable")]
        hits[link] = [best[link] in likeliest[:number] for number in NUMBERS]
    return hits


def score(draws: Floats, truth: Floats) -> Floats:
    """Energy score, CRPS of each column, and whether the 90 % intervals hold the truth, of draws (n, 4)."""
    first, second = draws / UNITS, np.roll(draws, 1, axis=0) / UNITS
    pairs = np.abs(draws[:, None] - draws).mean(axis=(0, 1))
    spread = np.linalg.norm(first[:, None] - first, axis=2).mean() if len(draws) > 1 else np.linalg.norm(first - second)
    energy = np.linalg.norm(first - truth / UNITS, axis=1).mean() - 0.5 * spread
    crps = np.abs(draws - truth).mean(axis=0) - 0.5 * pairs
    low, high = np.percentile(draws, [5, 95], axis=0)
    return np.concatenate([[energy], crps, (low - 1e-6 <= truth) & (truth <= high + 1e-6)])


def print_links(scores: dict[tuple[str, str], list[Floats]]) -> None:
    """Print a table for each group, means over homes."""
    for group in dict.fromkeys(key[0] for key in scores):
        print(f"\n| {group} | energy score | {' | '.join(COLUMNS)} | in 90 % intervals | best beams |\n{'|---' * 8}|")
        for method in METHODS:
            mean = np.nanmean(scores[group, method], axis=0)
            held, found = ("/".join(f"{each:.2f}" for each in part) for part in (mean[5:9], mean[9:]))
            print(f"| {method} | {' | '.join(f'{each:.2f}' for each in mean[:5])} | {held} | {found} |")


if __name__ == "__main__":
    main()
