"""How well materials explain measured gains, with what is assumed of them, and the way down to the next minimum."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sionna_partial.calibration.gain_errors import GainErrors, fit_errors
from sionna_partial.calibration.measured_building import LinkPaths, link_gains_db
from sionna_partial.tracing.slab import reflection_loss_db

PRIOR_SUSCEPTIBILITY, SUSCEPTIBILITY_SPREAD = 2.5, 0.9
"""Median of the relative permittivity less 1 before anything is measured, and standard deviation of its logarithm: 95 %
of materials are between 1.4 and 16. The building materials of ITU-R P.2040-3 at 28 GHz are between 1.5 and 7.1."""

PRIOR_CONDUCTIVITY_S_M, CONDUCTIVITY_SPREAD = 0.15, 1.8
"""Median of the conductivity before anything is measured [S/m], and standard deviation of its logarithm: 95 % are
between 0.004 and 5 S/m. The building materials of ITU-R P.2040-3 at 28 GHz are between 0.04 and 0.63."""

IMPEDANCE_OHM = 376.73
"""Impedance of the vacuum."""

LOWEST_GAIN_DB = -300.0
"""Predicted gain of a link whose paths all vanish [dB]."""

TYPICAL_DEG, TYPICAL_LOSS_DB = np.arange(0.0, 80.0, 2.5), 30.0
"""Angles of incidence at which reflections are compared [degrees], and the largest loss that counts [dB]."""

Report = Callable[[float, str], None]


@dataclass(frozen=True)
class Point:
    """Materials, and how well they explain the measurements.

    Parameters
    ----------
    permittivity, conductivity_s_m : (M,) float64 arrays
    loss : float
        Negative logarithm of the posterior density of the logarithms, but for a constant.
    errors : GainErrors
    """

    permittivity: NDArray[np.float64]
    conductivity_s_m: NDArray[np.float64]
    loss: float
    errors: GainErrors

    @property
    def logs(self) -> NDArray[np.float64]:
        """Logarithms (2 M,) of permittivity less 1, and of conductivity [S/m]."""
        return np.log(np.concatenate([self.permittivity - 1.0, self.conductivity_s_m]))


@dataclass(frozen=True)
class Posterior:
    """What measurements leave open about one material: K values with weights that sum to 1.

    Parameters
    ----------
    permittivity, conductivity_s_m, weight : (K,) float64 arrays
    """

    permittivity: NDArray[np.float64]
    conductivity_s_m: NDArray[np.float64]
    weight: NDArray[np.float64]

    def deviation(self, values: NDArray[np.float64], best: float) -> float:
        """Root mean square of how far values (K,) are from the best one."""
        return float(np.sqrt(self.weight @ (values - best) ** 2))

    def typical(self, thickness_m: float, frequency_hz: float) -> int:
        """Return the value whose reflection losses are nearest to their mean: the likeliest one may be an odd one."""
        loss_db = reflection_loss_db(
            self.permittivity[:, None], self.conductivity_s_m[:, None], thickness_m, frequency_hz, TYPICAL_DEG
        )
        shown = np.minimum(loss_db, TYPICAL_LOSS_DB)
        return int(np.argmin(((shown - self.weight @ shown) ** 2).sum(axis=1)))

    def interval(self, values: NDArray[np.float64]) -> tuple[float, float]:
        """Central 95 % of values (K,)."""
        order = np.argsort(values, kind="stable")
        place = np.cumsum(self.weight[order]) - 0.5 * self.weight[order]
        low, high = np.interp((0.025, 0.975), place, values[order])
        return float(low), float(high)


class MaterialTarget:
    """How well materials explain measured gains.

    Parameters
    ----------
    paths : LinkPaths
        Of N links, each with a path.
    gain_db : (N,) float64 array
        Measured gains [dB].

    Attributes
    ----------
    known : dict of str to list of float
        What has been found, by place; what is there is not evaluated again.
    on_progress : callable
        Called when something has been found.
    """

    def __init__(self, paths: LinkPaths, gain_db: NDArray[np.float64]) -> None:
        self.paths, self.gain_db = paths, gain_db
        self.known: dict[str, list[float]] = {}
        self.is_direct = np.zeros(len(gain_db), dtype=bool)
        self.is_direct[paths.link[paths.is_direct]] = True
        self.on_progress: Callable[[], None] = lambda: None

    def gains_db(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Predicted gains (N,) for (M,) materials [dB]."""
        return self._gains_db(self.paths.power(permittivity, conductivity_s_m))

    def at(self, permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> Point:
        """Judge materials (M,)."""
        key = _key(permittivity, conductivity_s_m)
        if key not in self.known:
            self._learn(key, self.gains_db(permittivity, conductivity_s_m))
            self.on_progress()
        loss, *errors_found = self.known[key]
        loss += _prior_loss(permittivity, conductivity_s_m)
        return Point(permittivity, conductivity_s_m, loss, GainErrors(*errors_found))

    def _gains_db(self, power: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.maximum(link_gains_db(power, self.paths.link, len(self.gain_db)), LOWEST_GAIN_DB)

    def _learn(self, key: str, gains_db: NDArray[np.float64]) -> None:
        errors, loss = fit_errors(self.gain_db - gains_db, self.is_direct)
        self.known[key] = [loss, errors.noise_db, errors.missed_share, errors.blocked_share]

    def slopes(self, point: Point) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Gradient (2 M,) and curvature (2 M, 2 M) of the loss over the logarithms, by Sionna RT and Dr.Jit."""
        key = f"slopes {_key(point.permittivity, point.conductivity_s_m)}"
        size = 2 * len(point.permittivity)
        if key not in self.known:
            gradient, curvature = self._slopes(point)
            self.known[key] = [*gradient.tolist(), *curvature.ravel().tolist()]
            self.on_progress()
        numbers = np.array(self.known[key])
        return numbers[:size], numbers[size:].reshape(size, size)

    def _slopes(self, point: Point) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        link, count = self.paths.link, len(self.gain_db)
        power, slopes = self.paths.slopes(point.permittivity, point.conductivity_s_m)
        total = np.maximum(np.bincount(link, weights=power, minlength=count), 1e-30)
        scale = np.concatenate([point.permittivity - 1.0, point.conductivity_s_m])
        sums = [np.bincount(link, weights=column, minlength=count) for column in slopes.T]
        jacobian: NDArray[np.float64] = np.stack(sums, axis=1) * (10.0 / math.log(10.0) * scale / total[:, None])
        error_db = self.gain_db - np.maximum(10.0 * np.log10(total), LOWEST_GAIN_DB)
        _, first, second = point.errors.curve(error_db, self.is_direct)
        off, information = _prior_slopes(point)
        curvature: NDArray[np.float64] = (jacobian.T * np.maximum(second, 0.0)) @ jacobian + np.diag(information)
        return -jacobian.T @ first + off, curvature


def descend(
    target: MaterialTarget, start: Point, report: Report, most_steps: int = 30
) -> tuple[list[Point], NDArray[np.float64]]:
    """Follow the slopes to a minimum of the loss, by Newton's method with damping (Levenberg and Marquardt).

    Parameters
    ----------
    target : MaterialTarget
    start : Point
    report : callable
        Called as ``report(share_done, message)``.
    most_steps : int
        Largest number of steps.

    Returns
    -------
    list of Point
        The start, and each step that made the loss smaller.
    (2 M, 2 M) float64 array
        Curvature at the last.
    """
    steps, damping = [start], 1e-3
    gradient, curvature = target.slopes(start)
    for number in range(most_steps):
        move = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature)), -gradient)
        move /= max(1.0, float(np.abs(move).max()))
        size = len(move) // 2
        values = np.exp(steps[-1].logs + move)
        trial = target.at(1.0 + values[:size], values[size:])
        report((number + 1) / most_steps, "following the slopes")
        if trial.loss < steps[-1].loss:
            gained = steps[-1].loss - trial.loss
            steps.append(trial)
            gradient, curvature = target.slopes(trial)
            damping = max(damping / 5.0, 1e-6)
            if gained < 1e-3:
                break
        elif damping > 1e4 or np.abs(move).max() < 1e-6:
            break
        else:
            damping *= 8.0
    return steps, curvature


def prior_posterior() -> Posterior:
    """Return what is assumed about a material before anything is measured."""
    spread = np.linspace(-3.0, 3.0, 31)
    weight = np.exp(-0.5 * spread**2)
    first, second = (axis.ravel() for axis in np.meshgrid(spread, spread))
    weights = np.outer(weight, weight).ravel()
    return Posterior(
        1.0 + PRIOR_SUSCEPTIBILITY * np.exp(SUSCEPTIBILITY_SPREAD * first),
        PRIOR_CONDUCTIVITY_S_M * np.exp(CONDUCTIVITY_SPREAD * second),
        weights / weights.sum(),
    )


def lossless_scale_s_m(index: float, thickness_m: float) -> float:
    """Conductivity that takes 8.7 dB on the way through a slab and back [S/m]."""
    return index / (IMPEDANCE_OHM * thickness_m)


def _key(permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> str:
    return " ".join(float(value).hex() for value in (*permittivity, *conductivity_s_m))


def _prior_loss(permittivity: NDArray[np.float64], conductivity_s_m: NDArray[np.float64]) -> float:
    first = np.log((permittivity - 1.0) / PRIOR_SUSCEPTIBILITY) / SUSCEPTIBILITY_SPREAD
    second = np.log(conductivity_s_m / PRIOR_CONDUCTIVITY_S_M) / CONDUCTIVITY_SPREAD
    return 0.5 * float((first**2).sum() + (second**2).sum())


def _prior_slopes(point: Point) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradient (2 M,) and information (2 M,) of what is assumed."""
    count = len(point.permittivity)
    centre = np.log(np.repeat([PRIOR_SUSCEPTIBILITY, PRIOR_CONDUCTIVITY_S_M], count))
    information = np.repeat([SUSCEPTIBILITY_SPREAD**-2.0, CONDUCTIVITY_SPREAD**-2.0], count)
    return information * (point.logs - centre), information
