import json
import os
import re
import shutil
import zipfile

import numpy as np
import pytest
from predictor_links import (
    LOS,
    OUTAGE,
    QUICK,
    QUIET,
    context_predictor,
    fit_context_predictor,
    make_links,
    make_seen_links,
    quick_predictor,
)

from sionna_partial.errors import OutputError, PredictorError
from sionna_partial.files import unzipped, zipped
from sionna_partial.prediction import predictor_files
from sionna_partial.prediction.map_networks import LINK_INPUTS, LINK_NETWORK, LINK_OUTPUTS
from sionna_partial.prediction.map_training import fit_context_networks
from sionna_partial.prediction.paper_networks import GAIN_INPUTS, assemble, import_keras, parts
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.prediction.predictor_files import CHECKSUMS, FORMAT, digest, pack, shipped_bytes
from sionna_partial.prediction.rule import GATE_NETWORK
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.settings import PredictorSettings

pytestmark = QUIET


@pytest.fixture(scope="module")
def quick():
    return quick_predictor()


@pytest.fixture
def saved(quick, tmp_path):
    quick.save(tmp_path / "mine.keras")
    return tmp_path / "mine.keras"


def test_card(quick, saved):
    card = json.loads(saved.with_suffix(".json").read_text())
    assert card["format"] == FORMAT
    assert card["features"] == ["distance_m", "unobserved_distance_m", "gain_db"]
    assert card["sha256"] == digest(saved.read_bytes()) == quick.fingerprint
    assert (card["homes"], card["settings"]["steps"]) == (["a", "b"], QUICK.steps)
    assert (sum(card["links"].values()), card["links"]["LOS given OUTAGE"]) == (900, 0)
    phi = make_links(900)[0]
    seen = phi.distance_m[phi.link_state == OUTAGE]
    assert card["scaling"]["state_given_outage"]["distance_m"] == pytest.approx([seen.min(), seen.max()])
    assert card["versions"]["keras"] == import_keras().__version__


def test_stock_keras_loads_it(quick, saved):
    model = import_keras().saving.load_model(saved, safe_mode=True)
    phi = make_links(20)[0]
    outputs = model({name: getattr(phi, name)[:, None] for name in GAIN_INPUTS})
    probabilities = np.asarray(outputs["state_given_los"])[phi.link_state == LOS]
    np.testing.assert_allclose(probabilities[:, LOS], quick.predict(phi).p_los[phi.link_state == LOS], rtol=1e-5)


def test_a_training_by_seed_gives_the_same_bytes_whatever_was_trained_before_it(quick):
    assert fit_context_predictor("map").fingerprint == context_predictor("map").fingerprint
    links, settings = make_seen_links(300), PredictorSettings("paths", passes=2)
    one, other = (fit_context_networks(*links, settings) for _ in range(2))
    for name, network in one.items():
        for found, again in zip(network.get_weights(), other[name].get_weights(), strict=True):
            np.testing.assert_array_equal(found, again)


def _repack(archive, change):
    contents = unzipped(archive, 10**8)
    return zipped(contents | {"config.json": change(contents["config.json"].decode()).encode()})


def _forge(path, archive):
    """Put an archive in the place of another, with a card that vouches for it."""
    card = json.loads(path.with_suffix(".json").read_text())
    path.write_bytes(archive)
    path.with_suffix(".json").write_text(json.dumps({**card, "sha256": digest(archive)}))


def _without_weights(path):
    contents = unzipped(path.read_bytes(), 10**8)
    _forge(path, zipped({name: content for name, content in contents.items() if name.endswith(".json")}))


def _inflates(path):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        target.writestr("config.json", bytes(70_000_000))
    _forge(path, path.read_bytes())


SPOILT = {
    r"mine\.keras' cannot be read \(No such file.*check the path": lambda path: path.unlink(),
    r"mine\.json' cannot be read": lambda path: path.with_suffix(".json").unlink(),
    r"mine\.keras' has SHA-256 .* the file is truncated, was changed": lambda path: path.write_bytes(b"PK"),
    r"mine\.keras' is no Keras archive": lambda path: _forge(path, b"PK\x03\x04" + bytes(50)),
    r"mine\.keras' cannot be evaluated": _without_weights,
    "unpacks to more than 64,000,000 bytes": _inflates,
    "has more than 64,000,000 bytes": lambda path: os.truncate(path, 64_000_001),
    r"mine\.json' is not JSON": lambda path: path.with_suffix(".json").write_bytes(b"[" * 100_000),
}


