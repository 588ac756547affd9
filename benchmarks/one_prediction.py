"""One prediction by every road: what should be equal, what should change nothing, and slopes.

Maps are the shipped apartment and house after 100 steps, the complete apartment, and a home mapped with 2 cm of range
noise; with `--shared` also a home and the map of a robot in `../shared`; or the paths given. Rows of the table, for
28 GHz and opaque walls / 5.2 GHz through walls of unknown material:

- tape: largest difference of mean and standard deviation under the gradient tape from `LinkModel.predict` [dB].
- slopes: median relative error of derivatives of the mean gain against central differences of `predict` over 2 mm,
  20 MHz, and a step of the weights of the networks; links (their number is in brackets) are left out where the number
  of listed paths differs between both ends. Predictions contain an estimate of the paths that the tolerance leaves out,
  which has no derivatives.
- lying: largest change of a mean on the turned or mirrored map, or with another origin [dB].
- cell: largest change of a mean by one changed cell more than 5 m from a link and its paths, before and after [dB].
- settings: largest change of a mean with a tolerance of 0, and with the default written, and of the traced gain with
  the paths in a folder [dB].
- swap: mean difference of means with ends swapped: predicted; traced; traced without diffraction; by the networks on
  features of swapped ends [dB].
- draws: mean difference of mean and standard deviation of drawn gains from the prediction [dB].

Run it with

    python benchmarks/one_prediction.py
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.prediction.evaluate import Network
from sionna_partial.prediction.features import context_of

FREQUENCIES_HZ = (28e9, 5.2e9)
FAR_M, NEAR_M = 5.0, 4.0
"""Distance of changed cells from links and their paths, and longest links beside which cells change [m]."""

STEPS = {"position": 1e-3, "frequency": 1e7, "weights": 2e-3}
"""Half of the differences [m], [Hz], and relative to the root mean square of the weights."""

LIDAR = sp.SensorSettings(range_noise_m=0.02, field_of_view_deg=360.0, range_m=12.0, drift_m_per_m=0.002)
SHARED = Path("../shared")

Array = NDArray[np.float64]
Row = tuple[str, str]


@dataclass(frozen=True)
class Case:
    """A map, a transmitter (3,) and receivers (N, 3) [m] on it, and the trace's settings."""

    partial: sp.PartialMap
    tx: Array
    rx: Array
    settings: sp.TraceSettings
    seed: int

    def model(self, partial: sp.PartialMap | None = None, **changed: object) -> sp.LinkModel:
        """Return the link model of the map, or of another map, with some settings changed."""
        settings = replace(self.settings, **changed) if changed else self.settings
        return sp.LinkModel(partial or self.partial, trace_settings=settings)

    def rng(self) -> np.random.Generator:
        """Return the same random numbers each time."""
        return np.random.default_rng(self.seed)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="*", type=Path, help="maps instead of the default ones")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=[*SECTIONS], help="rows of the table")
    parser.add_argument("--shared", action="store_true", help="also maps in ../shared")
    parser.add_argument("--receivers", type=int, default=24, help="receivers on each map")
    parser.add_argument("--seed", type=int, default=0, help="of positions, cells and draws")
    arguments = parser.parse_args()
    maps = {str(path): sp.load_map(path) for path in arguments.maps} or dict(default_maps(shared=arguments.shared))
    table: dict[str, list[str]] = {}
    for number, (name, partial) in enumerate(maps.items()):
        seed = arguments.seed + number
        tx, rx = positions(partial, arguments.receivers, np.random.default_rng(seed))
        for section in arguments.only:
            cases = [Case(partial, tx, rx, sp.TraceSettings(frequency_hz), seed) for frequency_hz in FREQUENCIES_HZ]
            for (row, first), (_, second) in zip(*map(SECTIONS[section], cases), strict=True):
                table.setdefault(row, []).append(f"{first} / {second}")
                print(f"{name}: {row} {first} / {second}", flush=True)
    print(f"\n| | {' | '.join(maps)} |\n|{'---|' * (1 + len(maps))}")
    for row, cells in table.items():
        print(f"| {row} | {' | '.join(cells)} |")


