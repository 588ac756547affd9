"""The predicted distribution as one differentiable function of transmitter, materials, frequency and network weights.

Sionna RT and Dr.Jit give the paths and their derivatives (`tracing.path_set`), a `tf.custom_gradient` hands both to
TensorFlow, and everything from there on, features and networks, is TensorFlow. At the place where links were traced the
distribution is that of `Predictor.predict`.

What gradients see, and what they do not:

- Paths are those of the trace. One that would appear elsewhere is not there; one that is no longer valid loses its
  power in a step, and no derivative sees that step. Link states of the partial trace, which states the map leaves
  possible, and whether the ends were seen, are those of the trace too.
- The unobserved length of a line, d_unobs, has a derivative that jumps from cell to cell. Where the transmitter moves,
  the length is that of the trace times s(tx) / s(tx at the trace), and s is `SmoothLengths`: so are the lengths of all
  paths in unknown cells, and of direct lines in known walls. A line that was wholly observed stays so.
- What the map network knows around the transmitter is read there and 15 cm to each side, and is linear between. Where a
  receiver passes the middle of one of its cells the slope has a bend, and wherever one of the paper's rectifiers
  switches.
- On a complete map the distribution is the trace itself: its probabilities are constant, and its gain is that of the
  paths.
- There are first derivatives alone: TensorFlow refuses those of derivatives.
"""

import math
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sionna_partial.constants import GAIN_FLOOR_DB, CellState, LinkState
from sionna_partial.differentiable.link_distribution import LinkDistribution
from sionna_partial.differentiable.path_power import moved_lengths_m, moved_paths
from sionna_partial.differentiable.smooth_lengths import SmoothLengths
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.certainty import possible_states
from sionna_partial.prediction.features import link_features
from sionna_partial.prediction.link_context import REACHES_M, kept_shares
from sionna_partial.prediction.map_networks import (
    LINK_NETWORK,
    MAP_NETWORKS,
    LinkNumbers,
    distribution,
    input_columns,
    link_marks,
    read_links,
    read_maps,
    reads_maps,
)
from sionna_partial.prediction.paper_networks import (
    FEATURES,
    GAIN_NETWORKS,
    STATE_NETWORKS,
    distribution_by_paper,
    free_space_gain_db,
    import_keras,
    parts,
)
from sionna_partial.prediction.predictor import Predictor
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.prediction.windows import CELLS_M, map_windows
from sionna_partial.settings import FREQUENCIES_HZ, SceneSettings, TraceSettings, require
from sionna_partial.tracing.path_set import PARAMETERS, PathScene, PathSet, one_transmitter
from sionna_partial.tracing.trace import Progress

WINDOW_STEP_M = CELLS_M[0] / 2
"""How far from the transmitter further windows are drawn [m]."""

_NEAREST_M = 1e-6
"""Distance that a transmitter keeps from receivers: at the receiver, a distance has no slope [m]."""

_LIMITS = {
    "tx_m": (-1e9, 1e9),
    "relative_permittivity": (1.0, 1e6),
    "conductivity_s_m": (0.0, 1e9),
    "thickness_m": (0.0, 10.0),
    "frequency_hz": FREQUENCIES_HZ,
}


