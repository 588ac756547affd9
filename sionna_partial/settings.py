"""One frozen dataclass of settings for each stage, checked when it is built."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, get_args

from sionna_partial.checks import Checked, Within, are_stages, plain, require, require_choice, require_number, shown
from sionna_partial.constants import (
    CARRIER_FREQUENCY_HZ,
    DEFAULT_HEIGHT_M,
    DRYWALL_CONDUCTIVITY_EXPONENT,
    DRYWALL_CONDUCTIVITY_S_M,
    DRYWALL_PERMITTIVITY,
    WALL_THICKNESS_M,
)
from sionna_partial.errors import ArgumentError

ITU_BANDS_GHZ: dict[str, tuple[tuple[float, float], ...]] = {
    "vacuum": ((0.001, 100.0),),
    "concrete": ((1.0, 100.0), (110.0, 330.0)),
    "brick": ((1.0, 40.0), (110.0, 330.0)),
    "plasterboard": ((1.0, 100.0), (110.0, 330.0), (100.0, 400.0)),
    "wood": ((0.001, 100.0), (110.0, 330.0), (100.0, 400.0)),
    "glass": ((0.1, 100.0), (220.0, 450.0), (100.0, 400.0)),
    "clear_acrylic": ((110.0, 330.0),),
    "ceiling_board": ((1.0, 100.0), (220.0, 450.0), (100.0, 400.0)),
    "chipboard": ((1.0, 100.0), (100.0, 200.0)),
    "plywood": ((1.0, 40.0), (110.0, 330.0), (100.0, 400.0)),
    "marble": ((1.0, 60.0), (110.0, 330.0), (100.0, 400.0)),
    "floorboard": ((50.0, 100.0), (220.0, 300.0), (300.0, 400.0), (400.0, 450.0), (100.0, 400.0)),
    "vinyl_tile": ((1.0, 40.0),),
    "carpet_tile": ((1.0, 40.0),),
    "asphalt_concrete": ((1.0, 40.0),),
    "metal": ((1.0, 100.0),),
    "very_dry_ground": ((1.0, 10.0),),
    "medium_dry_ground": ((1.0, 10.0),),
    "wet_ground": ((1.0, 10.0),),
}
"""ITU-R P.2040-3 materials and the frequency bands of their models [GHz], as Sionna RT has them."""


FREQUENCIES_HZ = (1e6, 1e12)
"""Lowest and highest carrier frequency [Hz]."""

POWER_TOLERANCE_DB = 0.1
"""Default of `TraceSettings.power_tolerance_db` where only powers count [dB]."""

OPAQUE_FROM_HZ = 24e9
"""Frequency from which on walls are opaque unless set otherwise [Hz]."""

HomeKind = Literal["apartment", "house", "office", "floor", "hall", "warehouse"]
"""Kinds of procedural homes; the last three are large."""

HOME_KINDS = get_args(HomeKind)

NetworkKind = Literal["paper", "paths", "map"]
"""Inputs of a predictor: the paper's features; also the walls along each path; also the map around the transmitter."""

Objective = Literal["coverage", "percentile"]
"""Objective of a placement: the mean predicted coverage, or the gain of the worst tenth of the receivers."""

Fusion = Literal["slam_toolbox", "gmapping", "cartographer", "vacuum"]
"""Mappers whose rule makes a robot's map of noisy readings."""

Policy = Literal["random", "coverage"]
"""Policy by which an exploring robot chooses frontiers."""

Frequency = Annotated[float, Within(*FREQUENCIES_HZ)]
Fraction = Annotated[float, Within(0.0, 1.0)]
Height = Annotated[float, Within(0.0, 1000.0, open_low=True)]
Seed = Annotated[int, Within(0, 2**31 - 1)]
Count = Annotated[int, Within(1, 1_000_000)]

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


