"""What receivers get from a transmitter at one place after another: traced, predicted and differentiated."""

import numpy as np
from numpy.typing import NDArray

from sionna_partial.differentiable.scene import DifferentiableLinks, DifferentiableScene
from sionna_partial.placement.area import PlacementArea
from sionna_partial.placement.objective import PlacementObjective
from sionna_partial.prediction.features import LinkFeatures, link_features
from sionna_partial.prediction.predictor import LinkPrediction
from sionna_partial.tracing.fixed_paths import FixedPaths
from sionna_partial.tracing.trace import nearest_m


class PlacementViews:
    """An objective, as the receivers of an area see it.

    Parameters
    ----------
    scene : DifferentiableScene
    area : PlacementArea
    objective : PlacementObjective
    """

    def __init__(self, scene: DifferentiableScene, area: PlacementArea, objective: PlacementObjective) -> None:
        self._scene, self._objective, self._rx_m, self._weight = scene, objective, area.rx_m, area.weight
        self._values: dict[bytes, NDArray[np.float64]] = {}
        self._paths: dict[bytes, FixedPaths] = {}

    def sees_as(self, other: "PlacementViews") -> bool:
        """Whether both have the same receivers and the same objective."""
        return self._objective == other._objective and np.array_equal(self._rx_m, other._rx_m)

    def scores(self, places_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Give the objective (P,) with a transmitter at each of the places (P, 3) [m], rounded to its `digits`."""
        scores = [self._objective.score(values, self._weight) for values in self.values(places_m)]
        return np.round(scores, self._objective.digits)

    def values(self, places_m: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Give what counts of each receiver (N,), for each of the places (P, 3) [m]; none is traced again."""
        new = {place.tobytes(): place for place in places_m if place.tobytes() not in self._values}
        if new:
            self._paths = {key: self._trace(place) for key, place in new.items()}
            scene = self._scene
            windows = scene.predictor.reads_maps and not scene.partial.is_complete
            traced = (paths.links() for paths in self._paths.values())
            features = [link_features(scene.partial, links, windows=windows) for links in traced]
            prediction = self._predict(LinkFeatures.concatenate(features))
            parts = np.split(self._objective.values(prediction), np.cumsum([len(each) for each in features])[:-1])
            for (key, place), part in zip(new.items(), parts, strict=True):
                self._values[key] = self._of_all(place, part)
        return [self._values[place.tobytes()] for place in places_m]

    def slope(self, place_m: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Differentiate the objective at a place (3,) with respect to x and y (2,) [1/m]; no place beside is looked at.

        Of the places that were looked at last, none is traced again.
        """
        import tensorflow as tf

        paths = self._paths.get(place_m.tobytes()) or self._trace(place_m)
        place = tf.constant(place_m)
        with tf.GradientTape() as tape:
            tape.watch(place)
            distribution = DifferentiableLinks(self._scene, paths)(tx_m=place)
            value = self._objective.tensor(distribution, self._weight[self._far(place_m)])
        return tape.gradient(value, place).numpy()[:2], np.zeros((0, 3))

    def _predict(self, phi: LinkFeatures) -> LinkPrediction:
        if self._scene.partial.is_complete:
            return LinkPrediction.of_trace(phi)
        return self._scene.predictor.predict(phi)

    def _trace(self, place_m: NDArray[np.float64]) -> FixedPaths:
        return self._scene.paths.paths(place_m, self._rx_m[self._far(place_m)])

    def _far(self, place_m: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which receivers (N,) are far enough from a transmitter to have a path gain."""
        return np.linalg.norm(self._rx_m - place_m, axis=1) >= nearest_m(self._scene.paths.settings.frequency_hz)

    def _of_all(self, place_m: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Let receivers at the transmitter be covered, with a gain of 0 dB."""
        all_values = np.full(len(self._rx_m), self._objective.value_at_transmitter)
        all_values[self._far(place_m)] = values
        return all_values
