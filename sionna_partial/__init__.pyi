"""Public names and the modules that define them: `__init__.py` loads a module when a name of it is first used."""

from sionna_partial import channels as channels
from sionna_partial import lab as lab
from sionna_partial import plots as plots
from sionna_partial.calibration.calibration import calibrate_materials as calibrate_materials
from sionna_partial.constants import CellState as CellState
from sionna_partial.constants import LinkState as LinkState
from sionna_partial.coverage.job import predict_map as predict_map
from sionna_partial.coverage.network import predict_network as predict_network
from sionna_partial.differentiable import DifferentiableScene as DifferentiableScene
from sionna_partial.errors import SionnaPartialError as SionnaPartialError
from sionna_partial.exploration.explore import explore as explore
from sionna_partial.exploration.explore import explore_trajectory as explore_trajectory
from sionna_partial.exploration.next_views import next_views as next_views
from sionna_partial.export import load_coverage as load_coverage
from sionna_partial.export import save_coverage as save_coverage
from sionna_partial.export import save_network as save_network
from sionna_partial.link_model import LinkModel as LinkModel
from sionna_partial.maps import importers as importers
from sionna_partial.maps.map_files import load_map as load_map
from sionna_partial.maps.map_files import map_from_array as map_from_array
from sionna_partial.maps.map_files import save_map as save_map
from sionna_partial.maps.partial_map import PartialMap as PartialMap
from sionna_partial.measurements.measurements import Measurements as Measurements
from sionna_partial.measurements.measurements import load_measurements as load_measurements
from sionna_partial.placement.placement import place_transmitter as place_transmitter
from sionna_partial.placement.several import place_transmitters as place_transmitters
from sionna_partial.prediction.features import LinkFeatures as LinkFeatures
from sionna_partial.prediction.features import link_features as link_features
from sionna_partial.prediction.predictor import Predictor as Predictor
from sionna_partial.prediction.rule import LinkPrediction as LinkPrediction
from sionna_partial.scene.export import export_scene as export_scene
from sionna_partial.settings import Material as Material
from sionna_partial.settings import SceneSettings as SceneSettings
from sionna_partial.settings import SensorSettings as SensorSettings
from sionna_partial.settings import TraceSettings as TraceSettings
from sionna_partial.tracing.antenna_files import load_antenna as load_antenna
from sionna_partial.tracing.antennas import Antenna as Antenna
from sionna_partial.tracing.antennas import AntennaPattern as AntennaPattern
from sionna_partial.tracing.gradients import gain_gradients as gain_gradients
from sionna_partial.tracing.links import TracedLinks as TracedLinks
from sionna_partial.tracing.simulation import Simulation as Simulation
from sionna_partial.tracing.trace import trace_links as trace_links
from sionna_partial.worlds.homes import make_home as make_home

__version__: str
