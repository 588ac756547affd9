"""Public names and the modules that define them: `__init__.py` loads a module when a name of it is first used."""

from sionna_partial.calibration.calibration import MaterialCalibration as MaterialCalibration
from sionna_partial.calibration.calibration import calibrate_materials as calibrate_materials
from sionna_partial.constants import CellState as CellState
from sionna_partial.constants import LinkState as LinkState
from sionna_partial.coverage import predict_map as predict_map
from sionna_partial.datasets.dataset import build_dataset as build_dataset
from sionna_partial.datasets.shards import read_dataset as read_dataset
from sionna_partial.differentiable.scene import DifferentiableScene as DifferentiableScene
from sionna_partial.errors import SionnaPartialError as SionnaPartialError
from sionna_partial.evaluation.evaluate import evaluate as evaluate
from sionna_partial.export import save_coverage as save_coverage
from sionna_partial.maps.map_files import load_map as load_map
from sionna_partial.maps.map_files import map_from_array as map_from_array
from sionna_partial.maps.map_files import map_from_habitat as map_from_habitat
from sionna_partial.maps.map_files import map_from_occupancy as map_from_occupancy
from sionna_partial.maps.map_files import map_from_slam as map_from_slam
from sionna_partial.maps.map_files import save_map as save_map
from sionna_partial.maps.partial_map import PartialMap as PartialMap
from sionna_partial.placement.placement import TransmitterPlacement as TransmitterPlacement
from sionna_partial.placement.placement import place_transmitter as place_transmitter
from sionna_partial.plots.coverage_plot import plot_coverage as plot_coverage
from sionna_partial.plots.exploration_plot import animate_exploration as animate_exploration
from sionna_partial.plots.exploration_plot import plot_exploration as plot_exploration
from sionna_partial.plots.material_plot import plot_calibration as plot_calibration
from sionna_partial.plots.placement_plot import plot_placement as plot_placement
from sionna_partial.prediction.features import LinkFeatures as LinkFeatures
from sionna_partial.prediction.features import link_features as link_features
from sionna_partial.prediction.predictor import LinkPrediction as LinkPrediction
from sionna_partial.prediction.predictor import Predictor as Predictor
from sionna_partial.scene.scene import export_scene as export_scene
from sionna_partial.settings import DatasetSettings as DatasetSettings
from sionna_partial.settings import Material as Material
from sionna_partial.settings import SceneSettings as SceneSettings
from sionna_partial.settings import SensorSettings as SensorSettings
from sionna_partial.settings import TraceSettings as TraceSettings
from sionna_partial.simulation.explore import Exploration as Exploration
from sionna_partial.simulation.explore import explore as explore
from sionna_partial.simulation.explore import explore_trajectory as explore_trajectory
from sionna_partial.simulation.homes import make_home as make_home
from sionna_partial.tracing.path_set import GainGradients as GainGradients
from sionna_partial.tracing.path_set import gain_gradients as gain_gradients
from sionna_partial.tracing.trace import TracedLinks as TracedLinks
from sionna_partial.tracing.trace import trace_links as trace_links
from sionna_partial.training import train as train

__version__: str