def default_maps(*, shared: bool) -> Iterator[tuple[str, sp.PartialMap]]:
    """Yield the maps with their names."""
    for name in ("apartment/step100", "house/step100", "apartment/complete"):
        yield name, sp.load_map(Path("scenes") / name)
    yield "home, 2 cm of noise", sp.explore(sp.make_home(74000), (0.7,), 0, sensor=LIDAR)[0]
    if shared:
        yield "Goffs after 100 steps", sp.explore(sp.load_map(SHARED / "gibson/Goffs"), (100,), 0)[0]
        yield "depot", sp.load_map(SHARED / "slam/depot.yaml")


def positions(partial: sp.PartialMap, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw a transmitter in a free cell, and receivers off walls, most of them within `NEAR_M`."""
    low, high = np.reshape(partial.bounds_m, (2, 2))
    free = np.argwhere(partial.state == sp.CellState.FREE)
    cell = free[rng.integers(len(free))][::-1] + rng.uniform(0.2, 0.8, 2)
    tx = np.array([*(np.array(partial.origin_m) + partial.resolution_m * cell), 1.55])
    near = rng.uniform(tx[:2] - NEAR_M, tx[:2] + NEAR_M, (100 * count, 2))
    plan = np.concatenate([near, rng.uniform(low, high, (100 * count, 2))])
    rx = np.column_stack([plan, rng.uniform(1.2, 1.7, len(plan))])
    good = partial.radios_can_stand(rx) & (partial.state_at(rx) != sp.CellState.WALL)
    good &= (np.linalg.norm(rx - tx, axis=1) > 0.3) & ((plan > low) & (plan < high)).all(axis=1)
    close, far = (rx[at][good[at]] for at in (slice(len(near)), slice(len(near), None)))
    return tx, np.concatenate([close[: 2 * count // 3], far[: count - 2 * count // 3]])


def tape(case: Case) -> Iterator[Row]:
    """Yield the differences of values under the gradient tape."""
    model = case.model()
    expected, found = model.predict(case.tx, case.rx), sp.DifferentiableScene(model).links(case.tx, case.rx)()
    for name, column in (("mean", "gain_mean_db"), ("std", "gain_std_db")):
        yield f"tape, {name}", f"{largest(getattr(found, column).numpy(), getattr(expected, column)):.2g}"


def slopes(case: Case) -> Iterator[Row]:
    """Yield the errors of derivatives."""
    import tensorflow as tf

    scene, rx = sp.DifferentiableScene(case.model()), case.rx[::3]
    links, model = scene.links(case.tx, rx), scene.model
    at = {"position": tf.Variable(links.base.tx_m), "frequency": tf.Variable(links.base.frequency_hz)}
    weights, rng = scene.weights, case.rng()
    along = [rng.normal(size=each.shape) * np.sqrt(np.mean(each.numpy() ** 2)) for each in weights]
    with tf.GradientTape(persistent=True) as recorded:
        means_db = tf.unstack(links(tx_m=at["position"], frequency_hz=at["frequency"]).gain_mean_db)
    found = [recorded.gradient(each, [*at.values(), *weights], unconnected_gradients="zero") for each in means_db]
    exact = {name: np.array([slope[number].numpy() for slope in found]) for number, name in enumerate(at)}
    if weights:
        steps = [np.concatenate([np.ravel(slope) for slope in each[len(at) :]]) for each in found]
        exact["weights"] = np.array(steps) @ np.concatenate([np.ravel(way) for way in along])

    def ends(name: str, step: Array | float) -> tuple[Array, Array]:
        if name == "position":
            return predicted(model, case.tx + step, rx)
        if name == "frequency":
            return predicted(case.model(frequency_hz=case.settings.frequency_hz + step), case.tx, rx)
        for weight, value, way in zip(weights, kept, along, strict=True):
            weight.assign(value + step * way)
        changed = replace(scene.predictor, network=Network.from_keras(scene.predictor.model))
        return predicted(sp.LinkModel(scene.partial, changed, case.settings), case.tx, rx)

    kept = [weight.numpy() for weight in weights]
    for name, half in STEPS.items():
        if name not in exact:
            yield f"slopes, {name}", "none"
            continue
        moves = half * np.eye(3) if name == "position" else [half]
        found = [[ends(name, way * move) for way in (1, -1)] for move in moves]
        expected = np.stack([(first[0] - last[0]) / (2.0 * half) for first, last in found], axis=-1)
        same = np.all([first[1] == last[1] for first, last in found], axis=0)
        off = np.linalg.norm(exact[name].reshape(expected.shape) - expected, axis=1)
        size = np.linalg.norm(expected, axis=1)
        moved = same & (size * half > 1e-7)
        relative = np.median(off[moved] / size[moved]) if moved.any() else 0.0
        yield f"slopes, {name}", f"{100.0 * relative:.2f} % ({same.sum()} of {len(same)})"


def predicted(model: sp.LinkModel, tx: Array, rx: Array) -> tuple[Array, NDArray[np.intp]]:
    """Return the means (N,) [dB] and numbers of listed paths."""
    links = sp.trace_links(model.simulation, tx, rx)
    return model.predict(tx, rx).gain_mean_db, np.bincount(links.path_rx, minlength=len(rx))


def lying(case: Case) -> Iterator[Row]:
    """Yield the changes on maps that lie in another way."""
    partial = case.partial
    expected = case.model().predict(case.tx, case.rx).gain_mean_db
    ways: dict[str, tuple[int, bool, tuple[float, float]]] = {
        "turned by 90 degrees": (1, False, partial.origin_m),
        "by 180": (2, False, partial.origin_m),
        "mirrored": (0, True, partial.origin_m),
        "other origin": (0, False, (1.2345, -7.771)),
    }
    for name, (quarters, mirrored, origin_m) in ways.items():
        state = partial.state[:, ::-1] if mirrored else partial.state
        turned = replace(partial, state=np.ascontiguousarray(np.rot90(state, quarters)), origin_m=origin_m)
        turn = np.linalg.matrix_power([[0, 1], [-1, 0]], quarters) @ np.diag([-1 if mirrored else 1, 1])
        ends = [
            np.concatenate([(points[..., :2] - middle(partial)) @ turn.T + middle(turned), points[..., 2:]], axis=-1)
            for points in (case.tx, case.rx)
        ]
        yield f"lying, {name}", f"{largest(case.model(turned).predict(*ends).gain_mean_db, expected):.2g}"


def middle(partial: sp.PartialMap) -> Array:
    """Return the middle of a map [m]."""
    return np.reshape(partial.bounds_m, (2, 2)).mean(axis=0)


def cell(case: Case) -> Iterator[Row]:
    """Yield the changes by one cell far away."""
    partial, model = case.partial, case.model()
    rx = case.rx[np.linalg.norm(case.rx - case.tx, axis=1) < NEAR_M]
    expected, distant = model.predict(case.tx, rx).gain_mean_db, distances(model, case.tx, rx)
    rng = case.rng()
    for state in sp.CellState:
        changes = []
        cells = rng.permutation(np.argwhere(partial.state == state))[:400]
        points = np.array(partial.origin_m) + partial.resolution_m * (cells[:, ::-1] + 0.5)
        far = distant(points) > FAR_M
        for at in np.argsort(-far.sum(axis=1), kind="stable")[:2]:
            for other in {*sp.CellState} - {state}:
                changed = partial.state.copy()
                changed[tuple(cells[at])] = other
                other_model = case.model(replace(partial, state=changed))
                still_far = far[at] & (distances(other_model, case.tx, rx)(points[at : at + 1])[0] > FAR_M)
                changes.extend(np.abs(other_model.predict(case.tx, rx).gain_mean_db - expected)[still_far])
        yield f"cell, {state.name.lower()}", f"{max(changes):.2g} ({len(changes)})" if changes else "none"


def distances(model: sp.LinkModel, tx: Array, rx: Array) -> Callable[[Array], Array]:
    """Return a function of points (K, 2) [m]: their distances (K, N) from links and their paths [m]."""
    paths = sp.trace_links(model.simulation, tx, rx)
    nodes = [
        [tx, *points[kinds > 0], rx[link]]
        for link, kinds, points in zip(paths.path_rx, paths.interactions, paths.vertices_m, strict=True)
    ]
    nodes += [[tx, end] for end in rx]
    link = np.repeat([*paths.path_rx, *range(len(rx))], [len(each) - 1 for each in nodes])
    start, end = (
        np.array([leg for each in nodes for leg in each[part]])[:, :2] for part in (slice(-1), slice(1, None))
    )
    along = end - start

    def of_points(points: Array) -> Array:
        found = np.full((len(points), len(rx)), np.inf)
        for row, point in zip(found, points, strict=True):
            part = np.clip(((point - start) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-12), 0.0, 1.0)
            np.minimum.at(row, link, np.linalg.norm(start + part[:, None] * along - point, axis=1))
        return found

    return of_points


def settings(case: Case) -> Iterator[Row]:
    """Yield the changes by settings that should not matter."""
    model = case.model()
    expected = model.predict(case.tx, case.rx).gain_mean_db
    for name, tolerance_db in (("tolerance 0", 0.0), ("default written", 0.1)):
        found = case.model(power_tolerance_db=tolerance_db).predict(case.tx, case.rx).gain_mean_db
        yield f"settings, {name}", f"{largest(found, expected):.2g}"
    with tempfile.TemporaryDirectory() as folder:
        stored, kept = (model.simulation.links(case.tx, case.rx, folder=each) for each in (folder, None))
        yield "settings, folder", f"{largest(stored.gain_db, kept.gain_db):.2g}"


def swap(case: Case) -> Iterator[Row]:
    """Yield the differences of links from links with swapped ends."""
    rx, model = case.rx[::2], case.model()
    there, back = model.features(case.tx, rx), model.features(rx, case.tx[None])
    context = context_of(there)
    ends = {"tx_m": context.rx_m, "rx_m": context.tx_m, "tx_seen": context.rx_seen, "rx_seen": context.tx_seen}
    turned = replace(there, context=replace(context, exposure=context.exposure[:, ::-1], **ends))
    means = [model.predict_features(phi).gain_mean_db for phi in (there, back, turned)]
    unbent = case.model(diffraction=False).simulation
    traces = unbent.links(case.tx, rx), unbent.links(rx, case.tx[None])
    yield "swap, predicted", mean_difference(*means[:2])
    yield "swap, traced", mean_difference(there.gain_db, back.gain_db)
    yield "swap, traced without diffraction", mean_difference(*(links.gain_db.ravel() for links in traces))
    yield "swap, networks", mean_difference(means[0], means[2])


def draws(case: Case) -> Iterator[Row]:
    """Yield the differences of draws from the prediction."""
    model = case.model()
    expected = model.predict(case.tx, case.rx)
    gain_db = sp.channels.sample_channels(model, case.tx, case.rx, n=1000, seed=case.seed).gain_db
    yield "draws, mean", f"{np.mean(gain_db.mean(axis=0) - expected.gain_mean_db):+.2f}"
    yield "draws, std", f"{np.mean(gain_db.std(axis=0) - expected.gain_std_db):+.2f}"


def largest(found: Array, expected: Array) -> float:
    """Return the largest difference."""
    return float(np.abs(found - expected).max())


def mean_difference(found: Array, expected: Array) -> str:
    """Return the mean difference, and the largest one."""
    off = np.abs(found - expected)
    return f"{off.mean():.2g} (at most {off.max():.2g})"


SECTIONS: dict[str, Callable[[Case], Iterator[Row]]] = {
    each.__name__: each for each in (tape, slopes, lying, cell, settings, swap, draws)
}

if __name__ == "__main__":
    main()