@dataclass(frozen=True, repr=False)
class Material(Checked):
    """Radio material of walls, floor and ceiling.

    Either an ITU-R P.2040-3 material, by its `itu` name, or a custom one. `Material.named` has materials of walls with
    their usual thickness. The default constants are the paper's layered drywall at 28 GHz, at every frequency; the
    conductivity of ``Material.named("drywall")`` decreases below 28 GHz, so that a wall loses 10 dB less at 5 GHz.

    Parameters
    ----------
    relative_permittivity : float
        Real relative permittivity, at least 1. Ignored for an ITU material.
    conductivity_s_m : float
        Conductivity at 28 GHz [S/m], at least 0. Ignored for an ITU material.
    thickness_m : float
        Slab thickness in the reflection and transmission coefficients [m].
    itu : str or None
        Name of an ITU material (a key of `ITU_BANDS_GHZ`).
    conductivity_exponent : float
        Exponent b of a conductivity that grows with the frequency f, as (f / 28 GHz)^b; 0 is a constant one. Ignored
        for an ITU material.

    Raises
    ------
    SettingsError
        For a value out of range or an unknown ITU name.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.Material(itu="concrete").itu
    'concrete'
    >>> sp.Material(4.0, conductivity_s_m=0.05, thickness_m=0.2).relative_permittivity
    4.0
    """

    relative_permittivity: Annotated[float, Within(1.0, 1e6)] = DRYWALL_PERMITTIVITY
    conductivity_s_m: Annotated[float, Within(0.0, 1e9)] = DRYWALL_CONDUCTIVITY_S_M
    thickness_m: Annotated[float, Within(0.0, 10.0, open_low=True)] = WALL_THICKNESS_M
    itu: str | None = None
    conductivity_exponent: Annotated[float, Within(0.0, 2.0)] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.itu is not None:
            require_choice("itu", self.itu, ITU_BANDS_GHZ)

    def __repr__(self) -> str:
        names = ["relative_permittivity", "conductivity_s_m"] if self.itu is None else ["itu"]
        names += ["thickness_m", *(["conductivity_exponent"] if self.itu is None else [])]
        return f"Material({', '.join(f'{name}={getattr(self, name)!r}' for name in names)})"

    @classmethod
    def named(cls, name: str) -> "Material":
        """Return a material of walls with its usual thickness, by its name.

        The names are the keys of `WALL_MATERIALS`, such as "drywall", the default, and the materials of ITU-R P.2040-3,
        with a thickness of 10 cm where `WALL_MATERIALS` has no other. Sources of the constants, and measured losses of
        such walls: `docs/walls.md`.

        Examples
        --------
        >>> import sionna_partial as sp
        >>> sp.Material.named("concrete").thickness_m
        0.2
        """
        require_choice("material", name, dict.fromkeys((*WALL_MATERIALS, *ITU_BANDS_GHZ)))
        return WALL_MATERIALS.get(name) or cls(itu=name)

    def require_frequency(self, frequency_hz: float) -> None:
        """Raise a SettingsError if the material's model does not cover `frequency_hz`."""
        require_number("frequency_hz", frequency_hz, *FREQUENCIES_HZ)
        if self.itu is None:
            return
        bands = ITU_BANDS_GHZ[self.itu]
        covered = any(low <= frequency_hz / 1e9 <= high for low, high in bands)
        spans = " or ".join(f"{low:g}-{high:g} GHz" for low, high in bands)
        remedy = f"ITU material {self.itu!r} is defined for {spans}; choose a frequency there or a custom Material."
        require(covered, "frequency_hz", frequency_hz, remedy)


WALL_MATERIALS = {
    "drywall": Material(conductivity_exponent=DRYWALL_CONDUCTIVITY_EXPONENT),
    "brick": Material(itu="brick", thickness_m=0.11),
    "concrete": Material(itu="concrete", thickness_m=0.2),
    "reinforced concrete": Material(itu="concrete", thickness_m=0.25),
    "glass": Material(itu="glass", thickness_m=0.006),
    "coated glass": Material(6.31, 10.0, 0.006),
    "wood": Material(itu="wood", thickness_m=0.04),
    "door": Material(itu="chipboard", thickness_m=0.04),
    "metal": Material(itu="metal", thickness_m=0.005),
}
"""Materials that walls have, with their usual thickness. Drywall has the paper's constants at 28 GHz and loses less
below; coated glass is glass with the conductivity of its metal film."""


