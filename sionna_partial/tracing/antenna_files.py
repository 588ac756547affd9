"""Measured antenna patterns: files in the MSI Planet format."""

import logging
import math
import re
from pathlib import Path

import numpy as np

from sionna_partial.arrays import Floats
from sionna_partial.checks import require
from sionna_partial.errors import SettingsError
from sionna_partial.files import read_bytes
from sionna_partial.tracing.antennas import AntennaPattern

_DIPOLE_DBI = 2.15
_LARGEST_GAP_DEG = 90.0
_READ_ONCE = ("GAIN", "FREQUENCY", "POLARIZATION", "HORIZONTAL", "VERTICAL")
_FILE_BYTES, _FILE_ANGLES = 1_000_000, 3600

_log = logging.getLogger(__name__)


def load_antenna(path: str | Path) -> AntennaPattern:
    r"""Read the pattern of an antenna from an MSI Planet file (.msi, .pln).

    A gain without unit is in dBd. Horizontal angles are clockwise from the main direction, vertical angles downwards
    from the horizon; cuts include an electrical tilt. Other polarisations than vertical and horizontal are computed
    as vertical, with a warning.

    Raises
    ------
    SettingsError
        If the file cannot be read, exceeds 1 MB, lacks or repeats its gain or a cut, has a gap of more than 90 degrees
        in a cut, is of a horizontally polarised antenna, or radiates more than twice the fed power.

    Examples
    --------
    >>> from pathlib import Path
    >>> import sionna_partial as sp
    >>> cut = "2\n0 0.0\n180 25.0\n"
    >>> _ = Path("panel.msi").write_text(f"NAME panel\nGAIN 9.0 dBi\nHORIZONTAL {cut}VERTICAL {cut}")
    >>> sp.load_antenna("panel.msi").gain_dbi
    9.0
    """
    remedy = "give an MSI Planet file with GAIN, HORIZONTAL and VERTICAL."
    lines = read_bytes(path, "antenna", SettingsError, _FILE_BYTES, remedy).decode("utf-8", "replace").splitlines()
    cuts: dict[str, Floats] = {}
    header: dict[str, str] = {}
    rows = iter(enumerate(lines, start=1))
    for number, line in rows:
        words = [*line.split(maxsplit=1), "", ""]
        key, value = words[0].upper().replace("POLARISATION", "POLARIZATION"), words[1].strip()
        repeated = key in _READ_ONCE and key in {*header, *cuts}
        require(not repeated, f"antenna, line {number}", line, f"{key} is there twice: keep one of them.")
        if key in ("HORIZONTAL", "VERTICAL"):
            count = int(value) if value.isascii() and value.isdigit() and len(value) < 5 else 0
            where = f"antenna, line {number}"
            require(
                2 <= count <= _FILE_ANGLES, where, line, f"give {key} and the number of angles, 2 to {_FILE_ANGLES}."
            )
            cuts[key] = _cut([text for _, (_, text) in zip(range(count), rows, strict=False)], count, where)
        else:
            header.setdefault(key, value)
    missing = {"GAIN", "HORIZONTAL", "VERTICAL"} - {*header, *cuts}
    require(not missing, f"antenna '{path}' without", sorted(missing), remedy)
    gain, unit = ([*header["GAIN"].split(), "dBd"])[:2] if header["GAIN"] else ("", "dBd")
    require(
        unit.lower() in ("dbd", "dbi") and _is_finite(gain), "GAIN", header["GAIN"], "give a number and dBd or dBi."
    )
    name = "".join(filter(str.isprintable, header.get("NAME", Path(path).stem)))[:100] or "antenna"
    _require_vertical(name, header.get("POLARIZATION", ""))
    left, gain_dbi = np.roll(cuts["HORIZONTAL"][::-1], 1), float(gain) + _DIPOLE_DBI * (unit.lower() == "dbd")
    frequency_hz = _frequency_hz(header.get("FREQUENCY", ""))
    return AntennaPattern(name, gain_dbi, left, cuts["VERTICAL"], frequency_hz)._require_passive()


def _require_vertical(name: str, polarisation: str) -> None:
    text = re.sub(r"[^a-z0-9]", "", polarisation.lower()).removesuffix("polarization").removesuffix("pol")
    horizontal = text in ("h", "hor", "horz") or ("horiz" in text and "vert" not in text)
    remedy = (
        f"antenna {name!r} is horizontally polarised, and receivers are vertical: it has next to no gain towards them. "
        "Write V if receivers are polarised like the antenna."
    )
    require(not horizontal, "POLARIZATION", polarisation, remedy)
    if text not in ("", "v") and not ("vert" in text and "horiz" not in text):
        message = (
            "antenna %r: POLARIZATION %s is computed as vertical; a vertical receiver gets less of a slanted field"
        )
        _log.warning(message, name, polarisation[:40])


def _frequency_hz(text: str) -> float | None:
    """Return the frequency of a header in MHz, the geometric mean of a band."""
    numbers = [float(number) for number in re.findall(r"\d+(?:\.\d+)?", text[:40])[:2]]
    frequency_hz = (1e9 if "ghz" in text.lower() else 1e6) * math.sqrt(numbers[0] * numbers[-1]) if numbers else 0.0
    return frequency_hz if 0.0 < frequency_hz <= 1e12 else None


def _cut(lines: list[str], count: int, where: str) -> Floats:
    pairs = [line.split() for line in lines]
    remedy = f"{count} lines of angle [degree] and loss [dB] follow, the angles increasing from 0 to 360."
    good = len(pairs) == count and all(len(pair) == 2 and all(map(_is_finite, pair)) for pair in pairs)
    angle_deg, loss_db = np.array(pairs, dtype=np.float64).T if good else np.zeros((2, 1))
    rising = bool((np.diff(angle_deg) > 0.0).all()) and angle_deg[0] >= 0.0 and angle_deg[-1] <= 360.0
    require(good and rising, where, lines[:2], remedy)
    gaps_deg = np.sort(np.diff(angle_deg, append=angle_deg[0] + 360.0))
    span = f"the cut covers {angle_deg[0]:g} to {angle_deg[-1]:g} degrees, with a gap of {gaps_deg[-1]:g} degrees"
    closed = gaps_deg[-1] <= max(_LARGEST_GAP_DEG, 2.0 * gaps_deg[(count - 1) // 2])
    require(bool(closed), where, lines[-1], f"{span}: give it all around.")
    return np.interp(np.arange(360.0), angle_deg, loss_db, period=360.0)


def _is_finite(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
