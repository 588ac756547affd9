"""The whole function, from scene to distribution: as the predictor has it, and slopes as its finite differences."""

import doctest
import functools
import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest
from pillar_room import TX_M, small_room
from predictor_links import QUIET

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.differentiable import scene as differentiable_links
from sionna_partial.differentiable.link_distribution import LinkDistribution
from sionna_partial.errors import PositionError, SettingsError
from sionna_partial.prediction.paper_networks import import_keras
from sionna_partial.tracing.path_set import MATERIAL_PARAMETERS, PARAMETERS

pytestmark = QUIET

TRACE = sp.TraceSettings(max_depth=1)
SCENE = sp.SceneSettings(material=sp.Material(thickness_m=0.02))
RX_M = np.array(
    [[1.47, 2.51, 1.7], [3.05, 0.61, 1.2], [3.12, 2.52, 1.3], [3.7, 1.2, 1.1], [2.6, 2.45, 1.9], [0.7, 0.7, 1]]
)
STEPS = dict(zip(PARAMETERS, (1e-3, 2e-3, 5e-3, 1e-5, 1e7), strict=True))
OUTPUTS = tuple(field.name for field in fields(LinkDistribution))


@pytest.fixture(scope="module")
def tf():
    import_keras()
    import tensorflow

    return tensorflow


def partial_room():
    """Return the small room, of which a corner behind the pillar and a wall were not seen."""
    whole = small_room()
    x, y = np.meshgrid(np.arange(42), np.arange(32))
    return replace(whole, state=np.where(x + 0.5 * y > 33, CellState.UNKNOWN, whole.state).astype(np.uint8))


MAPS = {
    "partial": partial_room(),
    "empty": sp.PartialMap(np.full((32, 42), CellState.UNKNOWN), 0.1),
    "complete": small_room(),
}


@functools.cache
def loaded(predictor=None):
    return sp.Predictor.load(predictor)


def scene_of(kind, predictor=None):
    return sp.DifferentiableScene(MAPS[kind], predictor=loaded(predictor), trace_settings=TRACE, scene_settings=SCENE)


@pytest.fixture(scope="module")
def links_of():
    """Return links of a kind of map and a predictor; each are traced once."""
    made = {}

    def links(kind, predictor=None):
        if (kind, predictor) not in made:
            made[kind, predictor] = scene_of(kind, predictor).links(TX_M, RX_M)
        return made[kind, predictor]

    return links


def predicted(kind, predictor):
    links = sp.trace_links(MAPS[kind], TX_M, RX_M, settings=TRACE, scene_settings=SCENE)
    return loaded(predictor).predict(sp.link_features(MAPS[kind], links)), links


def assert_same(found, expected, **tolerance):
    for name in OUTPUTS:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), **tolerance, err_msg=name)


class TestValues:
    @pytest.mark.parametrize("predictor", ["paper", "map"])
    @pytest.mark.parametrize("kind", ["partial", "empty"])
    def test_unmoved_as_predictor(self, kind, predictor, links_of):
        expected, links = predicted(kind, predictor)
        assert (links.link_state == sp.LinkState.NLOS).any() == (kind == "partial")
        assert_same(links_of(kind, predictor)(), expected, rtol=1e-6, atol=1e-9)

    def test_complete_map_is_the_trace(self, links_of):
        _, links = predicted("complete", "paper")
        found = links_of("complete")()
        expected = loaded().predict(sp.link_features(MAPS["complete"], links))
        assert_same(found, expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.gain_mean_db, links.gain_db, rtol=1e-9)
        assert not found.gain_std_db.numpy().any()

    @pytest.mark.parametrize("predictor", ["paper", "map"])
    @pytest.mark.parametrize("kind", MAPS)
    def test_moved_by_nothing(self, kind, predictor, links_of):
        links = links_of(kind, predictor)
        given = {name: getattr(links.base, name) for name in PARAMETERS}
        found, here = links(**given), links()
        for name in OUTPUTS:
            np.testing.assert_allclose(getattr(found, name), getattr(here, name), atol=1e-4, err_msg=name)

    def test_arguments_may_be_of_any_kind(self, links_of, tf):
        links = links_of("partial", "paper")
        place = TX_M + 0.01
        ways = (place, place.tolist(), tf.constant(place), tf.Variable(place), tf.constant(place, tf.float64))
        found = [links(tx_m=way).gain_mean_db.numpy() for way in ways]
        assert all(np.array_equal(one, found[0]) for one in found)
        np.testing.assert_allclose(links(tx_m=tf.constant(place, tf.float32)).gain_mean_db, found[0], atol=1e-4)

    @pytest.mark.parametrize("predictor", ["paper", "map"])
    def test_moved_as_a_new_trace(self, predictor, links_of):
        """Nearer than where it was for all but one, as the networks have kinks, and much nearer for some."""
        links, place = links_of("partial", predictor), TX_M + np.array([0.04, -0.03, 0.02])
        there = links._scene.links(place, RX_M)
        here, moved, traced = (each.gain_mean_db.numpy() for each in (links(), links(tx_m=place), there()))
        assert (np.abs(moved - traced) < np.abs(here - traced)).sum() >= len(RX_M) - 1
        assert (np.abs(moved - traced) < 0.3 * np.abs(here - traced)).sum() >= 2

    def test_two_runs_give_the_same_bytes(self, links_of):
        one, other = links_of("partial"), scene_of("partial").links(TX_M, RX_M)
        place = TX_M + 0.01
        for name in OUTPUTS:
            assert (
                getattr(one(tx_m=place), name).numpy().tobytes() == getattr(other(tx_m=place), name).numpy().tobytes()
            )

    def test_no_receivers(self, tf):
        place = tf.Variable(TX_M)
        for kind in MAPS:
            links = scene_of(kind).links(TX_M, [])
            with tf.GradientTape() as tape:
                found = links(tx_m=place)
                value = tf.reduce_sum(found.gain_mean_db)
            assert all(getattr(found, name).shape == (0,) for name in OUTPUTS)
            assert not np.any(tape.gradient(value, place, unconnected_gradients="zero"))

    @pytest.mark.parametrize("predictor", ["paper", "map"])
    @pytest.mark.parametrize(
        "place", [(2.3, 1.6, 1.4), (1e9, -1e9, 1e9), tuple(RX_M[0])], ids=["pillar", "far", "receiver"]
    )
    def test_impossible_places_have_finite_slopes(self, place, predictor, links_of, tf):
        links, place = links_of("partial", predictor), tf.Variable(np.array(place))
        with tf.GradientTape(persistent=True) as tape:
            found = links(tx_m=place)
        for name in OUTPUTS:
            assert np.isfinite(getattr(found, name)).all(), name
            slope = tape.gradient(getattr(found, name), place, unconnected_gradients="zero")
            assert np.isfinite(slope).all(), name
        np.testing.assert_allclose(found.p_los + found.p_nlos + found.p_outage, 1.0, atol=1e-6)


