"""Transmitters and radio settings of a window, and presets of common bands."""

import math
import re
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Annotated, NamedTuple

import numpy as np

from sionna_partial.checks import Checked, Within, require, require_choice
from sionna_partial.constants import DEFAULT_HEIGHT_M
from sionna_partial.coverage.link_budget import (
    ACCESS_POINTS,
    EIRP_LIMITS,
    Scheme,
    access_point_eirp_dbm,
    access_point_gain_dbi,
    schemes,
)
from sionna_partial.errors import SettingsError
from sionna_partial.maps.grid import nearest_free_m
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.settings import FREQUENCIES_HZ, WALL_MATERIALS, SceneSettings, TraceSettings, material_name
from sionna_partial.tracing.antennas import Antenna

MOST_TRANSMITTERS, _NEAREST_CELLS, _MOST_RECEIVERS, _LONGEST_CHANNEL = 10, 1000, 10_000, 8

FINEST_M = 0.15
"""Default spacing of receivers [m]."""

MATERIALS = ("", *WALL_MATERIALS)
"""Choices of wall materials; "" is unknown."""


MODELS = ("", *ACCESS_POINTS)
"""Kinds of transmitters; the power of "" is its own."""


class Preset(NamedTuple):
    frequency_hz: float
    bandwidth_hz: float
    eirp_dbm: float
    threshold_dbm: float


DEFAULT_PRESET = "Wi-Fi 5 GHz"


PRESETS = {
    "Wi-Fi 2.4 GHz": Preset(2.442e9, 20e6, 20.0, -67.0),
    "Wi-Fi 5 GHz": Preset(5.21e9, 80e6, 23.0, -67.0),
    "Wi-Fi 6 GHz": Preset(6.185e9, 160e6, 23.0, -67.0),
    "private 5G, 3.7 GHz": Preset(3.75e9, 100e6, 24.0, -75.0),
    "5G, 26 GHz": Preset(26.5e9, 100e6, 30.0, -80.0),
    "5G, 28 GHz": Preset(28e9, 100e6, 30.0, -80.0),
    "60 GHz (WiGig)": Preset(60.48e9, 2160e6, 30.0, -68.0),
}
"""Channels 7, 42 and 47 with the powers that Europe allows indoors (ETSI EN 300 328, EN 301 893, EN 303 687) and the
-67 dBm that vendors of Wi-Fi ask for; typical indoor cells; channel 2 with the sensitivity of MCS 1 (IEEE 802.11ad)."""

CHANNELS = {
    "Wi-Fi 2.4 GHz": ("1", "6", "11"),
    "Wi-Fi 5 GHz": ("42", "58", "106", "122"),
    "Wi-Fi 6 GHz": ("15", "47", "79"),
    "60 GHz (WiGig)": ("1", "2", "3", "4"),
}
"""Channels of a preset's bandwidth that do not overlap; Wi-Fi as in Europe, by the numbers of their centres."""

OTHER_CHANNELS = ("1", "2", "3", "4")
"""Channels of other bands."""


@dataclass(frozen=True)
class Transmitter(Checked):
    """Position [m], power [dBm], antenna, kind and channel of a transmitter; the antenna's gain is added."""

    x_m: Annotated[float, Within(-1e6, 1e6)]
    y_m: Annotated[float, Within(-1e6, 1e6)]
    z_m: Annotated[float, Within(0.0, 1000.0)] = DEFAULT_HEIGHT_M
    eirp_dbm: Annotated[float, Within(-200.0, 200.0)] = PRESETS[DEFAULT_PRESET].eirp_dbm
    antenna: Antenna = field(default_factory=Antenna)
    model: str = ""
    channel: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("model", self.model, MODELS)
        require(len(self.channel) <= _LONGEST_CHANNEL, "channel", self.channel, "give a number.")

    @property
    def position_m(self) -> tuple[float, float, float]:
        return self.x_m, self.y_m, self.z_m


def is_name(name: str) -> bool:
    return bool(re.fullmatch(r"[A-Za-z][\w-]{0,30}", name, re.ASCII))


def require_name(name: str) -> None:
    """Raise a SettingsError for an invalid name of a transmitter."""
    require(is_name(name), "name", name, "give a letter, then letters, digits, _ or -, up to 31 in all.")