def material_name(material: Material) -> str:
    """Return the name of a material of walls."""
    names = {known: name for name, known in WALL_MATERIALS.items()}
    return names.get(material) or material.itu or "a custom material"


DRYWALL = WALL_MATERIALS["drywall"]
"""Material of a trace where none is known."""


@dataclass(frozen=True)
class SceneSettings(Checked):
    """Settings of the conversion of a map to a scene. For a map with a mesh, only the material is used.

    Parameters
    ----------
    material : Material, str or None
        Material of walls, floor and ceiling, or of those parts of a mesh that name none; or its name, as of
        `Material.named`. With None it is the material of the map, if the map has one. Otherwise it is unknown where
        paths go through walls, and predictions average over the candidates of `WallMaterials`; the trace itself has
        drywall, as it has where walls are opaque.
    bridge_gap_m : float
        Longest gap that is closed in a seen wall [m], where its cells are UNKNOWN. Of FREE cells at most two are
        closed, and 0.11 m.
    floor_extent : {"observed", "none"}
        Extent of floor and ceiling: the observed area, so that unknown cells reflect nothing, or no floor and ceiling.
    ceiling : bool
        True for a ceiling above the floor.
    outline : {"lines", "cells"}
        Position of the walls: few straight lines fitted to the wall cells, or the staircase through the centres of
        the wall cells as they are, for which `bridge_gap_m` does not count.
    geometries : int or None
        Number of plausible geometries, 1 to 16, over which powers are averaged: the mapped outlines, and outlines whose
        vertices are moved at random by 3 cm. They count for links without line of sight on the mapped outlines. None is
        3 on nearly complete maps with range noise (`PartialMap.wall_noise` above 0.05) and opaque walls, and 1
        elsewhere. Gradients, channels, meshes, links with a folder and those with a
        `TraceSettings.power_tolerance_db` always have the mapped outlines.

    Raises
    ------
    SettingsError
        For a value out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.SceneSettings(material=sp.Material(itu="brick"), ceiling=False).floor_extent
    'observed'
    """

    material: Material | None = None
    bridge_gap_m: Annotated[float, Within(0.0, 1.0)] = 0.5
    floor_extent: Literal["observed", "none"] = "observed"
    ceiling: bool = True
    outline: Literal["lines", "cells"] = "lines"
    geometries: Annotated[int, Within(1, 16)] | None = None

    @property
    def traced_material(self) -> Material:
        """`material`, or drywall in place of None."""
        return DRYWALL if self.material is None else self.material


