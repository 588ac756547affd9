"""Settings: frozen dataclasses, checked when built."""

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, get_args

from sionna_partial.checks import Checked, Within, require, require_choice, require_number, shown
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, DEFAULT_HEIGHT_M, WALL_THICKNESS_M
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
"""Frequency bands of the ITU-R P.2040-3 materials in Sionna RT [GHz]."""

FREQUENCIES_HZ = (1e6, 1e12)

POWER_TOLERANCE_DB = 0.1
"""Default of `TraceSettings.power_tolerance_db` [dB]."""

OPAQUE_FROM_HZ = 24e9
"""Frequency from which walls are opaque by default [Hz]."""

HomeKind = Literal["apartment", "house", "office", "floor", "hall", "warehouse"]
"""Kinds of procedural homes; the last three are large."""

HOME_KINDS = get_args(HomeKind)

NetworkKind = Literal["paper", "paths", "map"]
"""Inputs of a predictor."""

Objective = Literal["coverage", "percentile"]

Fusion = Literal["slam_toolbox", "gmapping", "cartographer", "vacuum"]
Policy = Literal["random", "coverage"]

Frequency = Annotated[float, Within(*FREQUENCIES_HZ)]
Fraction = Annotated[float, Within(0.0, 1.0)]
Seed = Annotated[int, Within(0, 2**31 - 1)]
Count = Annotated[int, Within(1, 1_000_000)]

_Parameters = ParamSpec("_Parameters")
_Result = TypeVar("_Result")


@dataclass(frozen=True, repr=False)
class Material(Checked):
    """Radio material of walls, floor and ceiling.

    Either an ITU-R P.2040-3 material, by its `itu` name, or a custom one. The default is the paper's layered
    drywall at 28 GHz (of Wireless InSite), at every frequency; ``Material.named("drywall")`` loses 10 dB less at 5 GHz.

    Parameters
    ----------
    relative_permittivity : float
        Real relative permittivity, at least 1. Ignored for an ITU material.
    conductivity_s_m : float
        Conductivity at 28 GHz [S/m], at least 0. Ignored for an ITU material.
    thickness_m : float
        Slab thickness [m].
    itu : str or None
        Name of an ITU material (a key of `ITU_BANDS_GHZ`).
    conductivity_exponent : float
        Exponent b of the conductivity's factor (f / 28 GHz)^b. Ignored for an ITU material.

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

    relative_permittivity: Annotated[float, Within(1.0, 1e6)] = 2.94
    conductivity_s_m: Annotated[float, Within(0.0, 1e9)] = 0.1226
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
        """Return a wall material with its usual thickness.

        Names are the keys of `WALL_MATERIALS`, and other materials of ITU-R P.2040-3 (10 cm). Sources: `docs/walls.md`.

        Raises
        ------
        SettingsError
            For another name; the message lists the names.

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
    "drywall": Material(conductivity_exponent=0.9395),  # as plasterboard, ITU-R P.2040-3, table 3
    "brick": Material(itu="brick", thickness_m=0.11),
    "concrete": Material(itu="concrete", thickness_m=0.2),
    "reinforced concrete": Material(itu="concrete", thickness_m=0.25),
    "glass": Material(itu="glass", thickness_m=0.006),
    "coated glass": Material(6.31, 10.0, 0.006),
    "wood": Material(itu="wood", thickness_m=0.04),
    "door": Material(itu="chipboard", thickness_m=0.04),
    "metal": Material(itu="metal", thickness_m=0.005),
}
"""Wall materials with their usual thickness. Drywall has the paper's constants at 28 GHz and loses less below."""


def material_name(material: Material) -> str:
    """Return the name of a wall material."""
    names = {known: name for name, known in WALL_MATERIALS.items()}
    return names.get(material) or material.itu or "a custom material"


DRYWALL = WALL_MATERIALS["drywall"]
"""Traced material if none is known."""


