"""Uploaded surveys: measured powers of one or several access points, also at pixels of the page's floor plan."""

import itertools
import math
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any

from sionna_partial.apps.app.drawing import Plan
from sionna_partial.apps.app.files import file_name
from sionna_partial.constants import BAG_SUFFIXES
from sionna_partial.errors import MeasurementError
from sionna_partial.measurements.measurements import Measurements
from sionna_partial.measurements.recordings import load_survey
from sionna_partial.measurements.selection import SAME_TX_M
from sionna_partial.measurements.surveys import is_plan_survey, read_survey

SURVEY_SUFFIXES = (".csv", ".json", ".vwm", *BAG_SUFFIXES)

Position = tuple[float, float, float]


def is_survey(name: str, content: bytes) -> bool:
    """Return whether an uploaded file is a survey, and no map, whose suffixes some surveys share."""
    suffix = PurePath(name).suffix.lower()
    is_list = content.lstrip()[:1] == b"[" or b'"survey_points"' in content
    return suffix == ".csv" or (suffix == ".json" and is_list)


@dataclass(frozen=True, eq=False)
class Survey:
    """A survey, the floor plan of its pixels, the names of its access points (identity first), and where some are.

    `given_m` has the positions (x, y) that the file gives, with the name of the access point there, or "" [m].
    """

    name: str
    content: bytes
    plan: Plan | None = None
    access_points: tuple[tuple[str, ...], ...] = ()
    positions_m: Mapping[str, Position] = field(default_factory=dict)
    given_m: Mapping[tuple[float, float], str] = field(default_factory=dict)

    @classmethod
    def read(cls, name: str, content: bytes, plan: Plan | None, transmitters: Mapping[str, Position]) -> "Survey":
        """Find the access points, and give a transmitter the one that has its name."""
        bare = cls(file_name(name, "measured.csv"), content, plan)
        with bare._file() as (path, options):
            if path.suffix.lower() in BAG_SUFFIXES:
                return bare
            survey = read_survey(path, None, 0.0, options.get("pixel_m"))
        if {"tx_x", "tx_y"} <= {*survey.table}:
            given_m = zip(survey.table["tx_x"].tolist(), survey.table["tx_y"].tolist(), strict=True)
            names = [each[-1] for each in survey.transmitters] or itertools.repeat("")
            return replace(bare, given_m=dict(zip(given_m, names, strict=False)))
        found = {names[0]: names for names, _ in Counter(survey.transmitters).most_common()}
        named: dict[str, Position] = {}
        for name, at_m in transmitters.items():
            same = [names[0] for names in found.values() if name.lower() in map(str.lower, names)]
            named |= {same[0]: at_m} if len(same) == 1 else {}  # often all have one SSID
        return replace(bare, access_points=(*found.values(),), positions_m=named)

    @property
    def has_several(self) -> bool:
        return len(self.access_points) > 1

    @property
    def options(self) -> list[tuple[str, str]]:
        """Values and texts of a choice of the access points; none without a choice."""
        texts = ((names[0], f"{names[1]} ({names[0]})" if names[1:] else names[0]) for names in self.access_points)
        return [("", "none"), *texts] if self.has_several else []

    def access_point_at(self, tx_m: Position) -> str:
        """Return the access point of a transmitter, or ""."""
        return next((name for name, at_m in self.positions_m.items() if math.dist(at_m, tx_m) <= SAME_TX_M), "")

    def with_access_point(self, access_point: str, tx_m: Position) -> "Survey":
        """Give a transmitter an access point, or none of them for ""."""
        old = {access_point, self.access_point_at(tx_m)}
        others = {name: at_m for name, at_m in self.positions_m.items() if name not in old}
        return replace(self, positions_m=others | ({access_point: tx_m} if access_point else {}))

    def sources(self, measured: Measurements) -> list[tuple[str, Position]]:
        """Return the positions of the transmitters in the file, most measured first, with their names, or ""."""
        found: list[tuple[str, Position]] = []
        for at_m, _ in Counter(map(tuple, measured.tx[measured.tx_known].tolist())).most_common():
            if not any(math.dist(at_m, other_m) <= SAME_TX_M for _, other_m in found):
                found.append((self.given_m.get(at_m[:2], ""), at_m))
        return found

    def measurements(self, tx_m: Position | None) -> Measurements:
        """Return the measured powers; those without any position are of the transmitter at `tx_m`."""
        with self._file() as (path, options):
            if self.has_several:
                return load_survey(path, tx=dict(self.positions_m), **options)
            measured = load_survey(path, **options)
            return measured if tx_m is None or measured.tx_known.any() else load_survey(path, tx=tx_m, **options)

    @contextmanager
    def _file(self) -> Iterator[tuple[Path, dict[str, Any]]]:
        """Write the survey, and its plan beside it, to a temporary folder; yield its path and options."""
        with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
            path = Path(folder) / self.name
            path.write_bytes(self.content)
            if path.suffix.lower() in SURVEY_SUFFIXES[2:] or not is_plan_survey(path):
                yield path, {}
                return
            if self.plan is None or self.plan.pixel_m is None:
                raise MeasurementError(
                    f"'{self.name}' has powers at pixels of a floor plan: open the plan as a picture, and draw a known "
                    "length on it first."
                )
            path.with_suffix(PurePath(self.plan.name).suffix.lower()).write_bytes(self.plan.content)
            yield path, {"pixel_m": self.plan.pixel_m}