@dataclass(frozen=True)
class TraceSettings(Checked):
    """Settings of the ray tracer.

    Parameters
    ----------
    frequency_hz : float
        Carrier frequency [Hz].
    max_depth : int
        Largest number of interactions on a path, 0 (line of sight alone) to 10.
    diffraction : bool or None
        One diffraction at a vertical edge, with at most two reflections around it. On floor plans it is found by exact
        beams, as line of sight and specular reflections are; on meshes by shooting rays, which is slow. None is True
        on floor plans and False on meshes.
    diffraction_walls : int
        Largest number of reflections at walls of a floor plan before the diffraction, and after it: 0, 1 or 2.
    open_ends : bool
        True if a wall of a floor plan diffracts also at an end where observation stopped.
    power_tolerance_db : float or None
        By how much the power of a link's indirect paths may be changed by leaving out weak paths [dB], 0 to 1; 0 keeps
        every path. The power of all candidates is computed before any is verified, and is at least the power that
        Sionna RT finds, up to rounding. None is 0.1 for powers and predictions, and 0 for channels (`TracedLinks.cir`
        and the like), which are sums of fields: links that were traced with None are traced again for them.
    refraction : bool or None
        True if paths go through walls. None is False from 24 GHz on, where the paper takes walls for opaque, and True
        below.
    max_walls : int
        Largest number of walls that a path goes through, 1 to 16. `max_depth` does not count them.
    wall_depth_m : float
        Largest depth of one wall [m], 0 to 10. Of the faces that a path goes through one after the other, with no free
        cell between them, those within this depth are one wall, and have the loss of one slab of the material; so have
        the faces where it enters a closed body of a mesh and leaves it again. At 0 every face is a slab, as in the
        exported scene.
    diffuse_reflection : bool
        Diffuse reflections. With them, every path is found by shooting rays (Sionna RT's own candidate generator),
        which is slower than exact beams.
    samples_per_tx : int
        Number of rays shot from the transmitter where rays are shot.
    seed : int
        Seed of the rays where rays are shot.

    Raises
    ------
    SettingsError
        For a value out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.TraceSettings(frequency_hz=60e9, max_depth=3, diffraction=False).max_depth
    3
    """

    frequency_hz: Frequency = CARRIER_FREQUENCY_HZ
    max_depth: Annotated[int, Within(0, 10)] = 6
    diffraction: bool | None = None
    diffraction_walls: Annotated[int, Within(0, 2)] = 2
    open_ends: bool = False
    power_tolerance_db: Annotated[float, Within(0.0, 1.0)] | None = None
    refraction: bool | None = None
    max_walls: Annotated[int, Within(1, 16)] = 8
    wall_depth_m: Annotated[float, Within(0.0, 10.0)] = 0.6
    diffuse_reflection: bool = False
    samples_per_tx: Annotated[int, Within(1, 100_000_000)] = 1_000_000
    seed: Seed = 42

    @property
    def tolerance_db(self) -> float:
        """`power_tolerance_db`, or its default where only powers count [dB]."""
        return POWER_TOLERANCE_DB if self.power_tolerance_db is None else self.power_tolerance_db

    @property
    def through_walls(self) -> bool:
        """Return whether paths go through walls at this frequency."""
        return self.frequency_hz < OPAQUE_FROM_HZ if self.refraction is None else self.refraction

    @property
    def most_interactions(self) -> int:
        """Largest number of interactions on a path, at least 1."""
        return max(1, self.max_depth + (self.max_walls if self.through_walls else 0))


@dataclass(frozen=True)
class SensorSettings(Checked):
    """Sensor of the exploring robot and its errors; by default there are none.

    Parameters
    ----------
    range_noise_m : float
        Standard deviation of the camera's range readings [m], independent from ray to ray, at most 1. It makes walls
        ragged: see `fusion`.
    drift_m_per_m : float
        Odometry drift per metre travelled [1], at most 1, in a direction that is drawn once. What is seen later is
        mapped off its true position, and walls that are seen again may appear twice.
    missed_wall_fraction : float
        Fraction of squares of half a metre in which walls return no reading [1], as glass, mirrors and black surfaces
        do. Rays to them are dropped: their cells stay unknown, and nothing is seen through them.
    field_of_view_deg : float
        Horizontal angle [degree], in (0, 360], centred on the heading of the robot. The default is the camera of Active
        Neural SLAM (Chaplot et al., ICLR 2020, Section 4); a turning lidar has 360.
    range_m : float
        Largest range [m], in (0, 100]. The default is the 64 cells of 0.05 m that Active Neural SLAM maps ahead.
    heading_noise_deg : float
        Standard deviation of the heading that the map assumes for a picture [degree], independent from picture to
        picture, at most 180.
    missed_return_fraction : float
        Fraction of rays that return no reading [1], at random. With any error, those that graze a wall return none.
    fusion : {"slam_toolbox", "gmapping", "cartographer", "vacuum"}
        Mapper whose rule and default parameters decide from the readings which cells are walls (`FUSIONS`); "vacuum"
        thins walls, too. Without errors all agree, and the map is true.

    Raises
    ------
    SettingsError
        For a value out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.SensorSettings(range_noise_m=0.02, field_of_view_deg=360.0, range_m=8.0).is_exact
    False
    """

    range_noise_m: Annotated[float, Within(0.0, 1.0)] = 0.0
    drift_m_per_m: Annotated[float, Within(0.0, 1.0)] = 0.0
    missed_wall_fraction: Fraction = 0.0
    field_of_view_deg: Annotated[float, Within(0.0, 360.0, open_low=True)] = 90.0
    range_m: Annotated[float, Within(0.0, 100.0, open_low=True)] = 3.2
    heading_noise_deg: Annotated[float, Within(0.0, 180.0)] = 0.0
    missed_return_fraction: Fraction = 0.0
    fusion: Fusion = "slam_toolbox"

    @property
    def is_exact(self) -> bool:
        """Return whether it makes no errors."""
        errors = (self.range_noise_m, self.drift_m_per_m, self.heading_noise_deg)
        return not any((*errors, self.missed_wall_fraction, self.missed_return_fraction))


