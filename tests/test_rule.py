"""The rule of prediction: where the trace counts, how it is mixed, and that NumPy and Keras agree."""

from dataclasses import replace

import numpy as np
import pytest
from predictor_links import QUIET, assert_symmetric, features, make_seen_links

import sionna_partial as sp
from sionna_partial.constants import CellState, LinkState
from sionna_partial.prediction.evaluate import array_ops
from sionna_partial.prediction.map_networks import rule_values
from sionna_partial.prediction.paper_networks import import_keras
from sionna_partial.prediction.rule import (
    DOUBT_SCALE,
    GATE_INPUTS,
    GATE_NETWORK,
    GATE_OUTPUTS,
    doubt,
    gate_inputs,
    mixture,
    over_materials,
    predicted,
    traced_parts,
    with_errors,
)

pytestmark = QUIET

OUTAGE, LOS, NLOS = LinkState
STATES = np.array([LOS, NLOS, OUTAGE, NLOS], dtype=np.uint8)
GAINS_DB = np.array([-70.0, -95.0, -150.0, -110.0])


def values(exposure=0.0, noise=0.0, *, possible=True):
    """Return the features of four links, traced with `STATES` and `GAINS_DB`."""
    count = len(STATES)
    return {
        "link_state": STATES,
        "gain_db": GAINS_DB,
        "exposure": np.full((count, 2), 0.5 * exposure),
        "wall_noise": np.full(count, noise),
        "possible": np.full((count, 3), possible),
        "tx_seen": np.array([True, True, False, False]),
        "rx_seen": np.array([True, False, True, True]),
        "route": np.linspace(2.0, 5.0, count),
        "distance_m": np.linspace(1.0, 9.0, count),
        "unobserved_distance_m": np.linspace(0.0, 3.0, count),
        "strongest_unobserved_m": np.linspace(0.0, 4.0, count),
        "walled_m": np.zeros(count),
        "indirect_gain_db": np.linspace(-90.0, -150.0, 5 * count).reshape(count, 5),
        "free_db": np.full(count, -75.0),
    }


def expert():
    rng, count = np.random.default_rng(3), len(STATES)
    means_db = np.stack([np.full(count, -150.0), *rng.uniform(-120.0, -60.0, (2, count))])
    return rng.dirichlet(np.ones(3), count).T, means_db, np.stack([np.zeros(count), *rng.uniform(2.0, 9.0, (2, count))])


def gate_of(*outputs, ops=array_ops):
    return lambda inputs: ops.stack([ops.zeros_like(inputs[:, 0]) + each for each in outputs], axis=1)


GATE = gate_of(0.4, -0.3, 0.2, 0.7, -0.5)


def assert_parts(found, expected, **tolerance):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(np.asarray(one), np.asarray(other), **tolerance)


@pytest.mark.parametrize("gate", [None, GATE, gate_of(-50.0, 3.0, 3.0, -3.0, 3.0)])
def test_without_doubt_the_prediction_is_the_trace(gate):
    trace = traced_parts(STATES, GAINS_DB)
    for possible in (True, False):
        assert_parts(predicted(values(possible=possible), expert(), gate), trace, rtol=0.0)
    nearly = predicted(values(1e-9), expert(), gate)
    assert_parts([nearly[0]], [trace[0]], atol=1e-6)


def test_doubt_grows_with_exposure_and_noise():
    assert doubt(values()).tolist() == [0.0] * 4
    assert doubt(values() | {"rx_seen": np.array([True, False, True, False])}).tolist() == [0.0, 0.0, 0.0, 1.0]
    found = doubt(values(0.1, 0.02))
    np.testing.assert_allclose(found, 1.0 - np.exp(-DOUBT_SCALE * 0.12))
    for more in (values(0.11, 0.02), values(0.1, 0.03)):
        assert (doubt(more) > found).all()


def test_mixture_by_hand():
    """The mean and the variance given a state are weighted by the probability of the state in each part."""
    one, other = (
        tuple(np.array([column]).T for column in (probabilities, (-150.0, -60.0, mean_db), (0.0, 2.0, std_db)))
        for probabilities, mean_db, std_db in (((0.5, 0.0, 0.5), -80.0, 3.0), ((0.2, 0.4, 0.4), -100.0, 6.0))
    )
    probabilities, means_db, stds_db = mixture((one, other), np.array([0.25, 0.75]))
    np.testing.assert_allclose(probabilities[:, 0], [0.275, 0.3, 0.425])
    shares = np.array([0.125, 0.3]) / 0.425
    mean_db = shares @ [-80.0, -100.0]
    assert means_db[:, 0] == pytest.approx([-150.0, -60.0, mean_db], abs=1e-6)
    spread = shares @ [3.0**2 + 80.0**2, 6.0**2 + 100.0**2] - mean_db**2
    assert stds_db[:, 0] == pytest.approx([0.0, 2.0, np.sqrt(spread)], abs=1e-4)
    assert_parts(mixture((one, other), np.array([[1.0], [0.0]])), one)
    never = (np.array([[1.0], [0.0], [0.0]]), one[1], one[2])
    assert np.isfinite(np.concatenate(mixture((never, never), np.array([0.5, 0.5])))).all()


