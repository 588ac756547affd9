"""Options shared by subcommands, and their parsers."""

import functools
import inspect
import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

import sionna_partial as sp
from sionna_partial.checks import Progress
from sionna_partial.constants import CARRIER_FREQUENCY_HZ
from sionna_partial.display import reporting
from sionna_partial.files import require_writable
from sionna_partial.settings import Fusion, Material, SceneSettings, SensorSettings, TraceSettings

GROUPS = {
    "Transmitter": ("tx", "tx_power", "power", "tx_antenna", "azimuth", "tilt"),
    "Radio": (
        *("frequency", "threshold", "rx_height", "spacing", "receivers", "max_depth", "diffraction", "predictor"),
        *("measurements", "column", "access_point", "pixel"),
    ),
    "Walls": ("material", "through_walls", "material_of", "wall_layer", "wall_height", "obstacle_height"),
    "Map": ("strict", "resolution", "unit", "up", "height_band", "storey"),
    "Output": ("out", "formats", "logo", "memory"),
}
"""Groups of options in the help of a command."""

UNITS_HZ = {"": 1.0, "hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9}
"""Frequency units in lower case."""

MAP_HELP = (
    "ROS map_server YAML, rosbag, exported scene folder, .npz, mesh, point cloud, DXF floor plan, IFC model, "
    "Valetudo JSON, or picture."
)
_BAND_HELP = "Of a mesh or point cloud: z between which its surfaces are walls [m]."
_MATERIAL_HELP = (
    "drywall or an ITU material, or permittivity,conductivity[S/m],thickness[m]. Default: unknown below 24 GHz, "
    "drywall above."
)


def parse_frequency(text: str) -> float:
    """Return the frequency [Hz] of a number with or without a unit, or of a Wi-Fi channel such as ch36."""
    channel = re.fullmatch(r"(ch)?\s*(\d{1,3})", str(text).strip().lower())
    channel_hz = channel and _channel_hz(int(channel[2]))
    if channel and channel_hz and not channel[1]:
        what = f"ch{channel[2]} for this Wi-Fi channel ({channel_hz / 1e9:g} GHz), or a unit: {channel[2]}GHz"
        raise typer.BadParameter(f"{str(text)!r} is {channel[2]} Hz: give {what}.")
    if channel and channel[1]:
        if channel_hz is None:
            raise typer.BadParameter(f"{str(text)!r} is no channel: give ch1 to ch14, ch32 to ch177, or 5.955GHz.")
        return channel_hz
    found = re.fullmatch(r"(.*?[\d.nf])\s*([kmg]?hz)?", str(text).strip().lower())
    if not found or not _is_number(found[1]):
        raise typer.BadParameter(f"{str(text)!r} is not a frequency: give hertz, or a number with its unit, as 5.2GHz.")
    return float(found[1]) * UNITS_HZ[found[2] or ""]


def _channel_hz(number: int) -> float | None:
    """Return the centre of a Wi-Fi channel at 2.4 or 5 GHz (IEEE 802.11-2020, 17.3.8.4 and 15.4.4.3)."""
    if number == 14:
        return 2.484e9
    start_hz = 2.407e9 if 1 <= number <= 13 else 5e9 if 32 <= number <= 177 else None
    return None if start_hz is None else start_hz + 5e6 * number


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


Map = Annotated[Path, typer.Argument(metavar="MAP", help=MAP_HELP, show_default=False)]
MapIfGiven = Annotated[Path | None, typer.Argument(metavar="MAP", help=MAP_HELP, show_default=False)]
Strict = Annotated[bool, typer.Option("--strict", help="Read the map file to the letter, even if it looks wrong.")]
HeightBand = Annotated[
    tuple[float, float] | None, typer.Option(metavar="LOW HIGH", help=_BAND_HELP, show_default=False)
]
Up = Annotated[
    str | None, typer.Option(metavar="y|z|-y|-z", help="Of a mesh or cloud: the axis up.", show_default=False)
]
WallHeight = Annotated[
    float | None, typer.Option(help="Height of walls and ceiling [m]. Default: the map's.", show_default=False)
]
MaterialOf = Annotated[
    list[str] | None,
    typer.Option(
        metavar="LAYER=MATERIAL", help="Of a drawing or IFC model: material of a layer or type.", show_default=False
    ),
]
WallLayers = Annotated[
    list[str] | None,
    typer.Option("--wall-layer", metavar="LAYER", help="Of a drawing: a layer with walls.", show_default=False),
]
Unit = Annotated[
    float | None, typer.Option(help="Of a drawing or scan: length of its unit [m], 0.001 for mm.", show_default=False)
]
ObstacleHeight = Annotated[
    float | None,
    typer.Option(help="Height of what stands free on a robot's map [m]. Default: the ceiling.", show_default=False),
]
Resolution = Annotated[
    float | None,
    typer.Option(
        help="Of a picture: metres per pixel. Of scans and drawings: edge of the cells [m].", show_default=False
    ),
]
Storey = Annotated[str | None, typer.Option(metavar="NAME", help="Of an IFC model: a storey.", show_default=False)]
MaterialText = Annotated[str, typer.Option(help=_MATERIAL_HELP)]
Frequency = Annotated[
    float,
    typer.Option(
        help="Carrier frequency [Hz], with its unit (5.2GHz), or a Wi-Fi channel (ch36).",
        parser=parse_frequency,
        metavar="HZ",
        show_default=f"{CARRIER_FREQUENCY_HZ / 1e9:g}GHz",
    ),
]
MaxDepth = Annotated[int, typer.Option(help="Largest number of interactions on a path.")]
Diffraction = Annotated[
    bool,
    typer.Option("--diffraction/--no-diffraction", help="Diffraction at vertical edges of walls."),
]
ThroughWalls = Annotated[
    bool | None,
    typer.Option(
        "--through-walls/--opaque-walls",
        help="Whether paths go through walls. Default: below 24 GHz, not from there on.",
        show_default=False,
    ),
]
Measured = Annotated[
    Path | None,
    typer.Option(
        metavar="CSV|JSON|VWM|BAG",
        help="Measured gains; powers of a phone (x, y, rssi), wifi-survey-heatmap, Valeronoi (.vwm), or a rosbag.",
        show_default=False,
    ),
]
Columns = Annotated[
    list[str] | None,
    typer.Option("--column", metavar="NAME=HEADER", help="A header of the CSV: gain_db=level.", show_default=False),
]
AccessPoint = Annotated[
    str | None,
    typer.Option(
        metavar="BSSID|NAME",
        help="Of measurements of several access points: the one to read. Default of a .vwm: that with most of them.",
        show_default=False,
    ),
]
Pixel = Annotated[
    float | None,
    typer.Option(help="Of a JSON survey on a plan: metres per pixel of the plan beside it.", show_default=False),
]
RxHeight = Annotated[float, typer.Option(help="Height of the receivers [m].")]
Memory = Annotated[float, typer.Option("--memory", help="Memory that the process may take [GB].")]
TxAntenna = Annotated[
    str, typer.Option(metavar="PATTERN|FILE", help="iso, dipole, hw_dipole, tr38901, or an MSI file (.msi, .pln).")
]
Azimuth = Annotated[float, typer.Option(help="Of the antenna, counterclockwise from x [degree].")]
Tilt = Annotated[float, typer.Option(help="Of the antenna, below the horizon [degree].")]
PredictorName = Annotated[str, typer.Option(help="'map', 'paper', or a .keras file. Default: 'map'.")]
FieldOfView = Annotated[float, typer.Option(help="Field of view of the robot, up to 360 [degree].")]
Range = Annotated[float, typer.Option("--range", help="Range of its sensor [m].")]
RangeNoise = Annotated[float, typer.Option(help="Standard deviation of its range readings [m].")]
Drift = Annotated[float, typer.Option(help="Odometry drift per metre travelled [1].")]
MissedWalls = Annotated[float, typer.Option(help="Fraction of walls that it does not detect, as glass [1].")]
HeadingNoise = Annotated[float, typer.Option(help="Standard deviation of its heading in each picture [degree].")]
MissedReturns = Annotated[float, typer.Option(help="Fraction of rays that return no reading [1].")]
Mapper = Annotated[Fusion, typer.Option(help="Mapper that makes the map of readings with errors.")]


def in_options(message: str) -> str:
    """Return a message with switches as on the command line: --strict for strict=True."""
    return re.sub(r"\b(strict)=True\b", r"--\1", message)


class OnceCommand(TyperCommand):
    """A command with grouped options in its help, which refuses repeated options."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options in their groups."""
        options = {str(each.name): each for each in self.get_params(ctx) if each.param_type_name == "option"}
        grouped = {name: title for title, names in GROUPS.items() for name in names}
        for title in (*GROUPS, "Options"):
            names = GROUPS.get(title, [name for name in options if name not in grouped])
            rows = [options[name].get_help_record(ctx) for name in names if name in options]
            if any(rows):
                with formatter.section(title):
                    formatter.write_dl([row for row in rows if row])

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse arguments, and count the options among them."""
        order: list[Any] = self.make_parser(ctx).parse_args(args=[*args])[2]
        for option in order:
            if order.count(option) > 1 and not (option.multiple or option.count):
                others = " `sionna-partial network` takes several transmitters." if option.name == "tx" else ""
                raise typer.BadParameter(
                    f"{option.opts[0]} is given {order.count(option)} times: give it once.{others}"
                )
        return super().parse_args(ctx, args)


class TransmitterCommand(OnceCommand):
    """A command that takes `--tx X Y` and `--tx X Y Z`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the numbers after --tx to one value."""
        return super().parse_args(ctx, join_numbers(args, "--tx"))


def join_numbers(args: Sequence[str], option: str) -> list[str]:
    """Join the numbers after `option`, also negative ones, to one value."""
    joined: list[str] = []
    rest = list(args)
    while rest:
        arg = rest.pop(0)
        if arg.startswith(f"{option}="):
            rest.insert(0, arg.removeprefix(f"{option}="))
            arg = option
        if arg == option:
            words = list(itertools.takewhile(_is_number, rest)) or rest[:1]
            del rest[: len(words)]
            parse_position(" ".join(words))
            arg = f"{option}={' '.join(words)}"
        joined.append(arg)
    return joined


def parse_position(text: str) -> tuple[float, ...]:
    """Return the position [m] of "X Y" or "X Y Z"."""
    words = text.replace(",", " ").split()
    if len(words) not in (2, 3) or not all(map(_is_number, words)):
        raise typer.BadParameter(f"--tx {text!r} is not a position: give --tx X Y or --tx X Y Z in metres.")
    return tuple(map(float, words))


def parse_material(text: str) -> Material:
    """Return the material of a name (`Material.named`), or of "permittivity,conductivity,thickness"."""
    words = text.split(",")
    if len(words) == 1:
        return Material.named(text)
    if len(words) != 3 or not all(map(_is_number, words)):
        raise typer.BadParameter(
            f"--material {text!r} is neither a name nor permittivity,conductivity,thickness: "
            "give for example concrete, or 2.94,0.1226,0.1."
        )
    permittivity, conductivity_s_m, thickness_m = map(float, words)
    return Material(permittivity, conductivity_s_m, thickness_m)


def read_measurements(
    path: Path | None,
    column: list[str] | None,
    tx: tuple[float, ...] | None = None,
    access_point: str | None = None,
    pixel_m: float | None = None,
) -> Any:
    """Read the file of --measurements with the headers of --column; `tx` is the default position."""
    from sionna_partial.measurements.recordings import load_survey  # imports SciPy

    pairs = [text.partition("=") for text in column or ()]
    wrong = next((name for name, _, header in pairs if not name or not header), None)
    if wrong is not None:
        raise typer.BadParameter(f"--column {wrong!r} is no NAME=HEADER: give gain_db=level.")
    if path is None:
        return None
    options: dict[str, Any] = {"columns": {name: header for name, _, header in pairs} or None}
    options |= {"access_point": access_point, "pixel_m": pixel_m}
    measured = load_survey(path, **options)
    return load_survey(path, tx=tx, **options) if tx is not None and not measured.tx_known.any() else measured


def parse_antenna(text: str, azimuth_deg: float, downtilt_deg: float) -> Any:
    """Return an antenna from a pattern's name or an MSI file, and its orientation."""
    pattern = sp.load_antenna(text) if Path(text).suffix else text
    return sp.Antenna(pattern, azimuth_deg, downtilt_deg)


def for_each(values: Sequence[Any], count: int) -> Sequence[Any]:
    """Return values given once for all transmitters, or once for each."""
    if len(values) not in (1, count):
        raise typer.BadParameter(f"{len(values)} values for {count} transmitters: give one for all, or one for each.")
    return values if len(values) == count else [*values] * count


def settings_of(
    frequency: Frequency = CARRIER_FREQUENCY_HZ,
    material: MaterialText = "",
    max_depth: MaxDepth = 6,
    diffraction: Diffraction = True,
    through_walls: ThroughWalls = None,
) -> dict[str, Any]:
    """Return settings of scene and trace by argument name."""
    trace = TraceSettings(frequency, max_depth, None if diffraction else False, refraction=through_walls)
    return {
        "scene_settings": SceneSettings(material=parse_material(material) if material else None),
        "trace_settings": trace,
    }


def _read_map(
    map_path: Map,
    strict: Strict = False,
    height_band: HeightBand = None,
    up: Up = None,
    wall_height: WallHeight = None,
    material_of: MaterialOf = None,
    wall_layer: WallLayers = None,
    unit: Unit = None,
    storey: Storey = None,
    obstacle_height: ObstacleHeight = None,
    resolution: Resolution = None,
) -> Any:
    pairs = [text.rpartition("=") for text in material_of or ()]
    for layer, _, material in pairs:
        if not layer or not material:
            raise typer.BadParameter(f"--material-of {layer or material!r} is no LAYER=MATERIAL: give A-WALL=concrete.")
    materials = {layer: parse_material(material) for layer, _, material in pairs} or None
    return sp.load_map(
        map_path,
        strict=strict,
        wall_height_m=wall_height,
        height_band_m=height_band,
        up=up,
        layer_materials=materials,
        wall_layers=wall_layer or None,
        unit_m=unit,
        storey=storey,
        obstacle_height_m=obstacle_height,
        resolution_m=resolution,
    )


def _read_map_if_given(map_path: Path | None, **options: Any) -> Any:
    return None if map_path is None else _read_map(map_path, **options)


_read_map_if_given.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
    [
        option.replace(annotation=MapIfGiven, default=None) if name == "map_path" else option
        for name, option in inspect.signature(_read_map).parameters.items()
    ]
)