class TestSlopes:
    @staticmethod
    def outputs(found, tf):
        columns = [found.gain_mean_db, found.gain_std_db, 100.0 * found.p_los, 100.0 * found.coverage(-75.0, 1.0)]
        return tf.stack([*columns, found.gain_nlos_mean_db])

    @pytest.mark.parametrize("name", PARAMETERS)
    @pytest.mark.parametrize(("kind", "predictor"), [("partial", "paper"), ("partial", "map"), ("complete", None)])
    def test_by_differences(self, kind, predictor, name, links_of, tf):
        links = links_of(kind, predictor)
        variable, step = tf.Variable(getattr(links.base, name)), STEPS[name]
        share = np.random.default_rng(0).uniform(0.5, 1.5, len(RX_M))
        with tf.GradientTape(persistent=True) as tape:
            here = tf.unstack(self.outputs(links(**{name: variable}), tf) @ share[:, None])
        found = np.array([np.ravel(tape.gradient(each, variable)) for each in here])
        value = variable.numpy()
        for entry, along in enumerate(np.eye(value.size)):
            places = [value + sign * step * along.reshape(value.shape) for sign in (1, -1)]
            ends = [self.outputs(links(**{name: place}), tf).numpy() for place in places]
            expected = (ends[0] - ends[1]) / (2 * step)
            rounding = 1e-4 / step  # networks have single precision
            off = np.abs(found[:, entry] - expected @ share)
            assert (off <= 0.02 * np.abs(expected).sum(axis=1) + rounding).all()
            assert np.abs(expected[0]).sum() > 5 * rounding

    @pytest.mark.parametrize("predictor", ["paper", "map"])
    def test_weights(self, predictor, tf):
        scene = scene_of("partial", predictor)
        links, rng = scene.links(TX_M, RX_M), np.random.default_rng(0)
        for output in range(5):
            with tf.GradientTape() as tape:
                value = tf.reduce_sum(self.outputs(links(), tf)[output])
            slopes = [
                np.zeros(w.shape) if s is None else s.numpy()
                for w, s in zip(scene.weights, tape.gradient(value, scene.weights), strict=True)
            ]
            kept, step = [weight.numpy() for weight in scene.weights], 1e-3
            way = [
                slope / max(np.linalg.norm(slope), 1e-9) + 0.01 * rng.normal(size=slope.shape) / np.sqrt(slope.size)
                for slope in slopes
            ]
            ends = []
            for sign in (1, -1):
                for weight, value, along in zip(scene.weights, kept, way, strict=True):
                    weight.assign(value + sign * step * along)
                ends.append(tf.reduce_sum(self.outputs(links(), tf)[output]).numpy())
            for weight, value in zip(scene.weights, kept, strict=True):
                weight.assign(value)
            expected = (ends[0] - ends[1]) / (2 * step)
            assert sum((slope * along).sum() for slope, along in zip(slopes, way, strict=True)) == pytest.approx(
                expected, rel=0.03
            )

    def test_trace_of_a_complete_map_needs_no_weights(self, links_of, tf):
        links = links_of("complete")
        with tf.GradientTape() as tape:
            value = tf.reduce_sum(links().gain_mean_db)
        assert set(tape.gradient(value, links._scene.weights)) == {None}

    @pytest.mark.parametrize("predictor", ["paper", "map"])
    def test_weights_are_those_that_answer(self, predictor, tf):
        scene = scene_of("partial", predictor)
        links = scene.links(TX_M, RX_M)
        with tf.GradientTape() as tape:
            found = links()
            value = tf.add_n([tf.reduce_sum(getattr(found, name)) for name in OUTPUTS])
        touched = {variable.ref() for variable in tape.watched_variables()}
        assert {weight.ref() for weight in scene.weights} == touched
        assert None not in tape.gradient(value, scene.weights)


