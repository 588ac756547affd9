import dataclasses
import itertools
import json

import numpy as np
import pytest
from link_tables import make_dataset, make_table
from predictor_links import QUICK, QUIET, shallow_map_networks

from sionna_partial.errors import OutputError, PredictorError, PredictorWarning, SionnaPartialError
from sionna_partial.lab.baselines import Baselines
from sionna_partial.lab.evaluation import evaluate
from sionna_partial.lab.training.predictor import split_homes, train
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.settings import PredictorSettings

pytestmark = QUIET

UNTRAINED = PredictorSettings(minimum_links=1_000_000)
"""Every network gives mean and spread of its links: quick, and as deterministic as the links."""

FEW_TRAINED = dataclasses.replace(QUICK, minimum_links=350)
"""One network of the predictor and one of the baseline are trained, and the indoor model."""

HOMES = [f"home {index}" for index in range(10)]


@pytest.fixture(scope="module")
def table():
    return make_table(homes=5)


@pytest.fixture(scope="module")
def run(table):
    return train(table, test_fraction=0.4, settings=FEW_TRAINED)


@pytest.fixture(scope="module")
def untrained(table):
    return train(table, test_fraction=0.4, settings=UNTRAINED)


class TestSplitHomes:
    def test_no_home_is_on_both_sides_and_none_is_lost_whatever_their_order(self):
        for share, seed in itertools.product((0.01, 0.5, 0.99), range(2)):
            train_homes, test_homes = split_homes(HOMES, share, seed)
            assert not set(train_homes) & set(test_homes)
            assert sorted([*train_homes, *test_homes]) == HOMES
            assert len(test_homes) == min(max(round(share * 10), 1), 9)
            assert split_homes(HOMES[::-1], share, seed) == (train_homes, test_homes)
            assert split_homes(HOMES, 0.0, seed) == (tuple(HOMES), ())

    def test_refused(self):
        for homes, share, message in (
            (["a"], 0.3, "dataset has 1 home: give at least 2 to train on some and test on others"),
            ([], 0.0, "dataset has 0 homes"),
            (HOMES, 1.0, r"test_fraction = 1.0 is not allowed: give a number in \[0, 0.99\]"),
        ):
            with pytest.raises(SionnaPartialError, match=message):
                split_homes(homes, share, 0)


