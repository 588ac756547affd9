"""A tracer and a predictor that answer at once, for tests of what is made of their answers."""

from collections.abc import Callable, Iterable, Iterator

import numpy as np
import pytest
import xarray as xr
from extruded import drawn
from numpy.typing import NDArray

from sionna_partial import coverage as coverage_module
from sionna_partial.constants import LinkState
from sionna_partial.coverage import predict_map
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import IndirectPaths, LinkFeatures
from sionna_partial.prediction.predictor import LinkPrediction
from sionna_partial.prediction.unobserved import unobserved_lengths_m
from sionna_partial.settings import PredictorSettings, SceneSettings, TraceSettings
from sionna_partial.tracing.paths import SolvedPaths

PICTURE = """
????????????
?##########?
?#.....#...?
?#.....#.???
?#.........?
?#.....#..#?
?##########?
????????????
"""
"""A partly seen home of two rooms; the first line holds the largest y."""

COMPLETE = """
????????????
?##########?
?#.....#...#
?#.....#..#?
?#.........#
?#.....#..##
?##########?
????????????
"""
"""All of that home."""

TX = (0.6, 3.6)
"""Where the transmitter stands."""

SEVERAL = {"west": TX, "<b>east$}$": (3.4, 3.1)}
"""Where several stand."""


def map_of(picture: str, resolution_m: float = 0.5, origin_m: tuple[float, float] = (-1.0, 2.0)) -> PartialMap:
    """Make a map of a drawing, off the world's origin."""
    return drawn(picture, resolution_m, origin_m)


class FakeTracer:
    """Finds no paths, and says so."""

    def __init__(self, partial: PartialMap, settings: TraceSettings, scene_settings: SceneSettings) -> None:
        pass

    def paths(
        self, tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], report: Callable[[float, str], None]
    ) -> Iterator[SolvedPaths]:
        report(0.5, "tracing")
        return iter(())


def fake_features(
    partial: PartialMap,
    tx_m: NDArray[np.float64],
    rx_m: NDArray[np.float64],
    blocks: Iterable[SolvedPaths],
    context: bool,
) -> LinkFeatures:
    """Trace without walls: LOS up to 2 m, NLOS up to 4 m, then outage; Friis' gain, less 20 dB for NLOS."""
    assert not list(blocks)
    distance_m = np.linalg.norm(rx_m - tx_m, axis=1)
    state = np.select([distance_m < 2.0, distance_m < 4.0], [LinkState.LOS, LinkState.NLOS], LinkState.OUTAGE)
    gain_db = -61.4 - 20.0 * np.log10(distance_m) - np.choose(state, [150.0, 0.0, 20.0])
    unobserved_m = unobserved_lengths_m(partial, tx_m, rx_m)
    known = IndirectPaths(partial, tx_m[None], rx_m).context(state, unobserved_m) if context else None
    phi = LinkFeatures(state, unobserved_m, distance_m, np.maximum(gain_db, -150.0), known)
    return phi.with_windows((partial,), np.zeros(len(phi), dtype=np.int64))


class FakePredictor:
    """Answers with numbers that a test can compute: a tenth of the probability leaks for each unknown metre."""

    name = "fake"
    fingerprint = "0" * 64
    settings = PredictorSettings(networks="map")

    @classmethod
    def load(cls, name: object = None) -> "FakePredictor":
        return name if isinstance(name, cls) else cls()

    def predict(self, phi: LinkFeatures) -> LinkPrediction:
        leak = np.clip(0.1 * phi.unobserved_distance_m, 0.0, 0.6)
        p_outage, p_los, p_nlos = (np.where(phi.link_state == state, 1.0 - leak, leak / 2) for state in LinkState)
        return LinkPrediction(
            p_los=p_los,
            p_nlos=p_nlos,
            p_outage=p_outage,
            gain_mean_db=phi.gain_db + leak,
            gain_std_db=10.0 * leak,
            gain_los_mean_db=phi.gain_db,
            gain_los_std_db=leak,
            gain_nlos_mean_db=phi.gain_db - 20.0,
            gain_nlos_std_db=2.0 * leak,
        )

    def predict_indoor(self, phi: LinkFeatures) -> NDArray[np.float64]:
        return np.full(len(phi), 0.25)


def use_fakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let predict_map use the fakes."""
    monkeypatch.setattr(coverage_module, "Tracer", FakeTracer)
    monkeypatch.setattr(coverage_module, "features_of_paths", fake_features)
    monkeypatch.setattr(coverage_module, "Predictor", FakePredictor)


def small_coverage(monkeypatch: pytest.MonkeyPatch) -> xr.Dataset:
    """Coverage map of `PICTURE` with receivers 0.25 m apart."""
    use_fakes(monkeypatch)
    return predict_map(map_of(PICTURE), TX, spacing_m=0.25)


def coverage_of_several(monkeypatch: pytest.MonkeyPatch) -> xr.Dataset:
    """As `small_coverage`, of several transmitters."""
    use_fakes(monkeypatch)
    return predict_map(map_of(PICTURE), SEVERAL, spacing_m=0.25)