class DifferentiableScene:
    """A map and a predictor, for the differentiable links of any transmitters: built once, traced for each.

    Parameters
    ----------
    scene : PartialMap or path
        What is known of the building.
    predictor : None, "map", "paper", path or Predictor
        None is the shipped default. On a complete map it is not used.
    trace_settings : TraceSettings, optional
        Refraction and diffuse reflection must be off; diffraction too on meshes.
    scene_settings : SceneSettings, optional

    Raises
    ------
    MapError, SettingsError, PredictorError, BackendError
        As `predict_map`, or for paths that only rays find.
    """

    def __init__(
        self,
        scene: PartialMap | str | Path,
        *,
        predictor: Predictor | str | Path | None = None,
        trace_settings: TraceSettings | None = None,
        scene_settings: SceneSettings | None = None,
    ) -> None:
        self.partial = scene if isinstance(scene, PartialMap) else load_map(scene)
        self.paths = PathScene(self.partial, settings=trace_settings, scene_settings=scene_settings)
        self.predictor = predictor if isinstance(predictor, Predictor) else Predictor.load(predictor)
        self.networks = parts(self.predictor.model)

    @property
    def materials(self) -> tuple[str, ...]:
        """Names of the M radio materials, in the order of the arguments of `DifferentiableLinks`."""
        return self.paths.materials

    @property
    def weights(self) -> list[Any]:
        """Variables of the networks that answer."""
        seeing = [name for name in (*MAP_NETWORKS, LINK_NETWORK) if name in self.networks]
        answering = seeing or [*STATE_NETWORKS.values(), *(row.name for row in GAIN_NETWORKS)]
        return [weight.value for name in answering for weight in self.networks[name].trainable_variables]

    def links(self, tx: ArrayLike, rx: ArrayLike, *, progress: Progress | None = None) -> "DifferentiableLinks":
        """Trace the links from a transmitter to N receivers.

        Parameters
        ----------
        tx : (3,) array-like
            Transmitter position [m].
        rx : (N, 3) array-like
            Receiver positions [m].
        progress : callable, optional
            Called as ``progress(share_done, message)``.

        Raises
        ------
        PositionError
            As `trace_links`, or for several transmitters.
        """
        return DifferentiableLinks(self, self.paths.paths(one_transmitter(tx), rx, progress=progress))

    @cached_property
    def smooth_unknown(self) -> SmoothLengths:
        """Lengths in unknown cells."""
        return SmoothLengths(self.partial, CellState.UNKNOWN)

    @cached_property
    def smooth_walls(self) -> SmoothLengths:
        """Lengths in cells of known walls."""
        return SmoothLengths(self.partial, CellState.WALL)