class TestTrain:
    def test_training_and_test_homes_are_disjoint(self, run):
        assert not set(run.train_homes) & set(run.test_homes)
        assert len(run.test_homes) == 2
        assert run.predictor.homes == run.baselines.distance.homes == run.train_homes
        assert run.predictor.metrics["held_out_homes"] == list(run.test_homes)
        (row,) = run.evaluation.select(homes="test", stage=100, model="majority", ends_seen="all")
        assert run.predictor.metrics["exploration_steps"]["100"]["majority"] == row.metrics.as_json()
        anywhere = run.predictor.metrics["exploration_steps_receivers_anywhere"]["0"]
        assert set(anywhere) == {"with indoor model", "without indoor model", "always outage"}
        assert "paper" not in run.predictor.metrics["exploration_steps"]["0"]

    def test_links_of_test_homes_are_not_learned(self, table, untrained):
        spoiled = np.isin(table.home, untrained.test_homes)
        other = dataclasses.replace(table, gain_db=np.where(spoiled, -77.0, table.gain_db))
        again = train(other, test_fraction=0.4, settings=UNTRAINED)
        assert again.predictor.fingerprint == untrained.predictor.fingerprint
        assert again.baselines.distance.fingerprint == untrained.baselines.distance.fingerprint
        assert again.baselines.majority == untrained.baselines.majority
        assert again.predictor.metrics != untrained.predictor.metrics

    def test_links_indoors_make_the_predictor_and_those_anywhere_the_indoor_model(self, table, run):
        links = table.take(np.isin(table.home, run.train_homes))
        assert sum(run.predictor.links.values()) == (~links.anywhere).sum()
        hidden = links.take(links.anywhere & ~links.context.rx_seen)
        p_indoor = run.predictor.predict_indoor(hidden.phi)
        assert p_indoor[hidden.inside].mean() > p_indoor[~hidden.inside].mean() + 0.3
        assert p_indoor.mean() == pytest.approx(hidden.inside.mean(), abs=0.02)

    def test_few_homes(self, table):
        with pytest.raises(PredictorWarning, match="'map' are trained on 5 homes, fewer than 20"):
            train(table, test_fraction=0.0, settings=PredictorSettings("map"))

    @pytest.mark.filterwarnings("ignore::sionna_partial.errors.PredictorWarning")
    def test_networks_that_see_where_links_run(self):
        table, calls = make_table(homes=3, links=60, stages=(0,)), []
        settings = dataclasses.replace(UNTRAINED, networks="map", passes=1)
        with shallow_map_networks():
            seeing = train(table, settings=settings, progress=lambda *call: calls.append(call))
        assert calls[0] == (0.0, "training on 120 links in 2 homes")
        assert seeing.predictor.settings == settings
        assert {"map_network", "link_network", "gate_network"} <= set(seeing.predictor.model.output)
        assert seeing.baselines.distance.settings == dataclasses.replace(settings, networks="paper")
        assert [share for share, _ in calls] == sorted(share for share, _ in calls)
        assert any(message.startswith("step 0 of 1, loss ") for _, message in calls)

    def test_no_test_homes_and_without_receivers_anywhere_all_are_indoors(self, table):
        alone = train(table.take(~table.anywhere), test_fraction=0.0, settings=UNTRAINED)
        assert alone.evaluation is None
        assert alone.test_homes == ()
        assert alone.predictor.metrics == {}
        assert alone.predictor.predict_indoor(table.phi).min() > 0.999

    def test_settings_of_a_data_set_are_its_own(self, table, tmp_path):
        folder = make_dataset(tmp_path, table, frequency_hz=60e9, diffraction=False)
        message = "dataset was traced at 60 GHz without diffraction, settings are for links at 28 GHz with diffraction"
        with pytest.raises(PredictorError, match=message):
            train(folder, settings=UNTRAINED)
        settings = dataclasses.replace(UNTRAINED, frequency_hz=60e9, diffraction=False)
        assert train(folder, test_fraction=0.0, settings=settings).predictor.settings == settings


class TestSave:
    def test_same_links_and_seed_give_the_same_bytes(self, table, untrained, tmp_path):
        files = untrained.save(tmp_path / "one")
        again = train(table, test_fraction=0.4, settings=UNTRAINED).save(tmp_path / "two")
        names = ["distance.json", "distance.keras", "majority.json", "predictor.json", "predictor.keras", "split.json"]
        assert [file.name for file in files] == names
        for one, two in zip(files, again, strict=True):
            assert one.read_bytes() == two.read_bytes(), one.name

    def test_what_is_saved_can_be_evaluated(self, table, run, tmp_path):
        run.save(tmp_path)
        found = evaluate(tmp_path / "predictor.keras", table)
        assert found.homes == {"test": tuple(sorted(run.test_homes)), "train": tuple(sorted(run.train_homes))}
        measured = [row.metrics.as_json() for row in run.evaluation.rows]
        assert [row.metrics.as_json() for row in found.select(homes="test")] == measured
        assert Predictor.load(tmp_path / "predictor.keras").metrics == run.predictor.metrics
        assert Baselines.load(tmp_path).majority == run.baselines.majority
        split = json.loads((tmp_path / "split.json").read_text())
        assert split == {"test_fraction": 0.4, "seed": 0, "train": [*run.train_homes], "test": [*run.test_homes]}

    def test_nothing_half_written(self, run, tmp_path, files_that_fit):
        files_that_fit(2)
        with pytest.raises(OutputError, match="the disk is full"):
            run.save(tmp_path / "run")
        assert list(tmp_path.iterdir()) == []
