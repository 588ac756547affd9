"""Predict radio coverage from a robot's partial map of a building.

The public names load their modules, and the libraries that those need, when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sionna_partial.calibration.calibration import MaterialCalibration, calibrate_materials
    from sionna_partial.constants import CellState, LinkState
    from sionna_partial.coverage import predict_map
    from sionna_partial.datasets.dataset import build_dataset
    from sionna_partial.datasets.shards import read_dataset
    from sionna_partial.differentiable.scene import DifferentiableScene
    from sionna_partial.errors import SionnaPartialError
    from sionna_partial.evaluation.evaluate import evaluate
    from sionna_partial.export import save_coverage
    from sionna_partial.maps.map_files import (
        load_map,
        map_from_array,
        map_from_habitat,
        map_from_occupancy,
        map_from_slam,
        save_map,
    )
    from sionna_partial.maps.partial_map import PartialMap
    from sionna_partial.placement.placement import TransmitterPlacement, place_transmitter
    from sionna_partial.plots.coverage_plot import plot_coverage
    from sionna_partial.plots.exploration_plot import animate_exploration, plot_exploration
    from sionna_partial.plots.material_plot import plot_calibration
    from sionna_partial.plots.placement_plot import plot_placement
    from sionna_partial.prediction.features import LinkFeatures, link_features
    from sionna_partial.prediction.predictor import LinkPrediction, Predictor
    from sionna_partial.scene.scene import export_scene
    from sionna_partial.settings import DatasetSettings, Material, SceneSettings, SensorSettings, TraceSettings
    from sionna_partial.simulation.explore import Exploration, explore, explore_trajectory
    from sionna_partial.simulation.homes import make_home
    from sionna_partial.tracing.gradients import GainGradients, gain_gradients
    from sionna_partial.tracing.trace import TracedLinks, trace_links
    from sionna_partial.training import train

__version__ = "0.1.0"

_PUBLIC = {
    "constants": ("CellState", "LinkState"),
    "errors": ("SionnaPartialError",),
    "settings": ("DatasetSettings", "Material", "SceneSettings", "SensorSettings", "TraceSettings"),
    "maps.partial_map": ("PartialMap",),
    "maps.map_files": (
        "load_map",
        "map_from_array",
        "map_from_habitat",
        "map_from_occupancy",
        "map_from_slam",
        "save_map",
    ),
    "simulation.homes": ("make_home",),
    "simulation.explore": ("Exploration", "explore", "explore_trajectory"),
    "scene.scene": ("export_scene",),
    "tracing.trace": ("TracedLinks", "trace_links"),
    "tracing.gradients": ("GainGradients", "gain_gradients"),
    "prediction.features": ("LinkFeatures", "link_features"),
    "prediction.predictor": ("LinkPrediction", "Predictor"),
    "datasets.shards": ("read_dataset",),
    "datasets.dataset": ("build_dataset",),
    "evaluation.evaluate": ("evaluate",),
    "training": ("train",),
    "differentiable.scene": ("DifferentiableScene",),
    "coverage": ("predict_map",),
    "calibration.calibration": ("MaterialCalibration", "calibrate_materials"),
    "placement.placement": ("TransmitterPlacement", "place_transmitter"),
    "export": ("save_coverage",),
    "plots.coverage_plot": ("plot_coverage",),
    "plots.exploration_plot": ("animate_exploration", "plot_exploration"),
    "plots.material_plot": ("plot_calibration",),
    "plots.placement_plot": ("plot_placement",),
}
_MODULE_OF = {name: module for module, names in _PUBLIC.items() for name in names}

__all__ = [
    "CellState",
    "DatasetSettings",
    "DifferentiableScene",
    "Exploration",
    "GainGradients",
    "LinkFeatures",
    "LinkPrediction",
    "LinkState",
    "Material",
    "MaterialCalibration",
    "PartialMap",
    "Predictor",
    "SceneSettings",
    "SensorSettings",
    "SionnaPartialError",
    "TraceSettings",
    "TracedLinks",
    "TransmitterPlacement",
    "__version__",
    "animate_exploration",
    "build_dataset",
    "calibrate_materials",
    "evaluate",
    "explore",
    "explore_trajectory",
    "export_scene",
    "gain_gradients",
    "link_features",
    "load_map",
    "make_home",
    "map_from_array",
    "map_from_habitat",
    "map_from_occupancy",
    "map_from_slam",
    "place_transmitter",
    "plot_calibration",
    "plot_coverage",
    "plot_exploration",
    "plot_placement",
    "predict_map",
    "read_dataset",
    "save_coverage",
    "save_map",
    "trace_links",
    "train",
]


def __getattr__(name: str) -> object:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(globals() | _MODULE_OF)
