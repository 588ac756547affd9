"""Analogues against a learned generator of the paths that a partial map does not show.

`sample_channels` takes such paths from similar links of procedural homes (`PathModel.analogues`). Here a
recurrent network learns to write them from the same homes: path after path in order of power, each a mixture of
Gaussians of power, delay and angles given the link and the paths before it. Both serve the same draws, scored as in
`channel_samples.py`. Run

    python benchmarks/path_generator.py ../shared/gibson/*/map.yaml
    python benchmarks/path_generator.py --made 12
"""

import dataclasses
import time
from collections.abc import Iterable
from typing import Any

import keras
import numpy as np
from channel_samples import METHODS, given_homes, score_home
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.prediction.path_model import STATES, PathModel, wrapped
from sionna_partial.training.paths import MOST_PATHS, Example, made_examples

UNITS, MIXTURES, PASSES, BATCH, RATE = 96, 8, 12, 256, 3e-3
CONDITIONS, COLUMNS = 8, 6
ANGLES = np.array([False, False, False, True, False, True])
Floats = NDArray[np.float64]


def main() -> None:
    """Train the generator, score both, print the tables."""
    analogues, generator = PathModel.load(), Generator.fitted(made_examples())
    scores: dict[str, list[Floats]] = {"analogues": [], "generator": []}
    seconds = dict.fromkeys(scores, 0.0)
    for seed, (name, home) in enumerate(given_homes(__doc__)):
        for method, model in (("analogues", analogues), ("generator", generator)):
            start = time.process_time()
            scores[method].append(drawn_with(model, home, seed))
            seconds[method] += time.process_time() - start
        print(f"{name} done", flush=True)
    print_scores(scores, seconds)


def drawn_with(model: PathModel, home: sp.PartialMap, seed: int) -> Floats:
    """Mean scores of all links of a home, drawn with a model."""
    shipped, PathModel.load = PathModel.load, lambda: model  # type: ignore[method-assign]
    try:
        return score_home(home, seed)[0]["all links", METHODS[0]]
    finally:
        PathModel.load = shipped  # type: ignore[method-assign]


@dataclasses.dataclass(frozen=True, eq=False)
class Generator(PathModel):
    """A `PathModel` whose "analogues" are written by a network when they are asked for."""

    network: Any = None

    @classmethod
    def fitted(cls, examples: Iterable[Example]) -> "Generator":
        """Train on the examples of the shipped model."""
        conditions, paths = [], []
        for each in examples:
            for state, found in zip(STATES, each.analogues, strict=True):
                for key, rows in found:
                    conditions.append(condition(state, key[None])[0])
                    paths.append(rows)
        shipped = PathModel.load()
        columns = {column.name: getattr(shipped, column.name) for column in dataclasses.fields(PathModel)}
        return cls(**columns, network=train(np.array(conditions), paths))

    def analogues(self, state: sp.LinkState, keys: Floats, quantile: Floats) -> NDArray[np.intp]:
        """Write paths for links of one state, keep them, and return their numbers."""
        del quantile
        paths, counts = write(self.network, condition(state, keys), len(self.first))
        start = len(self.first) - 1
        names = {"fraction": 0, "excess_ns": 1, "departure_rad": slice(2, 4), "arrival_rad": slice(4, 6)}
        for name, at in names.items():
            object.__setattr__(self, name, np.concatenate([getattr(self, name), paths[:, at]]))
        first = np.concatenate([self.first, self.first[-1] + np.cumsum(counts)])
        object.__setattr__(self, "first", first)
        return np.arange(start, start + len(keys))


def condition(state: sp.LinkState, keys: Floats) -> Floats:
    """Return the inputs (L, 8) of the network."""
    flags = np.tile([float(state == each) for each in STATES], (len(keys), 1))
    return np.hstack([keys / [3.0, 3.0, 3.0, 1.0, 1.0, 1.0], flags])


def encoded(rows: Floats) -> Floats:
    """Paths (K, 6) as the network reads and writes them: logarithms of power and delay, angles."""
    power, excess_ns = np.log10(np.maximum(rows[:, 0], 1e-4)), np.log1p(np.maximum(rows[:, 1], 0.0) / 2.0)
    return np.column_stack([power, excess_ns, rows[:, 2:]])


