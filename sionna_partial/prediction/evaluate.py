"""Keras networks evaluated by NumPy: importing TensorFlow takes longer than a prediction.

The layers, activations and options are those of the networks of this package, in inference and single precision.
"""

import io
import itertools
import json
import re
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import erf, expit, log_softmax

if TYPE_CHECKING:
    import keras

Array = NDArray[np.float32]
Shape = tuple[int | None, ...]
Options = Mapping[str, Any]
Layer = Callable[..., Any]

_BLOCK_NUMBERS = 2**18
"""Numbers read for a block of image rows in a convolution: they stay in the cache of a core."""

_SOME_LENGTH = 64
"""Stands for axes of any length while shapes are derived."""


class Network:
    """A functional Keras model in inference: a function of float32 arrays, or of mappings of them by name.

    Parameters
    ----------
    config : mapping
        Its entry "config" of ``model.to_json()``.
    weights : iterable of arrays
        As from ``model.get_weights()``.

    Attributes
    ----------
    name : str
    input, output : tuple, or dict of tuples
        Shapes, with None for axes of any length.
    layers : dict
        Functions by the name of the layer; models in the model are networks.
    options : dict
        Configurations of the layers by name.

    Raises
    ------
    ValueError, KeyError, TypeError
        For layers, options or weights that are not supported, or do not fit together.
    """

    def __init__(self, config: Options, weights: Iterable[Array]) -> None:
        self.name: str = config["name"]
        self._input, self._output = config["input_layers"], config["output_layers"]
        self.layers: dict[str, Any] = {}
        self.options: dict[str, Options] = {}
        self._calls: dict[str, Options] = {}
        shapes: dict[str, Shape] = {}
        weights = iter(weights)
        for entry in config["layers"]:
            kind, name, options = (entry[key] for key in ("class_name", "name", "config"))
            if kind == "InputLayer":
                shapes[name] = tuple(options["batch_shape"])
            else:
                self.layers[name], self.options[name] = _LAYERS[kind](options, weights), options
                (self._calls[name],) = entry["inbound_nodes"]
        self.input = _by_name(self._input, shapes)
        self.output = self._shapes_out(shapes)

    def _shapes_out(self, shapes: Mapping[str, Shape]) -> Any:
        """Evaluate no rows: this fails where layers and weights do not fit together."""

        def shape(found: Array) -> Shape:
            return (None, *((None,) * (found.ndim - 2) if any_length else found.shape[1:-1]), found.shape[-1])

        any_length = any(None in each[1:] for each in shapes.values())
        rows = {name: np.zeros((0, *(size or _SOME_LENGTH for size in each[1:]))) for name, each in shapes.items()}
        found = self(_by_name(self._input, rows))
        return {name: shape(each) for name, each in found.items()} if isinstance(found, dict) else shape(found)

    def __call__(self, inputs: Any) -> Any:
        """Return the outputs for rows of inputs, in the shapes of `input` and `output`."""
        one = isinstance(self._input, list)
        given = {self._input[0]: inputs} if one else {end[0]: inputs[name] for name, end in self._input.items()}
        values = {name: np.asarray(each, dtype=np.float32) for name, each in given.items()}
        with _one_blas_thread():
            for name, call in self._calls.items():
                options = {key: each for key, each in call["kwargs"].items() if key != "mask"}
                values[name] = self.layers[name](*_filled(call["args"], values), **options)
        return _by_name(self._output, values)

    @classmethod
    def from_keras(cls, model: "keras.Model") -> Self:
        """Return the network of a functional Keras model."""
        return cls(json.loads(model.to_json())["config"], model.get_weights())

    @classmethod
    def read(cls, config: Options, weights: bytes, most: int) -> Self:
        """Return the network of a configuration, and of an HDF5 file of weights by Keras of up to `most` bytes."""
        import h5py

        with h5py.File(io.BytesIO(weights)) as stored:
            outside = stored.visititems_links(lambda name, link: None if isinstance(link, h5py.HardLink) else name)
            if outside is not None:
                raise ValueError(f"its weights '{outside}' are elsewhere")
            return cls(config, (_read(dataset, most) for dataset in _stored(config, stored)))