@dataclass(frozen=True)
class SceneSettings(Checked):
    """Settings of the conversion of a map to a scene; for a mesh, only the material is used.

    Parameters
    ----------
    material : Material, str or None
        Material of walls, floor and ceiling, or of parts of a mesh without one; or a name for `Material.named`. None is
        the map's material; without one, drywall is traced, and predictions through walls average over `WallMaterials`.
    bridge_gap_m : float
        Longest gap of UNKNOWN cells that is closed in a seen wall [m]. Gaps of FREE cells are closed up to two cells
        and 0.11 m.
    floor_extent : {"observed", "none"}
        Extent of floor and ceiling: the observed area, so that unknown cells reflect nothing, or none.
    ceiling : bool
        True for a ceiling above the floor.
    outline : {"lines", "cells"}
        Walls as straight lines fitted to the wall cells, or as the staircase through their centres, without
        `bridge_gap_m`.

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

    @property
    def traced_material(self) -> Material:
        """`material`, or drywall for None."""
        return DRYWALL if self.material is None else self.material


@dataclass(frozen=True)
class TraceSettings(Checked):
    """Settings of the ray tracer.

    Parameters
    ----------
    frequency_hz : float
        Carrier frequency [Hz].
    max_depth : int
        Largest number of interactions on a path, 0 (line of sight) to 10.
    diffraction : bool or None
        One diffraction at a vertical edge: by exact beams on floor plans, by shooting rays on meshes, which is slow.
        None is True on floor plans and False on meshes.
    diffraction_walls : int
        Largest number of wall reflections before, and after, the diffraction on floor plans: 0, 1 or 2.
    open_ends : bool
        True if walls of a floor plan also diffract at ends where observation stopped.
    power_tolerance_db : float or None
        Largest change of the power of a link's indirect paths by leaving out weak paths [dB], 0 to 1; 0 keeps every
        path. None is 0.1. Predictions leave out more paths, and add their expected power; the tolerance is then of
        the power through observed space, too.
    refraction : bool or None
        True if paths go through walls. None is True below 24 GHz only, as the paper assumes opaque walls.
    max_walls : int
        Largest number of walls that a path goes through, 1 to 16, besides `max_depth`.
    wall_depth_m : float
        Largest depth of one wall [m], 0 to 10. Successive faces within it, without a free cell between them, have the
        loss of one slab, as have the two faces of a closed body of a mesh. At 0 every face is a slab, as in the
        exported scene.
    diffuse_reflection : bool
        Diffuse reflections. All paths are then found by shooting rays, which is slower.
    samples_per_tx : int
        Number of rays, where rays are shot.
    seed : int
        Seed of the rays.

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
        """`power_tolerance_db`, or its default [dB]."""
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
    """Sensor of the exploring robot and its errors, by default none.

    Parameters
    ----------
    range_noise_m : float
        Standard deviation of range readings [m], independent between rays, at most 1.
    drift_m_per_m : float
        Odometry drift per metre travelled [1], at most 1, in one random direction; displaces later walls.
    missed_wall_fraction : float
        Fraction of squares of half a metre in which walls return no reading [1], like glass. Their cells stay unknown.
    field_of_view_deg : float
        Horizontal angle around the heading [degree], in (0, 360]. The default is the camera of Active Neural SLAM
        (Chaplot et al., ICLR 2020, Section 4); a turning lidar has 360.
    range_m : float
        Largest range [m], in (0, 100]; the default is from Active Neural SLAM.
    heading_noise_deg : float
        Standard deviation of the assumed heading [degree], independent between pictures, at most 180.
    missed_return_fraction : float
        Fraction of rays without a reading [1], at random. With any error, rays that graze a wall have none.
    fusion : {"slam_toolbox", "gmapping", "cartographer", "vacuum"}
        Mapper whose rule turns readings into walls (`FUSIONS`); "vacuum" also thins walls.
        Without errors all give the true map.

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
        """Return whether the sensor makes no errors."""
        errors = (self.range_noise_m, self.drift_m_per_m, self.heading_noise_deg)
        return not any((*errors, self.missed_wall_fraction, self.missed_return_fraction))


@dataclass(frozen=True)
class PredictorSettings(Checked):
    """Settings of the training of a predictor.

    Parameters
    ----------
    networks : {"paper", "paths", "map"}
        "paths" adds a network on the walls along paths, "map" also networks on the map around the transmitter; both
        need features with a context (`link_features`).
    frequency_hz : float
        Carrier frequency of the links [Hz].
    diffraction : bool
        True if the links were traced with diffraction.
    passes : int
        Number of passes of the added networks over the training links.
    steps : int
        Gradient steps of each of the paper's networks.
    batch_size : int
        Links per step.
    learning_rate : float
        First learning rate of Adam, which falls to 0 along a cosine.
    minimum_links : int
        A network of the paper with fewer links is not trained: it returns moments of its links and a prior.
    seed : int
        Seed of initial weights and batches.
    through_walls : bool
        True if the links were traced through walls.

    Raises
    ------
    SettingsError
        For a value out of range.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.lab.PredictorSettings(networks="paper").passes >= 1
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
        predicted gain [dB] of the worst tenth: sorted by mean gain, receivers count in full up to 5 % of the weight,
        and linearly less up to 15 %; an outage has -150 dB.
    threshold_db : float
        Path gain above which a receiver is covered [dB], in (-150, 0].
    tx_height_m, rx_height_m : float
        Heights below the ceiling [m].
    seed : int
        Seed of the grid of candidate positions.

    Raises
    ------
    SettingsError
        For values outside these ranges.

    Examples
    --------
    >>> from sionna_partial.settings import PlacementSettings
    >>> PlacementSettings(threshold_db=-90.0).objective
    'coverage'
    """

    objective: Objective = "coverage"
    threshold_db: Annotated[float, Within(-150.0, 0.0, open_low=True)] = -100.0
    tx_height_m: float = DEFAULT_HEIGHT_M
    rx_height_m: float = DEFAULT_HEIGHT_M
    seed: Annotated[int, Within(0, 2**63 - 1)] = 0


def takes_settings(function: Callable[_Parameters, _Result]) -> Callable[_Parameters, _Result]:
    """Let a function reject a setting given as an argument, naming its class."""
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
