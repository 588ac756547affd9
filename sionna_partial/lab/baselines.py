"""Baselines of an evaluation: the usual link, the distance alone, the trace on the partial map, and 3GPP TR 38.901."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sionna_partial.arrays import Floats, States
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.display import Shown
from sionna_partial.errors import PredictorError
from sionna_partial.files import atomic_write, read_bytes
from sionna_partial.lab.datasets.table import LinkTable
from sionna_partial.prediction.features import LinkFeatures
from sionna_partial.prediction.paper_networks import free_space_gain_db
from sionna_partial.prediction.predictor import Predictor, warm_predictor
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.settings import PredictorSettings

MAJORITY_FILE, DISTANCE_FILE = "majority.json", "distance.keras"

_MAX_BYTES = 1_000_000

OFFICES = ("mixed", "open")

_INDOOR_STD_DB = (0.0, 3.0, 8.03)


@dataclass(frozen=True)
class Majority:
    """Equal prediction for every link: fractions, means and standard deviations [dB] of the training links by state.

    A state without links has the gain of an outage.
    """

    fractions: tuple[float, ...]
    means_db: tuple[float, ...]
    stds_db: tuple[float, ...]

    @classmethod
    def fit(cls, link_state: States, gain_db: Floats) -> "Majority":
        """Fit to true link states (N,) and gains (N,) [dB]."""
        groups = [gain_db[link_state == state] for state in LinkState]
        known = [group if len(group) else np.array([GAIN_FLOOR_DB]) for group in groups]
        return cls(
            tuple(len(group) / len(gain_db) for group in groups),
            tuple(float(group.mean()) for group in known),
            tuple(float(group.std()) for group in known),
        )

    def predict(self, phi: LinkFeatures) -> LinkPrediction:
        """Return the same distribution for N links."""
        rows = (self.fractions, self.means_db, self.stds_db)
        return LinkPrediction.of_parts(*(np.repeat(np.array(row)[:, None], len(phi), axis=1) for row in rows))


@dataclass(frozen=True, eq=False)
class Baselines(Shown):
    """Baselines fitted to the training links of a predictor."""

    majority: Majority
    distance: Predictor

    @classmethod
    def fit(cls, links: LinkTable, settings: PredictorSettings) -> "Baselines":
        """Fit to links with receivers drawn indoors."""
        blind = nothing_seen(links.features, settings.frequency_hz)
        homes = list(dict.fromkeys(map(str, links.home)))
        distance = Predictor.fit(
            blind, links.link_state, links.gain_db, homes=homes, settings=replace(settings, networks="paper")
        )
        return cls(Majority.fit(links.link_state, links.gain_db), distance)

    def save(self, folder: Path) -> None:
        """Write the files into a folder."""
        self.distance.save(folder / DISTANCE_FILE)
        rows = zip(LinkState, self.majority.fractions, self.majority.means_db, self.majority.stds_db, strict=True)
        content = {
            state.name: {"share": fraction, "gain_mean_db": mean_db, "gain_std_db": std_db}
            for state, fraction, mean_db, std_db in rows
        }
        with atomic_write(folder / MAJORITY_FILE, "w") as stream:
            stream.write(json.dumps(content, indent=2) + "\n")

    @classmethod
    def load(cls, folder: Path) -> "Baselines":
        """Read the files of `save`."""
        path = folder / MAJORITY_FILE
        try:
            content = json.loads(read_bytes(path, "path", PredictorError, _MAX_BYTES))
            cells = [content[state.name] for state in LinkState]
            columns = (tuple(float(cell[name]) for cell in cells) for name in ("share", "gain_mean_db", "gain_std_db"))
            majority = Majority(*columns)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise PredictorError(
                f"path = '{path}' cannot be read ({error!r}): copy it again, or train the predictor beside it anew."
            ) from error
        return cls(majority, warm_predictor(folder / DISTANCE_FILE))


def nothing_seen(phi: LinkFeatures, frequency_hz: float) -> LinkFeatures:
    """Return the features of N links on an empty map, where only the distance is known."""
    frequency_hz = phi.frequency_hz or frequency_hz
    gain_db = np.maximum(free_space_gain_db(phi.distance_m, frequency_hz), GAIN_FLOOR_DB)
    state = np.full(len(phi), LinkState.LOS)
    return LinkFeatures(state, phi.distance_m, phi.distance_m, gain_db, frequency_hz=frequency_hz)


def indoor_los_probability(distance_m: Floats, office: str) -> Floats:
    """Return the LOS probability of 3GPP TR 38.901 V18.0.0, Table 7.4.2-1, at horizontal distances (N,) [m]."""
    d = distance_m
    if office == "mixed":
        near, far = np.exp(-(d - 1.2) / 4.7), 0.32 * np.exp(-(d - 6.5) / 32.6)
        return np.select([d <= 1.2, d < 6.5], [1.0, near], far)
    near, far = np.exp(-(d - 5.0) / 70.8), 0.54 * np.exp(-(d - 49.0) / 211.7)
    return np.select([d <= 5.0, d <= 49.0], [1.0, near], far)


def indoor_gain_db(distance_m: Floats, frequency_hz: float) -> dict[LinkState, Floats]:
    """Return the path gain [dB] of 3GPP TR 38.901 V18.0.0, Table 7.4.1-1, "InH - Office", at distances (N,) [m].

    The model covers 1 to 150 m and 0.5 to 100 GHz, and is extended to 1 cm here. There is no shadow fading.
    """
    decades, frequency = np.log10(np.maximum(distance_m, 0.01)), np.log10(frequency_hz / 1e9)
    los_db = 32.4 + 17.3 * decades + 20.0 * frequency
    nlos_db = np.maximum(los_db, 38.3 * decades + 17.30 + 24.9 * frequency)
    return {LinkState.LOS: -los_db, LinkState.NLOS: -nlos_db}


def tr38901_indoor(phi: LinkFeatures, frequency_hz: float, office: str) -> LinkPrediction:
    """Predict with the indoor model of 3GPP TR 38.901, which has no outage; both ends have the same height."""
    p_los = indoor_los_probability(phi.distance_m, office)
    gains_db = indoor_gain_db(phi.distance_m, phi.frequency_hz or frequency_hz)
    nothing = np.zeros(len(phi))
    means_db = np.stack([nothing + GAIN_FLOOR_DB, gains_db[LinkState.LOS], gains_db[LinkState.NLOS]])
    stds_db = np.stack([nothing + std_db for std_db in _INDOOR_STD_DB])
    probabilities = np.stack([nothing, p_los, 1.0 - p_los])
    return LinkPrediction.of_parts(probabilities, np.maximum(means_db, GAIN_FLOOR_DB), stds_db)


def baseline_predictions(
    baselines: Baselines, paper: Predictor | None, phi: LinkFeatures, frequency_hz: float
) -> Mapping[str, LinkPrediction]:
    distance = baselines.distance
    return ({} if paper is None else {"paper": paper.predict(phi)}) | {
        "distance only": distance.predict(nothing_seen(phi, frequency_hz)),
        "majority": baselines.majority.predict(phi),
        "partial trace": LinkPrediction.of_trace(phi),
        **{f"TR 38.901 {office} office": tr38901_indoor(phi, frequency_hz, office) for office in OFFICES},
    }
