"""Power of paths and lengths of segments as functions of TensorFlow (`dr.wrap` does not support TensorFlow)."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sionna_partial.differentiable.smooth_lengths import SmoothLengths
from sionna_partial.tracing.path_set import PathSet

STEEPEST = 4.0
"""Largest ratio of the growth of a length to that of its smooth surrogate, as where it hardly touches a cell."""


def moved_paths(paths: PathSet, given: Mapping[str, Any]) -> tuple[Any, Any]:
    """Evaluate power (P,) and vertices (P, D, 3) of paths, 0 where there are none, for float64 tensors.

    They are `given` for fields of `PathParameters`; the others are as the paths were traced. There are first
    derivatives only.
    """
    import tensorflow as tf

    @tf.custom_gradient
    def evaluate(*tensors: Any) -> tuple[tuple[Any, Any], Callable[..., list[Any]]]:
        values = {name: tensor.numpy() for name, tensor in zip(given, tensors, strict=True)}
        parameters = replace(paths.base, **values)

        @cache
        def slopes() -> dict[str, NDArray[np.float64]]:
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
    power, vertices_m = evaluate(*given.values())
    return power, vertices_m


def _pulled(slopes: NDArray[np.float64], upstream: Any) -> Any:
    """Sum (K,) of slopes (P, K) times upstream derivatives (P,), in an order that does not depend on threads."""
    import tensorflow as tf

    rows = tf.convert_to_tensor(upstream)[:, None] * slopes
    return tf.math.unsorted_segment_sum(rows, np.zeros(len(slopes), dtype=np.int32), 1)[0]


def _once_only(slopes: Any) -> Any:
    """Return derivatives that TensorFlow cannot differentiate again: a part would be missing."""
    import tensorflow as tf

    return tf.raw_ops.PreventGradient(input=slopes, message="links have first derivatives only.")


def moved_lengths_m(
    lengths: SmoothLengths,
    exact_m: NDArray[np.float64],
    base: tuple[NDArray[np.float64], NDArray[np.float64]],
    ends: tuple[Any, Any],
) -> Any:
    """Return lengths (N,) that change from exact ones as smooth ones do while the ends of their segments move.

    Exact lengths [m] are those in cells of one kind at the ends `base` (N, 3), and `ends` are the present ones [m].
    Lengths that were 0 stay so.
    """
    import tensorflow as tf

    @tf.custom_gradient
    def smooth_m(start: Any, end: Any) -> tuple[Any, Callable[[Any], list[Any]]]:
        def pull_back(upstream: Any) -> list[Any]:
            return [_once_only(upstream[:, None] * slopes) for slopes in lengths.slopes(start.numpy(), end.numpy())]

        return tf.constant(lengths(start.numpy(), end.numpy())), pull_back

    first_m = lengths(*base)
    pace = np.divide(exact_m, first_m, out=np.full_like(exact_m, STEEPEST), where=first_m > exact_m / STEEPEST)
    return tf.maximum(exact_m + np.where(exact_m > 0.0, pace, 0.0) * (smooth_m(*ends) - first_m), 0.0)
