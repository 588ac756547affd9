"""Training of `UnseenWalls`: walls on lines through procedural buildings that a robot has not seen."""

import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial as bind
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.constants import DEFAULT_HEIGHT_M, CellState
from sionna_partial.exploration.explore import explore
from sionna_partial.lab.datasets.home_links import home_sensor, map_area, points_in
from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.map_training import adam_w
from sionna_partial.prediction.paper_networks import import_keras, tf
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.prediction.unseen_walls import CELL_M, UnseenWalls, corrected, map_image, walls_met, walls_per_m
from sionna_partial.process import core_count
from sionna_partial.settings import HomeKind, Material, SceneSettings, TraceSettings
from sionna_partial.tracing.positions import nearest_m
from sionna_partial.tracing.simulation import Simulation
from sionna_partial.worlds.homes import make_home

CAMERA, ROBOTS, LARGE = (500_000, 350), (530_000, 200), (520_000, 60)
"""First seeds and numbers of homes explored by a camera, homes explored by robots, and floors and halls."""

STEPS, FRACTIONS = (10, 30, 60, 100, 200), (0, 0.1, 0.25, 0.5, 0.75)
"""Stages of exploration: steps of the camera, and area fractions observed by robots."""

TRANSMITTERS, RECEIVERS, MARGIN_M = 10, 80, 1.5
"""Numbers of ends of lines in a building, and the unknown margin around it [m]."""

LEAST_UNSEEN_M, LEAST_M, FEWEST_LINES = 0.05, 0.3, 30
"""Smallest unobserved and whole length of a line [m], and smallest number of lines of a map."""

STEPS_OF_TRAINING = 1_400

IMAGE_CELLS, IMAGES, LINES = 96, 16, 100
"""Edge of the part of a map that is read [cells], and numbers of parts per gradient step and of lines per part."""

_TRIALS, _FEWEST_IN_IMAGE = 20, 20
_TRACE = (
    TraceSettings(5e9, max_depth=0, diffraction=False, refraction=True, max_walls=16),
    SceneSettings(Material.named("drywall")),
)


class Lines(NamedTuple):
    """Lines (N,) on a partial map: its image, ends (N, 2) [cells], unseen and known walls, lengths [m]."""

    image: NDArray[np.uint8]
    start: NDArray[np.float32]
    end: NDArray[np.float32]
    unseen: NDArray[np.float32]
    unobserved_m: NDArray[np.float32]
    distance_m: NDArray[np.float32]
    known: NDArray[np.float32]

    def taken(self, rows: NDArray[np.intp]) -> "Lines":
        """Select lines of the map."""
        return Lines(self.image, *(column[rows] for column in self[1:]))


def lines_of(seed: int, kind: HomeKind | None, robot: bool) -> list[Lines]:
    """Make a building, explore it, and count the walls of lines between random points on every map.

    Return no lines if two of the points are too near to be traced.
    """
    home = map_area(make_home(seed, kind), MARGIN_M)
    settings = DatasetSettings(sensor="mixed") if robot else DatasetSettings()
    sensor = home_sensor(str(seed), settings)
    maps = explore(home, FRACTIONS if robot else STEPS, seed, sensor=sensor)
    maps = [each for number, each in enumerate(maps) if number == 0 or each != maps[number - 1]]
    free = np.logical_and.reduce([each.state != CellState.WALL for each in (home, *maps)])
    free &= home.state == CellState.FREE
    rng = np.random.default_rng([7, seed])
    tx_m, rx_m = (points_in(free, count, home, DEFAULT_HEIGHT_M, rng) for count in (TRANSMITTERS, RECEIVERS))
    distance_m = np.linalg.norm(tx_m[:, None] - rx_m, axis=2).ravel()
    if distance_m.min() < nearest_m(_TRACE[0].frequency_hz):
        return []
    every = _walls(home, tx_m, rx_m)
    start, end = np.repeat(tx_m, len(rx_m), axis=0), np.tile(rx_m, (len(tx_m), 1))
    found = []
    for each in maps:
        unobserved_m, known = unobserved_lengths_m(each, start, end), _walls(each, tx_m, rx_m)
        rows = np.isfinite(every - known) & (unobserved_m > LEAST_UNSEEN_M) & (distance_m > LEAST_M)
        if rows.sum() >= FEWEST_LINES:
            cells = ((end_m[:, :2] - home.origin_m) / CELL_M for end_m in (start, end))
            columns = *cells, np.maximum(every - known, 0.0), unobserved_m, distance_m, known
            found.append(Lines(map_image(each), *(column[rows].astype(np.float32) for column in columns)))
    return found


