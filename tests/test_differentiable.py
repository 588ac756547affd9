"""The prediction as TensorFlow functions: values of the predictor, slopes of its finite differences."""

import functools
from dataclasses import replace

import numpy as np
import pytest
from pillar_room import RX_M as PILLAR_RX_M
from pillar_room import TX_M, small_room
from predictor_links import QUIET
from scipy import stats

import sionna_partial as sp
from sionna_partial import differentiable
from sionna_partial.constants import GAIN_FLOOR_DB, CellState
from sionna_partial.differentiable import LinkDistribution
from sionna_partial.errors import SettingsError
from sionna_partial.prediction.moved_links import moved_lengths_m, moved_paths
from sionna_partial.prediction.paper_networks import import_keras, tf
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.tracing.path_set import PARAMETERS, PathSet

pytestmark = QUIET

TRACE, DIRECT = sp.TraceSettings(max_depth=1), sp.TraceSettings(max_depth=0)
SCENE = sp.SceneSettings(material=sp.Material(thickness_m=0.02))
RX_M = np.array(
    [[1.47, 2.51, 1.7], [3.05, 0.61, 1.2], [3.12, 2.52, 1.3], [3.7, 1.2, 1.1], [2.6, 2.45, 1.9], [0.7, 0.7, 1]]
)
STEPS = dict(zip(PARAMETERS, (1e-3, 2e-3, 5e-3, 1e-5, 1e7), strict=True))
TX_LINE = (0.5, -0.5, 1.0)
OUTPUTS = LinkDistribution.COLUMNS


def partial_room():
    """Return the small room, of which a corner behind the pillar and a wall were not seen."""
    whole = small_room()
    x, y = np.meshgrid(np.arange(42), np.arange(32))
    return replace(whole, state=np.where(x + 0.5 * y > 33, CellState.UNKNOWN, whole.state).astype(np.uint8))


def finished_map():
    """Return a complete map: the robot has finished a room beside the small one, and never saw that."""
    whole = small_room()
    state = np.where(whole.state == CellState.FREE, CellState.UNKNOWN, whole.state)
    beside = np.pad(np.full((30, 9), CellState.FREE), ((1, 1), (0, 1)), constant_values=CellState.WALL)
    return replace(whole, state=np.hstack([state, beside]).astype(np.uint8))


MAPS = {
    "partial": partial_room(),
    "finished": finished_map(),
    "empty": sp.PartialMap(np.full((32, 42), CellState.UNKNOWN), 0.1),
    "complete": small_room(),
}


@functools.cache
def loaded(predictor=None):
    return sp.Predictor.load(predictor)


def new_scene(kind, predictor):
    return sp.DifferentiableScene(MAPS[kind], predictor=loaded(predictor), trace_settings=TRACE, scene_settings=SCENE)


@functools.cache
def scene_of(kind, predictor):
    return new_scene(kind, predictor)


@pytest.fixture(scope="module")
def links_of():
    """Return links of a kind of map and a predictor; each are traced once."""
    return functools.cache(lambda kind, predictor: scene_of(kind, predictor).links(TX_M, RX_M))


def predicted(kind, predictor):
    model = sp.LinkModel(MAPS[kind], loaded(predictor), TRACE, SCENE)
    return model.predict(TX_M, RX_M), sp.trace_links(model.simulation, TX_M, RX_M)


def assert_same(found, expected, **tolerance):
    for name in OUTPUTS:
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), **tolerance, err_msg=name)


