"""Predictors of link state and path gain: networks, models of the user, and mean wall losses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, overload

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats
from sionna_partial.checks import Progress, shown
from sionna_partial.constants import GAIN_FLOOR_DB, LinkState
from sionna_partial.display import Shown, reporting
from sionna_partial.errors import PredictorError, SettingsError
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.evaluate import Network
from sionna_partial.prediction.features import LinkFeatures, link_numbers, link_states, require_each
from sionna_partial.prediction.map_networks import LINK_NETWORK, MapFeatures, kind_of, predict_by_context
from sionna_partial.prediction.map_training import fit_context_networks
from sionna_partial.prediction.paper_networks import (
    assemble,
    evaluate_indoor,
    evaluate_paper,
    fit_indoor_networks,
    fit_networks,
    import_keras,
    network_ranges,
    parts,
)
from sionna_partial.prediction.predictor_files import SUFFIX, digest, keras_model, pack, read_files, write_files
from sionna_partial.prediction.rule import LinkPrediction
from sionna_partial.prediction.unseen_walls import (
    WALL_LOSSES,
    DirectLines,
    UnseenWalls,
    WallTrace,
    by_mean_losses,
)
from sionna_partial.resources import PREDICTORS_FOLDER
from sionna_partial.settings import PredictorSettings

if TYPE_CHECKING:
    import keras

SHIPPED = ("map", "paper")
"""Names of the shipped predictors, the default first."""


@dataclass(frozen=True, eq=False)
class Predictor(Shown):
    """A predictor of link state and path gain, from `fit` or `load`.

    The paper's (Sections III-D and III-E): a logistic classifier on distance and unobserved distance gives P(link
    state) for each partial link state; the gain given the link state is Gaussian. P(indoor) is a logistic classifier on
    the unobserved distance, 1 before `fit_indoor`.

    With `PredictorSettings.networks` other than "paper", further networks predict links whose features have a context;
    on a complete map the trace is the prediction. The paper's networks predict features without a context.

    Parameters
    ----------
    network : Network
        All networks, evaluated by NumPy.
    archive : bytes
        The networks as a `.keras` file.
    settings : PredictorSettings
    homes : tuple of str
        Names of the training homes.
    links : mapping of str to int
        Number of training links by "true state given partial state".
    metrics : mapping
        Metrics on other homes.
    versions : mapping of str to str
        Package versions at training.
    name : str
        "fitted", a shipped name, or the file's path.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> phi = sp.LinkFeatures([1, 0], unobserved_distance_m=[0.0, 4.5], distance_m=[3.0, 6.0], gain_db=[-71.0, -150.0])
    >>> prediction = sp.Predictor.load("paper").predict(phi)
    >>> prediction.p_los.round() + 0.0
    array([1., 0.])
    """

    network: Network = field(repr=False)
    archive: bytes = field(repr=False)
    settings: PredictorSettings
    homes: tuple[str, ...] = ()
    links: Mapping[str, int] = field(default_factory=dict)
    metrics: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    name: str = "fitted"

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the `.keras` file, in hexadecimal."""
        return digest(self.archive)

    @cached_property
    def model(self) -> keras.Model:
        """The networks as a Keras model, for training and derivatives."""
        return keras_model(self.archive)

    @property
    def has_gate(self) -> bool:
        """Return whether predictions of features with a context follow the rule (`rule.predicted`)."""
        return LINK_NETWORK in self.network.layers

    @cached_property
    def _map_features(self) -> MapFeatures:
        return MapFeatures(self.network.layers)

    @classmethod
    def fit(
        cls,
        features: LinkFeatures,
        link_state: ArrayLike,
        gain_db: ArrayLike,
        *,
        homes: Sequence[str] = (),
        settings: PredictorSettings | None = None,
        progress: Progress | bool | None = None,
    ) -> Predictor:
        """Train on links of known truth; equal links and settings give equal weights.

        Link states are learned by cross-entropy; the gain by Gaussian likelihood in the paper's networks, by the CRPS
        in the others.

        Parameters
        ----------
        features : LinkFeatures
            Features of N links on partial maps.
        link_state : (N,) array-like of LinkState
            Link state on the complete map.
        gain_db : (N,) array-like
            Omnidirectional path gain on the complete map [dB].
        homes : sequence of str
            Names of the homes.
        settings : PredictorSettings, optional
        progress : bool or callable, optional
            As in `predict_map`.

        Returns
        -------
        Predictor

        Raises
        ------
        PredictorError
            For no links, wrong shapes or values, another frequency than the settings', or a training that diverges.
        """
        settings = settings or PredictorSettings()
        _require_features(features)
        if len(features) == 0:
            raise PredictorError("features has no links: give at least one.")
        states = link_states("link_state", link_state, features.shape).ravel()
        gains_db = np.maximum(link_numbers("gain_db", gain_db, features.shape), GAIN_FLOOR_DB).ravel()
        features = features.flat()
        given_hz, frequency_hz = features.frequency_hz, settings.frequency_hz
        if given_hz is not None and not math.isclose(given_hz, frequency_hz, rel_tol=1e-6):
            what = f"features are at {given_hz / 1e9:g} GHz, settings at {frequency_hz / 1e9:g} GHz"
            raise PredictorError(f"{what}: give PredictorSettings(frequency_hz={given_hz:g}).")
        context_networks = {}
        if settings.networks != "paper":
            if features.context is None:
                remedy = "give the LinkFeatures of link_features, or PredictorSettings(networks='paper')."
                raise PredictorError(f"features has no context, which all networks but the paper's need: {remedy}")
            with reporting(progress) as report:
                context_networks = fit_context_networks(features, states, gains_db, settings, progress=report)
        model = assemble(parts(fit_networks(features, states, gains_db, settings)) | context_networks)
        links = {
            f"{true.name} given {partial.name}": int(((states == true) & (features.link_state == partial)).sum())
            for partial in LinkState
            for true in LinkState
        }
        keras = import_keras()
        versions = {"keras": keras.__version__, "backend": keras.backend.backend(), "numpy": np.__version__}
        archive = pack(model)
        return cls(Network.from_keras(model), archive, settings, tuple(map(str, homes)), links, versions=versions)

    def fit_indoor(self, features: LinkFeatures, inside: ArrayLike) -> Predictor:
        """Return this predictor with P(indoor) trained (paper, "Indoor-Outdoor Estimation").

        A receiver in a free cell is indoors for certain: `train`, `predict_map` and `evaluate` use P(indoor) for the
        others only, unlike the paper.

        Parameters
        ----------
        features : LinkFeatures
            Features of N links, with receivers uniform over the wanted part of the map.
        inside : (N,) array-like of bool
            True where the receiver is indoors.

        Returns
        -------
        Predictor

        Raises
        ------
        PredictorError
            For wrong shapes or values, or a training that diverges.
        """
        _require_features(features)
        indoors = link_numbers("inside", inside, features.shape).ravel() > 0.0
        model = fit_indoor_networks(self.model, features.flat(), indoors, self.settings)
        return replace(self, network=Network.from_keras(model), archive=pack(model))

    def predict(self, features: LinkFeatures) -> LinkPrediction:
        """Predict link state and path gain for receivers indoors.

        Gains are predicted relative to free space at the frequency of the features.

        Parameters
        ----------
        features : LinkFeatures
            Features of shape (N,) or (T, N); N may be 0.

        Returns
        -------
        LinkPrediction
            In the shape of the features.

        Raises
        ------
        PredictorError
            If `features` are no LinkFeatures.
        """
        _require_features(features)
        networks = self.network.layers
        if len(features.shape) == 2:
            return self.predict(features.flat()).reshaped(features.shape)
        frequency_hz = self.settings.frequency_hz
        if features.context is None or not self.has_gate:
            return LinkPrediction.of_parts(*evaluate_paper(networks, features, frequency_hz))
        return LinkPrediction.of_parts(*predict_by_context(networks, features, frequency_hz, self._map_features))

    def predict_indoor(self, features: LinkFeatures) -> Floats:
        """Return the probability that each receiver is indoors; 1 before `fit_indoor`."""
        _require_features(features)
        return evaluate_indoor(self.network.layers, features.flat()).reshape(features.shape)

    def save(self, path: str | Path) -> None:
        """Write a `.keras` file, and a `.json` card of the same stem beside it.

        The card has features, scaling, settings, homes, metrics, versions and the SHA-256.

        Parameters
        ----------
        path : path-like
            Ends in `.keras`.

        Raises
        ------
        PredictorError
            If `path` has another suffix.
        OutputError
            If writing fails.
        """
        card = {
            "scaling": network_ranges(self.network.layers),
            "settings": asdict(self.settings),
            "homes": list(self.homes),
            "links": dict(self.links),
            "metrics": dict(self.metrics),
            "versions": dict(self.versions),
        }
        write_files(Path(path), self.archive, card)

    @classmethod
    def load(cls, name_or_path: Predictor | str | PathLike[str] | None = None) -> Predictor:
        """Load a predictor; nothing in its files is executed.

        Parameters
        ----------
        name_or_path : None, "map", "paper", path-like or Predictor
            A shipped predictor ("map" is the default), a `.keras` file, or a Predictor, which is returned unchanged.

        Returns
        -------
        Predictor

        Raises
        ------
        PredictorError
            If a file is missing, damaged, changed or of another kind.
        """
        if isinstance(name_or_path, Predictor):
            return name_or_path
        name = SHIPPED[0] if name_or_path is None else name_or_path
        known = " or ".join(map(repr, SHIPPED))
        if not isinstance(name, (str, PathLike)):
            raise PredictorError(
                f"name_or_path = {name!r} is not a path: give {known}, the path of a {SUFFIX} file, or an object with "
                "predict(phi)."
            )
        path = predictor_path(name)
        if path.suffix != SUFFIX:
            raise PredictorError(f"path = '{path}' is no predictor: give {known}, or the path of a {SUFFIX} file.")
        network, archive, card = read_files(path)
        try:
            settings = PredictorSettings(**card["settings"])
            homes, links = tuple(map(str, card["homes"])), {str(k): int(v) for k, v in card["links"].items()}
            metrics, versions = dict(card["metrics"]), dict(card["versions"])
        except (AttributeError, KeyError, TypeError, ValueError, SettingsError) as error:
            card_path = path.with_suffix(".json")
            raise PredictorError(
                f"path = '{card_path}' is damaged ({error!r}): copy it again, or train anew."
            ) from error
        found = kind_of(network.layers)
        if settings.networks != found:
            what = f"settings.networks = {settings.networks!r}, but the weights beside it are of {found!r} networks"
            raise PredictorError(f"path = '{path.with_suffix('.json')}': {what}: copy both files again, or train anew.")
        return cls(network, archive, settings, homes, links, metrics, versions, name=str(name))


