"""Networks that read the map and the paths of links, evaluated by NumPy or keras.ops.

The map network is a U-Net (Ronneberger, Fischer and Brox 2015) on the image of a map (`space.MapSpace`) that returns
`MAP_FEATURES` numbers per cell, once for a map. Its kernels are symmetric: turned and mirrored maps give turned and
mirrored features. The link network reads the features of a link, and those of the map at both ends and along the
direct line, symmetrically in the ends, and their mean over all known cells, which tells a home from a hall.
"""

import math
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats, Indices
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, GAIN_FLOOR_DB, LinkState
from sionna_partial.prediction.evaluate import array_ops
from sionna_partial.prediction.features import ATTENUATION_LENGTHS_M, LinkFeatures, context_of, shifted_gain_db
from sionna_partial.prediction.paper_networks import STD_RANGE_DB, free_space_gain_db
from sionna_partial.prediction.rule import (
    GATE_INPUTS,
    GATE_NETWORK,
    GATE_OUTPUTS,
    SHARED_INPUTS,
    LinkInputs,
    Parts,
    predicted,
)
from sionna_partial.prediction.space import MapSpace
from sionna_partial.settings import NetworkKind

Shapes = tuple[tuple[int | None, ...], tuple[int | None, ...]]
Networks = Mapping[str, Callable[[Any], Any]]

MAP_NETWORK, LINK_NETWORK = "map_network", "link_network"

MAP_CHANNELS, MAP_FEATURES = 3, 16
"""Channels of the image of a map, and features of its cells."""

LINE_POINTS = 24
"""Points of the direct line at which the features of the map are averaged."""

LINK_OUTPUTS = 7
"""Logits of the link states, then mean and spread of the gain given LOS and given NLOS."""

_LOS_MOST_DB = 10.0
"""Largest mean gain given LOS over free space [dB]: other paths add at most this power."""

_LOS_OFFSET = -1.5
_NLOS_DB, _NLOS_SCALE_DB = -25.0, 20.0

_IMPOSSIBLE = -1e30
_LINKS_AT_ONCE, _MAPS_KEPT = 16_384, 8
_LOG_NEAREST_M = 0.1
_SCALE_DB, _EXCESS_DB = 100.0, 30.0

FEATURES: dict[str, tuple[str, ...]] = {
    "link_state": ("partial_link_state",),
    "gain_db": ("partial_gain_db",),
    **{name: (name,) for name in ("unobserved_distance_m", "distance_m")},
    "indirect_gain_db": tuple(f"indirect_gain_reach_{length_m:g}_m_db" for length_m in ATTENUATION_LENGTHS_M),
    **{name: (name,) for name in ("strongest_unobserved_m", "straight_gain_db", "straight_walls", "wall_loss_db")},
    **dict.fromkeys(("tx_seen", "rx_seen", "possible", "walled_m", "wall_noise", "exposure", "route"), ()),
}
"""Features of links by their names in `LinkFeatures` or `LinkContext`, and their columns in data sets, if stored."""

_Make = Callable[[LinkInputs], Any]


def _gain(gain_db: _Make) -> _Make:
    return lambda of: (gain_db(of) - GAIN_FLOOR_DB) / _SCALE_DB


def _excess(gain_db: _Make) -> _Make:
    return lambda of: of.ops.clip((gain_db(of) - of["free_db"]) / _EXCESS_DB, -2.0, 0.5)


_INDIRECT: dict[str, _Make] = {
    f"indirect_{length_m:g}": lambda of, column=column: of["indirect_gain_db"][:, column]  # type: ignore[misc]
    for column, length_m in enumerate(ATTENUATION_LENGTHS_M)
}

LINK_INPUTS: dict[str, _Make] = {
    **SHARED_INPUTS,
    **{
        f"{state.name.lower()}_possible": lambda of, state=state: of.flag(of["possible"][:, state])  # type: ignore[misc]
        for state in LinkState
    },
    "walled": lambda of: of.ops.minimum(of["walled_m"], 1.0),
    "log_distance": lambda of: of.ops.log(of["near_m"]),
    "unobserved_fraction": lambda of: of["unobserved_distance_m"] / of["near_m"],
    "distance": lambda of: of.log_length(of["distance_m"]),
    "unobserved": lambda of: of.log_length(of["unobserved_distance_m"]),
    "observed": lambda of: of.log_length(of["distance_m"] - of["unobserved_distance_m"]),
    "strongest_unobserved": lambda of: of.log_length(of["strongest_unobserved_m"]),
    "gain": _gain(lambda of: of["gain_db"]),
    "free_gain": _gain(lambda of: of["free_db"]),
    **{name: _gain(gain_db) for name, gain_db in _INDIRECT.items()},
    "gain_above_free": _excess(lambda of: of["gain_db"]),
    **{f"{name}_above_free": _excess(gain_db) for name, gain_db in _INDIRECT.items()},
}
"""Inputs of the link network in order, dimensionless.

Besides the features they read `free_db`, the free-space gain, and `near_m`, the distance but at least 10 cm.
"""

