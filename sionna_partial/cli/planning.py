"""Subcommands calibrate, place, next, live and app."""

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import sionna_partial as sp
import sionna_partial.cli.options as opt
from sionna_partial.checks import transmitter_names
from sionna_partial.constants import CARRIER_FREQUENCY_HZ, DEFAULT_HEIGHT_M, MAX_COST
from sionna_partial.files import CALIBRATED_FILE, atomic_files, require_writable
from sionna_partial.process import cleaned_up
from sionna_partial.settings import Objective, SensorSettings

if TYPE_CHECKING:
    from sionna_partial.calibration.calibration import MaterialCalibration
    from sionna_partial.placement.placement import TransmitterPlacement
    from sionna_partial.placement.several import NetworkPlacement

TABLE_ANGLES_DEG = (0.0, 30.0, 45.0, 60.0)
"""Angles of incidence of the printed losses [degrees]."""

_CSV_HELP = "Columns tx_x,tx_y,tx_z,rx_x,rx_y,rx_z [m], gain_db [dB]."
_OBJECTIVE_HELP = "Mean predicted coverage, or the gain of the worst tenth of the receivers."

_POWER_HELP = "Topic of std_msgs/Float32 with received powers, NAME=TOPIC of several transmitters; may be repeated."
_CONNECTION_HELP = (
    "Topic of wireless_msgs/Connection with powers and frequency, NAME=TOPIC of several transmitters; may be repeated."
)
_TX_HELP = "Transmitter [m]; once for each. By default located by measured powers."
_FREQUENCY_HELP = "Carrier frequency [Hz], or with its unit: 5.2GHz. Default: from --connection."


@opt.with_options
def calibrate(
    *,
    measurements: Annotated[Path, typer.Option(metavar="CSV", help=_CSV_HELP, show_default=False)],
    out: Annotated[
        Path, typer.Option(help="Folder for the calibrated map, the numbers and a picture.", show_default=False)
    ],
    column: opt.Columns = None,
    material: opt.MaterialText = "",
    frequency: opt.Frequency = CARRIER_FREQUENCY_HZ,
    max_depth: opt.MaxDepth = 6,
    diffraction: opt.Diffraction = True,
    through_walls: opt.ThroughWalls = None,
    partial: opt.PartialMap,
) -> None:
    """Find the material of a building from measured path gains.

    The folder --out gets the map with the calibrated material, the numbers as JSON, and a picture. predict takes the
    folder as a map.
    """
    settings = opt.settings_of(frequency, material, max_depth, diffraction, through_walls)
    measured = opt.read_measurements(measurements, column)
    with opt.reporting_to(out, "loading Sionna RT") as report:
        result = sp.calibrate_materials(
            partial,
            measured,
            start=settings["scene_settings"].material if material else None,
            **settings,
            progress=report,
        )
        with atomic_files(out) as folder:
            sp.save_map(result.scene, folder / CALIBRATED_FILE)
            (folder / "calibration.json").write_text(json.dumps(result.record(), indent=1) + "\n", encoding="utf-8")
            sp.plots.plot_calibration(result).savefig(folder / "calibration.png")
    typer.echo(_table(result))
    opt.print_files(out, [CALIBRATED_FILE, "calibration.json", "calibration.png"])


@opt.with_options
def place(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the numbers and a picture.", show_default=False)],
    count: Annotated[int, typer.Option(help="Number of transmitters; several are placed for the coverage.")] = 1,
    goal: Annotated[
        float | None,
        typer.Option(help="Wanted fraction of covered receivers, by the fewest of up to --count transmitters."),
    ] = None,
    objective: Annotated[Objective, typer.Option(help=_OBJECTIVE_HELP)] = "coverage",
    threshold: Annotated[float, typer.Option(help="Path gain above which a receiver is covered [dB].")] = -100.0,
    height: Annotated[float, typer.Option(help="Height of the transmitter [m].")] = DEFAULT_HEIGHT_M,
    rx_height: opt.RxHeight = DEFAULT_HEIGHT_M,
    seed: Annotated[int, typer.Option(help="Seed of the positions that are compared.")] = 0,
    settings: opt.Settings,
    predictor: opt.PredictorName = "",
    partial: opt.PartialMap,
) -> None:
    """Find good positions for one transmitter or several on a partial map.

    The folder --out gets the positions and the search as JSON, and a picture.
    """
    if (count > 1 or goal is not None) and objective != "coverage":
        raise typer.BadParameter(f"--objective {objective} is for one transmitter: leave out --count and --goal.")
    options: dict[str, Any] = {"threshold_db": threshold, "tx_height_m": height, "rx_height_m": rx_height, "seed": seed}
    options |= {"predictor": predictor or None, **settings}
    result: TransmitterPlacement | NetworkPlacement
    with opt.reporting_to(out, "loading the predictor") as report:
        if count == 1 and goal is None:
            result = sp.place_transmitter(partial, objective=objective, **options, progress=report)
            positions_m, figure = [result.position_m], sp.plots.plot_placement(result)
        else:
            result = sp.place_transmitters(partial, count, goal=goal, **options, progress=report)
            positions_m, figure = [*result.positions_m], sp.plots.plot_network_placement(result)
        with atomic_files(out) as folder:
            result.save(folder / "placement.json")
            figure.savefig(folder / "placement.png")
    added: Any = getattr(result, "added", [])
    for (x, y, z), more in itertools.zip_longest(positions_m, added):
        text = f"transmitter at ({x:z.2f}, {y:z.2f}, {z:z.2f}) m"
        typer.echo(text + (f" adds {more:.1%}" if more is not None else ""))
    if goal is not None and result.score < goal:
        typer.echo(f"the goal of {goal:.1%} is not reached: give a larger --count, or more power (a lower --threshold)")
    if objective == "coverage":
        typer.echo(f"{result.score:.1%} of the receivers are predicted above {threshold:g} dB")
    else:
        typer.echo(f"the worst tenth of the receivers is predicted at {result.score:z.1f} dB")
    opt.print_files(out, ["placement.json", "placement.png"])