@dataclass(frozen=True)
class RadioSettings(Checked):
    """Settings of the prediction, and the power of new transmitters [dBm]; the material "" is unknown.

    With `both_ways` the weaker direction counts: clients transmit with `client_dbm`.
    """

    frequency_hz: Annotated[float, Within(*FREQUENCIES_HZ)] = PRESETS[DEFAULT_PRESET].frequency_hz
    through_walls: bool | None = None
    rx_height_m: Annotated[float, Within(0.0, 1000.0)] = DEFAULT_HEIGHT_M
    spacing_m: Annotated[float, Within(0.02, 10.0)] = FINEST_M
    bandwidth_hz: Annotated[float, Within(1e3, 1e11)] = PRESETS[DEFAULT_PRESET].bandwidth_hz
    threshold_dbm: Annotated[float, Within(-200.0, 100.0)] = PRESETS[DEFAULT_PRESET].threshold_dbm
    eirp_dbm: Annotated[float, Within(-200.0, 200.0)] = PRESETS[DEFAULT_PRESET].eirp_dbm
    material: str = ""
    both_ways: bool = False
    client_dbm: Annotated[float, Within(-200.0, 200.0)] = 15.0
    region: str = "ETSI"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_choice("material", self.material, MATERIALS)
        require_choice("region", self.region, EIRP_LIMITS)

    @property
    def trace_settings(self) -> TraceSettings:
        return TraceSettings(self.frequency_hz, refraction=self.through_walls)

    @property
    def scene_settings(self) -> SceneSettings:
        return SceneSettings(material=WALL_MATERIALS[self.material]) if self.material else SceneSettings()

    @property
    def preset(self) -> str:
        """Name of the preset with this frequency and bandwidth, "" for none."""
        own = self.frequency_hz, self.bandwidth_hz
        return next((name for name, preset in PRESETS.items() if preset[:2] == own), "")

    @property
    def schemes(self) -> tuple[str, list[Scheme]]:
        """Standard of the rates and its schemes, or "" and none for other frequencies and bandwidths."""
        for standard in ("wifi6", "nr"):
            with suppress(SettingsError):
                return standard, schemes(standard, self.bandwidth_hz, self.frequency_hz)
        return "", []

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of the band that do not overlap."""
        return CHANNELS.get(self.preset, OTHER_CHANNELS)

    def text(self, partial: PartialMap) -> str:
        """Return band, walls and direction, as above every picture."""
        band = self.preset or f"{self.frequency_hz / 1e9:g} GHz, {self.bandwidth_hz / 1e6:g} MHz"
        walls = "opaque walls"
        if self.trace_settings.through_walls:
            of_map = sorted(material_name(each) if each else "unknown material" for each in partial.wall_fractions)
            walls = f"walls of {self.material or ' and '.join(of_map)}"
        return ", ".join([band, walls, *[f"both ways, client {self.client_dbm:g} dBm"] * self.both_ways])

    def powered(self, transmitter: Transmitter) -> Transmitter:
        """Return a transmitter with the power of its kind in this band."""
        if not transmitter.model:
            return transmitter
        eirp_dbm = access_point_eirp_dbm(transmitter.model, self.frequency_hz, self.bandwidth_hz, self.region)
        return replace(transmitter, eirp_dbm=eirp_dbm)

    def uplink_dbm(self, transmitter: Transmitter) -> float:
        """Return the power of a client plus the gain of the transmitter's kind [dBm], infinite if it does not count."""
        if not self.both_ways:
            return math.inf
        gain_dbi = access_point_gain_dbi(transmitter.model, self.frequency_hz) if transmitter.model else 0.0
        return self.client_dbm + gain_dbi


def usual_height_m(partial: PartialMap) -> float:
    low_m, high_m = partial.height_range_m
    return DEFAULT_HEIGHT_M if low_m < DEFAULT_HEIGHT_M < high_m else round((low_m + high_m) / 2.0, 2)


def fitted(settings: RadioSettings, partial: PartialMap) -> RadioSettings:
    """Return settings with receivers inside the rooms of a map, about `_MOST_RECEIVERS` or fewer."""
    (x0, y0, x1, y1), (low_m, high_m) = partial.bounds_m, partial.height_range_m
    height_m = settings.rx_height_m if low_m < settings.rx_height_m < high_m else usual_height_m(partial)
    steps = math.ceil(math.sqrt((x1 - x0) * (y1 - y0) / _MOST_RECEIVERS) / 0.05)
    return replace(settings, rx_height_m=height_m, spacing_m=max(FINEST_M, round(0.05 * steps, 2)))


def placed(partial: PartialMap, transmitter: Transmitter) -> Transmitter:
    """Return a transmitter in the nearest free cell, or itself if it needs no move; its height must be right."""
    at_m = np.array(transmitter.position_m)
    if partial.radios_can_stand(at_m[None])[0]:
        return transmitter
    free_m = nearest_free_m(partial, at_m[:2], _NEAREST_CELLS)
    allowed = partial.radios_can_stand(np.insert(free_m, 2, at_m[2], axis=1))
    if not allowed.any():
        partial.require_positions("the transmitter", at_m)
    x_m, y_m = free_m[allowed.argmax()].round(3).tolist()
    return replace(transmitter, x_m=x_m, y_m=y_m)
