"""Predict radio coverage from a robot's partial map of a building.

The public names load their modules, and the libraries that those need, when they are first used.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sionna_partial.constants import CellState, LinkState
    from sionna_partial.coverage import predict_map
    from sionna_partial.errors import SionnaPartialError
    from sionna_partial.explore import explore
    from sionna_partial.export import save_coverage
    from sionna_partial.features import LinkFeatures, link_features
    from sionna_partial.homes import make_home
    from sionna_partial.map_files import (
        load_map,
        map_from_array,
        map_from_habitat,
        map_from_occupancy,
        map_from_slam,
        save_map,
    )
    from sionna_partial.partial_map import PartialMap
    from sionna_partial.plot import plot_coverage
    from sionna_partial.predictor import LinkPrediction, Predictor
    from sionna_partial.scene import export_scene
    from sionna_partial.settings import Material, SceneSettings, TraceSettings
    from sionna_partial.trace import TracedLinks, trace_links

__version__ = "0.1.0"

_PUBLIC = {
    "constants": ("CellState", "LinkState"),
    "errors": ("SionnaPartialError",),
    "settings": ("Material", "SceneSettings", "TraceSettings"),
    "partial_map": ("PartialMap",),
    "map_files": ("load_map", "map_from_array", "map_from_habitat", "map_from_occupancy", "map_from_slam", "save_map"),
    "homes": ("make_home",),
    "explore": ("explore",),
    "scene": ("export_scene",),
    "trace": ("TracedLinks", "trace_links"),
    "features": ("LinkFeatures", "link_features"),
    "predictor": ("LinkPrediction", "Predictor"),
    "coverage": ("predict_map",),
    "export": ("save_coverage",),
    "plot": ("plot_coverage",),
}
_MODULE_OF = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = [
    "CellState",
    "LinkFeatures",
    "LinkPrediction",
    "LinkState",
    "Material",
    "PartialMap",
    "Predictor",
    "SceneSettings",
    "SionnaPartialError",
    "TraceSettings",
    "TracedLinks",
    "__version__",
    "explore",
    "export_scene",
    "link_features",
    "load_map",
    "make_home",
    "map_from_array",
    "map_from_habitat",
    "map_from_occupancy",
    "map_from_slam",
    "plot_coverage",
    "predict_map",
    "save_coverage",
    "save_map",
    "trace_links",
]


class _Package(ModuleType):
    """Keeps the import system from putting the module `explore` in the place of the function `explore`."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _MODULE_OF and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(globals() | _MODULE_OF)
