"""Logo of a report: a small PNG or JPEG file."""

import io
import os
import warnings

import numpy as np
from PIL import Image

from sionna_partial.arrays import States
from sionna_partial.checks import shown
from sionna_partial.errors import SettingsError
from sionna_partial.files import read_bytes

LOGO_SUFFIXES = (".png", ".jpg", ".jpeg")

MOST_LOGO_BYTES, MOST_LOGO_PIXELS = 1_000_000, 16_000_000
"""Largest file, and its largest picture."""

_DRAWN_PIXELS = 1200
"""Longer side to which a logo is reduced [pixels]."""


def read_logo(logo: str | os.PathLike[str] | bytes) -> States:
    """Return the picture (rows, columns, 4) of a PNG or JPEG file, or of its content.

    Raises
    ------
    SettingsError
        For another kind of file, or one of more than 1 MB or 16 million pixels.
    """
    given = f"logo of {len(logo):,} bytes" if isinstance(logo, bytes) else f"logo = {shown(str(logo))}"
    content = logo if isinstance(logo, bytes) else read_bytes(logo, "logo", SettingsError, MOST_LOGO_BYTES)
    remedy = f"give a PNG or JPEG of up to {MOST_LOGO_BYTES:,} bytes and {MOST_LOGO_PIXELS:,} pixels."
    if len(content) > MOST_LOGO_BYTES:
        raise SettingsError(f"{given} is not allowed: {remedy}")
    try:
        with warnings.catch_warnings(), Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as image:
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            too_large = image.width * image.height > MOST_LOGO_PIXELS
            picture = None if too_large else image.convert("RGBA")
    except Exception as error:  # decoders fail in many ways on damaged files
        raise SettingsError(f"{given} is damaged or of another kind: {remedy}") from error
    if picture is None:
        raise SettingsError(f"{given} has {image.width:,} x {image.height:,} pixels: {remedy}")
    picture.thumbnail((_DRAWN_PIXELS, _DRAWN_PIXELS))
    return np.asarray(picture)