@opt.with_options
def next_views(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the poses and a picture.", show_default=False)],
    tx: Annotated[
        str,
        typer.Option(metavar="X Y [Z]", help="Transmitter [m]. Default: that of the measurements, or any."),
    ] = "",
    measurements: opt.Measured = None,
    column: opt.Columns = None,
    access_point: opt.AccessPoint = None,
    pixel: opt.Pixel = None,
    goal: Annotated[str, typer.Option(metavar="coverage|state|area", help="What is to become known.")] = "coverage",
    count: Annotated[int, typer.Option(help="Largest number of poses.")] = 5,
    start: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="X Y", help="Where the robot is [m]. Default: amid the free cells.", show_default=False),
    ] = None,
    threshold: Annotated[float, typer.Option(help="Path gain above which a receiver is covered [dB].")] = -100.0,
    field_of_view: opt.FieldOfView = SensorSettings.field_of_view_deg,
    range_m: opt.Range = SensorSettings.range_m,
    settings: opt.Settings,
    predictor: opt.PredictorName = "",
    partial: opt.PartialMap,
) -> None:
    """Rank poses where a robot learns most about the coverage per metre driven.

    The folder --out gets the poses as YAML, as in a geometry_msgs/PoseArray, and a picture.
    """
    position = opt.parse_position(tx) if tx else None
    with opt.reporting_to(out, "predicting"):
        views = sp.next_views(
            partial,
            position,
            opt.read_measurements(measurements, column, position, access_point, pixel),
            goal,
            count,
            start=start,
            threshold_db=threshold,
            sensor=SensorSettings(field_of_view_deg=field_of_view, range_m=range_m),
            predictor=predictor or None,
            **settings,
        )
        with atomic_files(out) as folder:
            views.save(folder / "next_views.yaml")
            sp.plots.plot_next_views(views).savefig(folder / "next_views.png")
    unit = "m2" if goal == "area" else "bit"
    for view in views:
        x, y = view.position_m
        typer.echo(
            f"({x:z.2f}, {y:z.2f}) m, heading {view.heading_deg:z.0f} deg, after {view.path_length_m:.1f} m: "
            f"{view.gain:z.2f} {unit}, {view.gain_per_m:z.2f} {unit}/m"
        )
    if not views:
        typer.echo("nothing unknown can be reached")
    opt.print_files(out, ["next_views.yaml", "next_views.png"])


def _table(result: "MaterialCalibration") -> str:
    numbers = result.record()
    lines = []
    for which, (found, start) in enumerate(zip(result.materials, result.start, strict=True)):
        own = "" if len(result.materials) == 1 else f"[{which}]"
        stds = [float(std[which] if own else std) for std in (result.permittivity_std, result.conductivity_std_s_m)]
        rows = (
            ("permittivity", found.relative_permittivity, stds[0], "", start.relative_permittivity),
            ("conductivity", found.conductivity_s_m, stds[1], " S/m", start.conductivity_s_m),
        )
        for name, value, std, unit, before in rows:
            note = "   CANNOT BE DETERMINED" if f"{name}{own}" in result.undetermined else ""
            lines.append(f"{name + own:<18}{value:.4g} +- {std:.2g}{unit} (start {before:.4g}{unit}){note}")
        losses = zip(*result.reflection_loss_db(TABLE_ANGLES_DEG, which=which), TABLE_ANGLES_DEG, strict=True)
        texts = (f"{loss:z.1f} +- {std:.1f} dB at {angle:g} deg" for loss, std, angle in losses)
        lines.append(f"{'reflection' + own:<18}{', '.join(texts)}")
    left = ", ".join(f"{count} {reason}" for reason, count in result.left_out.items() if count) or "none"
    rmse = numbers["rmse_db"]
    lines.append(f"{'links':<18}{numbers['links_used']} used; left out: {left}")
    lines.append(f"{'traced - measured':<18}{rmse['before']:.2f} dB before, {rmse['after']:.2f} dB after (RMS)")
    return "\n".join([*lines, f"{'noise':<18}{result.noise_db:.1f} dB"])


