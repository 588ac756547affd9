"""Made-up gains of reflections whose posterior is known, without tracing anything."""

from typing import cast

import numpy as np
from numpy.typing import NDArray

from sionna_partial.calibration.material_fit import LinkPaths, MaterialTarget, Point
from sionna_partial.tracing.power import reflection_loss_db

FREQUENCY_HZ, THICKNESS_M = 28e9, 0.03
ANGLES_DEG = np.linspace(2.0, 78.0, 60)


class FakePaths:
    """One reflection a link, at an angle of its own, in double precision."""

    link = np.arange(len(ANGLES_DEG))
    is_direct = np.zeros(len(ANGLES_DEG), dtype=bool)

    def power(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> NDArray[np.float64]:
        loss_db = reflection_loss_db(
            float(permittivity[0]), float(conductivity_s_m[0]), THICKNESS_M, FREQUENCY_HZ, ANGLES_DEG
        )
        return np.asarray(10.0 ** (-(80.0 + loss_db) / 10.0))

    def slopes(
        self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        at = np.concatenate([permittivity, conductivity_s_m])
        ends = [
            [self.power(position[:1], position[1:]) for position in (at + move, at - move)] for move in np.eye(2) * 1e-6
        ]
        slopes = np.stack([(high - low) / 2e-6 for high, low in ends], axis=1)
        return self.power(permittivity, conductivity_s_m), slopes


def fake_target(
    permittivity: float, conductivity_s_m: float, noise_db: float = 1.0, weight: float = 1.0
) -> MaterialTarget:
    gain_db = 10.0 * np.log10(FakePaths().power(np.array([permittivity]), np.array([conductivity_s_m])))
    noise = noise_db * np.random.default_rng(0).standard_normal(len(gain_db))
    return MaterialTarget(cast(LinkPaths, FakePaths()), gain_db + noise, np.zeros(len(gain_db)), weight)


def quiet(share: float, message: str) -> None:
    assert 0.0 <= share <= 1.0
    assert message


def point(target: MaterialTarget, permittivity: float, conductivity_s_m: float) -> Point:
    return target.at(np.array([[permittivity], [conductivity_s_m]]))
