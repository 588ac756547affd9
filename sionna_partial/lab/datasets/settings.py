"""Settings of a data set of links."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from sionna_partial.checks import Checked, Within, are_stages, plain, require
from sionna_partial.constants import DEFAULT_HEIGHT_M
from sionna_partial.settings import Count, Fraction, SceneSettings, Seed, SensorSettings, TraceSettings

Height = Annotated[float, Within(0.0, 1000.0, open_low=True)]

SHORT_LINK_M = 25.0
"""Largest horizontal length of a short link [m]."""

MIXED_SENSORS = {
    "range_m": (3.0, 30.0),
    "field_of_view_deg": (60.0, 120.0),
    "range_noise_m": (0.0, 0.05),
    "drift_m_per_m": (0.0, 0.02),
    "missed_wall_fraction": (0.0, 0.1),
    "heading_noise_deg": (0.0, 0.5),
    "missed_return_fraction": (0.0, 0.1),
}
"""Ranges of the sensors for `sensor="mixed"`: uniform logarithm of the range, field of view and mapper; squares of
uniform numbers for errors.
"""


@dataclass(frozen=True)
class DatasetSettings(Checked):
    """Selection of the links of each home in a data set.

    Parameters
    ----------
    links_per_home : int
        Number of links at each stage with receivers in free cells of the complete home, at least
        `transmitters_per_home`; as many more have receivers anywhere in the map area.
    transmitters_per_home : int
        Number of transmitters in free cells of the complete home.
    stages : tuple of int, or of float
        Increasing exploration steps; or, in [0, 1], observed fractions of the home's free area. At 1, the robot drove
        to the end, and unknown cells that touch free ones are walls: the map is complete, with the robot's errors.
    seed : int
        Seed of positions and robot, combined with the home's name.
    tx_height_m, rx_height_m : float
        Heights [m].
    margin_m : float
        Margin of the map area around the known cells of the complete home [m].
    sensor : SensorSettings or "mixed"
        Sensor of the robot; "mixed" draws one for each home from `MIXED_SENSORS`: a camera for one home in three, else
        a turning lidar.
    short_link_fraction : float
        Fraction of receivers drawn within `SHORT_LINK_M` of their transmitter [1]. In large buildings, most other links
        are in outage.
    scene : SceneSettings
        Conversion of maps to scenes; drywall without a material.
    trace : TraceSettings
    cir_paths : int
        Number of paths in the impulse responses of the complete map, the strongest of each link; 0 stores none.

    Raises
    ------
    SettingsError
        For a value out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> settings = sp.lab.DatasetSettings(links_per_home=100, stages=(0, 0.25, 0.5), sensor="mixed")
    >>> settings.trace.frequency_hz
    28000000000.0
    """

    links_per_home: Count = 400
    transmitters_per_home: Annotated[int, Within(1, 1000)] = 4
    stages: tuple[int, ...] | tuple[float, ...] = (0, 50, 100, 150, 200)
    seed: Seed = 0
    tx_height_m: Height = DEFAULT_HEIGHT_M
    rx_height_m: Height = DEFAULT_HEIGHT_M
    margin_m: Annotated[float, Within(0.0, 1000.0)] = 3.0
    sensor: SensorSettings | Literal["mixed"] = field(default_factory=SensorSettings)
    short_link_fraction: Fraction = 0.0
    scene: SceneSettings = field(default_factory=SceneSettings)
    trace: TraceSettings = field(default_factory=TraceSettings)
    cir_paths: Annotated[int, Within(0, 1000)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        enough = self.links_per_home >= self.transmitters_per_home
        remedy = f"give at least {self.transmitters_per_home}, one for each of the transmitters_per_home."
        require(enough, "links_per_home", self.links_per_home, remedy)
        remedy = "give increasing whole numbers of 0 or more, such as (0, 50, 100, 150, 200), or fractions in [0, 1]."
        require(isinstance(self.stages, tuple) and are_stages(self.stages), "stages", self.stages, remedy)
        object.__setattr__(self, "stages", tuple(map(plain, self.stages)))
        mixed = isinstance(self.sensor, str) and self.sensor == "mixed"
        remedy = "give SensorSettings(...), or 'mixed'."
        require(mixed or isinstance(self.sensor, SensorSettings), "sensor", self.sensor, remedy)
        self.scene.traced_material.require_frequency(self.trace.frequency_hz)