class TestSecondUse:
    def test_map_from_a_file(self, tmp_path, links_of):
        sp.export_scene(MAPS["partial"], tmp_path / "scene")
        scene = sp.DifferentiableScene(
            tmp_path / "scene", predictor="paper", trace_settings=TRACE, scene_settings=SCENE
        )
        assert_same(scene.links(TX_M, RX_M)(), links_of("partial", "paper")(), rtol=1e-6, atol=1e-9)

    def test_example_in_the_docstring(self):
        result = doctest.testmod(differentiable_links)
        assert result.attempted > 0
        assert result.failed == 0

    def test_process_ends_well_with_all_of_it_alive(self):
        code = (
            "import numpy as np, sionna_partial as sp\n"
            "field = sp.PartialMap(np.zeros((20, 60), dtype=np.uint8), 0.1)\n"
            "scene = sp.DifferentiableScene(field, predictor='paper')\n"
            "links = scene.links((1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)])\n"
            "import tensorflow as tf\n"
            "place = tf.Variable(links.base.tx_m)\n"
            "tape = tf.GradientTape(persistent=True)\n"
            "with tape:\n"
            "    found = links(tx_m=place)\n"
            "slope = tape.gradient(found.gain_mean_db, place)\n"
            "print(slope.shape)\n"
        )
        result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
        assert (result.returncode, result.stdout) == (0, "(3,)\n")
        assert "leak" not in result.stderr.lower()


class TestErrors:
    @pytest.mark.parametrize(
        ("name", "value", "remedy"),
        [
            ("tx_m", [1.0, 2.0], r"give a tensor of shape \(3,\)\."),
            ("tx_m", [[1.0, 2.0, 3.0]], r"give a tensor of shape \(3,\)\."),
            ("tx_m", [1.0, float("nan"), 1.0], r"give numbers in \[-1e\+09, 1e\+09\]\."),
            ("relative_permittivity", 2.0, r"give a tensor of shape \(1,\)\."),
            ("relative_permittivity", [0.9], r"give numbers in \[1, 1e\+06\]\."),
            ("conductivity_s_m", [-1.0], r"give numbers in \[0, 1e\+09\]\."),
            ("thickness_m", [11.0], r"give numbers in \[0, 10\]\."),
            ("frequency_hz", [28e9], r"give a tensor of shape \(\)\."),
            ("frequency_hz", 28.0, r"give numbers in \[1e\+06, 1e\+12\]\."),
        ],
    )
    def test_shape_and_range(self, name, value, remedy, links_of):
        with pytest.raises(SettingsError, match=rf"{name} = .* is not allowed: {remedy}"):
            links_of("partial", "paper")(**{name: value})

    def test_within_a_function(self, links_of, tf):
        links = links_of("partial", "paper")
        with pytest.raises(
            SettingsError, match=r"tx_m = .* is not allowed: call links eagerly, not within tf\.function"
        ):
            tf.function(lambda place: links(tx_m=place).p_los, autograph=False)(tf.constant(TX_M))

    def test_places(self, links_of):
        scene = links_of("partial", "paper")._scene
        with pytest.raises(PositionError, match=r"tx has shape \(1, 3\): give one transmitter"):
            scene.links(TX_M[None], RX_M)

    def test_second_derivatives(self, links_of, tf):
        links, place = links_of("partial", "paper"), tf.Variable(TX_M)
        with tf.GradientTape() as outer:
            with tf.GradientTape() as tape:
                value = tf.reduce_sum(links(tx_m=place).gain_mean_db)
            slope = tape.gradient(value, place)
        with pytest.raises(LookupError, match="first derivatives only"):
            outer.gradient(slope, place)

    def test_materials_are_named(self, links_of):
        scene = links_of("partial", "paper")._scene
        assert len(scene.materials) == len(links_of("partial", "paper").base.thickness_m) == 1
        assert all(getattr(links_of("partial", "paper").base, name).shape == (1,) for name in MATERIAL_PARAMETERS)
