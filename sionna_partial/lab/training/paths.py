"""Training of the `PathModel`: paths on partial maps compared with paths in the complete home."""

import math
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sionna_partial.arrays import Bools, Floats, Indices
from sionna_partial.constants import DEFAULT_HEIGHT_M, SPEED_OF_LIGHT_M_S, CellState, LinkState
from sionna_partial.exploration.explore import explore
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.paper_networks import import_keras
from sionna_partial.prediction.path_model import STATES, LinkGeometry, PathModel, survival_inputs, wrapped
from sionna_partial.prediction.unobserved import traced_unobserved_m
from sionna_partial.tracing.antennas import directions
from sionna_partial.tracing.links import TracedLinks
from sionna_partial.tracing.paths import path_gain_db
from sionna_partial.tracing.trace import trace_links
from sionna_partial.worlds.homes import make_home

ANALOGUES_OF_STATE = 3_000
"""Number of links with LOS, and of links without, whose paths are kept."""

RANGE_DB, MOST_PATHS = 25.0, 24
"""Limits for the paths of an analogue: power below the strongest path [dB], and number."""

LENGTH_M, DIRECTION, GAIN_DB = 0.3, 0.09, 4.0
"""Tolerances for equal paths: length [m], unit vectors at both ends [1], gain [dB]."""

HOME_STEPS, FLOOR_STEPS = (0, 50, 120, 250), (0, 200, 500)
TRANSMITTERS, RECEIVERS, NEAREST_M = 3, 50, 0.15
"""Exploration steps of homes and floors, numbers of random ends, and their smallest distance [m]."""

_UNITS, _PASSES, _BATCH = 20, 8, 512


@dataclass(frozen=True, eq=False)
class Example:
    """Links of one partial map: inputs and truth of survival, and analogues by state, each a key and its paths (K, 6).

    The columns of paths are the fraction of power, the excess delay [ns], zenith and azimuth at both ends [rad].
    """

    inputs: Floats
    exists: Bools
    analogues: tuple[list[tuple[Floats, Floats]], ...]


def example(partial: PartialMap, home: PartialMap, tx_m: Floats, rx_m: Floats) -> Example:
    """Trace links between (T, 3) and (N, 3) [m] on a partial map and in its home."""
    known, true = (trace_links(each, tx_m, rx_m, progress=False) for each in (partial, home))
    ends = np.repeat(tx_m, len(rx_m), axis=0), np.tile(rx_m, (len(tx_m), 1))
    geometry = LinkGeometry.of(partial, *ends, known.trace_settings.frequency_hz)
    link, true_link = known.path_link, true.path_link
    same = _same(known, link, true, true_link)
    state = true.link_state.ravel()
    indirect = np.flatnonzero((known.interactions > 0).any(axis=1) & (state[link] != LinkState.OUTAGE))
    inputs = survival_inputs(known, indirect, traced_unobserved_m(partial, known, indirect), geometry)
    inputs = np.column_stack([inputs, state[link[indirect]] == LinkState.LOS])
    new = np.ones(len(true_link), dtype=bool)
    new[same[same >= 0]] = False
    new &= (true.interactions > 0).any(axis=1)
    return Example(
        inputs, (same >= 0)[indirect], tuple(_analogues(true, true_link, new, geometry, each) for each in STATES)
    )


def _same(known: TracedLinks, link: Indices, true: TracedLinks, true_link: Indices) -> Indices:
    """Return the index of the same path in the home for each path on the partial map, or -1."""

    def points(links: TracedLinks, link: Indices) -> Floats:
        toward = [directions(angles_rad)[0] / DIRECTION for angles_rad in (links.departure_rad, links.arrival_rad)]
        length_m, gain_db = links.delay_s * SPEED_OF_LIGHT_M_S, path_gain_db(np.abs(links.a) ** 2)
        return np.column_stack([*toward, length_m / LENGTH_M, gain_db / GAIN_DB, 10.0 * link])

    if not len(true_link) or not len(link):
        return np.full(len(link), -1)
    apart, index = cKDTree(points(true, true_link)).query(points(known, link), distance_upper_bound=1.0)
    return np.where(np.isfinite(apart), index, -1)