SHORT_LINK_M = 25.0
"""Largest length of a short link, on the floor plan [m]."""

MIXED_SENSORS = {
    "range_m": (3.0, 30.0),
    "field_of_view_deg": (60.0, 120.0),
    "range_noise_m": (0.0, 0.05),
    "drift_m_per_m": (0.0, 0.02),
    "missed_wall_fraction": (0.0, 0.1),
    "heading_noise_deg": (0.0, 0.5),
    "missed_return_fraction": (0.0, 0.1),
}
"""Ranges of the sensors of a data set with `sensor="mixed"`.

The range is drawn uniformly on a logarithmic scale, the field of view of cameras and the mapper uniformly, and errors
more often small than large (the square of a uniform number).
"""


@dataclass(frozen=True)
class DatasetSettings(Checked):
    """Selection of the links of each home in a data set.

    Parameters
    ----------
    links_per_home : int
        Number of links whose receivers are drawn from the free cells of the complete home, at least
        `transmitters_per_home`. As many more have receivers drawn from the whole map area, indoors or not. All of them
        are there at each stage.
    transmitters_per_home : int
        Number of transmitters, drawn from the free cells of the complete home; each has receivers of its own.
    stages : tuple of int, or of float
        Steps that the robot has explored, increasing; or, all in [0, 1), fractions of the home's free area that it has
        observed, which mean the same in buildings of all sizes.
    seed : int
        Seed of the positions and of the robot, together with the home's name.
    tx_height_m, rx_height_m : float
        Heights of transmitters and receivers above the map's z = 0 [m].
    margin_m : float
        Width of the map area beyond the known cells of the complete home [m]. Maps are cut and extended to it.
    sensor : SensorSettings or "mixed"
        Sensor of the exploring robot and its errors; "mixed" draws it for each home from `MIXED_SENSORS`, by `seed`
        and the home's name: one home in three has a camera of 60 to 120 degrees, the others a lidar that turns.
    short_link_fraction : float
        Fraction of the receivers of each transmitter that are drawn within `SHORT_LINK_M` of it [1]. In large
        buildings most links between uniformly drawn positions are long, and in outage.
    scene : SceneSettings
        Conversion of maps to scenes; without a material the walls are of drywall.
    trace : TraceSettings
        Settings of the traces on the complete and on the partial maps.
    cir_paths : int
        Number of paths in the impulse responses of the complete map, the strongest of each link; 0 stores none.

    Raises
    ------
    SettingsError
        For a value out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> settings = sp.DatasetSettings(links_per_home=100, stages=(0, 0.25, 0.5), sensor="mixed")
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
        remedy = "give increasing whole numbers of 0 or more, such as (0, 50, 100, 150, 200), or fractions in [0, 1)."
        require(isinstance(self.stages, tuple) and are_stages(self.stages), "stages", self.stages, remedy)
        object.__setattr__(self, "stages", tuple(map(plain, self.stages)))
        mixed = isinstance(self.sensor, str) and self.sensor == "mixed"
        remedy = "give SensorSettings(...), or 'mixed'."
        require(mixed or isinstance(self.sensor, SensorSettings), "sensor", self.sensor, remedy)
        self.scene.traced_material.require_frequency(self.trace.frequency_hz)


@dataclass(frozen=True)
class PredictorSettings(Checked):
    """Settings of the training of a predictor.

    Parameters
    ----------
    networks : {"paper", "paths", "map"}
        "paper" has the networks of the paper alone. "paths" adds one that sees the crossings of paths, "map" adds two,
        of which one sees the map around the transmitter; both need features with a context, as `link_features`
        returns them.
    frequency_hz : float
        Carrier frequency of the links [Hz]; it sets the gain of free space.
    diffraction : bool
        True if the links were traced with diffraction.
    passes : int
        Number of passes of the added networks over the training links.
    steps : int
        Gradient steps of each of the paper's networks.
    batch_size : int
        Links in such a step.
    learning_rate : float
        Learning rate of Adam at the first such step; it falls to 0 along a cosine.
    minimum_links : int
        A network of the paper with fewer links is not trained: it returns mean and standard deviation of those it has
        and of prior knowledge.
    seed : int
        Seed of first weights and batches.
    through_walls : bool
        True if the links were traced through walls.

    Raises
    ------
    SettingsError
        For a value out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.PredictorSettings(networks="paper").passes >= 1
    True
    """

    networks: NetworkKind = "paper"
    frequency_hz: Frequency = CARRIER_FREQUENCY_HZ
    diffraction: bool = True
    passes: Count = 10
    steps: Count = 4000
    batch_size: Count = 1024
    learning_rate: Annotated[float, Within(0.0, 1.0, open_low=True)] = 0.01
    minimum_links: Count = 100
    seed: Annotated[int, Within(0, 1_000_000_000)] = 0
    through_walls: bool = False


@dataclass(frozen=True)
class PlacementSettings(Checked):
    """Objective of a placement, and heights of transmitter and receivers.

    Parameters
    ----------
    objective : {"coverage", "percentile"}
        "coverage" maximises the weighted mean over receivers of P(gain > threshold). "percentile" maximises the mean
        predicted gain [dB] of the worst tenth of the receivers, an outage counting -150 dB: sorted by mean gain, they
        count in full up to 5 % of the weight, and linearly less up to 15 %, so that no single one decides.
    threshold_db : float
        Path gain above which a receiver is covered [dB], in (-150, 0].
    tx_height_m, rx_height_m : float
        Heights of transmitter and receivers [m], below the ceiling.
    seed : int
        Seed of the grid of positions that are compared. The same seed gives the same bytes.

    Raises
    ------
    SettingsError
        For values outside these ranges.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.PlacementSettings(threshold_db=-90.0).objective
    'coverage'
    """

    objective: Objective = "coverage"
    threshold_db: Annotated[float, Within(-150.0, 0.0, open_low=True)] = -100.0
    tx_height_m: float = DEFAULT_HEIGHT_M
    rx_height_m: float = DEFAULT_HEIGHT_M
    seed: Annotated[int, Within(0, 2**63 - 1)] = 0


def takes_settings(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Let a function answer a setting that was given as an argument with the settings that hold it."""
    parameters = inspect.signature(function).parameters
    kinds: dict[str, Any] = {"trace_settings": TraceSettings, "scene_settings": SceneSettings}
    holders = {
        name: f"{argument}={kind.__name__}({name}=...)"
        for argument, kind in kinds.items()
        if argument in parameters
        for name in kind.__dataclass_fields__
    }

    @functools.wraps(function)
    def call(*args: _Parameters.args, **kwargs: _Parameters.kwargs) -> _Result:
        name = next((name for name in kwargs if name not in parameters and name in holders), None)
        if name is not None:
            raise ArgumentError(f"{name} = {shown(kwargs[name])} is a setting: give {holders[name]}.")
        return function(*args, **kwargs)

    return call
