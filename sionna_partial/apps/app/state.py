"""State of one window of the app: map, transmitters, settings, measurements, and the view of them."""

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np

from sionna_partial.apps.app.answer import LAYERS, NETWORK_LAYERS, RATE, View
from sionna_partial.apps.app.drawing import Plan, Source, Stroke, drawn
from sionna_partial.apps.app.files import Project, script
from sionna_partial.apps.app.marks import Marks, aims_m
from sionna_partial.apps.app.radio import (
    MOST_TRANSMITTERS,
    RadioSettings,
    Transmitter,
    fitted,
    is_name,
    placed,
    usual_height_m,
)
from sionna_partial.apps.app.survey import Position, Survey
from sionna_partial.arrays import Bools, Floats
from sionna_partial.constants import GAIN_FLOOR_DB
from sionna_partial.errors import MapError, PositionError
from sionna_partial.exploration.next_views import NextViews
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.selection import SAME_TX_M, can_be_used, nearest_transmitters

MEASURE = 'Drag along a length that you know, such as a wall; then type it in "Known length [m]" and press Enter.'
NO_TRANSMITTER = "there is no transmitter yet: click on the map where one shall be."
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

    @property
    def positions_m(self) -> dict[str, Position]:
        return {name: each.position_m for name, each in self.transmitters.items()}

    def require_positions_m(self) -> dict[str, Position]:
        if not self.transmitters:
            raise PositionError(NO_TRANSMITTER)
        return self.positions_m

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

    def transmitters_at(self, sources: Iterable[tuple[str, Position]]) -> tuple[dict[str, Transmitter], list[str]]:
        """Return new transmitters at the named positions of a survey where there is none, and what to tell of them."""
        added, left, partial = dict[str, Transmitter](), list[str](), self.require_map()
        for name, (x_m, y_m, z_m) in sources:
            if any(math.dist((x_m, y_m, z_m), at_m) <= SAME_TX_M for at_m in self.positions_m.values()):
                continue
            taken = {*self.transmitters, *added}
            new = placed(partial, replace(self.new_transmitter(), x_m=x_m, y_m=y_m, z_m=z_m))
            if len(taken) == MOST_TRANSMITTERS or math.dist((x_m, y_m), new.position_m[:2]) > SAME_TX_M:
                left.append(f"({x_m:g}, {y_m:g})")
                continue
            added[name if is_name(name) and name not in taken else unused_name(taken)] = new
        told = [f"Transmitters of the survey are added: {', '.join(added)}."] if added else []
        least = f"they are not in the map's free space, or the page has {MOST_TRANSMITTERS}"
        return added, [*told, *([f"Its transmitters at {', '.join(left)} are not added: {least}."] if left else [])]

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