class OtherPredictor:
    """A user's model instead of a `Predictor`: any object with `predict(phi)`.

    `predict` gets the `LinkFeatures` of the N uncertain links. It returns a `LinkPrediction`, or a mapping of (N,)
    arrays: `p_los`, `p_nlos`, `p_outage`, and `gain_mean_db`, `gain_std_db` of links with a path, or both
    `gain_los_...` and `gain_nlos_...` [dB]. Without a method `predict_indoor(phi)`, the default predictor gives
    P(indoor).
    """

    settings: PredictorSettings | None = None
    has_gate = False

    def __init__(self, model: Any) -> None:
        self._model = model
        self.name = f"{type(model).__module__}.{type(model).__qualname__}"
        self.fingerprint = ""

    def predict(self, phi: LinkFeatures) -> LinkPrediction:
        """Predict links; raise a PredictorError for arrays that are no distribution."""
        found = self._model.predict(phi)
        if isinstance(found, LinkPrediction):
            found = {name: getattr(found, name) for name in LinkPrediction.COLUMNS}
        if not isinstance(found, Mapping):
            raise PredictorError(f"{self.name}.predict returned {shown(found)}: give a LinkPrediction or a mapping.")

        def column(name: str, other: str = "") -> Floats:
            if name not in found and other not in found:
                what = f"{self.name}.predict returned no {name!r}"
                raise PredictorError(f"{what}: add it, an array of {len(phi)} numbers.")
            return link_numbers(f"{self.name}.predict: {name}", found[name if name in found else other], phi.shape)

        probabilities = np.stack([column(name) for name in ("p_outage", "p_los", "p_nlos")])
        sound = np.all(probabilities >= 0.0, axis=0) & (np.abs(probabilities.sum(axis=0) - 1.0) < 1e-3)
        require_each(
            np.asarray(sound), f"{self.name}.predict: p_los", probabilities[1], "the three probabilities sum to 1."
        )
        means_db, stds_db = (
            np.stack([column(f"gain_{state}_{name}", f"gain_{name}") for state in ("los", "nlos")])
            for name in ("mean_db", "std_db")
        )
        require_each(
            np.asarray(stds_db.min(axis=0) >= 0.0), f"{self.name}.predict: std", stds_db.min(axis=0), "give 0 or more."
        )
        means_db = np.pad(np.clip(means_db, GAIN_FLOOR_DB, 0.0), ((1, 0), (0, 0)), constant_values=GAIN_FLOOR_DB)
        return LinkPrediction.of_parts(
            probabilities / probabilities.sum(axis=0), means_db, np.pad(stds_db, ((1, 0), (0, 0)))
        )

    def predict_indoor(self, phi: LinkFeatures) -> Floats:
        """Return P(indoor) of links (N,)."""
        own = getattr(self._model, "predict_indoor", None) or _from_file(None).predict_indoor
        return np.clip(link_numbers(f"{self.name}.predict_indoor", own(phi), phi.shape), 0.0, 1.0)


