"""The rule of prediction: the one place where the distribution of a link is made.

Two experts know a link: the trace of the partial map, and a model of unobserved space (networks, or mean losses through
walls). The prediction is their mixture. The trace has the weight 1 - doubt (1 - trust).

- doubt grows from 0 with the exposure of both ends to unobserved space and with the range noise of the walls near them:
  where nothing unknown and no error can change a link, the prediction is the trace exactly.
- trust, 0 to 1, and the errors of the trace are outputs of the gate, a network that was trained on buildings of all
  kinds. Without a gate trust is 0, and the trace has no errors.

All functions take NumPy arrays, or tensors with `ops` = keras.ops.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.prediction.evaluate import array_ops
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


_SCALE_M, _SCALE_DB = 3.0, 30.0


class _Links(NamedTuple):
    """Inputs of the gate's table: features, the expert, and the ops."""

    values: Mapping[str, Any]
    expert: Parts
    ops: Any

    def flag(self, mask: Any) -> Any:
        """Return 1 where a mask is True, else 0."""
        one = self.ops.ones_like(self.values["gain_db"])
        return self.ops.where(mask, one, 0.0 * one)

    def log_length(self, length_m: Any) -> Any:
        """Return a length, compressed."""
        return self.ops.log(1.0 + self.ops.maximum(length_m, 0.0) / _SCALE_M)

    def depth(self, gain_db: Any) -> Any:
        """Return how far a gain is below free space."""
        return self.ops.clip((self.values["free_db"] - gain_db) / _SCALE_DB, -0.5, 3.0)

    def indirect(self, column: int) -> Any:
        """Return the depth of the indirect power for one attenuation length."""
        return self.depth(self.values["indirect_gain_db"][:, column])

    def apart(self, state: LinkState) -> Any:
        """Return the mean of the expert relative to the trace."""
        return self.ops.clip((self.expert[1][int(state)] - self.values["gain_db"]) / _SCALE_DB, -2.0, 3.0)


GATE_INPUTS: dict[str, Callable[[_Links], Any]] = {
    **{state.name.lower(): lambda of, state=state: of.flag(of.values["link_state"] == state) for state in LinkState},  # type: ignore[misc]
    "both_seen": lambda of: of.flag(of.values["tx_seen"] & of.values["rx_seen"]),
    "an_end_seen": lambda of: of.flag(of.values["tx_seen"] | of.values["rx_seen"]),
    "exposure": lambda of: of.values["exposure"][:, 0] + of.values["exposure"][:, 1],
    "both_exposed": lambda of: of.values["exposure"][:, 0] * of.values["exposure"][:, 1],
    "noise": lambda of: of.values["wall_noise"],
    "route": lambda of: of.values["route"] / 10.0,
    "detour": lambda of: of.log_length(of.values["route"] * WALK_M - of.values["distance_m"]),
    "distance": lambda of: of.log_length(of.values["distance_m"]),
    "unobserved": lambda of: of.log_length(of.values["unobserved_distance_m"]),
    "strongest_unobserved": lambda of: of.log_length(of.values["strongest_unobserved_m"]),
    "walled": lambda of: of.ops.minimum(of.values["walled_m"], 1.0),
    "depth": lambda of: of.depth(of.values["gain_db"]),
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
    links = _Links(values, expert, ops)
    return ops.stack([make(links) for make in GATE_INPUTS.values()], axis=1)
