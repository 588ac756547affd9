"""Networks evaluated by NumPy against Keras."""

import io
import json
from collections.abc import Callable
from typing import Any

import h5py
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from sionna_partial.files import unzipped
from sionna_partial.prediction.evaluate import Network
from sionna_partial.prediction.map_training import kernel_starts, u_net
from sionna_partial.prediction.paper_networks import import_keras, layer
from sionna_partial.prediction.predictor_files import WEIGHTS_FILE
from sionna_partial.resources import PREDICTORS_FOLDER

keras = import_keras()
RNG = np.random.default_rng(5)
SHIPPED = sorted(path.stem for path in PREDICTORS_FOLDER.glob("*.keras"))
DENSE = "layers/functional/layers/dense/vars"


def example(shape):
    """Images in [0, 1], lengths or gains, or scaled inputs of links."""
    size = [3, *(length or 24 for length in shape[1:])]
    if len(size) == 4:
        return RNG.random(size).astype(np.float32)
    return (RNG.normal(0.0, 1.5, size) if size[1] > 1 else RNG.uniform(0.01, 40.0, size)).astype(np.float32)


def read(name: str, spoil: Callable[[h5py.File], Any] = lambda _: None, old: str = "", new: str = "") -> Network:
    """Read a shipped network whose weights and configuration were changed."""
    files = unzipped((PREDICTORS_FOLDER / f"{name}.keras").read_bytes(), 10**8)
    stream = io.BytesIO(files[WEIGHTS_FILE])
    with h5py.File(stream, "r+") as weights:
        spoil(weights)
    config = json.loads(files["config.json"].decode().replace(old, new))["config"]
    return Network.read(config, stream.getvalue(), 10**7)


def randomized(model):
    for each in model.layers:
        weights = [RNG.normal(0.0, 0.3, weight.shape) for weight in each.weights]
        if isinstance(each, keras.layers.BatchNormalization):
            weights[3] = 0.5 + weights[3] ** 2
        each.set_weights(weights)
    return model


def blas_threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def test_one_thread_computes_and_all_are_back_afterwards() -> None:
    """On a loaded machine threads of small products wait for each other."""
    network, threads = read(SHIPPED[0]), []
    name, layer_of = next(iter(network.layers.items()))
    with threadpool_limits(2, "blas"):
        network.layers[name] = lambda *given, **options: threads.append(blas_threads()) or layer_of(*given, **options)
        network({key: example(shape) for key, shape in network.input.items()})
        assert (threads, blas_threads()) == ([{1}], {2})


def test_shipped_predictors() -> None:
    for name in SHIPPED:
        network = read(name)
        model = keras.saving.load_model(PREDICTORS_FOLDER / f"{name}.keras", compile=False)
        assert network.input == {key: tuple(end.shape) for key, end in model.input.items()}
        assert network.output == {key: tuple(end.shape) for key, end in model.output.items()}
        inputs = {key: example(shape) for key, shape in network.input.items()}
        found = network(inputs)
        for key, values in model(inputs, training=False).items():
            assert found[key].dtype == np.float32
            exact = key.startswith(("state", "indoor"))
            rtol, atol = (0.0, 1e-6) if exact else (2e-6, 5e-5)  # logits may be far from 0
            np.testing.assert_allclose(found[key], values, rtol=rtol, atol=atol, err_msg=key)


