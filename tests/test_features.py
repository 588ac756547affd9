import dataclasses
import re

import numpy as np
import pytest
from extruded import HALF
from predictor_links import features
from traced import made_links

from sionna_partial.constants import LinkState
from sionna_partial.errors import PredictorError
from sionna_partial.prediction.features import LinkFeatures, link_features
from sionna_partial.prediction.space import MapSpace


def phi_of(count=3):
    ones = np.ones(count)
    return LinkFeatures(np.full(count, LinkState.LOS), 0.5 * ones, ones * np.arange(1, count + 1), -60.0 * ones)


def traced(tx, rx, gain_db=-60.0):
    state = np.full(len(rx), LinkState.NLOS, dtype=np.uint8)
    return made_links(tx, rx, link_state=state, gain_db=np.full(len(rx), gain_db))


def test_link_features():
    rx = np.array([(4.5, 2.5, 1.5), (7.5, 2.5, 1.5)])
    phi = link_features(HALF, traced((1.5, 2.5, 1.5), rx, -72.0))
    assert phi.link_state.dtype == np.uint8
    assert phi.link_state.tolist() == [LinkState.NLOS, LinkState.NLOS]
    assert phi.distance_m.tolist() == [3.0, 6.0]
    assert phi.unobserved_distance_m == pytest.approx([0.0, 2.5])
    assert phi.gain_db.tolist() == [-72.0, -72.0]
    assert phi.context.spaces == (MapSpace.of(HALF),)
    assert phi.context.rx_m.tolist() == rx.tolist()
    assert phi.context.rx_seen.tolist() == [True, False]


def test_take_and_concatenate_with_context():
    phi = features(HALF, [(1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (3.0, 0.0, 0.0)], tx_m=(0.0, 0.0, 0.0))
    some = phi.take(np.array([2, 0]))
    assert some.context.rx_m[:, 0].tolist() == some.distance_m.tolist() == [3.0, 1.0]
    joined = LinkFeatures.concatenate([some, phi])
    assert joined.context.rx_m[:, 0].tolist() == joined.distance_m.tolist() == [3.0, 1.0, 1.0, 2.0, 3.0]
    assert LinkFeatures.concatenate([some, phi_of(3)]).context is None


def test_parts_and_contexts_that_do_not_fit():
    with pytest.raises(PredictorError, match="context has 2 links: give one of the same 3 links"):
        dataclasses.replace(phi_of(3), context=features(HALF, np.ones((2, 3))).context)
    with pytest.raises(PredictorError, match="parts is empty: give at least one LinkFeatures"):
        LinkFeatures.concatenate([])
    parts = [dataclasses.replace(phi_of(), frequency_hz=each) for each in (5e9, None)]
    message = r"parts have frequency_hz = 5e\+09, None: give links of one frequency together\."
    with pytest.raises(PredictorError, match=message):
        LinkFeatures.concatenate(parts)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"link_state": [1, 1, 3]}, "link_state[2] = 3 is not allowed: use LinkState: OUTAGE 0, LOS 1, NLOS 2."),
        ({"distance_m": [-1.0, 2.0, 3.0]}, "distance_m[0] = -1 is not allowed: a distance is not negative."),
        ({"distance_m": [[1.0, 2.0, 3.0]]}, "link_state has shape (3,): give one number for each of the 1 x 3 links."),
        ({"unobserved_distance_m": [0.5, 0.5, 3.5]}, "unobserved_distance_m[2] = 3.5 is not allowed: it lies between"),
        ({"gain_db": [-60.0, -151.0, -60.0]}, "gain_db[1] = -151 is not allowed: clip gains at -150 dB"),
        ({"gain_db": ["x", "y", "z"]}, "gain_db = ['x', 'y', 'z'] is not numeric: give an array of 3 numbers."),
        ({"frequency_hz": 0.0}, "frequency_hz = 0.0 is not allowed: give a frequency in Hz, or None for that of the"),
    ],
)
def test_bad_features(change, message):
    with pytest.raises(PredictorError, match=re.escape(message)):
        dataclasses.replace(phi_of(3), **change)
