"""Correlation of the states of links: the constants of `sionna_partial.channels.joint`, on procedural homes.

A robot explores homes of `make_home`; random links indoors are predicted on what it has seen. Two links are in outage
together, or without line of sight together, with a probability that follows from their own probabilities and the
correlation of their latents (bivariate normal). The table has, for some constants, how much likelier that makes the
pairs of states that occur than independence does [nat per pair]: links of one transmitter, of one receiver, and links
that share neither. Run

    python benchmarks/joint_links.py
"""

import argparse
import itertools

import numpy as np
from measurements import points
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

import sionna_partial as sp
from sionna_partial.channels import joint

FIRST_SEED, STEPS, TRANSMITTERS, RECEIVERS, PAIRS = 330_000, (50, 120, 250), 3, 40, 400
UNCERTAIN = (0.03, 0.97)
CONSTANTS = {"REACH_M": (0.5, 1.0, 2.0), "KNOWN_WEIGHT": (0.03, 0.1, 0.3), "OWN_VARIANCE": (0.05, 0.1, 0.3)}
GROUPS = ("same transmitter", "same receiver", "neither")
Floats = NDArray[np.float64]


def main() -> None:
    """Print the table: one constant after the other is varied."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--homes", type=int, default=20)
    maps = [each for seed in range(FIRST_SEED, FIRST_SEED + parser.parse_args().homes) for each in links_of(seed)]
    shipped = {name: getattr(joint, name) for name in CONSTANTS}
    tried = [shipped, *({**shipped, name: value} for name, values in CONSTANTS.items() for value in values)]
    print(f"| {' | '.join([*CONSTANTS, *GROUPS])} |\n|{'---|' * (len(CONSTANTS) + len(GROUPS))}")
    for constants in [each for number, each in enumerate(tried) if each not in tried[:number]]:
        for name, value in constants.items():
            setattr(joint, name, value)
        gained = np.array([gain(*each) for each in maps])
        columns = [f"{value:g}" for value in constants.values()]
        columns += [f"{np.nansum(each[:, 0]) / each[:, 1].sum():.4f}" for each in np.swapaxes(gained, 0, 1)]
        print(f"| {' | '.join(columns)} |", flush=True)


def links_of(seed: int) -> list[tuple[sp.PartialMap, Floats, Floats, Floats, NDArray[np.bool_]]]:
    """Return maps of a home, ends of links (L, 3), probabilities of outage and of no LOS (2, L), and the truth."""
    home, found = sp.make_home(seed), []
    rng = np.random.default_rng(seed)
    for partial in sp.explore(home, STEPS, seed):
        tx_m, rx_m = (points(home, partial, count, rng) for count in (TRANSMITTERS, RECEIVERS))
        rx_m = rx_m[np.linalg.norm(rx_m[:, None] - tx_m, axis=2).min(axis=1) > 0.15]
        truth, known = (sp.trace_links(each, tx_m, rx_m, progress=False) for each in (home, partial))
        prediction = sp.Predictor.load().predict(sp.link_features(partial, known).flat())
        probabilities = np.stack([prediction.p_outage, 1.0 - prediction.p_los])
        state = truth.link_state.ravel()
        ends = np.repeat(tx_m, len(rx_m), axis=0), np.tile(rx_m, (len(tx_m), 1))
        found.append(
            (partial, *ends, probabilities, np.stack([state == sp.LinkState.OUTAGE, state != sp.LinkState.LOS]))
        )
    return found


def gain(partial: sp.PartialMap, tx_m: Floats, rx_m: Floats, probabilities: Floats, truth: NDArray[np.bool_]) -> Floats:
    """Sum of log-likelihoods above independence, and number of pairs, of each group (3, 2)."""
    correlation, sums = joint.JointLatents(partial).correlation(tx_m, rx_m), np.zeros((len(GROUPS), 2))
    rng = np.random.default_rng(0)
    for probability, true in zip(probabilities, truth, strict=True):
        uncertain = np.flatnonzero((probability > UNCERTAIN[0]) & (probability < UNCERTAIN[1]))
        pairs = np.array([*itertools.combinations(uncertain, 2)], dtype=np.intp).reshape(-1, 2)
        same = [(each[pairs[:, 0]] == each[pairs[:, 1]]).all(axis=1) for each in (tx_m, rx_m)]
        for group, members in enumerate((same[0], same[1], ~same[0] & ~same[1])):
            a, b = rng.permutation(pairs[members])[:PAIRS].T
            both = together(probability[a], probability[b], correlation[a, b])
            options = [
                (~true[a] & ~true[b], 1 - probability[a] - probability[b] + both),
                (true[a] & ~true[b], probability[a] - both),
            ]
            options += [(~true[a] & true[b], probability[b] - both), (true[a] & true[b], both)]
            likelihood = np.select(*map(list, zip(*options, strict=True)))
            alone = np.where(true[a], probability[a], 1 - probability[a]) * np.where(
                true[b], probability[b], 1 - probability[b]
            )
            sums[group] += np.log(np.maximum(likelihood, 1e-4) / alone).sum(), len(a)
    return sums


def together(first: Floats, second: Floats, correlation: Floats) -> Floats:
    """Probability that two normal variables are below their quantiles, by Gauss and Legendre's rule (Drezner, 1978)."""
    x, weights = np.polynomial.legendre.leggauss(12)
    h, k = ndtri(first)[:, None], ndtri(second)[:, None]
    r = np.clip(correlation, -0.99, 0.99)[:, None] * (x + 1.0) / 2.0
    density = np.exp(-(h**2 - 2.0 * r * h * k + k**2) / (2.0 * (1.0 - r**2))) / np.sqrt(1.0 - r**2)
    return ndtr(h[:, 0]) * ndtr(k[:, 0]) + np.clip(correlation, -0.99, 0.99) / (4.0 * np.pi) * (density @ weights)


if __name__ == "__main__":
    main()
