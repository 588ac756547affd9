"""Searches of few cells of the plane of a material, which take little time."""

from typing import Any
from unittest import mock


def short_searches() -> Any:
    """Return a context in which calibrations search few cells."""
    from sionna_partial.calibration import material_fit

    few = {"FRINGE_CELLS": 7, "COARSE_CELLS": 8, "MOST_FRINGES": 1, "MOST_CELLS": 60, "FEW_FRINGES": 1}
    return mock.patch.multiple(material_fit, **few)