_computing = threading.RLock()


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Let one thread compute small products: on a loaded machine those of OpenBLAS wait for each other."""
    with _computing, _blas().limit(limits=1, user_api="blas"):
        yield


@cache
def _blas() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def _by_name(ends: Any, values: Mapping[str, Any]) -> Any:
    return {key: values[end[0]] for key, end in ends.items()} if isinstance(ends, Mapping) else values[ends[0]]


class _ArrayOps:
    """NumPy, and the functions of ``keras.ops`` that it lacks."""

    cast = staticmethod(np.asarray)
    sigmoid = staticmethod(expit)
    erf = staticmethod(erf)

    @staticmethod
    def softplus(x: Any) -> Any:
        return np.logaddexp(x, 0.0)

    @staticmethod
    def log_softmax(x: Any) -> Any:
        return log_softmax(x, axis=-1)

    def __getattr__(self, name: str) -> Any:
        return getattr(np, name)


array_ops: Any = _ArrayOps()
"""Takes the place of ``keras.ops`` in functions of networks, for arrays."""


def _filled(argument: Any, values: Mapping[str, Array]) -> Any:
    """Replace tensors in the arguments of a call by their values."""
    if isinstance(argument, list | tuple):
        return [_filled(each, values) for each in argument]
    if not isinstance(argument, Mapping):
        return argument
    if argument.get("class_name") == "__keras_tensor__":
        return values[argument["config"]["keras_history"][0]]
    return {name: _filled(each, values) for name, each in argument.items()}


def _stored(config: Options, group: Any) -> Iterator[Any]:
    """Yield the data sets of a file in the order of ``model.get_weights()``: Keras names them by class and number."""
    earlier: Counter[str] = Counter()
    for entry in config["layers"]:
        kind = re.sub("([a-z])([A-Z])", r"\1_\2", entry["class_name"]).lower()
        kind = {"conv2_d": "conv2d", "max_pooling2_d": "max_pooling2d", "up_sampling2_d": "up_sampling2d"}.get(
            kind, kind
        )
        here = f"layers/{kind}_{earlier[kind]}" if earlier[kind] else f"layers/{kind}"
        earlier[kind] += 1
        if "layers" in entry["config"]:
            yield from _stored(entry["config"], group[here])
        elif f"{here}/vars" in group:
            stored = group[f"{here}/vars"]
            yield from (stored[str(number)] for number in range(len(stored)))


def _read(dataset: Any, most: int) -> Array:
    if dataset.external or dataset.is_virtual or dataset.nbytes > most or dataset.dtype != np.float32:
        raise ValueError(
            f"its weights '{dataset.name}' have {dataset.nbytes:,} bytes of {dataset.dtype}, or are elsewhere"
        )
    return np.asarray(dataset)


def _taken(weights: Iterator[Array], *shape: int | None) -> Array:
    """Return the next weights, which must have this shape; None is any length."""
    found: Array = np.asarray(next(weights, np.empty(0)), dtype=np.float32)
    wanted = [length if size is None else size for size, length in itertools.zip_longest(shape, found.shape)]
    if list(found.shape) != wanted:
        raise ValueError(f"weights of shape {found.shape} instead of {shape}")
    if not np.isfinite(found).all():
        raise ValueError("weights that are not finite")
    return found


def _require(options: Options, **known: Any) -> None:
    """Refuse options that change the result in a way that is not implemented."""
    other = {name: options[name] for name in known if options.get(name, known[name]) != known[name]}
    if other:
        raise ValueError(f"its layer '{options['name']}' has {other}")


def _softmax(x: Array) -> Array:
    powers = np.exp(x - x.max(axis=-1, keepdims=True))
    return powers / powers.sum(axis=-1, keepdims=True)


_ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "linear": lambda x: x,
    "relu": lambda x: np.maximum(x, 0.0),
    "sigmoid": expit,
    "silu": lambda x: x * expit(x),
    "softmax": _softmax,
    "softplus": _ArrayOps.softplus,
    "tanh": np.tanh,
}


def _dense(options: Options, weights: Iterator[Array]) -> Layer:
    kernel = _taken(weights, None, options["units"])
    bias = _taken(weights, options["units"]) if options["use_bias"] else np.float32(0.0)
    active = _ACTIVATIONS[options["activation"]]
    return lambda x: active(x @ kernel + bias)


def _conv2d(options: Options, weights: Iterator[Array]) -> Layer:
    size, filters = tuple(options["kernel_size"]), options["filters"]
    _require(options, strides=[1, 1], dilation_rate=[1, 1], groups=1, data_format="channels_last")
    _require(options, padding=options["padding"] if size == (1, 1) else "same")
    kernel = _taken(weights, *size, None, filters)
    bias = _taken(weights, filters) if options["use_bias"] else np.float32(0.0)
    active = _ACTIVATIONS[options["activation"]]
    return lambda x: active(_convolved(x, kernel) + bias)


def _convolved(images: Array, kernel: Array) -> Array:
    """Return images (B, H, W, C) convolved with a kernel (h, w, C, F), zeros around them, image by image.

    The result for an image does not depend on the others, as it would in one matrix product of all.
    """
    (rows, columns), (height, width, channels, filters) = images.shape[1:3], kernel.shape
    around = [(0, 0), *(((size - 1) // 2, size // 2) for size in (height, width)), (0, 0)]
    matrix, found = kernel.reshape(-1, filters), np.empty((len(images), rows, columns, filters), np.float32)
    step = max(1, _BLOCK_NUMBERS // (columns * len(matrix)))
    for image, result in zip(np.pad(images, around), found, strict=True):
        for first in range(0, rows, step):
            block = result[first : first + step]
            windows = sliding_window_view(image[first : first + len(block) + height - 1], (height, width, channels))
            np.matmul(windows.reshape(-1, len(matrix)), matrix, out=block.reshape(-1, filters))
    return found


def _batch_normalization(options: Options, weights: Iterator[Array]) -> Layer:
    _require(options, axis=-1, scale=True, center=True)
    gamma, beta, mean, variance = (_taken(weights, None) for _ in range(4))
    scale = gamma / np.sqrt(variance + np.float32(options["epsilon"]))
    offset = beta - mean * scale
    return lambda x: x * scale + offset


def _max_pooling(options: Options, weights: Iterator[Array]) -> Layer:
    _require(options, pool_size=[2, 2], strides=[2, 2], padding="valid", data_format="channels_last")

    def pooled(x: Array) -> Array:
        x = x[:, : x.shape[1] // 2 * 2, : x.shape[2] // 2 * 2]
        rows = np.maximum(x[:, ::2], x[:, 1::2])
        return np.maximum(rows[:, :, ::2], rows[:, :, 1::2])

    return pooled


def _up_sampling(options: Options, weights: Iterator[Array]) -> Layer:
    _require(options, size=[2, 2], interpolation="nearest", data_format="channels_last")
    return lambda x: x.repeat(2, axis=1).repeat(2, axis=2)


def _relu(options: Options, weights: Iterator[Array]) -> Layer:
    _require(options, negative_slope=0.0, threshold=0.0)
    most = options["max_value"]
    return lambda x: np.clip(x, 0.0, most)


def _rescaling(options: Options, weights: Iterator[Array]) -> Layer:
    scale, offset = (np.asarray(options[name], dtype=np.float32) for name in ("scale", "offset"))
    return lambda x: x * scale + offset


def _concatenate(options: Options, weights: Iterator[Array]) -> Layer:
    return lambda parts: np.concatenate(parts, axis=options["axis"])


_LAYERS: dict[str, Callable[[Options, Iterator[Array]], Layer]] = {
    "Add": lambda options, weights: sum,
    "BatchNormalization": _batch_normalization,
    "Concatenate": _concatenate,
    "Conv2D": _conv2d,
    "Dense": _dense,
    "Functional": Network,
    "Log10": lambda options, weights: np.log10,
    "MaxPooling2D": _max_pooling,
    "Maximum": lambda options, weights: np.maximum,
    "ReLU": _relu,
    "Rescaling": _rescaling,
    "UpSampling2D": _up_sampling,
}