def _topics(
    map_topic: Annotated[str, typer.Option(help="Topic of the map.")] = "/map",
    prefix: Annotated[str, typer.Option(help="Beginning of the topics that are published.")] = "/radio",
    robot_frame: Annotated[str, typer.Option(help="Frame of the robot.")] = "base_link",
    power: Annotated[list[str], typer.Option(metavar="TOPIC", help=_POWER_HELP, show_default=False)] = [],  # noqa: B006
    key_values: Annotated[str, typer.Option(help="Topic of diagnostic_msgs/KeyValue: name, power.")] = "",
    connection: Annotated[list[str], typer.Option(metavar="TOPIC", help=_CONNECTION_HELP, show_default=False)] = [],  # noqa: B006
    publish_unknown: Annotated[
        bool, typer.Option("--publish-unknown", help="Publish predictions for unknown cells, at PREFIX/NAME/unknown.")
    ] = False,
) -> Any:
    from sionna_partial.apps.live.topics import Topics

    parsed = []
    for option, texts in (("--power", power), ("--connection", connection)):
        parts = [each.rpartition("=") for each in texts]
        parsed.append({topic: name or None for name, _, topic in parts})
        if len(parsed[-1]) < len(parts):
            raise typer.BadParameter(f"{option} {' '.join(texts)} has a topic twice: give each topic once.")
    powers, connections = parsed
    return Topics(map_topic, prefix, robot_frame, powers, key_values, publish_unknown, connections)


def _live_settings(
    frame: Annotated[str, typer.Option(help="Frame of the transmitters. Default: that of the first map.")] = "",
    threshold: Annotated[float, typer.Option(help="Path gain above which a receiver is covered [dB].")] = -100.0,
    spacing: Annotated[float, typer.Option(help="Distance between receivers [m].")] = 0.15,
    rx_height: opt.RxHeight = DEFAULT_HEIGHT_M,
    tx_power: Annotated[float, typer.Option(help="Subtracted from received powers [dBm].")] = 0.0,
    views_every: Annotated[float, typer.Option(help="Time between lists of next views [s]; 0: on request.")] = 0.0,
    max_cost: Annotated[
        int, typer.Option(help="Largest value of a grid [percent]; in nav2, 100 is a wall.")
    ] = MAX_COST,
) -> Any:
    from sionna_partial.apps.live.incoming import LiveSettings

    options = {"views_every_s": views_every, "max_cost": max_cost}
    return LiveSettings(frame, threshold, spacing, rx_height, tx_power, **options)  # type: ignore[arg-type]


def _live_model(
    frequency: Annotated[
        float | None,
        typer.Option(help=_FREQUENCY_HELP, parser=opt.parse_frequency, metavar="HZ", show_default=False),
    ] = None,
    material: opt.MaterialText = "",
    max_depth: opt.MaxDepth = 6,
    diffraction: opt.Diffraction = True,
    through_walls: opt.ThroughWalls = None,
) -> dict[str, Any]:
    known = CARRIER_FREQUENCY_HZ if frequency is None else frequency
    settings = opt.settings_of(known, material, max_depth, diffraction, through_walls)
    return {**settings, "await_frequency": frequency is None}


