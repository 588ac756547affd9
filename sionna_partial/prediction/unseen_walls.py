"""Number of walls that a straight line meets in unknown cells, and its effect on links through walls.

A U-Net (Ronneberger, Fischer and Brox 2015) estimates the walls per metre along x and y in each unknown cell; a second
network corrects the integral over a line. `training.walls` trains both on procedural buildings. Constants of the loss
were fitted to procedural buildings with 3 to 26 dB per wall (`benchmarks/unseen_walls.py`).
"""

import functools
import io
import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from sionna_partial.arrays import Floats, States
from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.files import atomic_write
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.evaluate import Network, array_ops
from sionna_partial.prediction.features import LinkFeatures, context_of
from sionna_partial.prediction.map_training import kernel_starts, u_net
from sionna_partial.prediction.paper_networks import import_keras, layer
from sionna_partial.prediction.predictor_files import shipped_bytes
from sionna_partial.prediction.rule import RARE, Parts
from sionna_partial.prediction.space import kept_by_map
from sionna_partial.prediction.unobserved import centred_grid, overlaps
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.settings import TraceSettings

if TYPE_CHECKING:
    import keras

CELL_M = 0.3

WEIGHTS_FILE = PREDICTORS_FOLDER / "unseen_walls.npz"

_WIDTHS, _UNITS = (16, 32, 48, 64), 24
_LINE_INPUTS = 6
_POINTS, _LENGTH_M = 96, 3.0
"""Number of integration points on a line, and the unit of lengths [m]."""

_FIRST, _LEAST = -1.5, -4.0
"""Initial walls per metre in training, and smallest number of walls, as logits of a softplus."""

_BORDER_M, _BLURRED_CELLS, _POOLED = 7.2, 8, 2 ** (len(_WIDTHS) - 1)
"""Width of the unknown border around known cells [m]; cells at the border of an image that are blurred, and left out;
cells joined by pooling. Images are centred on the mean known cell, so that grid, origin and far cells do not matter.
"""

_LINES_AT_ONCE = 4096

_MAX_BYTES = 10_000_000

WALL_LOSSES = "the mean loss of unobserved walls"
"""Predictor's name in coverage maps."""

LONGEST_M = 50.0
"""Longest line in training: longer lines have its walls per metre [m]."""

DISPERSION = 0.2
"""Variance of the number of walls in excess of Poisson, in squares of the mean."""

MOST_COUNTED = 32
"""Largest number of unseen walls with a probability of its own."""

LOSS_OF_WALL, LARGEST_LOSS_DB = 0.78, 120.0
"""Loss of the first unseen wall relative to a known one, as other paths add power; upper limit of the loss of many
walls [dB], where paths around them dominate.
"""

FOUND_WALLS = 0.43
"""Number of walls compensated by unseen reflections, for links without traced LOS."""

AROUND_RATIO, AROUND_SPREAD = 3.0, 0.9
"""Ratio of walls on the direct line to `max_walls`, above 1, at which other paths reach half of the receivers; scale of
the logistic function of this ratio. Measured on procedural floors.
"""

LOS_GAIN_DB = 2.0
"""Gain of unseen reflections on links with LOS, times the root of the expected number of walls."""

SEEN_STD_DB, LOS_STD_DB, UNSEEN_STD = 0.5, 0.8, 0.52
"""Standard deviations of gains with an observed direct line [dB]; of links with LOS, times the root of the expected
number of walls [dB]; and of other links, times the root of the number of walls, in losses of a wall.
"""


class DirectLines(NamedTuple):
    """Direct lines of N links: ends (N, 3), unobserved and whole lengths (N,) [m], and numbers of known walls (N,)."""

    tx_m: Any
    rx_m: Any
    unobserved_m: Any
    distance_m: Any
    known: Any

    @classmethod
    def of(cls, phi: LinkFeatures) -> Self:
        context = context_of(phi)
        return cls(context.tx_m, context.rx_m, phi.unobserved_distance_m, phi.distance_m, context.straight_walls)


