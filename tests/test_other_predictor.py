"""A model of the user in place of a predictor."""

import numpy as np
import pytest
from placement_cases import home

import sionna_partial as sp
from sionna_partial.errors import PredictorError

HALF_SEEN = "#####???\n#..#????\n#......?\n#..#????\n#####???"
TX = (0.75, 1.25, 1.5)


class Constant:
    """Says the same of all links."""

    def __init__(self, **columns: float) -> None:
        self.columns = {"p_los": 0.25, "p_nlos": 0.5, "p_outage": 0.25, "gain_mean_db": -90.0, "gain_std_db": 5.0}
        self.columns |= columns

    def predict(self, phi: sp.LinkFeatures) -> dict[str, np.ndarray]:
        assert phi.context is not None
        return {name: np.full(len(phi), value) for name, value in self.columns.items() if not np.isinf(value)}


def test_it_predicts_what_is_not_certain() -> None:
    model = sp.LinkModel(home(HALF_SEEN), Constant())
    found = model.predict(TX, [[3.2, 0.4, 1.5]])
    assert found.p_los.tolist() == [0.25]
    assert found.gain_mean_db[0] == pytest.approx(0.75 * -90.0 + 0.25 * -150.0)
    coverage = sp.predict_map(home(HALF_SEEN), TX, predictor=Constant(), spacing_m=0.5)
    assert "Constant" in coverage.attrs["predictor"]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"p_los": 0.9}, "p_los.*the three probabilities sum to 1"),
        ({"gain_std_db": -1.0}, "std.*give 0 or more"),
        ({"gain_mean_db": np.nan}, "gain_los_mean_db.*give finite numbers"),
        ({"gain_mean_db": np.inf}, "returned no 'gain_los_mean_db'"),
    ],
)
def test_what_is_no_distribution_is_refused(columns: dict[str, float], message: str) -> None:
    with pytest.raises(PredictorError, match=message):
        sp.LinkModel(home(HALF_SEEN), Constant(**columns)).predict(TX, [[3.2, 0.4, 1.5]])