LINK_INPUTS_WITH_MAP = len(LINK_INPUTS) + 4 * MAP_FEATURES
_GATE_SHAPES = {GATE_NETWORK: ((None, len(GATE_INPUTS)), (None, GATE_OUTPUTS))}

CONTEXT_SHAPES: tuple[Mapping[str, Shapes], ...] = (
    {},
    {LINK_NETWORK: ((None, len(LINK_INPUTS)), (None, LINK_OUTPUTS)), **_GATE_SHAPES},
    {
        LINK_NETWORK: ((None, LINK_INPUTS_WITH_MAP), (None, LINK_OUTPUTS)),
        MAP_NETWORK: ((None, None, None, MAP_CHANNELS), (None, None, None, MAP_FEATURES)),
        **_GATE_SHAPES,
    },
)
"""For "paper", "paths" and "map": inputs and outputs of the added networks."""


def feature_values(phi: LinkFeatures) -> dict[str, Any]:
    return {name: getattr(phi if hasattr(phi, name) else phi.context, name) for name in FEATURES}


def link_inputs(values: Mapping[str, Any], frequency_hz: float, shift_db: Any, ops: ModuleType = np) -> Any:
    """Return the inputs (N, len(LINK_INPUTS)) of the link network.

    `shift_db` is the free-space gain at `frequency_hz` less the one at the links' frequency; `ops` is NumPy or
    keras.ops.
    """
    gains_db = {name: shifted_gain_db(values[name], shift_db, ops) for name in ("gain_db", "indirect_gain_db")}
    free_db = free_space_gain_db(values["distance_m"], frequency_hz, ops)
    near_m = ops.maximum(values["distance_m"], _LOG_NEAREST_M)
    links = LinkInputs({**values, **gains_db, "free_db": free_db, "near_m": near_m}, None, ops)
    return ops.stack([make(links) for make in LINK_INPUTS.values()], axis=1)


def columns_of(phi: LinkFeatures) -> dict[str, Floats]:
    values = feature_values(phi)
    stored = ((columns, np.atleast_2d(values[name].T)) for name, columns in FEATURES.items() if columns)
    return {name: column for columns, rows in stored for name, column in zip(columns, rows, strict=True)}


def features_of_columns(columns: Mapping[str, Floats]) -> dict[str, Any]:
    stored = {name: [columns[column] for column in own] for name, own in FEATURES.items() if own}
    return {name: np.column_stack(values) if len(values) > 1 else values[0] for name, values in stored.items()}


def scaled_inputs(phi: LinkFeatures, frequency_hz: float) -> NDArray[np.float32]:
    inputs: Floats = link_inputs(feature_values(phi), frequency_hz, phi.free_space_shift_db(frequency_hz))
    return inputs.astype(np.float32)


def kind_of(networks: Networks) -> NetworkKind:
    return "map" if reads_maps(networks) else "paths" if LINK_NETWORK in networks else "paper"


def reads_maps(networks: Networks) -> bool:
    return MAP_NETWORK in networks


def line_points_m(tx_m: Any, rx_m: Any) -> Any:
    """Return points (N, 2 + LINE_POINTS, 2) [m] of links: both ends, and points along the direct line."""
    along = np.concatenate([[0.0, 1.0], (np.arange(LINE_POINTS) + 0.5) / LINE_POINTS])[:, None]
    return tx_m[:, None, :2] * (1.0 - along) + rx_m[:, None, :2] * along


def link_outputs(networks: Networks, inputs: Any, of_map: tuple[Any, Any] | None, ops: Any = array_ops) -> Any:
    """Return the outputs (N, LINK_OUTPUTS) for inputs (N, I).

    `of_map` has the map features (N, 2 + LINE_POINTS, F) of points, and their mean (N, F) over the known cells.
    """
    if of_map is not None:
        points, mean = of_map
        first, last = points[:, 0], points[:, 1]
        values = [inputs, first + last, first * last, ops.mean(points[:, 2:], axis=1), mean]
        inputs = ops.concatenate(values, axis=1)
    return networks[LINK_NETWORK](inputs)