class TestValues:
    @pytest.mark.parametrize(("kind", "predictor"), [("partial", "paper"), *((kind, "map") for kind in MAPS)])
    def test_unmoved_as_predictor(self, kind, predictor, links_of):
        """On a complete map as the trace, whichever the predictor; moved by nothing, the same."""
        expected, traced = predicted(kind, predictor)
        assert (traced.link_state == sp.LinkState.NLOS).any() == (kind != "empty")
        links = links_of(kind, predictor)
        here = links()
        assert_same(here, expected, rtol=1e-4, atol=1e-6)
        assert_same(links(**{name: getattr(links.base, name) for name in PARAMETERS}), here, atol=1e-4)

    @pytest.mark.parametrize("predictor", ["paper", "map"])
    def test_moved_as_a_new_trace(self, predictor, links_of):
        """Nearer than where it was for all but one, as the networks have kinks, and much nearer for some."""
        links, tx_m = links_of("partial", predictor), TX_M + np.array([0.04, -0.03, 0.02])
        there = links._scene.links(tx_m, RX_M)
        here, moved, traced = (each.gain_mean_db.numpy() for each in (links(), links(tx_m=tx_m), there()))
        assert (np.abs(moved - traced) < np.abs(here - traced)).sum() >= len(RX_M) - 1
        assert (np.abs(moved - traced) < 0.3 * np.abs(here - traced)).sum() >= 2

    def test_no_receivers(self):
        tx_m = tf.Variable(TX_M)
        for kind in ("partial", "complete"):
            links = scene_of(kind, "map").links(TX_M, [])
            with tf.GradientTape() as tape:
                value = tf.reduce_sum(links(tx_m=tx_m).gain_mean_db)
            assert value == 0.0
            assert not np.any(tape.gradient(value, tx_m, unconnected_gradients="zero"))

    @pytest.mark.parametrize("tx_m", [(1e9, -1e9, 1e9), tuple(RX_M[0])], ids=["far away", "at a receiver"])
    def test_impossible_positions_have_finite_slopes(self, tx_m, links_of):
        links, tx_m = links_of("partial", "map"), tf.Variable(np.array(tx_m))
        with tf.GradientTape() as tape:
            found = links(tx_m=tx_m)
            total = tf.add_n([getattr(found, name) for name in OUTPUTS])
        assert np.isfinite(total).all()
        assert np.isfinite(tape.gradient(total, tx_m, unconnected_gradients="zero")).all()
        np.testing.assert_allclose(found.p_los + found.p_nlos + found.p_outage, 1.0, atol=1e-6)


def outputs(found):
    columns = [found.gain_mean_db, found.gain_std_db, 100.0 * found.p_los, 100.0 * found.coverage(-75.0, 1.0)]
    return tf.stack([*columns, found.gain_nlos_mean_db])


def assert_slopes(links, names):
    """One gradient of a random sum of all outputs agrees with central differences along a line for each argument.

    Outputs have about the same part in the sum, and the axes of the transmitter in the differences.
    """
    rng = np.random.default_rng(0)
    at = {name: getattr(links.base, name) for name in names}
    lines = {name: STEPS[name] * np.reshape(TX_LINE if name == "tx_m" else 1.0, at[name].shape) for name in names}
    expected = {}
    for name, line in lines.items():
        ends = [outputs(links(**at | {name: at[name] + sign * line})).numpy() for sign in (1, -1)]
        expected[name] = (ends[0] - ends[1]) / 2.0
    parts = np.abs(expected["tx_m"]).sum(axis=1, keepdims=True)
    weights = rng.uniform(0.5, 1.5, expected["tx_m"].shape) / np.maximum(parts, 1e-3)
    variables = {name: tf.Variable(value) for name, value in at.items()}
    with tf.GradientTape() as tape:
        value = tf.reduce_sum(weights * outputs(links(**variables)))
    for name, slope in tape.gradient(value, variables).items():
        along = weights * expected[name]
        assert (slope.numpy() * lines[name]).sum() == pytest.approx(along.sum(), abs=0.004 * np.abs(along).sum())
        assert np.abs(expected[name][0]).sum() > 5e-4  # networks have single precision


class TestSlopes:
    @pytest.mark.parametrize(
        ("kind", "predictor", "names"),
        [
            ("partial", "map", PARAMETERS),
            ("partial", "paper", ("tx_m", "relative_permittivity")),
            ("complete", "map", ("tx_m",)),
        ],
    )
    def test_by_differences(self, kind, predictor, names, links_of):
        assert_slopes(links_of(kind, predictor), names)

    @pytest.mark.parametrize("predictor", ["paper", "map"])
    def test_weights(self, predictor):
        scene = new_scene("partial", predictor)
        links, rng, step = scene.links(TX_M, RX_M), np.random.default_rng(0), 1e-3

        def total():
            gain_db, _, _, covered, _ = tf.unstack(outputs(links()))
            return tf.reduce_sum(gain_db + 0.7 * covered)

        with tf.GradientTape() as tape:
            value = total()
        assert {variable.ref() for variable in tape.watched_variables()} == {weight.ref() for weight in scene.weights}
        slopes = [slope.numpy() for slope in tape.gradient(value, scene.weights, unconnected_gradients="zero")]
        kept, ends = [weight.numpy() for weight in scene.weights], []
        along_gradient = [
            slope / max(np.linalg.norm(slope), 1e-9) + 0.01 * rng.normal(size=slope.shape) / np.sqrt(slope.size)
            for slope in slopes
        ]
        for sign in (1, -1):
            for weight, value, along in zip(scene.weights, kept, along_gradient, strict=True):
                weight.assign(value + sign * step * along)
            ends.append(total().numpy())
        found = sum((slope * along).sum() for slope, along in zip(slopes, along_gradient, strict=True))
        assert found == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.03)


