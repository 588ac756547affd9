"""Link budgets: received power, noise, SNR, and rates of modulation and coding schemes (MCS)."""

import math
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sionna_partial.arrays import Floats
from sionna_partial.checks import Checked, Within, float_array, require, require_choice
from sionna_partial.errors import SettingsError

NOISE_DENSITY_DBM_HZ = -174.0
"""Thermal noise at 290 K [dBm/Hz]."""

RATES = ("wifi6", "wifi7", "nr")

_BITS = (0.5, 1, 1.5, 2, 3, 4, 4.5, 5, 6, 20 / 3, 7.5, 25 / 3, 9, 10)
_SENSITIVITY_DBM = (-82, -79, -77, -74, -70, -66, -65, -64, -59, -57, -54, -52, -49, -46)
"""Coded bits of a subcarrier, and minimum sensitivity at 20 MHz, of MCS 0 to 11 (IEEE 802.11ax-2021, clause 27.3.20.2)
and 12 and 13 (IEEE 802.11be-2024, clause 36.3.21.2; not compared with the standard, continued in steps of 3 dB)."""

_SENSITIVITY_HZ, _NOISE_FIGURE_DB, _SYMBOL_S = 20e6, 10.0, 13.6e-6
"""Bandwidth and noise figure of these sensitivities; symbol with guard interval."""

_SUBCARRIERS = {20e6: 234, 40e6: 468, 80e6: 980, 160e6: 1960, 320e6: 3920}
"""Data subcarriers of a channel of one user."""

_NR_QPSK = (120, 157, 193, 251, 308, 379, 449, 526, 602, 679)
_NR_16QAM = (340, 378, 434, 490, 553, 616, 658)
_NR_64QAM = (466, 517, 567, 616, 666, 719, 772, 822, 873, 910, 948)
"""Code rates x 1024 (3GPP TS 38.214, table 5.1.3.1-1) without MCS 17, which is no faster than 16. 873 and 910 were not
compared with the standard."""

_NR_OVERHEAD = {"FR1": 0.14, "FR2": 0.18}
"""Overhead of the downlink (3GPP TS 38.306, clause 4.1.2)."""


class Band(NamedTuple):
    """A frequency band and its bandwidths [Hz]: all of Wi-Fi, smallest and largest of NR."""

    low_hz: float
    high_hz: float
    bandwidths_hz: tuple[float, ...]


_WIFI_HZ = tuple(_SUBCARRIERS)
BANDS = {
    "wifi6": (Band(1e9, 3e9, _WIFI_HZ[:2]), Band(3e9, 7.125e9, _WIFI_HZ[:4])),
    "wifi7": (Band(1e9, 3e9, _WIFI_HZ[:2]), Band(3e9, 5.925e9, _WIFI_HZ[:4]), Band(5.925e9, 7.25e9, _WIFI_HZ)),
    "nr": (Band(410e6, 7.125e9, (5e6, 100e6)), Band(24.25e9, 71e9, (50e6, 2e9))),
}
"""Bands (IEEE 802.11ax and 802.11be; 3GPP TS 38.104: FR1 and FR2)."""


class EirpLimit(NamedTuple):
    """Largest EIRP [dBm], and EIRP density [dBm/MHz], of access points indoors in a band [Hz]."""

    low_hz: float
    high_hz: float
    eirp_dbm: float
    density_dbm_mhz: float = math.inf