@opt.with_options
def live(
    *,
    tx: Annotated[list[str], typer.Option(metavar="X Y [Z]", help=_TX_HELP, show_default=False)] = [],  # noqa: B006
    name: Annotated[list[str], typer.Option(help="Name of each transmitter.", show_default=False)] = [],  # noqa: B006
    domain: Annotated[
        int | None, typer.Option(help="DDS domain. Default: ROS_DOMAIN_ID, or 0.", show_default=False)
    ] = None,
    rosbridge: Annotated[str, typer.Option(metavar="URL", help="rosbridge in place of DDS: ws://robot:9090.")] = "",
    bag: Annotated[Path | None, typer.Option(help="A recording in place of a robot.", show_default=False)] = None,
    rate: Annotated[float, typer.Option(min=0.0, help="Its speed; 0 waits for each map's answer.")] = 1.0,
    out: Annotated[Path | None, typer.Option(help="Of a recording: folder for the last grids.")] = None,
    topics: Annotated[Any, _topics],
    settings: Annotated[Any, _live_settings],
    model: Annotated[Any, _live_model],
    predictor: opt.PredictorName = "",
) -> None:
    """Keep up with a robot's map: coverage as cost grids for its planner, until Ctrl-C."""
    positions = _live_positions(tx, name, topics)
    if model["await_frequency"] and not topics.connections:
        raise typer.BadParameter("--frequency is missing: give for example 5.2GHz, or a --connection with it.")
    last: dict[str, Any] = {}
    robot: Any = None
    settings = replace(settings, every_unknown=topics.unknown)
    if bag is None and rosbridge:
        from sionna_partial.apps.live.rosbridge import Rosbridge

        robot = Rosbridge(rosbridge, topics, positions)
    elif bag is None:
        from sionna_partial.apps.live.dds import Dds

        robot = Dds(topics, positions, domain)

    def publish(answer: Any) -> None:
        if robot:
            robot.publish(answer)
        if hasattr(answer, "cost"):
            last[answer.name] = answer
            kind = "final" if answer.is_final else "coarse"
            typer.echo(f"map {answer.map_number}, {answer.name}: {kind} after {answer.age_s:.1f} s")
        elif hasattr(answer, "position_m"):
            x_m, y_m = answer.position_m[:2]
            typer.echo(f"{answer.name}: at ({x_m:.1f}, {y_m:.1f}) m, {answer.area_m2:.1f} m2 hold 90 %")
        else:
            typer.echo(f"next views: {len(answer.views)}")

    from sionna_partial.apps.live.coverage import LiveCoverage

    coverage = LiveCoverage(positions, publish, settings, predictor=predictor or None, **model)
    if robot:
        with cleaned_up(getattr(robot, "close", lambda: None)):
            coverage.start()
            typer.echo(f"waiting for {topics.map} of {robot.source}; Ctrl-C ends")
            robot.listen(coverage)
    else:
        assert bag is not None
        _replay(coverage, topics, bag, rate)
        _save(last, out)


def _live_positions(tx: list[str], names: list[str], topics: Any) -> dict[str, Any]:
    """Return the transmitters by name; None is to be located, and none at all by the access points' own names."""
    if not tx:
        if not (topics.powers or topics.key_values or topics.connections):
            raise typer.BadParameter("--tx is missing: give X Y Z, or --power, --key-values or --connection.")
        return dict.fromkeys(names or ([] if topics.connections and not topics.powers else ["tx"]))
    names = names or (["tx"] if len(tx) == 1 else transmitter_names(len(tx)))
    if len(names) != len(tx) or len({*names}) < len(names):
        raise typer.BadParameter(f"{len(names)} --name for {len(tx)} --tx: give each its own.")
    return dict(zip(names, map(opt.parse_position, tx), strict=True))


def _replay(coverage: Any, topics: Any, bag: Path, rate: float) -> None:
    from sionna_partial.apps.live.topics import Listener, replay

    thread = coverage.start() if rate else None
    replay(Listener(coverage, topics), bag, rate)
    coverage.close()
    if thread:
        thread.join()
    else:
        coverage.run()


def _save(last: dict[str, Any], out: Path | None) -> None:
    if out and last:
        require_writable(out)
        with atomic_files(out) as folder:
            for name, answer in last.items():
                sp.save_coverage(answer.coverage, folder / f"{name}.nc")
        opt.print_files(out, [f"{name}.nc" for name in last])


def open_app(
    map_path: Annotated[
        Path | None, typer.Argument(metavar="[MAP]", help=opt.MAP_HELP + " Default: an example.", show_default=False)
    ] = None,
    address: Annotated[
        str, typer.Option(help="Address to listen at. Only this machine reaches the default.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen at; 0: any free one.")] = 0,
    browser: Annotated[bool, typer.Option(help="Whether the page is opened in a browser.")] = True,
) -> None:
    """Serve a page on which transmitters are dragged over a map, and the coverage follows, until Ctrl-C."""
    from sionna_partial.apps.app.drawing import uploaded_source
    from sionna_partial.apps.app.jobs import collected_warnings, logged_warnings
    from sionna_partial.apps.app.server import AppServer

    partial, source = None, None
    with collected_warnings() as warnings, logged_warnings():
        if map_path is not None and map_path.is_file():
            source = uploaded_source([(str(map_path), map_path.read_bytes())])
        if source is not None and source.is_scaled:
            partial = source.read()
        elif map_path is not None and source is None:
            partial = sp.load_map(map_path)
    server = AppServer(partial, str(map_path or ""), address, port, warnings, source)
    typer.echo(f"open {server.url}")
    if browser:
        import webbrowser

        webbrowser.open(server.url)
    server.run()
