"""Predictor files: a `.keras` archive of stock Keras classes, loaded in safe mode, and a JSON card with its SHA-256."""

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sionna_partial.constants import LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.files import atomic_write, read_bytes, temporary_folder, unzipped
from sionna_partial.prediction.evaluate import Network
from sionna_partial.prediction.map_networks import CONTEXT_SHAPES
from sionna_partial.prediction.paper_networks import GAIN_INPUTS, OUTPUT_WIDTHS, import_keras, own_input
from sionna_partial.resources import PREDICTORS_FOLDER

if TYPE_CHECKING:
    import keras

FORMAT = "sionna_partial predictor 2"

SUFFIX, WEIGHTS_FILE, CHECKSUMS = ".keras", "model.weights.h5", "SHA256SUMS"

_MAX_BYTES = 64_000_000
_MAX_CONFIG_BYTES, _MAX_SIZE = 1_000_000, 512
"""Largest configuration of a model [bytes], and largest number in it; ours have 150,000 and 112."""

_CLASSES = {
    *("Functional", "InputLayer", "Concatenate", "Rescaling", "ReLU", "Dense", "Add"),
    *("Conv2D", "BatchNormalization", "MaxPooling2D", "UpSampling2D", "Maximum", "Log10"),
    *("DTypePolicy", "GlorotUniform", "Zeros", "Ones", "Constant", "__keras_tensor__"),
}
_COUNTED = re.compile(rb'"(maximum|log10)_\d+"')
"""Unnamed operations, which Keras numbers through a process."""

_INPUTS = dict.fromkeys(GAIN_INPUTS, (None, 1))
_OUTPUTS = {name: (None, width) for name, width in OUTPUT_WIDTHS.items()}

_FIXED_ENTRIES = {
    "format": FORMAT,
    "features": list(GAIN_INPUTS),
    "link_states": {state.name: state.value for state in LinkState},
    "outputs": OUTPUT_WIDTHS,
}


def pack(model: "keras.Model") -> bytes:
    """Return the `.keras` archive without Keras's date, so that a training has one hash."""
    keras = import_keras()
    config = json.dumps(keras.saving.serialize_keras_object(model)).encode()
    metadata = json.dumps({"keras_version": keras.__version__}).encode()
    with temporary_folder() as folder:
        model.save_weights(folder / WEIGHTS_FILE)
        weights = (folder / WEIGHTS_FILE).read_bytes()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as target:
        entries = {"metadata.json": metadata, "config.json": _COUNTED.sub(rb'"\1"', config), WEIGHTS_FILE: weights}
        for name, content in entries.items():
            target.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


def digest(archive: bytes) -> str:
    return hashlib.sha256(archive).hexdigest()


def write_files(path: Path, archive: bytes, card: Mapping[str, Any]) -> None:
    """Write the `.keras` file and its card, whole or not at all."""
    if path.suffix != SUFFIX:
        raise PredictorError(f"path = '{path}' is no predictor: give the path of a {SUFFIX} file.")
    entries = {**_FIXED_ENTRIES, "sha256": digest(archive), **card}
    with atomic_write(path.with_suffix(".json"), "w") as text, atomic_write(path) as stream:
        text.write(json.dumps(entries, indent=2, allow_nan=False) + "\n")
        stream.write(archive)


def read_files(path: Path) -> tuple[Network, bytes, dict[str, Any]]:
    archive = _read(path)
    card = _read_card(path.with_suffix(".json"))
    if card["sha256"] != digest(archive):
        raise PredictorError(
            f"path = '{path}' has SHA-256 {digest(archive)}, but its card has {card['sha256']!r}: the file is "
            "truncated, was changed, or belongs to another card; copy both files again, or train anew."
        )
    return _unpack(path, archive, _checked_config(path, archive)), archive, card


def shipped_bytes(path: Path, most: int = _MAX_BYTES) -> bytes:
    """Return a file of the package, after a check of its SHA-256; `make predictor` writes the list."""
    remedy = "install sionna-partial again."
    content = read_bytes(path, "path", PredictorError, most, remedy)
    lines = read_bytes(PREDICTORS_FOLDER / CHECKSUMS, "path", PredictorError, most, remedy).decode().splitlines()
    expected = {name: sum_of for sum_of, name in (line.split() for line in lines)}.get(path.name, "none")
    if digest(content) != expected:
        raise PredictorError(
            f"path = '{path}' has SHA-256 {digest(content)}, but the package lists {expected}: the file is damaged or "
            f"was changed; {remedy}"
        )
    return content


