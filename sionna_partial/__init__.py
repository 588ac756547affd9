"""Predict radio coverage from a robot's partial map of a building.

Public names, listed in `__init__.pyi`, load their modules and libraries on first use. The import also chooses the LLVM
library of Dr.Jit: import this package before `sionna.rt`, `mitsuba` or `drjit`.
"""

import sys
from importlib import import_module
from importlib.util import find_spec as _find_spec
from warnings import warn as _warn

from sionna_partial.llvm import choose_llvm as _choose_llvm
from sionna_partial.resources import lazy_names as _lazy_names

__version__ = "0.1.0"

_choose_llvm()

if "coverage" not in sys.modules and getattr(_find_spec("coverage"), "origin", "") is None:
    # a folder of that name, as of results, is no library: numba, which looks for one, would fail on it
    sys.modules["coverage"] = None  # type: ignore[assignment]

_MOVED = {
    "channels": ("dft_codebook", "load_channels", "sample_channels", "save_channels"),
    "maps.importers": (
        *("map_from_bag", "map_from_drawing", "map_from_habitat", "map_from_occupancy", "map_from_points"),
        *("map_from_slam", "measurements_from_bag", "poses_from_bag"),
    ),
    "lab": ("DatasetSettings", "PredictorSettings", "build_dataset", "evaluate", "read_dataset", "train"),
    "plots": (
        *("animate_exploration", "plot_calibration", "plot_coverage", "plot_exploration", "plot_map", "plot_network"),
        *("plot_network_placement", "plot_next_views", "plot_placement"),
    ),
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
_DEPRECATED = {name: (place, name) for place, names in _MOVED.items() for name in names}
_DEPRECATED["network_map"] = "coverage.network", "predict_network"
"""Names of version 0.1.0, and the modules and names that replace them."""

_load, __dir__, __all__ = _lazy_names(__name__)
__all__ += ["__version__"]


def __getattr__(name: str) -> object:
    if name not in _DEPRECATED:
        return _load(name)
    place, new = _DEPRECATED[name]
    group = place.removeprefix("maps.")
    there = new if new in __all__ else f"{group if group in __all__ else place}.{new}"
    _warn(f"{__name__}.{name} is deprecated: use {__name__}.{there}.", DeprecationWarning, stacklevel=2)
    return getattr(import_module(f"{__name__}.{place}"), new)
