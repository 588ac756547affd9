"""Features of traced links as TensorFlow functions of the transmitter's position and the power of paths.

Paths are moved, not traced again. NumPy functions get first derivatives: paths by Dr.Jit, lengths in cells and losses
of walls by central differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.arrays import Floats
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import ATTENUATION_LENGTHS_M, LinkFeatures, context_of
from sionna_partial.prediction.map_networks import feature_values
from sionna_partial.prediction.paper_networks import import_keras, tf
from sionna_partial.prediction.space import MapSpace
from sionna_partial.prediction.unobserved import attenuation, unobserved_lengths_m, walled_lengths_m
from sionna_partial.prediction.wall_materials import WallMaterials
from sionna_partial.scene.scene import power_laws
from sionna_partial.tracing.path_set import MATERIAL_PARAMETERS, PathSet
from sionna_partial.tracing.power import mean_loss_db, wall_loss_db
from sionna_partial.tracing.simulation import Simulation

_NEAREST_M = 1e-6
"""Shortest distance between transmitter and receivers, where a distance has no slope [m]."""

_LENGTH_STEP_M = 1e-3
"""Step of central differences of lengths in cells [m]: their derivatives jump where a line passes a corner."""

_STEEPEST = 30.0
"""Largest derivative of a length: lines along the border of cells have none."""

_RELATIVE_STEP = 1e-5
"""Step of central differences, relative to the value or to itself."""


class MovedLinks:
    """Features of N traced links with P paths, for another transmitter position and other powers of the paths."""

    def __init__(self, on_map: PartialMap, paths: PathSet, phi: LinkFeatures) -> None:
        self._map, self._paths, self._phi = on_map, paths, phi

    def ends_m(self, tx_m: Any) -> tuple[Any, Any]:
        """Return the ends (N, 3) [m] of the links; `tx_m` None is the traced position."""
        tx_m, rx_m = self._paths.base.tx_m if tx_m is None else tx_m, tf.constant(self._paths.rx_m)
        return tf.broadcast_to(tx_m, rx_m.shape), rx_m

    def features(self, tx_m: Any, power: Any, vertices_m: Any) -> dict[str, Any]:
        """Return the features by name, for powers (P,) and vertices (P, D, 3) of the paths."""
        gain_db = self.changed_db(self._phi.gain_db, power, self._paths.power)
        values = feature_values(self._phi) | {"gain_db": gain_db}
        if tx_m is not None:
            values |= self._of_position(tx_m)
        return values | self._of_paths(values["distance_m"], tx_m, power, vertices_m)

    def changed_db(
        self, gain_db: Floats, power: Any, first_power: Any, rx: NDArray[np.integer[Any]] | None = None
    ) -> Any:
        """Return gains (N,) [dB] that change as the sums of the powers of paths, to `rx`, do; outages stay."""
        rx = self._paths.path_rx if rx is None else rx
        sums = (tf.math.unsorted_segment_sum(each, rx, len(self._paths.rx_m)) for each in (power, first_power))
        now_db, first_db = map(_gain_db, sums)
        changed_db = tf.maximum(gain_db + (now_db - first_db), GAIN_FLOOR_DB)
        return tf.where(gain_db > GAIN_FLOOR_DB, changed_db, GAIN_FLOOR_DB)

    @cached_property
    def _legs(self) -> _Legs:
        return _Legs(self._map, self._paths)

    def _of_position(self, tx_m: Any) -> dict[str, Any]:
        """Return the features that depend on the position of the transmitter alone."""
        ends, first_m, traced = self.ends_m(tx_m), self._paths.base.tx_m, context_of(self._phi)
        distance_m = tf.sqrt(tf.maximum(tf.reduce_sum((ends[1] - tx_m) ** 2, axis=1), _NEAREST_M**2))
        unobserved_m = moved_lengths_m(partial(unobserved_lengths_m, self._map), ends)
        ops, space = import_keras().ops, MapSpace.of(self._map)
        exposed = space.exposure_at(tx_m[None], ops) - space.exposure_at(first_m[None])
        noise = by_differences(lambda at: self._map.noise_near(at["tx_m"][None]), {"tx_m": tx_m})
        longer = space.routes(tx_m, self._paths.rx_m, ops) - space.routes(first_m, self._paths.rx_m)
        return {
            "exposure": traced.exposure + exposed[:, None] * np.array([1.0, 0.0]),
            "route": traced.route + longer,
            "wall_noise": traced.wall_noise + 0.5 * (noise - self._map.noise_near(first_m[None])),
            "distance_m": distance_m,
            "unobserved_distance_m": tf.minimum(unobserved_m, distance_m),
            "walled_m": moved_lengths_m(partial(walled_lengths_m, self._map), ends),
        }

    def _of_paths(self, distance_m: Any, tx_m: Any, power: Any, vertices_m: Any) -> dict[str, Any]:
        """Return the features of the indirect paths."""
        legs, context, first_power = self._legs, context_of(self._phi), self._paths.power[self._legs.paths]
        unobserved_m = tf.constant(legs.unobserved_m) if tx_m is None else legs.moved_m(tx_m, vertices_m)
        gains_db = []
        for column, length_m in enumerate(ATTENUATION_LENGTHS_M):
            first = attenuation(legs.unobserved_m, length_m)
            kept = tf.exp(-unobserved_m / length_m) if length_m > 0.0 else first
            powers = tf.gather(power, legs.paths) * kept, first_power * first
            gains_db.append(self.changed_db(context.indirect_gain_db[:, column], *powers, legs.rx))
        strongest_m = context.strongest_unobserved_m
        if len(legs.paths):
            grown_m = tf.gather(unobserved_m - legs.unobserved_m, np.maximum(legs.strongest, 0))
            strongest_m = strongest_m + tf.where(legs.strongest >= 0, grown_m, distance_m - self._phi.distance_m)
        return {"indirect_gain_db": tf.stack(gains_db, axis=1), "strongest_unobserved_m": strongest_m}


class _Legs:
    """The straight legs of the Q indirect paths, and their lengths in unknown cells.

    `strongest` (N,) is the strongest path to each receiver, -1 for none. Legs join nodes in this order: transmitter,
    receivers, vertices path by path.
    """

    def __init__(self, on_map: PartialMap, paths: PathSet) -> None:
        self.paths = np.flatnonzero(~paths.is_direct)
        self.rx = paths.path_rx[self.paths]
        self._rx_m = paths.rx_m
        interacts, vertices_m = paths.interactions[self.paths] > 0, paths.vertices_m[self.paths]
        nodes_m = np.concatenate([paths.base.tx_m[None], paths.rx_m, vertices_m.reshape(-1, 3)])
        first = np.zeros((len(self.rx), 1), dtype=np.intp)
        numbers = 1 + len(paths.rx_m) + np.arange(interacts.size).reshape(interacts.shape)
        exists = np.pad(interacts, ((0, 0), (1, 1)), constant_values=True)
        of_path, nodes = np.nonzero(exists)[0], np.hstack([first, numbers, 1 + self.rx[:, None]])[exists]
        same = of_path[:-1] == of_path[1:]
        self._of_path, self._start, self._end = of_path[:-1][same], nodes[:-1][same], nodes[1:][same]
        self._lengths_m = partial(unobserved_lengths_m, on_map)
        exact_m = self._lengths_m(nodes_m[self._start], nodes_m[self._end])
        self.unobserved_m = np.bincount(self._of_path, weights=exact_m, minlength=len(self.rx)).astype(np.float64)
        self.strongest = np.full(len(paths.rx_m), -1)
        weakest_first = np.argsort(paths.power[self.paths], kind="stable")
        self.strongest[self.rx[weakest_first]] = weakest_first

    def moved_m(self, tx_m: Any, vertices_m: Any) -> Any:
        """Return the lengths (Q,) [m] for a transmitter at `tx_m` and vertices (P, D, 3) [m]."""
        vertices_m = tf.reshape(tf.gather(vertices_m, self.paths), (-1, 3))
        nodes_m = tf.concat([tx_m[None], self._rx_m, vertices_m], axis=0)
        ends = tf.gather(nodes_m, self._start), tf.gather(nodes_m, self._end)
        moved_m = moved_lengths_m(self._lengths_m, ends)
        return tf.math.unsorted_segment_sum(moved_m, self._of_path, len(self.rx))


def _gain_db(power: Any) -> Any:
    """Return the gain (N,) of a power, at least -150 dB, where its derivative is 0."""
    return 10.0 / math.log(10.0) * tf.math.log(tf.maximum(power, 10.0 ** (GAIN_FLOOR_DB / 10.0)))


def moved_paths(paths: PathSet, given: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return power (P,) and vertices (P, D, 3), 0 where there are none."""

    @tf.custom_gradient
    def evaluate(*tensors: Any) -> tuple[tuple[Any, Any], Callable[..., list[Any]]]:
        values = {name: tensor.numpy() for name, tensor in zip(given, tensors, strict=True)}
        parameters = replace(paths.base, **values)

        @cache
        def slopes() -> dict[str, Floats]:
            constants = [name for name in given if name != "tx_m"]
            found = paths.slopes(parameters, constants) if constants else {}
            if "tx_m" in given:
                found["tx_m"], of_vertices = paths.transmitter_slopes(parameters)
                found["vertices_m"] = of_vertices.reshape(-1, 3)
            return found

        def pull_back(of_power: Any, of_vertices: Any) -> list[Any]:
            found = {name: _pulled(slopes()[name], of_power) for name in given}
            if "tx_m" in given:
                found["tx_m"] += _pulled(slopes()["vertices_m"], tf.reshape(of_vertices, [-1]))
            return [_once_only(tf.reshape(found[name], values[name].shape)) for name in given]

        power, vertices_m = paths.at(parameters)
        return (tf.constant(power), tf.constant(np.nan_to_num(vertices_m))), pull_back

    if not given:
        return tf.constant(paths.power), tf.constant(np.nan_to_num(paths.vertices_m))
    return evaluate(*given.values())


