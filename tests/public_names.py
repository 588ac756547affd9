"""Public names by their paths in the package, and the classes that only functions return."""

from importlib import import_module
from operator import attrgetter
from typing import Any

import sionna_partial as sp

GROUPS = ("channels", "importers", "lab", "plots")
"""Modules with public names of their own."""

TOP = [name for name in sp.__all__ if name not in (*GROUPS, "__version__")]

NAMES = [*TOP, *(f"{group}.{name}" for group in GROUPS for name in getattr(sp, group).__all__)]

_RETURNED = {
    "apps.live.coverage": ("LiveCoverage", "LiveSettings"),
    "calibration.calibration": ("MaterialCalibration",),
    "channels.samples": ("ChannelSamples",),
    "exploration.explore": ("Exploration",),
    "exploration.next_views": ("NextView", "NextViews"),
    "measurements.assimilation": ("Assimilation",),
    "placement.placement": ("TransmitterPlacement",),
    "placement.several": ("NetworkPlacement",),
    "settings": ("PlacementSettings",),
    "tracing.gradients": ("GainGradients",),
}

RETURNED = {
    name: getattr(import_module(f"sionna_partial.{module}"), name)
    for module, names in _RETURNED.items()
    for name in names
}
"""Classes that functions return, or few users make, by name."""

EVERY: dict[str, Any] = {name: attrgetter(name)(sp) for name in NAMES} | RETURNED