def _read(path: Path) -> bytes:
    if path.parent == PREDICTORS_FOLDER:
        return shipped_bytes(path)
    remedy = f"a predictor is a {SUFFIX} file and a .json file of the same name beside it; train one and save it there."
    return read_bytes(path, "path", PredictorError, _MAX_BYTES, remedy)


def _read_card(path: Path) -> dict[str, Any]:
    try:
        card = json.loads(_read(path))
    except (ValueError, RecursionError) as error:
        raise PredictorError(f"path = '{path}' is not JSON ({error}): copy it again, or train anew.") from error
    for name, wanted in _FIXED_ENTRIES.items():
        found = card.get(name) if isinstance(card, dict) else None
        if found != wanted:
            raise PredictorError(
                f"path = '{path}': {name} = {found!r}, but this version reads {wanted!r}; choose another predictor, or "
                "train anew."
            )
    if not isinstance(card.get("sha256"), str):
        raise PredictorError(f"path = '{path}' names no sha256: copy it again, or train anew.")
    return card


def _checked_config(path: Path, archive: bytes) -> dict[str, Any]:
    """Return the configuration of a model if it has only layers of ours."""
    try:
        content = unzipped(archive, _MAX_BYTES)["config.json"]
        config, config_bytes = json.loads(content), len(content)
        found, largest = set(_classes(config)), max(_sizes(config), default=0)
    except (KeyError, ValueError, RecursionError) as error:
        raise PredictorError(f"path = '{path}' is no Keras archive ({error}): train and save it anew.") from error
    foreign = sorted(name for name in found if name not in _CLASSES)
    if foreign:
        raise PredictorError(
            f"path = '{path}' holds {', '.join(foreign)}, which no predictor of ours has: it may run foreign code; do "
            "not use it."
        )
    if largest > _MAX_SIZE or config_bytes > _MAX_CONFIG_BYTES:
        raise PredictorError(
            f"path = '{path}' describes a network with a size of {largest:,}, in {config_bytes:,} bytes: no predictor "
            f"of ours has more than {_MAX_SIZE:,} and {_MAX_CONFIG_BYTES:,}; do not use it."
        )
    return dict(config)


def _sizes(entry: Any) -> Iterator[int]:
    """Yield the whole numbers of a configuration except seeds."""
    if isinstance(entry, int):
        yield abs(entry)
    values = entry.items() if isinstance(entry, dict) else enumerate(entry) if isinstance(entry, list) else ()
    for key, value in values:
        if key != "seed":
            yield from _sizes(value)


def _classes(entry: Any) -> Iterator[str]:
    if isinstance(entry, dict) and "class_name" in entry:
        module, name = str(entry.get("module") or "keras"), str(entry["class_name"])
        yield name if module.split(".")[0] == "keras" else f"{module}.{name}"
    values = entry.values() if isinstance(entry, dict) else entry if isinstance(entry, list) else ()
    for value in values:
        yield from _classes(value)


def keras_model(archive: bytes) -> "keras.Model":
    """Load a model for training or derivatives from bytes that were checked: a file may change meanwhile."""
    keras = import_keras()
    with temporary_folder() as folder:
        copy = folder / f"model{SUFFIX}"
        copy.write_bytes(archive)
        return keras.saving.load_model(copy, compile=False, safe_mode=True)


def _unpack(path: Path, archive: bytes, config: dict[str, Any]) -> Network:
    try:
        weights = unzipped(archive, _MAX_BYTES)[WEIGHTS_FILE]
        network = Network.read(config["config"], weights, _MAX_BYTES)
    except Exception as error:  # HDF5 fails in many ways on damaged files
        raise PredictorError(f"path = '{path}' cannot be evaluated ({error!r}): train it anew.") from error
    known = [
        (
            _INPUTS | {own_input(name): shapes[0] for name, shapes in more.items()},
            _OUTPUTS | {name: shapes[1] for name, shapes in more.items()},
        )
        for more in CONTEXT_SHAPES
    ]
    if (network.input, network.output) not in known:
        what = f"inputs {sorted(network.input)} and outputs {network.output}"
        raise PredictorError(f"path = '{path}' has {what}: train it anew.")
    return network