EIRP_LIMITS = {
    "ETSI": (
        EirpLimit(2.4e9, 2.4835e9, 20.0, 10.0),
        EirpLimit(5.15e9, 5.35e9, 23.0, 10.0),
        EirpLimit(5.47e9, 5.725e9, 30.0, 17.0),
        EirpLimit(5.945e9, 6.425e9, 23.0, 10.0),
        EirpLimit(57e9, 71e9, 40.0, 23.0),
    ),
    "FCC": (
        EirpLimit(2.4e9, 2.4835e9, 36.0),
        EirpLimit(5.15e9, 5.25e9, 36.0, 23.0),
        EirpLimit(5.25e9, 5.35e9, 30.0, 17.0),
        EirpLimit(5.47e9, 5.725e9, 30.0, 17.0),
        EirpLimit(5.725e9, 5.85e9, 36.0),
        EirpLimit(5.925e9, 7.125e9, 30.0, 5.0),
        EirpLimit(57e9, 71e9, 40.0),
    ),
}
"""Limits with transmit power control and antennas of up to 6 dBi: Europe (ETSI EN 300 328, EN 301 893, EN 303 687 low
power indoor, EN 302 567), United States (47 CFR 15.247, 15.255, 15.407; 6 GHz low power indoor)."""


class AccessPoint(NamedTuple):
    """Typical conducted power, all chains together [dBm], and antenna gain [dBi], at 2.4, 5 and 6 GHz."""

    power_dbm: tuple[float, float, float]
    gain_dbi: tuple[float, float, float]


ACCESS_POINTS = {
    "ceiling access point": AccessPoint((22.0, 25.0, 24.0), (4.0, 5.5, 5.5)),
    "home router": AccessPoint((20.0, 23.0, 23.0), (2.0, 3.0, 3.0)),
    "wall plate": AccessPoint((17.0, 20.0, 20.0), (3.0, 4.0, 4.0)),
}
"""Kinds of access points, with round figures of data sheets; a product's own figures give its EIRP more exactly."""

_WIFI_BANDS_HZ = (1e9, 3e9, 5.925e9, 7.25e9)
"""Ends of the bands at 2.4, 5 and 6 GHz."""

_NR_SHANNON = 0.6
"""Fraction of the Shannon bound (3GPP TR 36.942, annex A)."""


@dataclass(frozen=True)
class LinkBudget(Checked):
    """Receivers and traffic of a network; the fields are arguments of `predict_network`."""

    noise_figure_db: Annotated[float, Within(0.0, 100.0)] = 7.0
    bandwidth_hz: Annotated[float, Within(1.0, 1e11)] = 100e6
    load: Annotated[float, Within(0.0, 1.0)] = 1.0
    sinr_threshold_db: Annotated[float, Within(-200.0, 200.0)] = 0.0

    @property
    def noise_dbm(self) -> float:
        return NOISE_DENSITY_DBM_HZ + 10.0 * math.log10(self.bandwidth_hz) + self.noise_figure_db


def transmit_powers_dbm(powers_dbm: ArrayLike, count: int, name: str = "tx_power_dbm") -> Floats:
    remedy = f"give one power [dBm], or one for each of the {count} transmitters, from -200 to 200."
    found = float_array(name, powers_dbm, SettingsError, remedy)
    allowed = found.shape in ((), (count,)) and bool((np.abs(found) <= 200.0).all())
    require(allowed, name, powers_dbm, remedy)
    return np.broadcast_to(found, count).copy()


def eirp_limit_dbm(frequency_hz: float, bandwidth_hz: float, region: str = "ETSI") -> float:
    """Return the largest EIRP of an access point indoors [dBm], infinite where `EIRP_LIMITS` has no band."""
    require_choice("region", region, EIRP_LIMITS)
    limits = [
        min(limit.eirp_dbm, limit.density_dbm_mhz + 10.0 * math.log10(bandwidth_hz / 1e6))
        for limit in EIRP_LIMITS[region]
        if limit.low_hz <= frequency_hz <= limit.high_hz
    ]
    return min(limits, default=math.inf)


