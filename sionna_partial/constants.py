"""Physical and project-wide constants, each with its unit and source."""

from enum import IntEnum

SPEED_OF_LIGHT_M_S = 299_792_458.0
"""Exact (SI)."""

CARRIER_FREQUENCY_HZ = 28e9
"""Carrier frequency of the paper's experiments [Hz]."""

GAIN_FLOOR_DB = -150.0
"""Smallest omnidirectional path gain, and the gain of an outage [dB] (paper, eq. 5)."""

LOWEST_DB, HIGHEST_DB = GAIN_FLOOR_DB - 50.0, 0.0
"""Limits of measured gains [dB]; others have another unit or sign. Noise may take an outage below -150 dB."""

NO_RECEIVER = 255
"""Link state where no receiver can be, or no link was traced."""

DEFAULT_HEIGHT_M = 1.5
"""Default height of transmitters and receivers [m] (the paper's reference trace)."""

MEMORY_GB = 2.0
"""Default memory limit of a job [GB]."""

DEFAULT_WALL_HEIGHT_M = 3.0
"""Default height of walls [m]."""

WALL_THICKNESS_M = 0.1
"""Thickness of the slab in the reflection coefficient [m] (Sionna RT's default)."""

COST_THRESHOLD_DB = -100.0
"""Default path gain up to which a cell of a cost grid counts as not covered [dB]."""

MAX_COST = 98
"""Largest value of a cost grid [percent]: nav2 reads 99 as an inscribed obstacle and 100 as an obstacle."""

MESH_SUFFIXES = (".ply", ".glb", ".gltf", ".obj", ".stl")

POINT_SUFFIXES = (".pcd", ".las", ".laz", ".xyz", ".pts")
"""Point clouds, besides PLY files without faces."""

DRAWING_SUFFIXES = (".dxf",)

IFC_SUFFIXES = (".ifc",)

BAG_SUFFIXES = (".bag", ".mcap", ".db3")
"""A bag of ROS 2 may also be a folder with a metadata.yaml."""


VACUUM_SUFFIXES = (".json", ".vwm")
"""Maps of vacuum robots: Valetudo, and recordings of Valeronoi."""

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp")
"""Floor plans as pictures."""


class LinkState(IntEnum):
    """State of a radio link (paper, Section II-B).

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.LinkState(1).name
    'LOS'
    """

    OUTAGE = 0
    LOS = 1
    NLOS = 2


class CellState(IntEnum):
    """State of a map cell.

    Examples
    --------
    >>> import sionna_partial as sp
    >>> sp.CellState(2).name
    'UNKNOWN'
    """

    FREE = 0
    WALL = 1
    UNKNOWN = 2