def mean_features(features: Any, images: Any, ops: Any = array_ops) -> Any:
    """Return the mean (B, F) of map features (B, H, W, F) over the known cells of images."""
    known = images[..., :1] + images[..., 1:2]
    total = ops.sum(features * known, axis=(1, 2))
    return total / ops.maximum(ops.sum(known, axis=(1, 2)), 1.0)


def expert_parts(outputs: Any, free_db: Any, possible: Any, ops: Any = array_ops) -> Parts:
    """Return the distribution of the networks."""
    states = ops.where(possible, outputs[:, : len(LinkState)], _IMPOSSIBLE)
    los_db = _LOS_MOST_DB * ops.sigmoid(_LOS_OFFSET + outputs[:, 3])
    means_db = [free_db + los_db, free_db + _NLOS_DB + _NLOS_SCALE_DB * outputs[:, 4]]
    low, high = (math.log(std_db) for std_db in STD_RANGE_DB)
    stds_db = [ops.exp(low + (high - low) * ops.sigmoid(outputs[:, column])) for column in (5, 6)]
    outage = ops.zeros_like(free_db)
    return (
        ops.transpose(ops.exp(ops.log_softmax(states))),
        ops.maximum(ops.stack([outage + GAIN_FLOOR_DB, *means_db]), GAIN_FLOOR_DB),
        ops.stack([outage, *stds_db]),
    )


def image_features(networks: Networks, image: Any, ops: Any = array_ops) -> tuple[Any, Any]:
    """Return the features (H, W, F) of an image (H, W, C), and their mean (F,)."""
    features = networks[MAP_NETWORK](image[None])
    return features[0], mean_features(features, image[None], ops)[0]


class MapFeatures:
    """Features of the latest maps by a map network."""

    def __init__(self, networks: Networks) -> None:
        self._networks, self._kept = networks, dict[bytes, Any]()

    def __call__(self, space: MapSpace) -> tuple[Any, Any]:
        """Return the features (H, W, F) of the cells of a map, and their mean (F,)."""
        key = space.image.tobytes()
        if key not in self._kept:
            found = image_features(self._networks, space.image)
            self._kept = dict([*self._kept.items()][1 - _MAPS_KEPT :]) | {key: found}
        return self._kept[key]


def read_features(
    space: MapSpace, found: tuple[Any, Any], tx_m: Any, rx_m: Any, ops: Any = array_ops
) -> tuple[Any, Any]:
    """Return the map features of N links that `link_outputs` takes."""
    features, mean = found
    points = space.read(features, line_points_m(tx_m, rx_m), ops)
    return points, ops.zeros_like(points[:, 0]) + mean


def predict_by_context(networks: Networks, phi: LinkFeatures, frequency_hz: float, features: MapFeatures) -> Parts:
    """Predict N links with a context."""
    context, inputs = context_of(phi), scaled_inputs(phi, frequency_hz)
    outputs = np.zeros((len(phi), LINK_OUTPUTS))
    for index, links in enumerate(links_by_map(phi)):
        for start in range(0, len(links), _LINKS_AT_ONCE):
            here = links[start : start + _LINKS_AT_ONCE]
            of_map = None
            if reads_maps(networks):
                space = context.spaces[index]
                of_map = read_features(space, features(space), context.tx_m[here], context.rx_m[here])
            outputs[here] = link_outputs(networks, inputs[here], of_map)
    values = rule_values(phi, frequency_hz)
    expert = expert_parts(outputs, values["free_db"], context.possible)
    return predicted(values, expert, networks[GATE_NETWORK])


def rule_values(phi: LinkFeatures, frequency_hz: float = CARRIER_FREQUENCY_HZ) -> dict[str, Any]:
    """Return the features that the rule reads; `frequency_hz` is for links without their own [Hz]."""
    free_db = free_space_gain_db(phi.distance_m, phi.frequency_hz or frequency_hz)
    return feature_values(phi) | {"free_db": free_db}


def links_by_map(phi: LinkFeatures) -> list[Indices]:
    index, count = context_of(phi).map_index, len(context_of(phi).spaces)
    order = np.argsort(index, kind="stable")
    return np.split(order, np.searchsorted(index[order], np.arange(1, count)))