class TestSmoothed:
    @staticmethod
    def mean_db(found):
        return tf.reduce_mean(found.gain_mean_db)

    def test_means_of_single_predictions(self, monkeypatch):
        """Of direct paths, as others come and go: a trace leaves out weak ones. A step along the gradient ascends."""
        within_m, rx, singles = 0.01, RX_M[[0, 5]], []
        scene = sp.DifferentiableScene(MAPS["partial"], predictor=loaded("paper"), trace_settings=DIRECT)
        single = scene._with_slope
        with monkeypatch.context() as patch:
            patch.setattr(
                scene, "_with_slope", lambda *given: singles.append((given[1], *single(*given))) or singles[-1][1:]
            )
            value, gradient = scene.smoothed(self.mean_db, TX_M, rx, within_m=within_m)
        positions_m, values, slopes = (np.array(column) for column in zip(*singles, strict=True))
        angles = np.arange(8) * np.pi / 4.0
        rim_m = TX_M + within_m * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(8)])
        np.testing.assert_allclose(positions_m, [TX_M, *rim_m])
        tx_m = tf.Variable(rim_m[3])
        with tf.GradientTape() as tape:
            of_one = self.mean_db(scene.links(rim_m[3], rx)(tx_m=tx_m))
        assert of_one.numpy() == values[4]
        np.testing.assert_array_equal(tape.gradient(of_one, tx_m), slopes[4])
        weight = np.array([0.5, *np.full(8, 1.0 / 16.0)])
        assert value == pytest.approx(weight @ values, abs=1e-6)
        mean = weight @ slopes
        assert np.linalg.norm(mean) > 0.5
        np.testing.assert_allclose(gradient, mean, atol=0.02 * np.linalg.norm(mean))
        there_m = TX_M + 0.1 * gradient * (1.0, 1.0, 0.0) / np.linalg.norm(gradient[:2])
        assert scene.smoothed(self.mean_db, there_m, rx, within_m=within_m)[0] > value

    def test_what_appears_has_a_part_in_the_gradient(self):
        """Receivers in a row behind the pillar come into sight one by one, which no path's derivative shows."""
        rx = np.column_stack([np.full(60, 3.4), np.linspace(0.3, 2.8, 60), np.full(60, 1.4)])
        scene, radius_m = sp.DifferentiableScene(MAPS["complete"], trace_settings=DIRECT), 0.2
        at = TX_M + np.array([0.0, 0.4, 0.0])

        def seen(found):
            return tf.reduce_mean(found.p_los)

        gradient, across = scene.smoothed(seen, at, rx, within_m=radius_m)[1], np.array([-1.0, 1.0, 0.0]) / np.sqrt(2.0)
        ends = [scene.smoothed(seen, at + way * 0.1 * across, rx, within_m=radius_m)[0] for way in (1.0, -1.0)]
        assert gradient @ across == pytest.approx((ends[0] - ends[1]) / 0.2, abs=0.05)
        assert np.linalg.norm(gradient) > 0.2

    def test_positions_in_walls_and_at_receivers_are_left_out(self):
        near_wall = np.array([0.13, 1.5, 1.4])
        rx = np.concatenate([RX_M, near_wall[None] + (0.0, 0.1, 0.0)])
        scene = sp.DifferentiableScene(MAPS["partial"], predictor=loaded("paper"), trace_settings=DIRECT)
        value, gradient = scene.smoothed(self.mean_db, near_wall, rx)
        assert np.isfinite([value, *gradient]).all()

    def test_ascent(self, monkeypatch):
        monkeypatch.setattr(differentiable, "_RIM", differentiable._RIM[::2])

        def covered(found):
            return tf.reduce_mean(found.coverage(-75.0))

        scene = scene_of("partial", "map")
        value, gradient = scene.smoothed(covered, TX_M, RX_M)
        there = TX_M + 0.1 * np.array([*gradient[:2], 0.0]) / np.linalg.norm(gradient[:2])
        assert scene.smoothed(covered, there, RX_M)[0] > value

    def test_radius(self):
        with pytest.raises(SettingsError, match=r"within_m = 0 is not allowed: give a number in \(0, 1\]\."):
            scene_of("partial", "paper").smoothed(self.mean_db, TX_M, RX_M, within_m=0)


WIFI = sp.TraceSettings(5e9, max_depth=1)


def wifi_model(material, **changed):
    settings = sp.SceneSettings(material=material and sp.Material.named(material))
    return sp.LinkModel(MAPS["partial"], None, replace(WIFI, **{"frequency_hz": 5e9} | changed), settings)