class DifferentiableLinks:
    """Links from one transmitter to N receivers, traced once: their distribution as a function (see the module).

    Parameters
    ----------
    scene : DifferentiableScene
    paths : PathSet

    Attributes
    ----------
    base : PathParameters
        Where they were traced; its fields are the arguments of a call.

    Examples
    --------
    By the direct path, the gain rises by 20 / ln(10) / 2 dB for each metre that the transmitter comes nearer from 2 m:

    >>> import numpy as np
    >>> import sionna_partial as sp
    >>> import tensorflow as tf
    >>> room = sp.PartialMap(np.pad(np.zeros((18, 58), dtype=np.uint8), 1, constant_values=1), resolution_m=0.1)
    >>> scene = sp.DifferentiableScene(room, trace_settings=sp.TraceSettings(max_depth=0))
    >>> links = scene.links((1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)])
    >>> place = tf.Variable(links.base.tx_m)
    >>> with tf.GradientTape() as tape:
    ...     gain_db = links(tx_m=place).gain_mean_db[0]
    >>> (tape.gradient(gain_db, place).numpy() + 0.0).round(3).tolist()
    [4.343, 0.0, 0.0]
    """

    def __init__(self, scene: DifferentiableScene, paths: PathSet) -> None:
        self.base, self._scene, self._paths = paths.base, scene, paths
        self._phi = link_features(scene.partial, paths.links())

    def __call__(
        self,
        *,
        tx_m: Any = None,
        relative_permittivity: Any = None,
        conductivity_s_m: Any = None,
        thickness_m: Any = None,
        frequency_hz: Any = None,
    ) -> LinkDistribution:
        """Evaluate the distribution; nothing is traced again.

        Call it eagerly, not within `tf.function`. What is not given is as it was traced, and costs no derivatives.

        Parameters
        ----------
        tx_m : (3,) tensor, optional
            Transmitter position [m].
        relative_permittivity, conductivity_s_m, thickness_m : (M,) tensors, optional
            Of each of the scene's materials; [S/m] and [m].
        frequency_hz : () tensor, optional
            Carrier frequency of the trace [Hz]; ITU materials follow it.

        Returns
        -------
        LinkDistribution

        Raises
        ------
        SettingsError
            For another shape, a value out of range, or a call within `tf.function`.
        """
        import tensorflow as tf

        values = (tx_m, relative_permittivity, conductivity_s_m, thickness_m, frequency_hz)
        pairs = zip(PARAMETERS, values, strict=True)
        given = {name: self._tensor(name, value) for name, value in pairs if value is not None}
        power, vertices_m = moved_paths(self._paths, given)
        gain_db = _gain_db(self._sum(power, self._paths.path_rx))
        if self._scene.partial.is_complete:
            states = tf.cast([self._phi.link_state == state for state in LinkState], tf.float64)
            return LinkDistribution.of_parts(states, tf.stack([gain_db] * len(LinkState)), tf.zeros_like(states))
        place = given.get("tx_m")
        numbers = self._moved_numbers(place, gain_db)
        if LINK_NETWORK in self._scene.networks:
            return self._seen(place, self._with_context(numbers, place, power, vertices_m))
        inputs = {name: tf.cast(getattr(numbers, name), tf.float32)[:, None] for name in FEATURES}
        return LinkDistribution.of_parts(*distribution_by_paper(self._scene.networks, inputs, self._phi.link_state))

    def _tensor(self, name: str, value: Any) -> Any:
        """Check one argument, and return it as a float64 tensor."""
        import tensorflow as tf

        require(tf.executing_eagerly(), name, value, "call links eagerly, not within tf.function.")
        tensor = tf.cast(tf.convert_to_tensor(value, dtype_hint=tf.float64), tf.float64)
        shape = getattr(self.base, name).shape
        require(tensor.shape == shape, name, value, f"give a tensor of shape {shape}.")
        low, high = _LIMITS[name]
        numbers = tensor.numpy()
        require(
            bool(((numbers >= low) & (numbers <= high)).all()), name, value, f"give numbers in [{low:g}, {high:g}]."
        )
        return tensor

    @cached_property
    def _numbers(self) -> LinkNumbers:
        return LinkNumbers.of(self._phi)

    @cached_property
    def _legs(self) -> "_Legs":
        return _Legs(self._scene.partial, self._paths)

    def _sum(self, power: Any, rx: NDArray[np.int32]) -> Any:
        """Sum (N,) over the paths to each receiver."""
        import tensorflow as tf

        return tf.math.unsorted_segment_sum(power, rx, len(self._paths.rx_m))

    def _moved_numbers(self, place: Any, gain_db: Any) -> LinkNumbers:
        """Return what derives from the transmitter's place alone, None being where it was, and the gain (N,)."""
        import tensorflow as tf

        numbers, rx_m = replace(self._numbers, gain_db=gain_db), tf.constant(self._paths.rx_m)
        if place is None:
            return numbers
        first, ends = np.broadcast_to(self.base.tx_m, rx_m.shape), (tf.broadcast_to(place, rx_m.shape), rx_m)
        scene, base = self._scene, (first, self._paths.rx_m)
        distance_m = tf.sqrt(tf.maximum(tf.reduce_sum((rx_m - place) ** 2, axis=1), _NEAREST_M**2))
        unobserved_m = moved_lengths_m(scene.smooth_unknown, numbers.unobserved_distance_m, base, ends)
        return replace(
            numbers,
            distance_m=distance_m,
            unobserved_distance_m=tf.minimum(unobserved_m, distance_m),
            walled_m=moved_lengths_m(scene.smooth_walls, numbers.walled_m, base, ends),
        )

    def _with_context(self, numbers: LinkNumbers, place: Any, power: Any, vertices_m: Any) -> LinkNumbers:
        """Add what the indirect paths say, whose power (P,) and vertices (P, D, 3) are those now."""
        import tensorflow as tf

        legs = self._legs
        crossed_m = tf.constant(legs.crossed_m)
        if place is not None:
            crossed_m = legs.moved_m(self._scene.smooth_unknown, place, vertices_m)
        indirect = tf.gather(power, legs.paths)
        gains_db = [_gain_db(self._sum(indirect * self._kept(crossed_m, reach), legs.rx)) for reach in REACHES_M]
        strongest = tf.gather(crossed_m, np.maximum(legs.strongest, 0)) if len(legs.paths) else numbers.distance_m
        return replace(
            numbers,
            indirect_gain_db=tf.stack(gains_db, axis=1),
            strongest_unobserved_m=tf.where(legs.strongest >= 0, strongest, numbers.distance_m),
        )

    def _kept(self, crossed_m: Any, reach_m: float) -> Any:
        """Share of power that gets through the unobserved; paths wholly in observed space stay so."""
        import tensorflow as tf

        return tf.exp(-crossed_m / reach_m) if reach_m > 0.0 else kept_shares(self._legs.crossed_m, 0.0)

    def _seen(self, place: Any, numbers: LinkNumbers) -> LinkDistribution:
        """Let the networks answer that see where links run."""
        import tensorflow as tf

        keras, frequency_hz = import_keras(), self._scene.predictor.settings.frequency_hz
        marks = tf.constant(link_marks(self._phi))
        columns = input_columns(marks, numbers, frequency_hz, keras.ops)
        away_m = tf.constant(self._paths.rx_m) - (self.base.tx_m if place is None else place)
        known = self._known(place) if reads_maps(self._scene.networks) else []
        outputs = read_links(
            self._scene.networks, known, tf.cast(columns, tf.float32)[None], tf.cast(away_m, tf.float32)[None, :, :2]
        )
        free_db = free_space_gain_db(numbers.distance_m, frequency_hz, keras.ops)
        possible = possible_states(self._phi)
        return LinkDistribution.of_parts(*distribution(tf.cast(outputs[0], tf.float64), free_db, possible))

    def _known(self, place: Any) -> list[Any]:
        """Return what the map networks read (1, ...) around the transmitter: linear around where it was."""
        import tensorflow as tf

        known = read_maps(self._scene.networks, self._windows[:1] if place is None else self._windows)
        if place is None:
            return known
        away = tf.cast(place - self.base.tx_m, tf.float32)[:2] / (2.0 * WINDOW_STEP_M)
        return [maps[:1] + away[0] * (maps[1:2] - maps[2:3]) + away[1] * (maps[3:4] - maps[4:5]) for maps in known]

    @cached_property
    def _windows(self) -> NDArray[np.float32]:
        """Windows around the transmitter, and around places to the right, left, top and bottom of it."""
        steps_m = WINDOW_STEP_M * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        return map_windows(self._scene.partial, self.base.tx_m[:2] + steps_m).astype(np.float32)