class WallDensity(NamedTuple):
    """Estimated walls of unknown cells: walls per metre (1, ny, nx, 2) along x and y, and the corner [m]."""

    per_m: Any
    origin_m: Floats
    lines: Any

    def counts(self, lines: DirectLines, ops: Any = array_ops) -> Any:
        """Return the expected number of unseen walls on each line (N,); `ops` is `array_ops`, or keras.ops."""
        starts = range(0, max(1, len(lines.known)), _LINES_AT_ONCE)
        parts = (DirectLines._make(column[first : first + _LINES_AT_ONCE] for column in lines) for first in starts)
        return ops.concatenate([self._counts(part, ops) for part in parts])

    def _counts(self, lines: DirectLines, ops: Any) -> Any:
        start, end = ((end_m[:, :2] - self.origin_m)[None] / CELL_M for end_m in (lines.tx_m, lines.rx_m))
        scale = LONGEST_M / ops.maximum(lines.distance_m, LONGEST_M)
        integral = scale * walls_met(self.per_m, start, end, ops)[0]
        lengths_m = scale * lines.unobserved_m, scale * lines.distance_m
        found = corrected(self.lines, integral, *lengths_m, scale * lines.known, ops)
        return ops.where(lines.unobserved_m > 0.0, found / scale, 0.0)


class UnseenWalls(NamedTuple):
    """Networks for the walls of cells and the corrections of lines: Keras models before training."""

    cells: Any
    lines: Any

    @classmethod
    def untrained(cls, seed: int = 0) -> Self:
        keras, start = import_keras(), kernel_starts(seed)
        return cls(_cell_network(keras, start), _line_network(keras, start))

    @classmethod
    @functools.cache
    def shipped(cls) -> Self:
        """Return the trained networks as functions of arrays."""
        with np.load(io.BytesIO(shipped_bytes(WEIGHTS_FILE, _MAX_BYTES)), allow_pickle=False) as stored:
            return cls(*(Network(json.loads(str(stored[name])), _numbered(stored, name)) for name in cls._fields))

    @staticmethod
    @functools.cache
    def keras_lines() -> "keras.Model":
        """Return the trained corrections of lines as a Keras model, for derivatives."""
        model = UnseenWalls.untrained().lines
        with np.load(io.BytesIO(shipped_bytes(WEIGHTS_FILE, _MAX_BYTES)), allow_pickle=False) as stored:
            model.set_weights([*itertools.islice(_numbered(stored, "lines"), len(model.weights))])
        return model

    def save(self, path: Path) -> None:
        """Write the configuration and the weights of trained Keras models."""
        arrays: dict[str, Any] = {}
        for name, model in self._asdict().items():
            arrays[name] = np.array(json.dumps(json.loads(model.to_json())["config"]))
            arrays |= {f"{name}_{number}": values for number, values in enumerate(model.get_weights())}
        with atomic_write(path) as stream:
            np.savez_compressed(stream, **arrays)

    @staticmethod
    @kept_by_map
    def shipped_of_map(partial: PartialMap) -> WallDensity:
        """Return the walls of a map by the trained networks, which are kept with it."""
        return UnseenWalls.shipped().of_map(partial)

    def of_map(self, partial: PartialMap) -> WallDensity:
        part = _known_part(partial)
        known, border = part.state != CellState.UNKNOWN, _BORDER_M / CELL_M
        known |= not known.any()
        shape, first = centred_grid(np.argwhere(known), CELL_M / part.resolution_m, border, _POOLED)
        start_m = np.array(part.origin_m) + part.resolution_m * first[::-1]
        image = map_image(part, shape, np.round(first[::-1], 6))
        per_m = _symmetric_walls(self.cells, image[None].astype(np.float32))
        inner = slice(_BLURRED_CELLS, -_BLURRED_CELLS)
        return WallDensity(per_m[:, inner, inner], start_m + _BLURRED_CELLS * CELL_M, self.lines)


def _cell_network(keras: Any, start: Callable[[], Any]) -> "keras.Model":
    image = keras.Input((None, None, 3), name="image", dtype="float32")
    x = u_net(keras, start, image, _WIDTHS)
    options = {"kernel_initializer": start(), "bias_initializer": keras.initializers.Constant(_FIRST)}
    return keras.Model(image, layer(keras, "Conv2D", "per_m", 2, 1, activation="softplus", **options)(x), name="cells")


def _line_network(keras: Any, start: Callable[[], Any]) -> "keras.Model":
    line = keras.Input((_LINE_INPUTS,), name="line", dtype="float32")
    x = layer(keras, "Dense", "hidden", _UNITS, activation="silu", kernel_initializer=start())(line)
    return keras.Model(line, layer(keras, "Dense", "outputs", 2, kernel_initializer="zeros")(x), name="lines")


def _numbered(stored: Mapping[str, Any], name: str) -> Iterator[Any]:
    return (stored[f"{name}_{number}"] for number in itertools.count())


