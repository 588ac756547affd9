"""The features of links, and the inputs that networks make of them: two tables, for NumPy and for Keras's tensors."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats
from sionna_partial.constants import GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S, LinkState
from sionna_partial.prediction.features import ATTENUATION_LENGTHS_M, LinkFeatures, shifted_gain_db

NEAREST_M = 0.01
"""Distance below which the gain of free space rises no more [m]."""

_LOG_NEAREST_M = 0.1
_SCALE_M, _SCALE_DB, _EXCESS_DB = 3.0, 100.0, 30.0


@dataclass(frozen=True)
class Feature:
    """A feature of links by its name in `LinkFeatures` or `LinkContext`: unit, and columns in data sets.

    Without columns it follows from the map and the positions.
    """

    name: str
    unit: str
    columns: tuple[str, ...] = ()

    def of(self, phi: LinkFeatures) -> Any:
        """Return its values of links (N,) or (N, K)."""
        return getattr(phi if hasattr(phi, self.name) else phi.context, self.name)


FEATURES = (
    Feature("link_state", "LinkState", ("partial_link_state",)),
    Feature("gain_db", "dB", ("partial_gain_db",)),
    Feature("unobserved_distance_m", "m", ("unobserved_distance_m",)),
    Feature("distance_m", "m", ("distance_m",)),
    Feature("indirect_gain_db", "dB", tuple(f"indirect_gain_reach_{each:g}_m_db" for each in ATTENUATION_LENGTHS_M)),
    Feature("strongest_unobserved_m", "m", ("strongest_unobserved_m",)),
    Feature("straight_gain_db", "dB", ("straight_gain_db",)),
    Feature("straight_walls", "1", ("straight_walls",)),
    Feature("wall_loss_db", "dB", ("wall_loss_db",)),
    Feature("tx_seen", "bool"),
    Feature("rx_seen", "bool"),
    Feature("possible", "bool by LinkState"),
    Feature("walled_m", "m"),
)
"""Features that networks, the mean loss of walls and multi-wall models read, in the order that data sets have them."""

STATE_INPUTS = ("distance_m", "unobserved_distance_m")
GAIN_INPUTS = (*STATE_INPUTS, "gain_db")
INDOOR_INPUTS = ("unobserved_distance_m",)
"""Unscaled inputs of the paper's networks; the link state of the partial trace selects the network."""


Values = Mapping[str, Any]
"""Features by name; `free_db`, the gain of free space, and `near_m`, the distance but at least 10 cm."""

Make = Callable[[Values, ModuleType], Any]


def _is_state(state: LinkState) -> Make:
    return lambda of, ops: 1.0 * (of["link_state"] == state)


def _flag(name: str, column: int | None = None) -> Make:
    return lambda of, ops: 1.0 * (of[name] if column is None else of[name][:, column])


def _log_length(length_m: Callable[[Values], Any]) -> Make:
    return lambda of, ops: ops.log(1.0 + length_m(of) / _SCALE_M)


def _gain(gain_db: Callable[[Values], Any]) -> Make:
    return lambda of, ops: (gain_db(of) - GAIN_FLOOR_DB) / _SCALE_DB


def _excess(gain_db: Callable[[Values], Any]) -> Make:
    return lambda of, ops: ops.clip((gain_db(of) - of["free_db"]) / _EXCESS_DB, -2.0, 0.5)


_INDIRECT: dict[str, Callable[[Values], Any]] = {
    f"indirect_{length_m:g}": lambda of, column=column: of["indirect_gain_db"][:, column]  # type: ignore[misc]
    for column, length_m in enumerate(ATTENUATION_LENGTHS_M)
}

LINK_INPUTS: dict[str, Make] = {
    **{state.name.lower(): _is_state(state) for state in LinkState},
    "tx_seen": _flag("tx_seen"),
    "rx_seen": _flag("rx_seen"),
    **{f"{state.name.lower()}_possible": _flag("possible", state) for state in LinkState},
    "walled": lambda of, ops: ops.minimum(of["walled_m"], 1.0),
    "log_distance": lambda of, ops: ops.log(of["near_m"]),
    "unobserved_fraction": lambda of, ops: of["unobserved_distance_m"] / of["near_m"],
    "distance": _log_length(lambda of: of["distance_m"]),
    "unobserved": _log_length(lambda of: of["unobserved_distance_m"]),
    "observed": _log_length(lambda of: of["distance_m"] - of["unobserved_distance_m"]),
    "strongest_unobserved": _log_length(lambda of: of["strongest_unobserved_m"]),
    "gain": _gain(lambda of: of["gain_db"]),
    "free_gain": _gain(lambda of: of["free_db"]),
    **{name: _gain(gain_db) for name, gain_db in _INDIRECT.items()},
    "gain_above_free": _excess(lambda of: of["gain_db"]),
    **{f"{name}_above_free": _excess(gain_db) for name, gain_db in _INDIRECT.items()},
}
"""The inputs of the link network in their order, without units: how each is made of features."""


def feature_values(phi: LinkFeatures) -> dict[str, Any]:
    """Return all features of links, which have a context, by name."""
    return {each.name: each.of(phi) for each in FEATURES}


def link_inputs(values: Values, frequency_hz: float, shift_db: Any, ops: ModuleType = np) -> Any:
    """Return the inputs (N, len(LINK_INPUTS)) of the link network of a frequency.

    `values` are from `feature_values`, or tensors in their place; `ops` is NumPy, or keras.ops for tensors. Free space
    is stronger by `shift_db` at that frequency than at the frequency of the links.
    """
    gains_db = {name: shifted_gain_db(values[name], shift_db, ops) for name in ("gain_db", "indirect_gain_db")}
    free_db = free_space_gain_db(values["distance_m"], frequency_hz, ops)
    near_m = ops.maximum(values["distance_m"], _LOG_NEAREST_M)
    of = {**values, **gains_db, "free_db": free_db, "near_m": near_m}
    return ops.stack([make(of, ops) for make in LINK_INPUTS.values()], axis=1)


def free_space_gain_db(distance_m: ArrayLike, frequency_hz: float, ops: ModuleType = np) -> Any:
    """Return Friis' path gain between isotropic antennas [dB]; with keras.ops for `ops`, of tensors."""
    return gain_at_1m_db(frequency_hz) - 20.0 * ops.log10(ops.maximum(distance_m, NEAREST_M))


def gain_at_1m_db(frequency_hz: float) -> float:
    """Return the same at 1 m [dB]."""
    return 20.0 * math.log10(SPEED_OF_LIGHT_M_S / (4.0 * math.pi * frequency_hz))


def columns_of(phi: LinkFeatures) -> dict[str, Floats]:
    """Return the columns (N,) that data sets have of links, which have a context."""
    stored = ((feature.columns, np.atleast_2d(feature.of(phi).T)) for feature in FEATURES if feature.columns)
    return {name: values for columns, rows in stored for name, values in zip(columns, rows, strict=True)}


def features_of_columns(columns: Mapping[str, Floats]) -> dict[str, Any]:
    """Return the features by name that such columns hold."""
    stored = ((feature.name, [columns[name] for name in feature.columns]) for feature in FEATURES if feature.columns)
    return {name: np.column_stack(values) if len(values) > 1 else values[0] for name, values in stored}