def by_differences(function: Callable[[dict[str, Floats]], Floats], given: Mapping[str, Any]) -> Any:
    """Return a NumPy function (K,) of a few tensors, with derivatives by central differences."""

    @tf.custom_gradient
    def evaluate(*tensors: Any) -> tuple[Any, Callable[[Any], list[Any]]]:
        values = {name: tensor.numpy() for name, tensor in zip(given, tensors, strict=True)}

        def slope(name: str, entry: int, upstream: Floats) -> float:
            value, step = values[name], np.zeros(values[name].size)
            step[entry] = _RELATIVE_STEP * max(abs(value.ravel()[entry]), _RELATIVE_STEP)
            ends = [function(values | {name: value + way * step.reshape(value.shape)}) for way in (1, -1)]
            return float((ends[0] - ends[1]) @ upstream) / (2.0 * step[entry])

        def pull_back(upstream: Any) -> list[Any]:
            pulled = []
            for name, value in values.items():
                slopes = [slope(name, entry, upstream.numpy()) for entry in range(value.size)]
                pulled.append(_once_only(tf.constant(slopes, tf.float64, value.shape)))
            return pulled

        return tf.constant(function(values)), pull_back

    return evaluate(*given.values()) if given else tf.constant(function({}))


def wall_losses(simulation: Simulation, values: Mapping[str, Floats]) -> Floats:
    """Return the mean loss of traced walls [dB], additional losses (2 K,) [dB] and prior (K,) of candidates.

    `values` replace parameters of the simulation.
    """
    at, on_map, total_db = simulation.parameters(np.zeros(3)), simulation.partial, 0.0
    base_hz, at = float(at.frequency_hz), replace(at, **values)
    frequency_hz, default = float(at.frequency_hz), simulation.resolved.scene_settings.traced_material
    known = on_map.environment.scene_materials(default)
    traced = [known[name] for name in simulation.materials]
    for named, fraction in on_map.wall_fractions.items():
        material = named or default
        if material not in traced:
            total_db += fraction * wall_loss_db(material, frequency_hz)
            continue
        slab = [getattr(at, name)[traced.index(material)] for name in MATERIAL_PARAMETERS]
        grown = [(frequency_hz / base_hz) ** law.exponent for law in power_laws(material, base_hz)]
        total_db += fraction * mean_loss_db(slab[0] * grown[0], slab[1] * grown[1], slab[2], frequency_hz)
    candidates = WallMaterials.at(frequency_hz, on_map.wall_class_count)
    return np.concatenate([[total_db], candidates.crossing_db.ravel(), candidates.prior])