@functools.cache
def wifi_links(material):
    return sp.DifferentiableScene(wifi_model(material)).links(TX_M, RX_M)


class TestThroughWalls:
    """Mean losses, unseen walls and unknown material on an incomplete map."""

    @pytest.mark.parametrize("material", [None, "brick"])
    def test_unmoved_as_the_link_model(self, material):
        links, expected = wifi_links(material), wifi_model(material).predict(TX_M, RX_M)
        assert {0.0, 1.0} < {*expected.p_los.tolist()}
        assert_same(links(), expected, rtol=1e-6, atol=1e-6)
        assert_same(
            links(**{name: getattr(links.base, name) for name in ("tx_m", "frequency_hz")}), expected, atol=1e-4
        )

    @pytest.mark.parametrize(("material", "names"), [(None, ("tx_m", "frequency_hz")), ("brick", PARAMETERS)])
    def test_by_differences(self, material, names):
        assert_slopes(wifi_links(material), names)

    @pytest.mark.parametrize("material", [None, "brick"])
    def test_frequency_as_other_models(self, material):
        links, frequency_hz = wifi_links(material), tf.Variable(5e9, dtype=tf.float64)
        with tf.GradientTape() as tape:
            total_db = tf.reduce_sum(links(frequency_hz=frequency_hz).gain_mean_db)
        models = [wifi_model(material, frequency_hz=5e9 + hz, power_tolerance_db=0.0) for hz in (1e7, -1e7)]
        ends = [model.predict(TX_M, RX_M).gain_mean_db.sum() for model in models]
        assert tape.gradient(total_db, frequency_hz).numpy() * 2e7 == pytest.approx(ends[0] - ends[1], rel=0.01)


class TestErrors:
    @pytest.mark.parametrize(
        ("name", "value", "remedy"),
        [
            ("tx_m", [1.0, 2.0], r"give a tensor of shape \(3,\)\."),
            ("relative_permittivity", [0.9], r"give numbers in \[1, 1e\+06\]\."),
        ],
    )
    def test_shape_and_range(self, name, value, remedy, links_of):
        with pytest.raises(SettingsError, match=rf"{name} = .* is not allowed: {remedy}"):
            links_of("partial", "paper")(**{name: value})

    def test_networks_that_learnt_from_opaque_walls(self, caplog):
        settings = replace(TRACE, frequency_hz=5e9, max_depth=2)
        sp.DifferentiableScene(MAPS["partial"], predictor="map", trace_settings=settings)
        assert "was trained on opaque walls, and is used through walls" in caplog.text

    def test_functions_and_second_derivatives(self, links_of):
        links = links_of("partial", "paper")
        with pytest.raises(SettingsError, match=r"tx_m = .* is not allowed: call links eagerly, not within"):
            tf.function(lambda tx_m: links(tx_m=tx_m).p_los, autograph=False)(tf.constant(TX_M))
        links, tx_m = links_of("partial", "paper"), tf.Variable(TX_M)
        with tf.GradientTape() as outer:
            with tf.GradientTape() as tape:
                value = tf.reduce_sum(links(tx_m=tx_m).gain_mean_db)
            slope = tape.gradient(value, tx_m)
        with pytest.raises(LookupError, match="first derivatives only"):
            outer.gradient(slope, tx_m)


@pytest.fixture(scope="module")
def paths() -> PathSet:
    return sp.Simulation(small_room(), sp.TraceSettings(max_depth=1)).paths(TX_M, PILLAR_RX_M)


class TestMovedPaths:
    def test_slopes_are_those_of_where_it_was_evaluated(self, paths):
        tx_m = tf.Variable(paths.base.tx_m)
        before = paths.base.tx_m.copy()
        with tf.GradientTape() as tape:
            value = tf.reduce_sum(moved_paths(paths, {"tx_m": tf.convert_to_tensor(tx_m)})[0])
        tx_m.assign_add([0.3, -0.2, 0.1])
        np.testing.assert_array_equal(paths.base.tx_m, before)
        np.testing.assert_allclose(tape.gradient(value, tx_m), paths.transmitter_slopes(paths.base)[0].sum(axis=0))

    def test_a_part_of_the_paths(self, paths):
        """TensorFlow hands back derivatives of single entries in another form."""
        given = {name: tf.Variable(getattr(paths.base, name)) for name in ("tx_m", "conductivity_s_m")}
        with tf.GradientTape() as tape:
            power, vertices_m = moved_paths(paths, {name: tf.identity(each) for name, each in given.items()})
            value = tf.reduce_sum(tf.gather(power, [3, 5])) + 0.0 * tf.reduce_sum(tf.gather(vertices_m, [2]))
        found, slopes = tape.gradient(value, given), paths.slopes(paths.base)
        for name, each in found.items():
            np.testing.assert_allclose(each, slopes[name][[3, 5]].sum(axis=0), rtol=1e-9)