def _known_part(partial: PartialMap) -> PartialMap:
    known = partial.state != CellState.UNKNOWN
    if not known.any():
        return partial
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    x_m, y_m = np.array(partial.origin_m) + partial.resolution_m * np.array([columns[0], rows[0]])
    part = partial.state[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return PartialMap(part, partial.resolution_m, (float(x_m), float(y_m)))


def map_image(
    partial: PartialMap, shape: tuple[int, int] | None = None, start: Floats | tuple[float, float] = (0.0, 0.0)
) -> NDArray[np.uint8]:
    """Return the fractions of free and wall of coarse cells (ny, nx, 2) [1/255], by default of the whole map."""
    coarse = CELL_M / partial.resolution_m
    counts = shape or [max(1, math.ceil(count / coarse - 1e-9)) for count in partial.shape]
    rows, columns = (
        overlaps(first + np.arange(count + 1.0) * coarse, fine)
        for first, count, fine in zip((start[1], start[0]), counts, partial.shape, strict=True)
    )
    kinds = CellState.FREE, CellState.WALL
    fractions = [rows @ (partial.state == kind).astype(np.float64) @ columns.T for kind in kinds]
    return np.round(255.0 * np.stack(fractions, axis=-1)).astype(np.uint8)


def walls_per_m(cells: Any, images: Any, ops: Any = array_ops, *, training: bool = False) -> Any:
    """Return the walls per metre (B, ny, nx, 2) along x and y of images (B, ny, nx, 2) in [0, 255].

    `ops` is `array_ops` for a `Network`, or keras.ops for a Keras model.
    """
    known = images / 255.0
    unknown = ops.maximum(1.0 - ops.sum(known, axis=-1, keepdims=True), 0.0)  # fractions are rounded
    options = {"training": True} if training else {}
    return cells(ops.concatenate([known, unknown], axis=-1), **options) * unknown


def _symmetric_walls(cells: Any, images: Floats) -> Floats:
    """Return the mean walls per metre over the eight turned and mirrored images."""
    total = np.zeros((*images.shape[:3], 2), dtype=np.float32)
    for turned, up, right in itertools.product((False, True), (1, -1), (1, -1)):
        view = images[:, ::up, ::right]
        found = walls_per_m(cells, np.ascontiguousarray(view.swapaxes(1, 2) if turned else view))
        total += (found.swapaxes(1, 2)[..., ::-1] if turned else found)[:, ::up, ::right]
    return total / 8.0


def walls_met(per_m: Any, start: Any, end: Any, ops: Any = array_ops) -> Any:
    """Integrate walls per metre (B, ny, nx, 2) over lines (B, R) from `start` to `end` (B, R, 2) [cells].

    Walls per metre are bilinear between the centres of cells, so that integrals have derivatives by the ends.
    """
    batch, ny, nx, _ = per_m.shape
    at = ops.cast((np.arange(_POINTS) + 0.5) / _POINTS, start.dtype)
    points = start[:, :, None] + (end - start)[:, :, None] * at[:, None] - 0.5
    within = [ops.clip(points[..., axis], 0.0, count - 1.0) for axis, count in enumerate((nx, ny))]
    first = [ops.minimum(ops.floor(x), count - 2.0) for x, count in zip(within, (nx, ny), strict=True)]
    right, up = (ops.stack([1.0 - (x - low), x - low], axis=-1) for x, low in zip(within, first, strict=True))
    column, row = (ops.cast(low, "int64") for low in first)
    corners = [per_m[:, above : ny - 1 + above, aside : nx - 1 + aside] for above in (0, 1) for aside in (0, 1)]
    patches = ops.reshape(ops.stack(corners, axis=-2), (-1, 2, 2, 2))
    index = (np.arange(batch)[:, None, None] * (ny - 1) + row) * (nx - 1) + column
    values = ops.cast(ops.take(patches, index, axis=0), start.dtype)
    weights = up[..., None] * right[..., None, :] / _POINTS
    return ops.sum(ops.sum(weights[..., None] * values, axis=(2, 3, 4)) * ops.abs(end - start), axis=-1) * CELL_M


def corrected(lines: Any, integral: Any, unobserved_m: Any, distance_m: Any, known: Any, ops: Any = array_ops) -> Any:
    lengths = (ops.log(1.0 + each_m / _LENGTH_M) for each_m in (unobserved_m, distance_m))
    share, none = unobserved_m / (distance_m + 0.1), ops.cast(known == 0.0, integral.dtype)
    inputs = ops.stack([ops.log(integral + 0.02), *lengths, ops.log(1.0 + known), share, none], axis=-1)
    outputs = lines(ops.cast(ops.reshape(inputs, (-1, _LINE_INPUTS)), "float32"))
    outputs = ops.cast(ops.reshape(outputs, (*integral.shape, 2)), integral.dtype)
    return integral * ops.exp(outputs[..., 0]) + ops.softplus(outputs[..., 1] + _LEAST)


def count_probabilities(walls: Any, ops: Any = array_ops) -> Any:
    """Return the negative binomial probabilities (K, N) of 0, 1, ... and K - 1 or more walls, given the mean (N,)."""
    count, failures = np.arange(MOST_COUNTED)[:, None], 1.0 / DISPERSION
    ratios = (count + failures) / (count + 1.0) * (walls / (walls + failures))
    none = (1.0 + DISPERSION * walls) ** -failures
    probabilities = none * ops.concatenate([ops.ones_like(ratios[:1]), ops.cumprod(ratios, axis=0)])
    most = ops.maximum(1.0 - ops.sum(probabilities[:-1], axis=0, keepdims=True), 0.0)
    return ops.concatenate([probabilities[:-1], most])


class WallTrace(NamedTuple):
    """Traced links through walls of one material: state, gain and loss of a wall [dB], known walls on the line (N,)."""

    link_state: States
    gain_db: Any
    wall_loss_db: Any
    known: Floats

    @classmethod
    def of(cls, phi: LinkFeatures) -> Self:
        context = context_of(phi)
        return cls(phi.link_state, phi.gain_db, context.wall_loss_db, context.straight_walls)


def by_mean_losses(
    trace: WallTrace, walls: Any, max_walls: int = TraceSettings.max_walls, ops: Any = array_ops
) -> Parts:
    """Return the distributions of links through walls; `walls` (N,) are the expected unseen walls on the direct lines.

    `ops` is `array_ops`, or keras.ops for tensors.
    """
    starts = range(0, max(1, len(trace.known)), _LINES_AT_ONCE)
    blocks = [slice(first, first + _LINES_AT_ONCE) for first in starts]
    found = [_by_mean_losses(WallTrace._make(each[at] for each in trace), walls[at], max_walls, ops) for at in blocks]
    probabilities, means_db, stds_db = (ops.concatenate(parts, axis=1) for parts in zip(*found, strict=True))
    return probabilities, means_db, stds_db


def _by_mean_losses(trace: WallTrace, walls: Any, max_walls: int, ops: Any) -> Parts:
    los, reached = trace.link_state == LinkState.LOS, trace.gain_db > GAIN_FLOOR_DB
    probabilities = count_probabilities(walls, ops)
    count = np.arange(float(len(probabilities)))[:, None]
    loss_db = LOSS_OF_WALL * trace.wall_loss_db * np.maximum(count - np.where(los, 0.0, FOUND_WALLS), 0.0)
    near = 1.0 / (1.0 + loss_db / LARGEST_LOSS_DB)
    gain_db = trace.gain_db - loss_db * near
    std_db = ops.sqrt(SEEN_STD_DB**2 + (UNSEEN_STD * trace.wall_loss_db * near**2) ** 2 * count)
    ratio = (trace.known + count) / max_walls
    around = np.where(ratio > 1.0, expit((AROUND_RATIO - ratio) / AROUND_SPREAD), 1.0)
    around = around * (0.5 + 0.5 * ops.erf((gain_db - GAIN_FLOOR_DB) / (math.sqrt(2.0) * std_db)))
    linked = ops.where((count == 0) & reached, 1.0, ops.where(reached, around, 0.0))
    p_los = ops.where(los, probabilities[0], 0.0)
    joint = ops.where((count > 0) | ~los, probabilities * linked, 0.0)
    p_nlos = ops.sum(joint, axis=0)
    weights = joint + RARE * (count == 1)
    weights = weights / ops.sum(weights, axis=0)
    gain_db = ops.maximum(gain_db, GAIN_FLOOR_DB)
    mean_db = ops.sum(weights * gain_db, axis=0)
    variance = ops.sum(weights * (std_db**2 + (gain_db - mean_db) ** 2), axis=0)
    nothing, some = ops.zeros_like(walls), walls > 0.0
    root = ops.where(some, ops.sqrt(ops.where(some, walls, 1.0)), 0.0)
    los_db = ops.minimum(trace.gain_db + LOS_GAIN_DB * root, 0.0)
    return (
        ops.stack([ops.maximum(1.0 - p_los - p_nlos, 0.0), p_los, p_nlos]),
        ops.stack([nothing + GAIN_FLOOR_DB, los_db, mean_db]),
        ops.stack([nothing, ops.sqrt(SEEN_STD_DB**2 + LOS_STD_DB**2 * walls), ops.sqrt(variance)]),
    )
