"""Maps of other formats: drawings, building models, pictures, recordings, clouds, simulators, vacuum robots."""

from sionna_partial.maps.importers.bags import map_from_bag as map_from_bag
from sionna_partial.maps.importers.bags import map_from_occupancy as map_from_occupancy
from sionna_partial.maps.importers.drawings import map_from_drawing as map_from_drawing
from sionna_partial.maps.importers.points import map_from_points as map_from_points
from sionna_partial.maps.importers.simulators import map_from_habitat as map_from_habitat
from sionna_partial.maps.importers.simulators import map_from_slam as map_from_slam
from sionna_partial.measurements.recordings import measurements_from_bag as measurements_from_bag
from sionna_partial.measurements.recordings import poses_from_bag as poses_from_bag