def access_point_eirp_dbm(model: str, frequency_hz: float, bandwidth_hz: float, region: str = "ETSI") -> float:
    """Return the EIRP of one of `ACCESS_POINTS` within the limit of its band [dBm].

    Raises
    ------
    SettingsError
        For another model, or a frequency outside the bands of Wi-Fi.
    """
    eirp_dbm = access_point_gain_dbi(model, frequency_hz) + ACCESS_POINTS[model].power_dbm[_band_of(frequency_hz)]
    return min(eirp_dbm, eirp_limit_dbm(frequency_hz, bandwidth_hz, region))


def access_point_gain_dbi(model: str, frequency_hz: float) -> float:
    """Return the antenna gain of one of `ACCESS_POINTS` [dBi], or raise a SettingsError."""
    require_choice("model", model, ACCESS_POINTS)
    return ACCESS_POINTS[model].gain_dbi[_band_of(frequency_hz)]


def _band_of(frequency_hz: float) -> int:
    low_hz, *between_hz, high_hz = _WIFI_BANDS_HZ
    remedy = f"access points have {low_hz / 1e9:g} to {high_hz / 1e9:g} GHz: choose a band of Wi-Fi, or give the EIRP."
    require(low_hz <= frequency_hz <= high_hz, "frequency_hz", frequency_hz, remedy)
    return sum(frequency_hz >= end_hz for end_hz in between_hz)


class Scheme(NamedTuple):
    """A modulation and coding scheme: lowest SNR and rate."""

    snr_db: float
    rate_bit_s: float


def schemes(standard: str, bandwidth_hz: float, frequency_hz: float) -> list[Scheme]:
    """Return the schemes of a standard for one spatial stream, the slowest first.

    The SNR follows from the minimum sensitivity (Wi-Fi), or from 0.6 of the Shannon bound (NR).
    """
    require_choice("standard", standard, RATES)
    _require_band(standard, bandwidth_hz, frequency_hz)
    if standard == "nr":
        overhead = _NR_OVERHEAD["FR1" if frequency_hz < 24e9 else "FR2"]
        coded = [(2, rate) for rate in _NR_QPSK] + [(4, rate) for rate in _NR_16QAM] + [(6, rate) for rate in _NR_64QAM]
        each = [order * rate / 1024 for order, rate in coded]
        return [
            Scheme(10 * math.log10(2 ** (bits / _NR_SHANNON) - 1), bits * bandwidth_hz * (1 - overhead))
            for bits in each
        ]
    noise_dbm = LinkBudget(_NOISE_FIGURE_DB, _SENSITIVITY_HZ).noise_dbm
    count = {"wifi6": 12, "wifi7": 14}[standard]
    return [
        Scheme(level_dbm - noise_dbm, _SUBCARRIERS[bandwidth_hz] * bits / _SYMBOL_S)
        for bits, level_dbm in zip(_BITS[:count], _SENSITIVITY_DBM[:count], strict=True)
    ]


def _require_band(standard: str, bandwidth_hz: float, frequency_hz: float) -> None:
    bands = BANDS[standard]
    ends = sorted({band.low_hz for band in bands} ^ {band.high_hz for band in bands})  # without ends that two share
    spans = " and ".join(f"{low / 1e9:g} to {high / 1e9:g}" for low, high in zip(ends[::2], ends[1::2], strict=True))
    band = next((band for band in bands if band.low_hz <= frequency_hz <= band.high_hz), None)
    remedy = f"{standard} is defined at {spans} GHz: choose another standard, or predict the map at its frequency."
    require(band is not None, "frequency_hz", frequency_hz, remedy)
    widths_hz = band.bandwidths_hz  # type: ignore[union-attr]
    if standard == "nr":
        good, text = widths_hz[0] <= bandwidth_hz <= widths_hz[1], " to ".join(f"{width:g}" for width in widths_hz)
    else:
        good, text = bandwidth_hz in widths_hz, ", ".join(f"{width:g}" for width in widths_hz)
    remedy = f"channels of {standard} at {frequency_hz / 1e9:g} GHz are {text} Hz wide."
    require(good, "bandwidth_hz", bandwidth_hz, remedy)