@pytest.mark.parametrize("activation", ["linear", "relu", "sigmoid", "silu", "softmax", "softplus", "tanh"])
def test_dense_layers(activation: str) -> None:
    values = keras.Input((7,))
    hidden = keras.layers.Dense(9, activation=activation)(values)
    hidden = keras.layers.Concatenate()([hidden, keras.layers.Rescaling(2.0, -1.0)(values)])
    hidden = keras.layers.ReLU(max_value=1.5)(hidden)
    model = randomized(keras.Model(values, keras.layers.Dense(3, use_bias=False)(hidden)))
    rows = example((None, 7))
    np.testing.assert_allclose(Network.from_keras(model)(rows), model(rows), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("shape", [(24, 40), (8, 8), (40, 16)])
def test_u_nets_on_images_of_any_size(shape: tuple[int, int]) -> None:
    image = keras.Input((None, None, 4), dtype="float32")
    x = u_net(keras, kernel_starts(1), image, (5, 6, 7, 8))
    model = randomized(keras.Model(image, layer(keras, "Conv2D", "last", 2, 1, activation="softplus")(x)))
    network, images = Network.from_keras(model), RNG.random((2, *shape, 4)).astype(np.float32)
    assert network.output == (None, None, None, 2)
    found, expected = network(images), np.asarray(model(images, training=False))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5 * np.abs(expected).max())
    assert (network(images[1:])[0] == found[1]).all(), "an image does not depend on the others"


@pytest.mark.parametrize("size", [(3, 3), (2, 2), (1, 5), (4, 3)])
def test_convolutions_by_blocks_of_rows(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sionna_partial.prediction.evaluate._BLOCK_NUMBERS", 500)
    image = keras.Input((None, None, 3))
    model = keras.Model(image, keras.layers.Conv2D(4, size, padding="same", activation="relu")(image))
    images = RNG.random((1, 11, 6, 3)).astype(np.float32)
    np.testing.assert_allclose(Network.from_keras(model)(images), model(images), atol=1e-5)


def test_pooling_leaves_out_the_last_odd_row_and_column() -> None:
    image = keras.Input((None, None, 3))
    model = keras.Model(image, keras.layers.MaxPooling2D()(image))
    images = RNG.random((2, 7, 9, 3)).astype(np.float32)
    np.testing.assert_array_equal(Network.from_keras(model)(images), model(images))


def replaced(name: str, **options: Any) -> Callable[[h5py.File], None]:
    def replace(weights: h5py.File) -> None:
        del weights[f"{DENSE}/{name}"]
        weights.create_dataset(f"{DENSE}/{name}", **options)

    return replace


def linked(weights: h5py.File) -> None:
    del weights[f"{DENSE}/1"]
    weights[f"{DENSE}/1"] = h5py.ExternalLink("/etc/passwd", "/")


@pytest.mark.parametrize(
    ("message", "spoil"),
    [
        ("its weights '.*dense/vars/1' are elsewhere", linked),
        ("matmul", replaced("0", data=np.zeros((4, 20), np.float32))),
        (r"weights of shape \(21,\) instead of \(20,\)", replaced("1", data=np.zeros(21, np.float32))),
        ("have 160 bytes of float64", replaced("1", data=np.zeros(20))),
        ("have 400,000,000 bytes", replaced("1", shape=10**8, dtype="f4", chunks=(10**6,), compression="gzip")),
        ("or are elsewhere", replaced("1", shape=20, dtype="f4", external=[("/etc/passwd", 0, 80)])),
        ("functional_2' doesn't exist", lambda weights: weights.pop("layers/functional_2")),
    ],
)
def test_spoilt_weights(message: str, spoil: Callable[[h5py.File], Any]) -> None:
    with pytest.raises((ValueError, KeyError), match=message):
        read("paper", spoil)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"negative_slope": 0.0', '"negative_slope": 0.1'),
        ('"strides": [1, 1]', '"strides": [2, 2]'),
        ('"padding": "same"', '"padding": "valid"'),
        ('"interpolation": "nearest"', '"interpolation": "bilinear"'),
        ('"pool_size": [2, 2]', '"pool_size": [4, 4]'),
        ('"activation": "silu"', '"activation": "gelu"'),
    ],
)
def test_other_options_are_refused(old: str, new: str) -> None:
    with pytest.raises((ValueError, KeyError), match=r"its layer '.*' has {'.*': |gelu"):
        read("map", old=old, new=new)
