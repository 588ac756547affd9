"""The tolerance of predictions, on maps where weak paths lead through observed space."""

import functools

import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.checks import no_progress
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.prediction.features import LinkFeatures, features_of_paths
from sionna_partial.prediction.unobserved import path_unobserved_m
from sionna_partial.resources import scenes_folder


@pytest.mark.parametrize("frequency_hz", [28e9, 5e9])
def test_the_tolerance_bounds_power_and_power_through_observed_space(frequency_hz: float) -> None:
    """A weak path in observed space counts beside a strong one through unknown cells."""
    partial = sp.load_map(scenes_folder() / "apartment/step100")
    free = np.argwhere(partial.state == sp.CellState.FREE)
    cells = free[np.random.default_rng(0).choice(len(free), 26, replace=False)]
    tx_m, *rx_m = np.column_stack([cell_centres_m(partial, cells), np.full(len(cells), 1.5)])
    unobserved = functools.partial(path_unobserved_m, partial)

    def features(tolerance_db: float) -> LinkFeatures:
        settings = sp.TraceSettings(frequency_hz, max_depth=3, power_tolerance_db=tolerance_db)
        simulation = sp.Simulation(partial, settings, sp.SceneSettings(material="drywall"))
        paths = simulation.blocks(tx_m, np.array(rx_m), no_progress, None, unobserved)
        return features_of_paths(partial, tx_m, np.array(rx_m), paths, simulation.resolved)

    every, some = features(0.0), features(0.1)
    np.testing.assert_allclose(some.gain_db, every.gain_db, atol=0.2)
    assert every.context is not None
    assert some.context is not None
    np.testing.assert_allclose(some.context.indirect_gain_db, every.context.indirect_gain_db, atol=0.3)