def _pulled(slopes: Floats, upstream: Any) -> Any:
    """Sum (K,) slopes (P, K) times upstream derivatives (P,), in an order independent of threads."""
    rows = tf.convert_to_tensor(upstream)[:, None] * slopes
    return tf.math.unsorted_segment_sum(rows, np.zeros(len(slopes), dtype=np.int32), 1)[0]


def _once_only(slopes: Any) -> Any:
    """Refuse second derivatives: a part would be missing."""
    return tf.raw_ops.PreventGradient(input=slopes, message="links have first derivatives only.")


def moved_lengths_m(lengths_m: Callable[[Floats, Floats], Floats], ends_m: tuple[Any, Any]) -> Any:
    """Return lengths (N,) [m] of segments between two tensors (N, 3) [m], with derivatives by differences."""

    @tf.custom_gradient
    def evaluate(*tensors: Any) -> tuple[Any, Callable[[Any], list[Any]]]:
        ends = np.stack([tensor.numpy() for tensor in tensors])

        def pull_back(upstream: Any) -> list[Any]:
            slopes = np.zeros(ends.shape)
            for end, axis in np.ndindex(len(ends), ends.shape[2]):
                step = np.zeros((len(ends), 1, ends.shape[2]))
                step[end, 0, axis] = _LENGTH_STEP_M
                slopes[end, :, axis] = (lengths_m(*(ends + step)) - lengths_m(*(ends - step))) / (2.0 * _LENGTH_STEP_M)
            return [_once_only(upstream[:, None] * slope) for slope in np.clip(slopes, -_STEEPEST, _STEEPEST)]

        return tf.constant(lengths_m(*ends)), pull_back

    return evaluate(*ends_m)