class MeanLosses:
    """Predictor of links through walls by mean losses; `networks` predict P(indoor)."""

    name = WALL_LOSSES
    has_gate = False

    def __init__(self, networks: Predictor | OtherPredictor, partial: PartialMap, max_walls: int) -> None:
        self._networks, self._partial, self._max_walls = networks, partial, max_walls
        self.settings, self.fingerprint = networks.settings, networks.fingerprint
        self.predict_indoor = networks.predict_indoor

    def predict(self, phi: LinkFeatures) -> LinkPrediction:
        """Predict links (N,)."""
        return self.predict_each([phi])[0]

    def predict_each(self, features: Sequence[LinkFeatures]) -> list[LinkPrediction]:
        """Predict the same links for several wall losses."""
        walls = UnseenWalls.shipped_of_map(self._partial).counts(DirectLines.of(features[0]))
        traces = map(WallTrace.of, features)
        return [LinkPrediction.of_parts(*by_mean_losses(trace, walls, self._max_walls)) for trace in traces]


AnyPredictor: TypeAlias = Predictor | OtherPredictor | MeanLosses


@overload
def warm_predictor(asked: Predictor | str | PathLike[str] | None) -> Predictor: ...
@overload
def warm_predictor(asked: Any) -> Predictor | OtherPredictor: ...
def warm_predictor(asked: Any) -> Predictor | OtherPredictor:
    """Return a user's model, or `Predictor.load` with files read once per process until they change.

    Callers share the weights and must not change them.
    """
    if not isinstance(asked, (str, PathLike, type(None), Predictor)) and callable(getattr(asked, "predict", None)):
        return OtherPredictor(asked)
    if not isinstance(asked, (str, PathLike, type(None))):
        return Predictor.load(asked)
    return _from_file(asked)


def _from_file(name_or_path: str | PathLike[str] | None) -> Predictor:
    path, name = predictor_path(name_or_path), SHIPPED[0] if name_or_path is None else str(name_or_path)
    try:
        files = [each.stat() for each in (path, path.with_suffix(".json"))]
    except (OSError, ValueError):
        return Predictor.load(name_or_path)
    return _read_once(name, path.absolute(), *((each.st_ino, each.st_size, each.st_mtime_ns) for each in files))


@lru_cache(maxsize=4)
def _read_once(name: str, *identity: object) -> Predictor:
    return Predictor.load(name)


def predictor_path(name_or_path: str | PathLike[str] | None) -> Path:
    name = SHIPPED[0] if name_or_path is None else name_or_path
    return PREDICTORS_FOLDER / f"{name}{SUFFIX}" if name in SHIPPED else Path(name)


def _require_features(features: object) -> None:
    if not isinstance(features, LinkFeatures):
        raise PredictorError(f"features is of type {type(features).__name__}: give the LinkFeatures of link_features.")
