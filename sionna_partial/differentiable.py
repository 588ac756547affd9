"""Predicted distribution as a differentiable function of transmitter, materials, frequency and network weights.

Paths and their derivatives are from `tracing`; features, networks and mean losses are TensorFlow. Where links were
traced, the distribution equals `LinkModel.predict`: its features change as the powers of all paths do. Limits of the
gradients:

- Paths, link states and the completeness of links are taken from the trace. A path that would appear elsewhere is
  missing; one that becomes invalid loses its power in a step, which has no derivative. `smoothed` includes both.
- Derivatives of lengths in unknown cells and in walls are differences over 2 mm: they jump where a line passes the
  corner of a cell.
- Map features, exposure and routes are bilinear between cells of 0.3 m, and range noise between cells of the map.
- On a complete map probabilities are constant. TensorFlow refuses second derivatives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats
from sionna_partial.checks import Progress, require, require_number
from sionna_partial.display import part_of, reporting
from sionna_partial.errors import MapError
from sionna_partial.link_model import LinkModel, link_model_of, warn_of_other_traces
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import context_of
from sionna_partial.prediction.map_networks import (
    LINK_NETWORK,
    MAP_NETWORK,
    expert_parts,
    feature_values,
    image_features,
    link_inputs,
    link_outputs,
    read_features,
)
from sionna_partial.prediction.moved_links import MovedLinks, by_differences, moved_paths, wall_losses
from sionna_partial.prediction.paper_networks import (
    GAIN_INPUTS,
    GAIN_NETWORKS,
    STATE_NETWORKS,
    distribution_by_paper,
    free_space_gain_db,
    import_keras,
    parts,
    tf,
)
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.prediction.rule import (
    GATE_NETWORK,
    LinkPrediction,
    Parts,
    doubt,
    over_materials,
    predicted,
    traced_parts,
)
from sionna_partial.prediction.space import MapSpace
from sionna_partial.prediction.unseen_walls import DirectLines, UnseenWalls, WallDensity, WallTrace, by_mean_losses
from sionna_partial.prediction.wall_materials import RESIDUAL_DB
from sionna_partial.settings import FREQUENCIES_HZ, SceneSettings, TraceSettings, takes_settings
from sionna_partial.tracing.gradients import one_transmitter
from sionna_partial.tracing.path_set import MATERIAL_PARAMETERS, PARAMETERS, PathSet
from sionna_partial.tracing.paths import unnamed_counts
from sionna_partial.tracing.positions import nearest_m
from sionna_partial.tracing.simulation import Simulation

_FINER = 0.1
"""Tolerance of the paths of derivatives, relative to the tolerance of values: the slope of a gain in dB is less exact
than the gain where weak paths change fast."""


_RIM = np.array([(math.cos(angle), math.sin(angle), 0.0) for angle in np.arange(8) * math.pi / 4.0])
"""Directions (8, 3) of the positions on the rim of a disc."""

_LIMITS = {
    "tx_m": (-1e9, 1e9),
    "relative_permittivity": (1.0, 1e6),
    "conductivity_s_m": (0.0, 1e9),
    "thickness_m": (0.0, 10.0),
    "frequency_hz": FREQUENCIES_HZ,
}


@dataclass(frozen=True, eq=False)
class LinkDistribution(LinkPrediction):
    """A `LinkPrediction` of (N,) float64 tensors that have derivatives."""

    def coverage(self, threshold_db: float, softness_db: float = 0.0) -> Any:
        """Return the probability (N,) that the gain exceeds a threshold above -150 dB [dB].

        `softness_db` is an additional Gaussian spread of the gain [dB]: without spread, the probability is a step.
        """
        covered = tf.zeros_like(self.p_los)
        for probability, mean_db, std_db in (
            (self.p_los, self.gain_los_mean_db, self.gain_los_std_db),
            (self.p_nlos, self.gain_nlos_mean_db, self.gain_nlos_std_db),
        ):
            variance = std_db**2 + softness_db**2
            spread, above_db = variance > 0.0, mean_db - threshold_db
            above = 0.5 * tf.math.erfc(-above_db / tf.sqrt(2.0 * tf.where(spread, variance, 1.0)))
            covered += probability * tf.where(spread, above, tf.cast(above_db > 0.0, above.dtype))
        return covered


class DifferentiableScene:
    """A map and a predictor for differentiable links, traced for each transmitter.

    Parameters
    ----------
    scene : PartialMap, path, Simulation or LinkModel
        Map of the building. The predictor of a link model is loaded again, as its weights may change.
    predictor : None, "map", "paper", path or Predictor
        As in `predict_map`.
    trace_settings : TraceSettings, optional
        Without diffuse reflection, and on meshes without diffraction.
    scene_settings : SceneSettings, optional
        For an unknown material, links are averaged over candidates, unless a call gives constants.

    Raises
    ------
    MapError, SettingsError, PredictorError, BackendError
        As `predict_map`; also for obstacles below the ceiling, and for paths that only rays find.

    Examples
    --------
    At a distance of 2 m the gain of the direct path changes by 20 / ln(10) / 2 dB per metre:

    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> import tensorflow as tf
    >>> room = sp.PartialMap(np.pad(np.zeros((18, 58), dtype=np.uint8), 1, constant_values=1), resolution_m=0.1)
    >>> scene = sp.DifferentiableScene(room, trace_settings=sp.TraceSettings(max_depth=0))
    >>> links = scene.links((1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)])
    >>> tx_m = tf.Variable(links.base.tx_m)
    >>> with tf.GradientTape() as tape:
    ...     gain_db = links(tx_m=tx_m).gain_mean_db[0]
    >>> (tape.gradient(gain_db, tx_m).numpy() + 0.0).round(3).tolist()
    [4.343, 0.0, 0.0]
    """

    @takes_settings
    def __init__(
        self,
        scene: PartialMap | str | Path | Simulation | LinkModel,
        *,
        predictor: Predictor | str | Path | None = None,
        trace_settings: TraceSettings | None = None,
        scene_settings: SceneSettings | None = None,
    ) -> None:
        model = link_model_of(scene, predictor, trace_settings, scene_settings)
        self.simulation = model.simulation
        self.simulation.require_exact()
        self.partial = self.simulation.partial
        if self.partial.obstacle is not None:
            raise MapError(
                "scene has obstacles below the ceiling, which have no gradients: give it with obstacle=None."
            )
        self.model = LinkModel(self.simulation, model.asked)
        if not (self.partial.is_complete or model.by_mean_losses):
            warn_of_other_traces(self.predictor, *self.simulation.resolved)

    @cached_property
    def _finer(self) -> Simulation:
        return self.simulation.with_tolerance(_FINER * self.simulation.trace_settings.tolerance_db)

    @cached_property
    def predictor(self) -> Predictor:
        """The predictor with its networks, which no other object shares."""
        return Predictor.load(self.model.asked)

    @cached_property
    def networks(self) -> dict[str, Any]:
        """The networks by name."""
        return parts(self.predictor.model)

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the M radio materials, in the order of arguments."""
        return self.simulation.materials

    @property
    def weights(self) -> list[Any]:
        """Variables of the networks; none where mean losses predict."""
        if self.model.by_mean_losses:
            return []
        names = [name for name in (MAP_NETWORK, LINK_NETWORK, GATE_NETWORK) if name in self.networks]
        names = names or [*STATE_NETWORKS.values(), *(row.name for row in GAIN_NETWORKS)]
        return [weight.value for name in names for weight in self.networks[name].trainable_variables]

    def links(self, tx: ArrayLike, rx: ArrayLike, *, progress: Progress | bool | None = None) -> DifferentiableLinks:
        """Trace the links from a transmitter to N receivers.

        Parameters
        ----------
        tx : (3,) array-like
            Transmitter position [m].
        rx : (N, 3) array-like
            Receiver positions [m].
        progress : bool or callable, optional
            As in `predict_map`.

        Raises
        ------
        PositionError
            As `trace_links`, or for several transmitters.
        """
        return DifferentiableLinks(self, self._finer.paths(one_transmitter(tx), rx, progress=progress))

    def smoothed(
        self,
        objective: Callable[[LinkDistribution], Any],
        tx: ArrayLike,
        rx: ArrayLike,
        *,
        within_m: float = 0.1,
        progress: Progress | bool | None = None,
    ) -> tuple[float, Floats]:
        """Return the mean of an objective over transmitter positions in a horizontal disc, and its gradient.

        The objective itself jumps wherever a path appears or vanishes. Links are traced from the centre and from eight
        positions on the rim, except inside walls and at receivers; both have half of the weight. By Gauss' theorem the
        gradient of the mean over a disc follows from the values on its rim: it is the mean of the gradients, plus the
        part of the values that gradients do not explain, which is due to paths that appear or vanish in the disc.

        Parameters
        ----------
        objective : callable
            Function of a `LinkDistribution` that returns a () tensor.
        tx : (3,) array-like
            Centre of the disc [m].
        rx, progress
            As in `links`.
        within_m : float
            Radius of the disc [m], above 0 and at most 1.

        Returns
        -------
        value : float
        gradient : (3,) float64 array
            By the position of the disc [1/m].

        Raises
        ------
        PositionError
            As `links`.
        SettingsError
            For a radius out of range.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> import tensorflow as tf
        >>> cells = [[1, 1, 1, 1, 1], [1, 0, 0, 0, 2], [1, 0, 0, 0, 2], [1, 1, 1, 1, 1]]  # a room, open to the unknown
        >>> scene = sp.DifferentiableScene(sp.map_from_array(cells, resolution_m=1.0))
        >>> rx = [(3.0, 2.0, 1.5), (4.5, 1.5, 1.5)]
        >>> value, gradient = scene.smoothed(lambda links: tf.reduce_mean(links.gain_mean_db), (1.5, 1.5, 1.5), rx)
        >>> bool(gradient[0] > 0.0)  # nearer to the receivers
        True
        """
        require_number("within_m", within_m, 0.0, 1.0, open_low=True)
        steps_m = within_m * _RIM
        with reporting(progress) as report:
            centre, slope = self._with_slope(objective, tx, rx, part_of(report, 0.0, 1.0 / 9.0))
            rim_m = np.asarray(tx, dtype=np.float64) + steps_m
            gap_m = np.linalg.norm(rim_m[:, None] - np.reshape(rx, (-1, 3)), axis=2).min(axis=1, initial=math.inf)
            possible = self.partial.radios_can_stand(rim_m)
            possible &= gap_m >= nearest_m(self.simulation.trace_settings.frequency_hz)
            values, slopes, jump = [], [], np.zeros(3)
            for number in np.flatnonzero(possible).tolist():
                part = part_of(report, (number + 1) / 9.0, (number + 2) / 9.0)
                value, there = self._with_slope(objective, rim_m[number], rx, part)
                values.append(value)
                slopes.append(there)
                unexplained = value - centre - 0.5 * (slope + there) @ steps_m[number]
                jump += unexplained * steps_m[number] * 2.0 / (len(_RIM) * within_m**2)
            report(1.0, "done")
        if not values:
            return centre, slope
        return 0.5 * (centre + float(np.mean(values))), 0.5 * (slope + np.mean(slopes, axis=0)) + jump

    def _with_slope(
        self, objective: Callable[[LinkDistribution], Any], tx: ArrayLike, rx: ArrayLike, progress: Progress
    ) -> tuple[float, Floats]:
        links = self.links(tx, rx, progress=progress)
        tx_m = tf.Variable(links.base.tx_m)
        with tf.GradientTape(watch_accessed_variables=False) as tape:  # the weights have no part in it
            tape.watch(tx_m)
            value = objective(links(tx_m=tx_m))
        return float(value), tape.gradient(value, tx_m, unconnected_gradients="zero").numpy()

    @cached_property
    def _walls(self) -> WallDensity:
        walls = UnseenWalls.shipped_of_map(self.partial)
        return walls._replace(lines=UnseenWalls.keras_lines())