def train(conditions: Floats, paths: list[Floats]) -> Any:
    """Train by maximum likelihood; return the weights."""
    count = len(paths)
    tokens = np.zeros((count, MOST_PATHS + 1, COLUMNS), np.float32)
    more = np.zeros((count, MOST_PATHS + 1), np.float32)
    counted = np.zeros((count, MOST_PATHS + 1), np.float32)
    for number, rows in enumerate(paths):
        tokens[number, : len(rows)] = encoded(rows)
        more[number, : len(rows)] = 1.0
        counted[number, : len(rows) + 1] = 1.0
    before = np.concatenate([np.zeros_like(tokens[:, :1]), tokens[:, :-1]], axis=1)
    inputs = np.concatenate([features(before), np.repeat(conditions[:, None], MOST_PATHS + 1, axis=1)], axis=2)
    targets = np.concatenate([tokens, more[..., None], counted[..., None]], axis=2)
    keras.utils.set_random_seed(0)
    given = keras.Input((MOST_PATHS + 1, inputs.shape[2]))
    hidden = keras.layers.GRU(UNITS, return_sequences=True, reset_after=False)(given)
    hidden = keras.layers.Dense(UNITS, activation="relu")(keras.layers.Concatenate()([hidden, given]))
    network = keras.Model(given, keras.layers.Dense(1 + MIXTURES * (1 + 2 * COLUMNS))(hidden))
    steps = PASSES * -(-count // BATCH)
    network.compile(keras.optimizers.Adam(keras.optimizers.schedules.CosineDecay(RATE, steps)), loss)
    history = network.fit(inputs, targets, epochs=PASSES, batch_size=BATCH, verbose=0, validation_split=0.1)
    print(f"{count} links; negative log-likelihood {[round(each, 2) for each in history.history['val_loss']]}")
    return [np.asarray(each, dtype=np.float64) for each in network.get_weights()]


def features(tokens: Floats) -> Floats:
    """Paths as inputs: angles of azimuth as sine and cosine."""
    azimuths = tokens[..., ANGLES]
    return np.concatenate([tokens[..., ~ANGLES], np.sin(azimuths), np.cos(azimuths)], axis=-1)


def loss(targets: Any, outputs: Any) -> Any:
    """Negative log-likelihood of whether a path follows, and which."""
    ops = keras.ops
    tokens, more, counted = targets[..., None, :COLUMNS], targets[..., COLUMNS], targets[..., COLUMNS + 1]
    stop, weight, mean, log_std = split(outputs, ops)
    off = tokens - mean
    off = ops.where(ANGLES, ops.arctan2(ops.sin(off), ops.cos(off)), off)
    density = ops.sum(-0.5 * (off * ops.exp(-log_std)) ** 2 - log_std - 0.919, axis=-1)
    follows = ops.logsumexp(density + ops.log_softmax(weight, axis=-1), axis=-1)
    binary = more * ops.log_sigmoid(stop) + (1.0 - more) * ops.log_sigmoid(-stop)
    return -ops.mean(ops.sum(counted * binary + more * follows, axis=1))


def split(outputs: Any, ops: Any) -> tuple[Any, Any, Any, Any]:
    """Logit of another path; logits, means and logarithms of deviations of the mixture."""
    stop, weight, rest = outputs[..., 0], outputs[..., 1 : 1 + MIXTURES], outputs[..., 1 + MIXTURES :]
    rest = ops.reshape(rest, (*(-1 if size is None else size for size in outputs.shape[:-1]), MIXTURES, 2 * COLUMNS))
    return stop, weight, rest[..., :COLUMNS], ops.clip(rest[..., COLUMNS:], -5.0, 2.0)


def write(weights: list[Floats], conditions: Floats, seed: int) -> tuple[Floats, NDArray[np.intp]]:
    """Paths of links one after the other, and the number of each."""
    kernel, recurrent, bias, dense, dense_bias, out, out_bias = weights
    rng, count = np.random.default_rng(seed), len(conditions)
    state, token = np.zeros((count, UNITS)), np.zeros((count, COLUMNS))
    tokens, more = np.zeros((count, MOST_PATHS, COLUMNS)), np.ones((count, MOST_PATHS), bool)
    alive = np.arange(count)
    for number in range(MOST_PATHS):
        given = np.concatenate([features(token), conditions[alive]], axis=1)
        x = given @ kernel + bias
        h = state @ recurrent[:, : 2 * UNITS]
        update, reset = (1.0 / (1.0 + np.exp(-x[:, at] - h[:, at])) for at in (slice(UNITS), slice(UNITS, 2 * UNITS)))
        candidate = np.tanh(x[:, 2 * UNITS :] + (reset * state) @ recurrent[:, 2 * UNITS :])
        state = update * state + (1.0 - update) * candidate
        hidden = np.maximum(np.hstack([state, given]) @ dense + dense_bias, 0.0)
        stop, weight, mean, log_std = split(hidden @ out + out_bias, np)
        chosen = np.argmax(weight + rng.gumbel(size=weight.shape), axis=1)[:, None, None]
        mean, log_std = (np.take_along_axis(each, chosen, axis=1)[:, 0] for each in (mean, log_std))
        token = mean + np.exp(log_std) * rng.standard_normal(mean.shape)
        token[:, 0], token[:, 1] = np.minimum(token[:, 0], 0.0), np.clip(token[:, 1], 0.0, 6.0)
        follows = rng.random(len(alive)) < 1.0 / (1.0 + np.exp(-stop))
        more[alive[~follows], number:] = False
        alive, state, token = alive[follows], state[follows], token[follows]
        tokens[alive, number] = token
    rows = tokens[more]
    power, excess_ns = 10.0 ** rows[:, 0], 2.0 * np.expm1(rows[:, 1])
    return np.column_stack([power, excess_ns, wrapped(rows[:, 2:])]), more.sum(axis=1)


def print_scores(scores: dict[str, list[Floats]], seconds: dict[str, float]) -> None:
    """Print mean scores over homes and the paired lead of the analogues in energy score."""
    rows = {method: np.array(values) for method, values in scores.items()}
    lead = rows["generator"][:, 0] - rows["analogues"][:, 0]
    print("\n| | energy score | CRPS gain, delay, departure, arrival | 90 % intervals hold | best beams | time |")
    print("|---|---|---|---|---|---|")
    for method, values in rows.items():
        mean = np.nanmean(values, axis=0)
        crps, held, found = (
            "/".join(f"{each:.2f}" for each in mean[part]) for part in (slice(1, 5), slice(5, 9), slice(9, None))
        )
        time_ratio = seconds[method] / seconds["analogues"]
        print(f"| {method} | {mean[0]:.3f} | {crps} | {held} | {found} | {time_ratio:.2f} |")
    print(f"\nlead of the analogues in energy score: {lead.mean():.3f} +- {lead.std(ddof=1) / np.sqrt(len(lead)):.3f}")


if __name__ == "__main__":
    main()