def _walls(partial: PartialMap, tx_m: Floats, rx_m: Floats) -> Floats:
    """Return the number of walls on each direct line (T N,); NaN beyond the largest traced number."""
    links = Simulation(partial, *_TRACE).links(tx_m, rx_m, polarisations=1, progress=False)
    count = np.full(links.gain_db.shape, np.nan)
    count[links.path_tx, links.path_rx] = np.count_nonzero(links.interactions, axis=1)
    return count.ravel()


def all_lines() -> Iterator[list[Lines]]:
    """Yield the lines of each training building, made on all cores."""
    kinds: tuple[HomeKind, ...] = ("floor", "floor", "hall")
    jobs: list[tuple[int, HomeKind | None, bool]] = [(CAMERA[0] + number, None, False) for number in range(CAMERA[1])]
    jobs += [(ROBOTS[0] + number, None, True) for number in range(ROBOTS[1])]
    jobs += [(LARGE[0] + number, kinds[number % len(kinds)], True) for number in range(LARGE[1])]
    with ProcessPoolExecutor(core_count(), get_context("spawn")) as pool:
        yield from pool.map(lines_of, *zip(*jobs, strict=True))


def fit_unseen_walls(maps: list[Lines], steps: int = STEPS_OF_TRAINING, seed: int = 0) -> UnseenWalls:
    """Train by Poisson likelihood; equal lines and seed give equal weights."""
    networks = UnseenWalls.untrained(seed)
    weights = [weight for network in networks for weight in network.trainable_variables]
    optimizer, ops = adam_w(weights, steps), import_keras().ops

    @bind(tf.function, autograph=False)
    def step(batch: Lines) -> None:
        with tf.GradientTape() as tape:
            per_m = walls_per_m(networks.cells, batch.image, ops, training=True)
            integral = walls_met(per_m, batch.start, batch.end, ops)
            mean = corrected(networks.lines, integral, batch.unobserved_m, batch.distance_m, batch.known, ops)
            loss = tf.reduce_mean(mean - batch.unseen * tf.math.log(mean))
        optimizer.apply_gradients(zip(tape.gradient(loss, weights), weights, strict=True))

    for batch in _batches(maps, steps, np.random.default_rng(seed)):
        step(batch)
    return networks


def _batches(maps: list[Lines], steps: int, rng: np.random.Generator) -> Iterator[Lines]:
    order: list[int] = []
    for _ in range(steps):
        parts: list[Lines] = []
        while len(parts) < IMAGES:
            order = order or rng.permutation(len(maps)).tolist()
            part = _part(maps[order.pop()], rng)
            parts += [] if part is None else [part]
        yield Lines(*(np.stack(column).astype(np.float32) for column in zip(*parts, strict=True)))  # type: ignore[arg-type]


def _part(lines: Lines, rng: np.random.Generator) -> Lines | None:
    for _ in range(_TRIALS):
        spare = [count - IMAGE_CELLS for count in lines.image.shape[1::-1]]
        corner = np.array([rng.integers(min(0, most), max(0, most) + 1) for most in spare])
        ends = (end - corner.astype(np.float32) for end in (lines.start, lines.end))
        rows = np.flatnonzero(np.logical_and.reduce([((end >= 0) & (end < IMAGE_CELLS)).all(axis=1) for end in ends]))
        if len(rows) >= _FEWEST_IN_IMAGE:
            break
    else:
        return None
    image = np.zeros((IMAGE_CELLS, IMAGE_CELLS, lines.image.shape[2]), dtype=np.uint8)
    (x, y), (ny, nx) = corner, lines.image.shape[:2]
    top, left = max(y, 0), max(x, 0)
    known = lines.image[top : min(y + IMAGE_CELLS, ny), left : min(x + IMAGE_CELLS, nx)]
    image[top - y : top - y + known.shape[0], left - x : left - x + known.shape[1]] = known
    part, turn = lines.taken(rng.choice(rows, LINES)), int(rng.integers(8))
    middle = corner + IMAGE_CELLS / 2
    start, end = (
        turned_offsets((each - middle).astype(np.float32), turn) + IMAGE_CELLS / 2 for each in (part.start, part.end)
    )
    return part._replace(image=turned(image[None], turn)[0], start=start, end=end)


def turned(image: NDArray[np.uint8], turn: int) -> NDArray[np.uint8]:
    """Return one of the eight orientations of squares (K, S, S, C)."""
    image = image[:, :, ::-1] if turn & 1 else image
    image = image[:, ::-1] if turn & 2 else image
    return image.transpose(0, 2, 1, 3) if turn & 4 else image


def turned_offsets(offsets_m: NDArray[np.float32], turn: int) -> NDArray[np.float32]:
    """Return offsets (N, 2) in the same orientation."""
    x, y = offsets_m.T
    x = -x if turn & 1 else x
    y = -y if turn & 2 else y
    return np.stack([y, x] if turn & 4 else [x, y], axis=1)


if __name__ == "__main__":
    fit_unseen_walls([each for lines in all_lines() for each in lines]).save(Path(sys.argv[1]))
