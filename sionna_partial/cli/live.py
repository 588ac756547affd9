"""The subcommands that stay up: live, which keeps up with a robot, and app, the page in the browser."""

from pathlib import Path
from typing import Annotated, Any

import typer

import sionna_partial as sp
import sionna_partial.cli.options as opt
from sionna_partial.checks import transmitter_names
from sionna_partial.constants import DEFAULT_HEIGHT_M, MAX_COST
from sionna_partial.files import atomic_files, require_writable
from sionna_partial.process import cleaned_up

_POWER_HELP = "Topic of std_msgs/Float32 with received powers, NAME=TOPIC of several transmitters; may be repeated."


def _topics(
    map_topic: Annotated[str, typer.Option(help="Topic of the map.")] = "/map",
    prefix: Annotated[str, typer.Option(help="Beginning of the topics that are published.")] = "/radio",
    robot_frame: Annotated[str, typer.Option(help="Frame of the robot.")] = "base_link",
    power: Annotated[list[str], typer.Option(metavar="TOPIC", help=_POWER_HELP, show_default=False)] = [],  # noqa: B006
    key_values: Annotated[str, typer.Option(help="Topic of diagnostic_msgs/KeyValue: name, power.")] = "",
    publish_unknown: Annotated[
        bool, typer.Option("--publish-unknown", help="Publish predictions for unknown cells, at PREFIX/NAME/unknown.")
    ] = False,
) -> Any:
    from sionna_partial.live.topics import Topics

    parts = [each.rpartition("=") for each in power]
    powers = {topic: name or None for name, _, topic in parts}
    if len(powers) < len(parts):
        raise typer.BadParameter(f"--power {' '.join(power)} has a topic twice: give each topic once.")
    return Topics(map_topic, prefix, robot_frame, powers, key_values, publish_unknown)


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
    options = {"views_every_s": views_every, "max_cost": max_cost}
    return sp.LiveSettings(frame, threshold, spacing, rx_height, tx_power, **options)  # type: ignore[arg-type]


@opt.with_options
def live(
    *,
    tx: Annotated[list[str], typer.Option(metavar="X Y [Z]", help="Transmitter [m]; once for each.")],
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
    model: opt.Settings,
    predictor: opt.PredictorName = "",
) -> None:
    """Keep up with a robot's map: coverage as cost grids for its planner, until Ctrl-C."""
    names = name or (["tx"] if len(tx) == 1 else transmitter_names(len(tx)))
    if len(names) != len(tx) or len({*names}) < len(names):
        raise typer.BadParameter(f"{len(names)} --name for {len(tx)} --tx: give each its own.")
    positions = dict(zip(names, map(opt.parse_position, tx), strict=True))
    last: dict[str, Any] = {}
    robot: Any = None
    if bag is None and rosbridge:
        from sionna_partial.live.topics import Rosbridge

        robot = Rosbridge(rosbridge, topics, positions)
    elif bag is None:
        from sionna_partial.live.topics import Dds

        robot = Dds(topics, positions, domain)

    def publish(answer: Any) -> None:
        if robot:
            robot.publish(answer)
        if hasattr(answer, "cost"):
            last[answer.name] = answer
            kind = "final" if answer.is_final else "coarse"
            typer.echo(f"map {answer.map_number}, {answer.name}: {kind} after {answer.age_s:.1f} s")
        else:
            typer.echo(f"next views: {len(answer.views)}")

    coverage = sp.LiveCoverage(positions, publish, settings, predictor=predictor or None, **model)
    if robot:
        with cleaned_up(getattr(robot, "close", lambda: None)):
            coverage.start()
            typer.echo(f"waiting for {topics.map} of {robot.source}; Ctrl-C ends")
            robot.listen(coverage)
    else:
        assert bag is not None
        _replay(coverage, topics, bag, rate)
        _save(last, out)


def _replay(coverage: Any, topics: Any, bag: Path, rate: float) -> None:
    from sionna_partial.live.topics import Listener, replay

    thread = coverage.start() if rate else None
    replay(Listener(coverage, topics), bag, rate)
    coverage.close()
    if thread:
        thread.join()


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
    from sionna_partial.app.jobs import collected_warnings, logged_warnings
    from sionna_partial.app.server import AppServer

    with collected_warnings() as warnings, logged_warnings():
        partial = None if map_path is None else sp.load_map(map_path)
    server = AppServer(partial, str(map_path or ""), address, port, warnings)
    typer.echo(f"open {server.url}")
    if browser:
        import webbrowser

        webbrowser.open(server.url)
    server.run()