def _sensor(
    field_of_view: FieldOfView = SensorSettings.field_of_view_deg,
    range_m: Range = SensorSettings.range_m,
    range_noise: RangeNoise = SensorSettings.range_noise_m,
    drift: Drift = SensorSettings.drift_m_per_m,
    missed_walls: MissedWalls = SensorSettings.missed_wall_fraction,
    heading_noise: HeadingNoise = SensorSettings.heading_noise_deg,
    missed_returns: MissedReturns = SensorSettings.missed_return_fraction,
    fusion: Mapper = SensorSettings.fusion,
) -> SensorSettings:
    errors = range_noise, drift, missed_walls
    return SensorSettings(*errors, field_of_view, range_m, heading_noise, missed_returns, fusion)


Settings = Annotated[dict[str, Any], settings_of]
PartialMap = Annotated[Any, _read_map]
PartialMapIfGiven = Annotated[Any, _read_map_if_given]
Sensor = Annotated[SensorSettings, _sensor]
"""Parameters of commands that combine options; see `with_options`."""


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Replace parameters that are `Annotated[..., function]` by the options of the function."""
    options: dict[str, inspect.Parameter] = {}
    makers: dict[str, Callable[..., Any]] = {}
    for name, parameter in inspect.signature(command).parameters.items():
        maker = getattr(parameter.annotation, "__metadata__", [None])[0]
        if inspect.isfunction(maker):
            makers[name] = maker
            options |= inspect.signature(maker).parameters
        else:
            options[name] = parameter

    @functools.wraps(command)
    def run(**given: Any) -> None:
        for name, maker in makers.items():
            given[name] = maker(**{option: given.pop(option) for option in inspect.signature(maker).parameters})
        command(**given)

    keywords = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in options.values()]
    run.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    run.__annotations__ = {name: parameter.annotation for name, parameter in options.items()}
    return run


@contextmanager
def reporting_to(folder: Path, message: str) -> Iterator[Progress]:
    """Check that a folder can be written, and report progress."""
    require_writable(folder)
    with reporting(None, command=True) as report:
        report(0.0, message)
        yield report


def print_files(folder: Path, names: Sequence[str]) -> None:
    """Print written files."""
    for name in names:
        typer.echo(f"wrote {folder / name}")
