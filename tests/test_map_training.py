"""Training of the networks that read maps and paths, on links of known rules."""

import dataclasses
import functools
import math

import numpy as np
import pytest
from predictor_links import FREQUENCY_HZ, NLOS, OUTAGE, QUIET, features, make_seen_links
from scipy.integrate import trapezoid
from scipy.stats import norm

from sionna_partial.constants import CellState
from sionna_partial.errors import PredictorError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction import map_networks as module
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.map_networks import (
    evaluate_context_networks,
    fit_context_networks,
    receiver_offsets_m,
    scaled_inputs,
)
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.prediction.unobserved import WINDOW_CELLS
from sionna_partial.settings import PredictorSettings

pytestmark = QUIET

FREE, UNKNOWN = CellState.FREE, CellState.UNKNOWN
ROOMS, ROOM_CELLS, RESOLUTION_M = 4, 8, 0.5
HALF_M = ROOMS * ROOM_CELLS * RESOLUTION_M / 2
DISTANCE_M, GAIN_DB, STD_DB = 5.0, -90.0, 3.0


@dataclasses.dataclass(frozen=True)
class Links:
    """Links that differ in nothing but the rooms that their receivers are in.

    Half of the rooms of each map are seen. The transmitter, and receivers in rooms of both kinds, stand in cells that
    are not.
    """

    phi: LinkFeatures
    in_seen_room: np.ndarray

    def truth(self):
        """Return true states and gains: NLOS in seen rooms, outage in the others."""
        linked, noise = self.in_seen_room, np.random.default_rng(0).normal(GAIN_DB, STD_DB, len(self.in_seen_room))
        return np.where(linked, NLOS, OUTAGE).astype(np.uint8), np.where(linked, noise, -150.0)


@functools.cache
def make_room_links(maps, links, seed):
    rng = np.random.default_rng(seed)
    partial, in_seen_room, rx_m = [], [], []
    for _ in range(maps):
        seen = np.kron(rng.permutation(ROOMS**2).reshape(ROOMS, ROOMS) % 2, np.ones((ROOM_CELLS, ROOM_CELLS))) > 0
        position = rng.permutation(seen.size)[:links]
        state = np.where(seen, FREE, UNKNOWN)
        state.ravel()[position] = state[len(seen) // 2, len(seen) // 2] = UNKNOWN
        partial.append(PartialMap(state, RESOLUTION_M, (-HALF_M, -HALF_M)))
        in_seen_room.append(seen.ravel()[position])
        cells = np.column_stack(np.divmod(position, len(seen)))[:, ::-1] + rng.uniform(size=(links, 2))
        rx_m.append(np.column_stack([RESOLUTION_M * cells - HALF_M, np.full(links, 1.5)]))
    count = maps * links
    where, tx_m = (tuple(partial), np.repeat(np.arange(maps), links)), (0.01, 0.01, 1.5)
    known = {"unobserved_m": 3.0, "distance_m": DISTANCE_M, "state": NLOS, "gain_db": -90.0, "indirect_db": -90.0}
    phi = features(where, np.concatenate(rx_m), tx_m=tx_m, **known)
    order = rng.permutation(count)
    return Links(phi.take(order), np.concatenate(in_seen_room)[order])


TRAINING, OTHERS = (24, 60, 1), (6, 100, 2)
"""Arguments of `make_room_links` for links to learn from, and for links on other maps."""


def test_the_rooms_of_receivers_are_learnt_from_maps(monkeypatch):
    """In few, larger steps."""
    seen, others = make_room_links(*TRAINING), make_room_links(*OTHERS)
    for name, value in {"LEARNING_RATE": 0.01, "WINDOWS_AT_ONCE": 8, "_WIDTHS": ((8, 16), (8, 16))}.items():
        monkeypatch.setattr(module, name, value)
    networks = fit_context_networks(seen.phi, *seen.truth(), PredictorSettings("map", passes=14))
    state, _ = others.truth()
    probabilities, means_db, _ = evaluate_context_networks(networks, others.phi, FREQUENCY_HZ)
    assert (probabilities.argmax(axis=0) == state).mean() > 0.9
    assert -np.log(probabilities[state, np.arange(len(state))]).mean() < 0.5 * math.log(2.0)
    assert means_db[NLOS][state == NLOS].mean() == pytest.approx(GAIN_DB, abs=4.0)


def test_diverging_training():
    phi, state, gain_db = make_seen_links(200)
    with pytest.raises(PredictorError, match=r"training diverged in step 0: give another seed\."):
        fit_context_networks(phi, state, gain_db + np.inf, PredictorSettings("paths", passes=1))


def test_crps_is_the_integral_of_the_squared_difference_of_distributions():
    gain_db = np.linspace(-60.0, 60.0, 120_001)
    errors_db, stds_db = np.array([0.0, 2.5, -7.0, 20.0]), np.array([1.0, 4.0, 3.0, 0.5])
    below = norm.cdf(gain_db / stds_db[:, None])
    expected = trapezoid((below - (gain_db >= errors_db[:, None])) ** 2, gain_db)
    np.testing.assert_allclose(module._crps(errors_db, stds_db), expected, atol=2e-3)


@pytest.fixture(scope="module")
def links():
    return make_room_links(*OTHERS)


@pytest.fixture(scope="module")
def examples(links):
    """Gains are the numbers of the links."""
    numbers = np.arange(len(links.phi), dtype=np.float64)
    return module._Examples(links.phi, links.truth()[0], numbers, PredictorSettings("map"))


class TestExamples:
    def test_links_go_with_their_window_however_it_is_turned(self, links, examples):
        """The cell of a receiver has the same values after one of the eight turns, which are all taken."""
        phi, half, cell_m = links.phi, WINDOW_CELLS / 2, 0.3
        inputs, state = scaled_inputs(phi, FREQUENCY_HZ), links.truth()[0]
        turns = set()
        for batch in examples.batches(4, np.random.default_rng(4)):
            for number, drawn in enumerate(batch["gain_db"].astype(int)):
                (window,) = set(phi.context.window_index[drawn])
                offsets_m, moved_m = receiver_offsets_m(phi)[drawn], batch["offsets_m"][number]
                before, after = ((each / cell_m + half).astype(int).T[::-1] for each in (offsets_m, moved_m))
                image = batch["windows"][number, 0]
                np.testing.assert_array_equal(image[*after], phi.context.windows[window, 0][*before])
                swapped = not np.allclose(abs(moved_m), abs(offsets_m), atol=1e-4)
                turns.add((swapped, *np.sign(moved_m[0] * (offsets_m[0, ::-1] if swapped else offsets_m[0]))))
                np.testing.assert_array_equal(batch["links"][number], inputs[drawn])
                np.testing.assert_array_equal(batch["link_state"][number], state[drawn])
                free_db = free_space_gain_db(phi.distance_m[drawn], FREQUENCY_HZ)
                np.testing.assert_allclose(batch["free_db"][number], free_db, rtol=1e-6)
        assert len(turns) == 8

    def test_each_pass_has_every_window_once(self, links, examples):
        drawn = [
            links.phi.context.window_index[int(numbers[0])]
            for batch in examples.batches(3, np.random.default_rng(6))
            for numbers in batch["gain_db"]
        ]
        count = len(examples)
        passes = [sorted(drawn[start : start + count]) for start in range(0, len(drawn) - count, count)]
        assert passes == [list(range(count))] * 7