class TestGate:
    def test_trust_is_the_weight_of_the_trace_where_all_is_in_doubt(self):
        logit = 0.4
        trust = 1.0 / (1.0 + np.exp(-logit))
        found = predicted(values(50.0), expert(), gate_of(logit, 0.0, 0.0, 0.0, 0.0))
        trace, beside = traced_parts(STATES, GAINS_DB)[0], expert()[0]
        np.testing.assert_allclose(found[0], trust * trace + (1.0 - trust) * beside, rtol=1e-9)
        impossible = predicted(values(50.0, possible=False), expert(), gate_of(logit, 0.0, 0.0, 0.0, 0.0))
        np.testing.assert_allclose(impossible[0], beside, rtol=1e-9)

    def test_errors_vanish_with_the_doubt_and_never_fall_below_the_floor(self):
        trace, outputs = traced_parts(STATES, GAINS_DB), GATE(np.zeros((4, 1)))
        means_db, stds_db = with_errors(trace, outputs, np.zeros(4))[1:]
        np.testing.assert_array_equal(means_db, trace[1])
        assert not stds_db.any()
        means_db, stds_db = with_errors(trace, outputs, np.ones(4))[1:]
        np.testing.assert_allclose((means_db - trace[1])[:, 0], [0.0, -3.0, 7.0])
        assert (stds_db[1:] > 0.3).all()
        assert means_db.min() == -150.0

    @pytest.mark.parametrize("kind", ["empty", "outages"])
    def test_inputs_are_finite(self, kind):
        """Of links in outage, coincident ends and unknown maps."""
        phi = make_seen_links(50)[0]
        if kind == "outages":
            nothing = replace(phi.context, indirect_gain_db=np.full((50, 5), -150.0))
            phi = replace(phi, link_state=np.zeros(50), gain_db=np.full(50, -150.0), context=nothing)
        else:
            partial = sp.PartialMap(np.full((20, 20), CellState.UNKNOWN), 0.5)
            ends = [(5.0, 5.001, 1.5), (5.0, 5.3, 1.5), (9.5, 9.5, 1.5), (300.0, -40.0, 1.0)]
            phi = features(partial, ends, tx_m=(5.0, 5.0, 1.5), gain_db=-150.0, state=OUTAGE)
        predictor = sp.Predictor.load()
        inputs = gate_inputs(rule_values(phi, 28e9), predictor.predict(phi).by_state)
        assert inputs.shape == (len(phi), len(GATE_INPUTS))
        assert np.abs(inputs).max() < 50.0
        assert predictor.network.layers[GATE_NETWORK](inputs.astype(np.float32)).shape == (len(phi), GATE_OUTPUTS)


@pytest.mark.parametrize("doubtful", [0.0, 0.05, 2.0])
def test_numpy_and_keras_agree(doubtful):
    ops = import_keras().ops
    numeric = values(doubtful, 0.1 * doubtful)
    tensors = {name: ops.convert_to_tensor(each) for name, each in numeric.items()}
    beside = tuple(map(ops.convert_to_tensor, expert()))
    for gate, of_tensors in ((None, None), (GATE, gate_of(0.4, -0.3, 0.2, 0.7, -0.5, ops=ops))):
        expected = predicted(numeric, expert(), gate)
        found = predicted(tensors, beside, of_tensors, ops)
        assert_parts(found, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(gate_inputs(tensors, beside, ops), gate_inputs(numeric, expert()), rtol=1e-9, atol=1e-9)


def test_the_residual_is_about_gains_of_links_with_a_path():
    parts = [expert(), traced_parts(STATES, GAINS_DB)]
    plain, wide = (over_materials(parts, np.array([0.3, 0.7]), residual_db) for residual_db in (0.0, 5.0))
    np.testing.assert_array_equal(plain[0], wide[0])
    np.testing.assert_array_equal(plain[1], wide[1])
    np.testing.assert_allclose(wide[2][1:], np.hypot(plain[2][1:], 5.0))
    assert not wide[2][OUTAGE].any()


def test_predictions_are_symmetric_in_the_ends():
    assert_symmetric(sp.Predictor.load(), make_seen_links(300, seed=6)[0])