class DifferentiableLinks:
    """Links from one transmitter to N receivers, traced once; a call returns their distribution.

    Attributes
    ----------
    base : PathParameters
        Values of the arguments of a call in the trace.
    """

    def __init__(self, scene: DifferentiableScene, paths: PathSet) -> None:
        self.base, self._scene, self._paths = paths.base, scene, paths
        self._phi = scene.model.features(paths.base.tx_m, paths.rx_m)
        self._moved = MovedLinks(scene.partial, paths, self._phi)
        self._is_certain = not doubt(feature_values(self._phi)).any()
        # before any call, as a tape would watch variables that are made under it
        self._networks = {} if self._is_certain or scene.model.by_mean_losses else scene.networks

    def __call__(
        self,
        *,
        tx_m: Any = None,
        relative_permittivity: Any = None,
        conductivity_s_m: Any = None,
        thickness_m: Any = None,
        frequency_hz: Any = None,
    ) -> LinkDistribution:
        """Evaluate the distribution without a new trace; arguments that are not given keep their traced values.

        Parameters
        ----------
        tx_m : (3,) tensor, optional
            Transmitter position [m].
        relative_permittivity, conductivity_s_m, thickness_m : (M,) tensors, optional
            Values of the scene's materials; [S/m] and [m].
        frequency_hz : () tensor, optional
            Carrier frequency of the trace [Hz]; materials follow it.

        Raises
        ------
        SettingsError
            For another shape, a value out of range, or a call within `tf.function`.
        """
        ops, values = import_keras().ops, (tx_m, relative_permittivity, conductivity_s_m, thickness_m, frequency_hz)
        pairs = zip(PARAMETERS, values, strict=True)
        given = {name: self._tensor(name, value) for name, value in pairs if value is not None}
        moved = moved_paths(self._paths, given)
        through_walls = self._scene.simulation.trace_settings.through_walls
        traces, prior = self._traces(moved[0], given)
        if self._is_certain:
            found = [traced_parts(trace.link_state, trace.gain_db, ops) for trace in traces]
        else:
            found = self._by_rule(traces, given, *moved)
        distribution = over_materials(found, prior, RESIDUAL_DB, ops) if through_walls else found[0]
        return LinkDistribution.of_parts(*distribution, ops=ops)

    def _tensor(self, name: str, value: Any) -> Any:
        require(tf.executing_eagerly(), name, value, "call links eagerly, not within tf.function.")
        tensor = tf.cast(tf.convert_to_tensor(value, dtype_hint=tf.float64), tf.float64)
        shape = getattr(self.base, name).shape
        require(tensor.shape == shape, name, value, f"give a tensor of shape {shape}.")
        low, high = _LIMITS[name]
        inside = bool(((tensor >= low) & (tensor <= high)).numpy().all())
        require(inside, name, value, f"give numbers in [{low:g}, {high:g}].")
        return tensor

    def _traces(self, power: Any, given: Mapping[str, Any]) -> tuple[list[WallTrace], Any]:
        """Return the traced links under each candidate for the material of walls, and their probabilities."""
        phi, scene, nothing = self._phi, self._scene, np.zeros(len(self._phi))
        constants = {name: value for name, value in given.items() if name != "tx_m"}
        walls = by_differences(lambda at: wall_losses(scene.simulation, at), constants)
        known = context_of(phi).straight_walls
        if phi.path_power is None or {*given} & {*MATERIAL_PARAMETERS}:
            gain_db = self._moved.changed_db(phi.gain_db, power, self._paths.power)
            return [WallTrace(phi.link_state, gain_db, nothing + walls[0], known)], np.ones(1)
        materials, fractions, traces = scene.model.wall_materials, scene.partial.unnamed_walls, []
        count = len(materials.prior)
        crossings_db, prior = tf.reshape(walls[1:-count], (count, -1)), walls[-count:]
        for number, under in enumerate(materials.under(phi, fractions)):
            reflection_db, crossing_db = materials.reflection_db[number], crossings_db[number]
            kept, first = (
                10.0 ** (-0.1 * tf.linalg.matvec(self._unnamed, tf.concat([each_db, [reflection_db]], axis=0)))
                for each_db in (crossing_db, materials.crossing_db[number])
            )
            gain_db = self._moved.changed_db(under.gain_db, power * kept, self._paths.power * first)
            loss_db = walls[0] + tf.reduce_sum(crossing_db * fractions)
            traces.append(WallTrace(under.link_state, gain_db, nothing + loss_db, known))
        return traces, prior

    @cached_property
    def _unnamed(self) -> Floats:
        """Crossings of thin and thick walls of unknown material, and reflections at them (P, 3)."""
        classes = self._scene.partial.wall_classes(self._paths.vertices_m)
        return np.stack(unnamed_counts(self._paths.interactions, classes), axis=1).astype(np.float64)

    def _by_rule(
        self, traces: Sequence[WallTrace], given: Mapping[str, Any], power: Any, vertices_m: Any
    ) -> list[Parts]:
        """Return the prediction under each candidate for the material of walls (`LinkModel.predict_features`)."""
        ops, scene, values = import_keras().ops, self._scene, self._moved.features(given.get("tx_m"), power, vertices_m)
        if scene.model.by_mean_losses:
            experts = self._by_mean_losses(traces, values, given.get("tx_m"))
        else:
            values["free_db"], expert = self._by_networks(values, given)
            if LINK_NETWORK in self._networks:
                return [predicted(values, expert, _doubled(self._networks[GATE_NETWORK]), ops)] * len(traces)
            experts = [expert] * len(traces)
        under = [{"gain_db": trace.gain_db, "link_state": trace.link_state} for trace in traces]
        return [predicted(values | own, expert, ops=ops) for own, expert in zip(under, experts, strict=True)]

    def _by_mean_losses(self, traces: Sequence[WallTrace], values: Mapping[str, Any], tx_m: Any) -> list[Parts]:
        ops, scene = import_keras().ops, self._scene
        lengths_m = (tf.convert_to_tensor(values[name]) for name in ("unobserved_distance_m", "distance_m"))
        lines = DirectLines._make([*self._moved.ends_m(tx_m), *lengths_m, traces[0].known])
        walls = scene._walls.counts(lines, ops)
        states, gains_db, losses_db, known = zip(*traces, strict=True)
        together = WallTrace(
            np.concatenate(states), tf.concat(gains_db, 0), tf.concat(losses_db, 0), np.concatenate(known)
        )
        repeated, max_walls = tf.tile(walls, [len(traces)]), scene.simulation.trace_settings.max_walls
        found = (tf.split(part, len(traces), axis=1) for part in by_mean_losses(together, repeated, max_walls, ops))
        return [*zip(*found, strict=True)]

    def _by_networks(self, values: Mapping[str, Any], given: Mapping[str, Any]) -> tuple[Any, Parts]:
        """Return the free-space gain (N,) [dB], and the distribution of the networks."""
        ops, networks = import_keras().ops, self._networks
        frequency_hz = self._scene.predictor.settings.frequency_hz
        carrier_hz = given.get("frequency_hz", tf.constant(self.base.frequency_hz))
        shift_db = 20.0 / math.log(10.0) * tf.math.log(carrier_hz / frequency_hz)
        free_db = free_space_gain_db(values["distance_m"], frequency_hz, ops) - shift_db
        if LINK_NETWORK not in networks:
            inputs = {name: values[name][:, None] for name in GAIN_INPUTS}
            return free_db, distribution_by_paper(networks, inputs, self._phi.link_state, shift_db, ops)
        inputs, of_map = tf.cast(link_inputs(values, frequency_hz, shift_db, ops), tf.float32), None
        if MAP_NETWORK in networks:
            space = MapSpace.of(self._scene.partial)
            ends_m = self._moved.ends_m(given.get("tx_m"))
            of_map = read_features(space, image_features(networks, space.image, ops), *ends_m, ops)
        outputs = tf.cast(link_outputs(networks, inputs, of_map, ops), tf.float64)
        return free_db, expert_parts(outputs, free_db, context_of(self._phi).possible, ops)


def _doubled(network: Any) -> Any:
    """Return a network that takes and returns double precision."""
    return lambda inputs: tf.cast(network(tf.cast(inputs, tf.float32)), tf.float64)