class TestMovedLengths:
    def test_slopes(self):
        ends_m = [(1.03, 1.02, 1.5), (4.96, 2.53, 1.2)]
        lengths_m, ends = self.lengths_and_ends(0.4, ends_m)
        with tf.GradientTape() as tape:
            found_m = moved_lengths_m(lengths_m, (ends[0] + 0.0, ends[1] + 0.0))
        here = np.array(ends_m)[:, None]
        assert found_m.numpy() == lengths_m(*here)
        for end, slope in enumerate(tape.gradient(found_m, ends)):
            for axis in range(3):
                there = here.copy()
                there[end, 0, axis] += 1e-4
                grown_m = (lengths_m(*there) - lengths_m(*here)).item()
                assert slope.numpy()[0, axis] == pytest.approx(grown_m / 1e-4, abs=1e-2)

    def test_along_a_border_of_cells(self):
        lengths_m, ends = self.lengths_and_ends(0.0, [(3.8, 1.0, 1.5), (3.8, 3.0, 1.5)])
        with tf.GradientTape() as tape:
            found_m = moved_lengths_m(lengths_m, (ends[0] + 0.0, ends[1] + 0.0))
        assert [np.abs(slope).max() for slope in tape.gradient(found_m, ends)] == [30.0, 30.0]

    @staticmethod
    def lengths_and_ends(slant, ends_m):
        """Return unobserved lengths on a map that is known up to a line, and ends."""
        x, y = np.meshgrid(np.arange(60), np.arange(40))
        state = np.where(x + slant * y >= 38, CellState.UNKNOWN, CellState.FREE).astype(np.uint8)
        lengths_m = functools.partial(unobserved_lengths_m, sp.PartialMap(state, 0.1))
        return lengths_m, [tf.Variable(np.array([point])) for point in ends_m]


THRESHOLD_DB = -100.0


def random_parts(count=200, seed=0):
    """Return probabilities, means and standard deviations (3, N), some links certain in state, gain or both."""
    rng = np.random.default_rng(seed)
    probabilities = rng.dirichlet(np.ones(3), count).T
    probabilities[:, :30] = np.eye(3)[:, np.arange(30) % 3]
    means_db = np.stack([np.full(count, GAIN_FLOOR_DB), *rng.uniform(-140.0, -60.0, (2, count))])
    stds_db = np.stack([np.zeros(count), *rng.uniform(0.3, 20.0, (2, count))])
    stds_db[:, ::4] = 0.0
    return probabilities, means_db, stds_db


def of(*parts):
    return LinkDistribution.of_parts(*(tf.cast(part, tf.float64) for part in parts), ops=import_keras().ops)


class TestCoverage:
    @pytest.mark.parametrize("softness_db", [0.0, 3.0])
    def test_as_scipy(self, softness_db):
        """Slopes are of the Gaussian density, and 0 where there is no spread; nowhere NaN, be the gain where it may."""
        probabilities, means_db, stds_db = random_parts()
        means_db[1, :4] = THRESHOLD_DB
        tensors = [tf.constant(part) for part in (probabilities, means_db, stds_db)]
        with tf.GradientTape() as tape:
            tape.watch(tensors)
            covered = of(*tensors).coverage(THRESHOLD_DB, softness_db)
        of_probability, of_mean, of_std = (slope.numpy() for slope in tape.gradient(covered, tensors))
        assert all(np.isfinite(slope).all() for slope in (of_probability, of_mean, of_std))
        spread = np.hypot(stds_db, softness_db)
        with np.errstate(divide="ignore", invalid="ignore"):
            fractions = stats.norm.sf(THRESHOLD_DB, means_db, spread)
            density = np.where(spread > 0.0, stats.norm.pdf(THRESHOLD_DB, means_db, spread), 0.0)
        fractions = np.where(spread > 0.0, fractions, means_db > THRESHOLD_DB)[1:]
        np.testing.assert_allclose(covered, (probabilities[1:] * fractions).sum(axis=0), rtol=1e-10, atol=1e-14)
        np.testing.assert_allclose(of_mean[1:], (probabilities * density)[1:], rtol=1e-9, atol=1e-15)
        assert not of_mean[0].any()
        np.testing.assert_allclose(of_probability[1:], fractions, rtol=1e-9)