def _analogues(
    true: TracedLinks, link: Indices, new: Bools, geometry: LinkGeometry, state: LinkState
) -> list[tuple[Floats, Floats]]:
    power, count = np.abs(true.a) ** 2, len(geometry.distance_m)
    indirect = (true.interactions > 0).any(axis=1)
    survivors = np.bincount(link, weights=power * (~new & indirect), minlength=count).astype(np.float64)
    keys = geometry.keys(state, true.gain_db.ravel(), path_gain_db(survivors))
    excess_ns = 1e9 * (true.delay_s - geometry.distance_m[link] / SPEED_OF_LIGHT_M_S)
    turned = [true.departure_rad - geometry.departure_rad[link], true.arrival_rad - geometry.arrival_rad[link]]
    rows = np.column_stack([power, excess_ns, wrapped(np.hstack(turned))])
    found = []
    for number in np.flatnonzero(true.link_state.ravel() == state):
        here = np.flatnonzero((link == number) & new)
        here = here[power[here] > power[here].max(initial=0.0) * 10.0 ** (-RANGE_DB / 10.0)]
        paths = rows[here[np.argsort(-power[here], kind="stable")][:MOST_PATHS]]
        paths[:, 0] /= paths[:, 0].sum() if len(paths) else 1.0
        found.append((keys[number], paths))
    return found


def fit_path_model(examples: Iterable[Example], seed: int = 0) -> PathModel:
    """Train on examples; equal examples and seed give an equal model."""
    inputs, exists = [], []
    banks: tuple[list[tuple[Floats, Floats]], ...] = tuple([] for _ in STATES)
    for each in examples:
        inputs.append(each.inputs)
        exists.append(each.exists)
        for bank, found in zip(banks, each.analogues, strict=True):
            bank.extend(found)
    rng = np.random.default_rng(seed)
    chosen = [[bank[index] for index in np.sort(rng.permutation(len(bank))[:ANALOGUES_OF_STATE])] for bank in banks]
    keys, paths = zip(*(each for bank in chosen for each in bank), strict=True)
    rows = np.concatenate(paths).astype(np.float16)
    return PathModel(
        _fit_survival(np.concatenate(inputs), np.concatenate(exists), seed),
        np.array(keys, dtype=np.float32),
        np.array(len(chosen[0])),
        np.cumsum([0, *map(len, paths)]),
        np.array([_spread_ns(each) for each in paths], dtype=np.float32),
        *(rows[:, columns] for columns in (0, 1, slice(2, 4), slice(4, 6))),
    )


def _spread_ns(paths: Floats) -> float:
    fraction, delay_ns = paths[:, 0], paths[:, 1]
    variance = float(fraction @ delay_ns**2 - (fraction @ delay_ns) ** 2)
    return math.sqrt(max(0.0, variance))


def _fit_survival(inputs: Floats, exists: Bools, seed: int) -> tuple[Floats, ...]:
    """Train by cross-entropy; the first layer includes the scaling of the inputs."""
    keras = import_keras()
    keras.utils.set_random_seed(seed)
    mean, std = inputs.mean(axis=0), inputs.std(axis=0) + 1e-9
    layers = [keras.layers.Dense(units, activation="relu") for units in (_UNITS, _UNITS)]
    network = keras.Sequential([keras.Input((inputs.shape[1],)), *layers, keras.layers.Dense(1, activation="sigmoid")])
    network.compile("adam", "binary_crossentropy")
    network.fit((inputs - mean) / std, exists.astype(np.float32), epochs=_PASSES, batch_size=_BATCH, verbose=0)
    kernel, bias, *rest = (np.asarray(each, dtype=np.float64) for each in network.get_weights())
    return kernel / std[:, None], bias - (mean / std) @ kernel, *rest


def made_examples(homes: int = 60, floors: int = 10, first_seed: int = 320_000) -> Iterator[Example]:
    """Yield examples of homes and office floors of `make_home` after several numbers of exploration steps."""
    for number in range(homes + floors):
        seed, is_home = first_seed + number, number < homes
        home = make_home(seed) if is_home else make_home(seed, kind="floor")
        rng = np.random.default_rng([seed, 1])
        for partial in explore(home, HOME_STEPS if is_home else FLOOR_STEPS, seed):
            tx_m, rx_m = (_points(home, count, rng) for count in (TRANSMITTERS, RECEIVERS))
            apart_m = np.linalg.norm(rx_m[:, None] - tx_m, axis=2).min(axis=1)
            yield example(partial, home, tx_m, rx_m[apart_m > NEAREST_M])


def _points(home: PartialMap, count: int, rng: np.random.Generator) -> Floats:
    row, column = rng.permutation(np.argwhere(home.state == CellState.FREE))[:count].T
    cell = np.stack([column, row], axis=1) + rng.uniform(0.25, 0.75, (len(row), 2))
    return np.column_stack([home.origin_m + cell * home.resolution_m, np.full(len(row), DEFAULT_HEIGHT_M)])


if __name__ == "__main__":
    fit_path_model(made_examples()).save(Path(sys.argv[1]))
