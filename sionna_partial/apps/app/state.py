"""State of one window of the app: map, transmitters, settings, measurements, and the view of them."""

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np

from sionna_partial.apps.app.answer import LAYERS, NETWORK_LAYERS, RATE, View
from sionna_partial.apps.app.drawing import Plan, Source, Stroke, drawn
from sionna_partial.apps.app.files import Project, script
from sionna_partial.apps.app.marks import Marks, aims_m
from sionna_partial.apps.app.radio import RadioSettings, Transmitter, fitted, placed, usual_height_m
from sionna_partial.apps.app.survey import Survey
from sionna_partial.arrays import Bools, Floats
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.errors import MapError, PositionError
from sionna_partial.exploration.next_views import NextViews
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.selection import SAME_TX_M, can_be_used, nearest_transmitters

MEASURE = 'Drag along a length that you know, such as a wall; then type it in "Known length [m]" and press Enter.'
SAVED_MAP = 'partial = sp.load_map("map.npz")  # in the file of "Save the project", with everything drawn on it'


class WindowState:
    """Contents of a window, without anything that is computed for longer.

    `partial` is the map with all strokes, `bare` the map without them; `home` is the complete map of an example, which
    a simulated robot has explored for `steps` steps. `python_map` has the lines of Python that load `bare`.
    """

    def __init__(self) -> None:
        self.partial: PartialMap | None = None
        self.bare: PartialMap | None = None
        self.source: Source | None = None
        self.strokes: tuple[Stroke, ...] = ()
        self.home: PartialMap | None = None
        self.title, self.steps, self.seed = "", 0, 0
        self.python_map: list[str] = []
        self.transmitters: dict[str, Transmitter] = {}
        self.chosen = ""
        self.settings, self.view = RadioSettings(), View()
        self.survey: Survey | None = None
        self.measured: Measurements | None = None
        self.logo: tuple[str, bytes] | None = None
        self.views: NextViews | None = None
        self.map_warnings: list[str] = []
        self.action_warnings: list[str] = []

    @property
    def plan(self) -> Plan | None:
        """The picture of which the map was made."""
        return self.source if isinstance(self.source, Plan) else None

    @property
    def layers(self) -> list[str]:
        """Layers of these transmitters and settings."""
        lacking = () if len(self.transmitters) > 1 else NETWORK_LAYERS
        lacking = lacking if self.settings.schemes[0] else (*lacking, RATE)
        return [name for name in LAYERS if name not in lacking]

    @property
    def shown_view(self) -> View:
        """The view, with what there is."""
        several = len(self.transmitters) > 1
        layer = self.view.layer if self.view.layer in self.layers else View.layer
        name = self.view.transmitter if several and self.view.transmitter in self.transmitters else ""
        return replace(self.view, layer=layer, transmitter=name, truth=self.view.truth and self.home is not None)

    def require_map(self) -> PartialMap:
        if self.partial is None:
            raise MapError(MEASURE if self.source else "there is no map yet: open one, or an example.")
        return self.partial

    def require_positions_m(self) -> dict[str, tuple[float, float, float]]:
        if not self.transmitters:
            raise PositionError("there is no transmitter yet: click on the map where one shall be.")
        return {name: each.position_m for name, each in self.transmitters.items()}

    def forget_map(self) -> None:
        """Remove the map and everything on it."""
        self.map_warnings, self.action_warnings = [], []
        self.transmitters, self.chosen, self.measured, self.views = {}, "", None, None
        self.source, self.strokes, self.home, self.survey = None, (), None, None

    def fit(self, partial: PartialMap, python: list[str]) -> None:
        """Draw the strokes on a map, and fit the settings to it."""
        self.bare, self.python_map = partial, python
        self.partial = drawn(partial, self.strokes)
        self.settings = fitted(self.settings, self.partial)

    def take_transmitters(self, transmitters: Mapping[str, Transmitter]) -> None:
        """Take transmitters; one that cannot be where it is moves to the nearest free cell."""
        found = {name: placed(self.require_map(), each) for name, each in transmitters.items()}
        self.action_warnings = [
            f"{name} cannot be at ({old.x_m:g}, {old.y_m:g}): ({new.x_m:g}, {new.y_m:g}) is the nearest free cell."
            for (name, old), new in zip(transmitters.items(), found.values(), strict=True)
            if new is not old
        ]
        self.transmitters, self.views = found, None
        if self.chosen not in found:
            self.chosen = next(iter(found), "")
        if self.measured is not None and not self.are_ours(self.measured).any():
            self.measured = None
            self.action_warnings.append(
                f"The measurements are not used any more: no transmitter is within {SAME_TX_M:g} m of theirs."
            )

    def new_transmitter(self) -> Transmitter:
        return Transmitter(0.0, 0.0, usual_height_m(self.require_map()), self.settings.eirp_dbm)

    def threshold_db(self, transmitters: Sequence[Transmitter]) -> float:
        """Return the path gain at the threshold of the weakest transmitter [dB]."""
        weakest_dbm = min(min(each.eirp_dbm, self.settings.uplink_dbm(each)) for each in transmitters)
        return float(np.clip(self.settings.threshold_dbm - weakest_dbm, GAIN_FLOOR_DB + 1.0, 0.0))

    def are_ours(self, measured: Measurements) -> Bools:
        """Return which measured links (N,) are of a transmitter of this window."""
        return np.asarray(self._of_each(measured).any(axis=0))

    def _of_each(self, measured: Measurements) -> Bools:
        """Return which measured links are of each transmitter (T, N)."""
        sources_m = [np.array([transmitter.position_m]) for transmitter in self.transmitters.values()]
        return np.asarray(nearest_transmitters(measured.tx, sources_m))

    def measured_names(self) -> list[str]:
        """Return the transmitter of each measured link, "" for others."""
        if self.measured is None:
            return []
        of_each, names = self._of_each(self.measured), [*self.transmitters, ""]
        return [names[at] for at in np.where(of_each.any(axis=0), of_each.argmax(axis=0), -1)]

    @property
    def marks(self) -> Marks:
        """Marks on the picture."""
        return Marks(*self.measured_points(), aims_m(self.partial, self.transmitters.values()), self.views)

    def measured_points(self) -> tuple[Floats, Bools]:
        """Return the measured receivers (N, 3) [m], and which of them are used (N,)."""
        measured, tx_m = self.measured, np.array([each.position_m for each in self.transmitters.values()])
        if measured is None or self.partial is None:
            return np.empty((0, 3)), np.empty(0, dtype=bool)
        used = can_be_used(self.partial, tx_m, measured.rx, self.settings.frequency_hz)
        return measured.rx, used & self.are_ours(measured)

    def project(self) -> Project:
        source = self.source and (self.source.name, self.source.content, self.source.settings)
        strokes = [asdict(each) for each in self.strokes] if source else []
        of_window = self.require_map(), self.title, self.transmitters, self.settings, self.measured
        return Project(*of_window, asdict(self.view), source or None, strokes, self.logo)

    def python(self) -> str:
        """Return a script that gives the same coverage."""
        if self.partial is None or not self.transmitters:
            return ""
        return script(self.project(), [SAVED_MAP] if self.strokes else self.python_map)


def unused_name(taken: Collection[str]) -> str:
    return next(name for name in map("tx{}".format, itertools.count(1)) if name not in taken)
