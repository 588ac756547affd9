"""The rule of prediction: the one place where the distribution of a link is made.

Two experts know a link: the trace of the partial map, and a model of unobserved space (networks, or mean losses through
walls). The prediction is their mixture. The trace has the weight 1 - doubt (1 - trust).

- doubt grows from 0 with the exposure of both ends to unobserved space and with the range noise of the walls near them:
  where nothing unknown and no error can change a link, the prediction is the trace exactly.
- trust, 0 to 1, and the errors of the trace are outputs of the gate, a network that was trained on buildings of all
  kinds. Without a gate trust is 0, and the trace has no errors.

All functions take NumPy arrays, or tensors with `ops` = keras.ops.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import ModuleType
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from sionna_partial.arrays import Bools, Floats, States, read_only
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.display import Shown
from sionna_partial.prediction.evaluate import array_ops
from sionna_partial.prediction.features import LinkFeatures, link_numbers, require_each
from sionna_partial.prediction.space import WALK_M

GATE_NETWORK, GATE_OUTPUTS = "gate_network", 5
"""Name of the gate, and its outputs: logit of trust; shift and spread of the traced gain given LOS, and given NLOS."""

DOUBT_SCALE = 8.0
"""Growth of the logarithm of 1 - doubt with exposure and noise."""

_SHIFT_DB, _STDS_DB, _SPREAD_RANGE = 10.0, (1.0, 4.0), 2.5
"""Unit of shifts; standard deviations of an untrained gate; largest logarithm of a change of them."""

RARE = 1e-9
"""Probability below which means and standard deviations given a link state are those of all parts."""


Parts = tuple[Any, Any, Any]
"""Probabilities, means and standard deviations of the gain [dB] by LinkState, each (3, N)."""


def doubt(values: Mapping[str, Any], ops: Any = array_ops) -> Any:
    """Return the doubt (N,) about the trace, 0 to 1; 1 for links without an observed end."""
    exposure, unseen = values["exposure"], ~(values["tx_seen"] | values["rx_seen"])
    doubts = 1.0 - ops.exp(-DOUBT_SCALE * (exposure[:, 0] + exposure[:, 1] + values["wall_noise"]))
    return ops.where(unseen, 1.0, doubts)


def traced_parts(traced: Any, gain_db: Any, ops: Any = array_ops) -> Parts:
    """Return the trace without errors."""
    one = ops.ones_like(gain_db)
    states = ops.stack([ops.where(traced == state, one, 0.0 * one) for state in LinkState])
    means_db = ops.stack([gain_db] * len(LinkState))
    return states, means_db, ops.zeros_like(means_db)


def predicted(
    values: Mapping[str, Any], expert: Parts, gate: Callable[[Any], Any] | None = None, ops: Any = array_ops
) -> Parts:
    """Return the mixture of the trace and the expert for unobserved space.

    `values` are features by name (`map_networks.rule_values`), with the free-space gain `free_db`.
    """
    doubts, trace = doubt(values, ops), traced_parts(values["link_state"], values["gain_db"], ops)
    if gate is None:
        return mixture((trace, expert), ops.stack([1.0 - doubts, doubts]), ops)
    outputs = gate(gate_inputs(values, expert, ops))
    possible = ops.sum(ops.where(ops.transpose(values["possible"]), trace[0], 0.0), axis=0)
    trust = possible * ops.sigmoid(outputs[:, 0])
    weight = 1.0 - doubts * (1.0 - trust)
    weights = ops.stack([weight, 1.0 - weight])
    return mixture((with_errors(trace, outputs, doubts, ops), expert), weights, ops)


def with_errors(trace: Parts, outputs: Any, doubts: Any, ops: Any = array_ops) -> Parts:
    """Return the trace with the errors of the gate, which vanish with the doubt."""
    shifts_db = [doubts * _SHIFT_DB * outputs[:, column] for column in (1, 3)]
    doubtful = doubts > 0.0
    root = ops.where(doubtful, ops.sqrt(ops.where(doubtful, doubts, 1.0)), 0.0)
    stds_db = [
        root * std_db * ops.exp(_SPREAD_RANGE * ops.tanh(outputs[:, column] / _SPREAD_RANGE))
        for column, std_db in zip((2, 4), _STDS_DB, strict=True)
    ]
    nothing = ops.zeros_like(shifts_db[0])
    means_db = ops.maximum(trace[1] + ops.stack([nothing, *shifts_db]), GAIN_FLOOR_DB)
    return trace[0], means_db, ops.stack([nothing, *stds_db])


def mixture(parts: Sequence[Parts], weights: Any, ops: Any = array_ops) -> Parts:
    """Return the mixture of K distributions of the same links by weights (K,) or (K, N), which sum to 1.

    `ops` is `array_ops`, or keras.ops for tensors.
    """
    if len(parts) == 1:
        return parts[0]
    p_all, means_db, stds_db = (ops.stack(each) for each in zip(*parts, strict=True))
    weights = ops.reshape(weights, (len(parts), 1, -1))
    probabilities = ops.sum(weights * p_all, axis=0)
    fractions = weights * (p_all + RARE)  # states that no part allows have the mean of all
    fractions = fractions / ops.sum(fractions, axis=0)
    mean_db = ops.sum(fractions * means_db, axis=0)
    variance = ops.sum(fractions * (stds_db**2 + (means_db - mean_db) ** 2), axis=0)
    spread = variance > 0.0
    std_db = ops.where(spread, ops.sqrt(ops.where(spread, variance, 1.0)), 0.0)
    return probabilities / ops.sum(probabilities, axis=0), mean_db, std_db


def over_materials(parts: Sequence[Parts], prior: Any, residual_db: float, ops: Any = array_ops) -> Parts:
    """Return the mixture over wall materials; `residual_db` is the standard deviation about the true trace."""
    probabilities, means_db, stds_db = mixture(parts, prior, ops)
    has_path = np.arange(len(LinkState))[:, None] != LinkState.OUTAGE
    return probabilities, means_db, ops.where(has_path, ops.sqrt(stds_db**2 + residual_db**2), 0.0)


_SCALE_M, _SCALE_DB, _SCALE_ROUTE = 3.0, 30.0, 10.0


@dataclass(frozen=True)
class LinkInputs:
    """Features of N links, from which the inputs of networks are made, and the expert for the gate."""

    values: Mapping[str, Any]
    expert: Any
    ops: Any

    def __getitem__(self, name: Any) -> Any:
        """Return a feature by its name."""
        return self.values[name]

    def flag(self, mask: Any) -> Any:
        """Return 1 where a mask is True, else 0."""
        one = self.ops.ones_like(self["gain_db"])
        return self.ops.where(mask, one, 0.0 * one)

    def log_length(self, length_m: Any) -> Any:
        """Return a length, compressed."""
        return self.ops.log(1.0 + self.ops.maximum(length_m, 0.0) / _SCALE_M)

    def depth(self, gain_db: Any) -> Any:
        """Return how far a gain is below free space."""
        return self.ops.clip((self["free_db"] - gain_db) / _SCALE_DB, -0.5, 3.0)

    def indirect(self, column: int) -> Any:
        """Return the depth of the indirect power for one attenuation length."""
        return self.depth(self["indirect_gain_db"][:, column])

    def apart(self, state: LinkState) -> Any:
        """Return the mean of the expert relative to the trace."""
        return self.ops.clip((self.expert[1][int(state)] - self["gain_db"]) / _SCALE_DB, -2.0, 3.0)


SHARED_INPUTS: dict[str, Callable[[LinkInputs], Any]] = {
    **{state.name.lower(): lambda of, state=state: of.flag(of["link_state"] == state) for state in LinkState},  # type: ignore[misc]
    "both_seen": lambda of: of.flag(of["tx_seen"] & of["rx_seen"]),
    "an_end_seen": lambda of: of.flag(of["tx_seen"] | of["rx_seen"]),
    "exposure": lambda of: of["exposure"][:, 0] + of["exposure"][:, 1],
    "both_exposed": lambda of: of["exposure"][:, 0] * of["exposure"][:, 1],
    "noise": lambda of: of["wall_noise"],
    "route": lambda of: of["route"] / _SCALE_ROUTE,
    "detour": lambda of: of.log_length(of["route"] * WALK_M - of["distance_m"]),
}
"""First inputs of the gate and of the link network (`map_networks.LINK_INPUTS`)."""

GATE_INPUTS: dict[str, Callable[[LinkInputs], Any]] = {
    **SHARED_INPUTS,
    "distance": lambda of: of.log_length(of["distance_m"]),
    "unobserved": lambda of: of.log_length(of["unobserved_distance_m"]),
    "strongest_unobserved": lambda of: of.log_length(of["strongest_unobserved_m"]),
    "walled": lambda of: of.ops.minimum(of["walled_m"], 1.0),
    "depth": lambda of: of.depth(of["gain_db"]),
    **{f"indirect_{column}": lambda of, column=column: of.indirect(column) for column in range(5)},  # type: ignore[misc]
    "hidden_power": lambda of: of.indirect(4) - of.indirect(0),
    **{
        f"expert_p_{state.name.lower()}": lambda of, state=state: of.expert[0][int(state)]  # type: ignore[misc]
        for state in LinkState
    },
    "expert_los_apart": lambda of: of.apart(LinkState.LOS),
    "expert_nlos_apart": lambda of: of.apart(LinkState.NLOS),
    "expert_nlos_width": lambda of: of.ops.log(of.expert[2][int(LinkState.NLOS)] / 10.0),
}
"""Inputs of the gate in order, dimensionless and symmetric in the ends of a link, if the expert is."""


def gate_inputs(values: Mapping[str, Any], expert: Parts, ops: Any = array_ops) -> Any:
    """Return the inputs (N, len(GATE_INPUTS)) of the gate."""
    links = LinkInputs(values, expert, ops)
    return ops.stack([make(links) for make in GATE_INPUTS.values()], axis=1)


@read_only
@dataclass(frozen=True, eq=False)
class LinkPrediction(Shown):
    """Predictive distribution of link state and path gain; every array is (N,) or (T, N) float64.

    `Predictor.predict` returns it for receivers indoors, `anywhere` for receivers that may be outdoors.

    Parameters
    ----------
    p_los, p_nlos, p_outage : arrays
        Probabilities of the link states; they sum to 1.
    gain_mean_db, gain_std_db : arrays
        Mean and standard deviation over all link states, with -150 dB for an outage [dB].
    gain_los_mean_db, gain_los_std_db, gain_nlos_mean_db, gain_nlos_std_db : arrays
        Mean and standard deviation given LOS, and given NLOS [dB].
    by_material : (tuple of LinkPrediction, (K,) float64 array), optional
        For walls of unknown material, the distributions for each candidate, without the residual of gains about a
        trace, and the probabilities of the candidates.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> phi = sp.LinkFeatures([1, 0], unobserved_distance_m=[0.0, 4.5], distance_m=[3.0, 6.0], gain_db=[-71.0, -150.0])
    >>> sp.Predictor.load("paper").predict(phi).p_los.round() + 0.0
    array([1., 0.])
    """

    p_los: Floats
    p_nlos: Floats
    p_outage: Floats
    gain_mean_db: Floats
    gain_std_db: Floats
    gain_los_mean_db: Floats
    gain_los_std_db: Floats
    gain_nlos_mean_db: Floats
    gain_nlos_std_db: Floats

    by_material: tuple[tuple[LinkPrediction, ...], Floats] | None = None

    COLUMNS: ClassVar[tuple[str, ...]]
    """Names of the arrays."""

    @property
    def materials(self) -> tuple[tuple[LinkPrediction, ...], Floats]:
        """`by_material`, or this distribution as the only one."""
        return self.by_material or ((self,), np.ones(1))

    @classmethod
    def over_materials(cls, parts: Sequence[LinkPrediction], weights: Floats, residual_db: float) -> LinkPrediction:
        """Return the mixture over materials; `residual_db` is the standard deviation about the true trace."""
        mixed = cls.of_parts(*over_materials([part.by_state for part in parts], weights, residual_db))
        return replace(mixed, by_material=(tuple(parts), weights))

    @classmethod
    def of_columns(cls, column: Callable[[str], Any]) -> LinkPrediction:
        """Return the distribution whose arrays a function gives by name."""
        return LinkPrediction(**{name: column(name) for name in cls.COLUMNS})

    def mapped(self, change: Callable[[LinkPrediction], LinkPrediction]) -> LinkPrediction:
        """Apply `change` to this distribution and to its parts by material."""
        return self._combined([self], lambda links: change(links[0]))

    @classmethod
    def _combined(
        cls, some: Sequence[LinkPrediction], combine: Callable[[Sequence[LinkPrediction]], LinkPrediction]
    ) -> LinkPrediction:
        """Combine distributions, and their parts for each material; one without parts is the same for all."""
        whole, found = combine(some), [links.by_material for links in some if links.by_material is not None]
        if not found:
            return whole
        weights = found[0][1]
        under = [(links,) * len(weights) if links.by_material is None else links.by_material[0] for links in some]
        return replace(whole, by_material=(tuple(combine(parts) for parts in zip(*under, strict=True)), weights))

    @property
    def link_state(self) -> States:
        """Most probable LinkState (N,)."""
        return np.argmax([self.p_outage, self.p_los, self.p_nlos], axis=0).astype(np.uint8)

    @classmethod
    def of_parts(cls, probabilities: Any, means_db: Any, stds_db: Any, *, ops: ModuleType = np) -> Self:
        """Combine distributions given LinkState (3, N); `ops` is NumPy, or keras.ops for tensors."""
        mean_db = ops.maximum(ops.sum(probabilities * means_db, axis=0), GAIN_FLOOR_DB)
        variance = ops.sum(probabilities * (stds_db**2 + (means_db - mean_db) ** 2), axis=0)
        spread = variance > 0.0
        return cls(
            p_los=probabilities[LinkState.LOS],
            p_nlos=probabilities[LinkState.NLOS],
            p_outage=probabilities[LinkState.OUTAGE],
            gain_mean_db=mean_db,
            gain_std_db=ops.where(spread, ops.sqrt(ops.where(spread, variance, 1.0)), 0.0),
            gain_los_mean_db=means_db[LinkState.LOS],
            gain_los_std_db=stds_db[LinkState.LOS],
            gain_nlos_mean_db=means_db[LinkState.NLOS],
            gain_nlos_std_db=stds_db[LinkState.NLOS],
        )

    @property
    def by_state(self) -> tuple[Floats, Floats, Floats]:
        """Arguments of `of_parts`: probabilities, means and standard deviations [dB], each (3, N)."""
        nothing = np.zeros_like(self.p_outage)
        return (
            np.stack([self.p_outage, self.p_los, self.p_nlos]),
            np.stack([nothing + GAIN_FLOOR_DB, self.gain_los_mean_db, self.gain_nlos_mean_db]),
            np.stack([nothing, self.gain_los_std_db, self.gain_nlos_std_db]),
        )

    @classmethod
    def of_trace(cls, phi: LinkFeatures) -> LinkPrediction:
        """Return the trace as a prediction without uncertainty, as on a complete map (paper, eq. 9)."""
        return cls.of_parts(*traced_parts(phi.link_state, phi.gain_db))

    def probability_above(self, threshold_db: float | Floats) -> Floats:
        """Return the probability (N,) that the path gain exceeds a threshold t [dB]; an outage has -150 dB.

        ``p_los Phi((m_los - t) / s_los) + p_nlos Phi((m_nlos - t) / s_nlos) + p_outage (-150 > t)`` with means m,
        standard deviations s and the normal distribution function Phi.
        """
        probability = self.p_outage * (threshold_db < GAIN_FLOOR_DB)
        for p_state, mean_db, std_db in (
            (self.p_los, self.gain_los_mean_db, self.gain_los_std_db),
            (self.p_nlos, self.gain_nlos_mean_db, self.gain_nlos_std_db),
        ):
            above_db, spread = mean_db - threshold_db, std_db > 0.0
            normal = ndtr(above_db / np.where(spread, std_db, 1.0))
            probability = probability + p_state * np.where(spread, normal, above_db > 0.0)
        return probability

    def amplified(self, change_db: ArrayLike) -> LinkPrediction:
        """Return the distribution with gains higher by `change_db`, a number or (N,) [dB].

        Outages stay, and no gain falls below -150 dB.
        """
        has_path = np.arange(len(LinkState))[:, None] != LinkState.OUTAGE

        def amplified(links: LinkPrediction) -> LinkPrediction:
            probabilities, means_db, stds_db = links.by_state
            means_db = np.maximum(means_db + np.where(has_path, change_db, 0.0), GAIN_FLOOR_DB)
            return LinkPrediction.of_parts(probabilities, means_db, stds_db)

        return self.mapped(amplified)

    def take(self, index: NDArray[np.generic] | slice | tuple[slice, slice]) -> LinkPrediction:
        """Select links by an index array, a mask (N,), or slices."""
        return self._by_column(lambda column: column[index])

    @classmethod
    def concatenate(cls, parts: Sequence[LinkPrediction]) -> LinkPrediction:
        """Join links."""

        def join(parts: Sequence[LinkPrediction]) -> LinkPrediction:
            return cls.of_columns(lambda name: np.concatenate([getattr(part, name) for part in parts]))

        return cls._combined(parts, join)

    @classmethod
    def mixture(cls, parts: Sequence[LinkPrediction], weights: Floats) -> LinkPrediction:
        """Return the mixture of K distributions of the same links by weights (K,) or (K, N), which sum to 1."""
        if len(parts) == 1:
            return parts[0]
        return cls._combined(parts, lambda some: cls.of_parts(*mixture([part.by_state for part in some], weights)))

    def reshaped(self, shape: tuple[int, ...]) -> LinkPrediction:
        """Return the links in another shape."""
        return self._by_column(lambda column: column.reshape(shape))

    def _by_column(self, change: Callable[[Floats], Floats]) -> LinkPrediction:
        return self.mapped(lambda links: self.of_columns(lambda name: change(getattr(links, name))))

    def where(self, taken: Bools, other: LinkPrediction) -> LinkPrediction:
        """Return `other` where a mask (N,) is True, this distribution elsewhere."""

        def choose(links: Sequence[LinkPrediction]) -> LinkPrediction:
            here, there = links
            return self.of_columns(lambda name: np.where(taken, getattr(there, name), getattr(here, name)))

        return self._combined([self, other], choose)

    def anywhere(self, p_indoor: ArrayLike) -> LinkPrediction:
        """Return the distribution for receivers that may be outdoors, in outage (paper, "Indoor-Outdoor Estimation").

        Parameters
        ----------
        p_indoor : (N,) array-like
            Probability that each receiver is indoors.

        Returns
        -------
        LinkPrediction

        Raises
        ------
        PredictorError
            For another shape, or a value outside [0, 1].
        """
        indoors = link_numbers("p_indoor", p_indoor, self.p_los.shape)
        require_each((indoors >= 0.0) & (indoors <= 1.0), "p_indoor", indoors, "it lies between 0 and 1.")

        def outdoors(links: LinkPrediction) -> LinkPrediction:
            probabilities, means_db, stds_db = links.by_state
            probabilities = indoors * probabilities
            probabilities[LinkState.OUTAGE] += 1.0 - indoors
            return LinkPrediction.of_parts(probabilities, means_db, stds_db)

        return self.mapped(outdoors)


LinkPrediction.COLUMNS = tuple(field.name for field in fields(LinkPrediction) if field.name != "by_material")