class _Legs:
    """The straight legs of the indirect paths: what moves with the transmitter, and how much of it is unobserved.

    Parameters
    ----------
    partial : PartialMap
    paths : PathSet

    Attributes
    ----------
    paths : (Q,) int array
        Which of the paths are indirect.
    rx : (Q,) int32 array
        Their receivers.
    crossed_m : (Q,) float64 array
        Their length in unknown cells as they were traced [m].
    strongest : (N,) int array
        The strongest of them to each receiver; -1 where there is none.
    """

    def __init__(self, partial: PartialMap, paths: PathSet) -> None:
        self.paths = np.flatnonzero(~paths.is_direct)
        self.rx = paths.path_rx[self.paths]
        self._rx_m = paths.rx_m
        vertices_m = paths.vertices_m[self.paths]
        self._of_path, self._start, self._end = _leg_nodes(paths.interactions[self.paths] > 0, self.rx, len(paths.rx_m))
        nodes_m = np.concatenate([paths.base.tx_m[None], paths.rx_m, vertices_m.reshape(-1, 3)])
        self._base = nodes_m[self._start], nodes_m[self._end]
        self._exact_m = unobserved_lengths_m(partial, *self._base)
        self.crossed_m = np.bincount(self._of_path, weights=self._exact_m, minlength=len(self.rx)).astype(np.float64)
        self.strongest = np.full(len(paths.rx_m), -1)
        weakest_first = np.argsort(paths.power[self.paths], kind="stable")
        self.strongest[self.rx[weakest_first]] = weakest_first

    def moved_m(self, lengths: SmoothLengths, place: Any, vertices_m: Any) -> Any:
        """Return the length (Q,) in unknown cells with the transmitter at a place, and vertices (P, D, 3) now [m]."""
        import tensorflow as tf

        bends = tf.reshape(tf.gather(vertices_m, self.paths), (-1, 3))
        nodes_m = tf.concat([place[None], self._rx_m, bends], axis=0)
        ends = tf.gather(nodes_m, self._start), tf.gather(nodes_m, self._end)
        crossed_m = moved_lengths_m(lengths, self._exact_m, self._base, ends)
        return tf.math.unsorted_segment_sum(crossed_m, self._of_path, len(self.rx))


def _leg_nodes(
    bends: NDArray[np.bool_], rx: NDArray[np.int32], receivers: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Path, start and end of each leg of Q paths that bend at some of D vertices (Q, D), to receivers (Q,).

    Nodes are counted through: the transmitter, the receivers, and all vertices, path by path.
    """
    paths, depth = bends.shape
    vertices = 1 + receivers + np.arange(paths * depth).reshape(paths, depth)
    chain = np.column_stack([np.zeros(paths, dtype=np.intp), vertices, 1 + rx])
    there = np.column_stack([np.ones(paths, dtype=bool), bends, np.ones(paths, dtype=bool)])
    of_path, nodes = np.nonzero(there)[0], chain[there]
    on = of_path[:-1] == of_path[1:]
    return of_path[:-1][on], nodes[:-1][on], nodes[1:][on]


def _gain_db(power: Any) -> Any:
    """Gain (N,) of power, at least -150 dB; there it does not change."""
    import tensorflow as tf

    floor = 10.0 ** (GAIN_FLOOR_DB / 10.0)
    return 10.0 / math.log(10.0) * tf.math.log(tf.maximum(power, floor))