@pytest.mark.parametrize(("message", "spoil"), SPOILT.items())
def test_spoilt_files(saved, message, spoil):
    spoil(saved)
    with pytest.raises(PredictorError, match=message):
        Predictor.load(saved)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ('"ReLU"', '"Lambda"', "holds Lambda,"),
        ('"module": "keras.layers"', '"module": "os"', r"holds .*os\.Dense"),
        ('"module": "keras.layers"', '"module": "kerasx"', r"holds .*kerasx\.Dense"),
        ('"class_name": "Conv2D"', '"class_name": "TFSMLayer"', "holds TFSMLayer,"),
    ],
)
def test_foreign_code_is_refused(saved, old, new, found):
    archive = context_predictor("map").archive if "TFSM" in new else saved.read_bytes()
    _forge(saved, _repack(archive, lambda text: text.replace(old, new)))
    with pytest.raises(PredictorError, match=f"{found}.* which no predictor of ours has: it may run foreign code"):
        Predictor.load(saved)


def test_foreign_networks_are_refused(saved):
    keras = import_keras()
    values = keras.Input((len(LINK_INPUTS),), name="link")
    foreign = keras.Model(values, keras.layers.Dense(LINK_OUTPUTS + 1, name="outputs")(values), name=LINK_NETWORK)
    paper, alone = parts(quick_predictor().model), parts(context_predictor("map").model)
    del alone[GATE_NETWORK]
    for networks in (alone, paper | {LINK_NETWORK: foreign}, paper | {"third_network": foreign}):
        _forge(saved, pack(assemble(networks)))
        message = r"mine\.keras' has inputs \['distance_m', .*\] and outputs .*: train it"
        with pytest.raises(PredictorError, match=message):
            Predictor.load(saved)


def test_bad_card(saved):
    path = saved.with_suffix(".json")
    card = json.loads(path.read_text())
    others = "settings.networks = 'map', but the weights beside it are of 'paper' networks: copy both"
    for change, message in (
        ({"format": "other"}, "format = 'other', but this version reads"),
        ({"link_states": {"LOS": 0}}, "link_states = {'LOS': 0}"),
        ({"sha256": None}, "names no sha256"),
        ({"settings": {"steps": 0}}, "is damaged (SettingsError"),
        ({"settings": None}, "is damaged (TypeError"),
        ({"settings": {**card["settings"], "networks": "map"}}, others),
        ({"links": {"LOS given LOS": "many"}}, "is damaged (ValueError"),
    ):
        path.write_text(json.dumps({**card, **change}))
        with pytest.raises(PredictorError, match=re.escape(message)):
            Predictor.load(saved)
    for name in ("networks", "passes"):  # cards from before there were others
        del card["settings"][name]
    path.write_text(json.dumps(card))
    assert Predictor.load(saved).settings.networks == "paper"


def test_the_package_lists_the_checksums_of_its_predictors(monkeypatch, tmp_path):
    names = sorted(path.name for path in PREDICTORS_FOLDER.iterdir() if path.name != CHECKSUMS)
    lines = (PREDICTORS_FOLDER / CHECKSUMS).read_text().splitlines()
    assert sorted(line.split()[1] for line in lines) == names
    for name in names:
        assert len(shipped_bytes(PREDICTORS_FOLDER / name)) > 0
        shutil.copy(PREDICTORS_FOLDER / name, tmp_path)
    shutil.copy(PREDICTORS_FOLDER / CHECKSUMS, tmp_path)
    monkeypatch.setattr(predictor_files, "PREDICTORS_FOLDER", tmp_path)
    card = json.loads((tmp_path / "map.json").read_text())
    (tmp_path / "map.json").write_text(json.dumps({**card, "settings": {**card["settings"], "frequency_hz": 60e9}}))
    with pytest.raises(PredictorError, match=r"map\.json' has SHA-256 .* was changed; install sionna-partial again"):
        predictor_files.read_files(tmp_path / "map.keras")


def test_other_suffix(quick, tmp_path):
    with pytest.raises(PredictorError, match=r"mine\.h5' is no predictor: give 'map' or 'paper', or the path"):
        Predictor.load(tmp_path / "mine.h5")
    with pytest.raises(PredictorError, match=r"mine\.h5' is no predictor: give the path of a \.keras file"):
        quick.save(tmp_path / "mine.h5")
    with pytest.raises(PredictorError, match=r"name_or_path = 3 is not a path: give 'map' or 'paper', the path of"):
        Predictor.load(3)


def test_unwritable_folder_leaves_nothing(quick, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="could not be written"):
        quick.save(tmp_path / "file" / "mine.keras")
    (tmp_path / "mine.keras").mkdir()
    with pytest.raises(OutputError, match="could not be written"):
        quick.save(tmp_path / "mine.keras")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "mine.keras"]
