"""Command line: subcommands from a map to its coverage, and from homes to a predictor."""

import logging
import os
import sys
import warnings
from contextlib import suppress
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import sionna_partial.cli.options as opt
from sionna_partial import __version__
from sionna_partial.cli.learning import dataset, evaluate, train
from sionna_partial.cli.options import OnceCommand, TransmitterCommand
from sionna_partial.cli.planning import calibrate, live, next_views, open_app, place
from sionna_partial.cli.prediction import channels, demo, explore, export_scene, info, network, predict
from sionna_partial.errors import SionnaPartialError, one_line
from sionna_partial.process import end_at_signals, end_process
from sionna_partial.resources import optional_packages


class _ErrorLineGroup(TyperGroup):
    """Reports an error that the user can mend in one line, with exit code 2."""

    def invoke(self, ctx: Any) -> Any:
        """Run the subcommand."""
        try:
            with optional_packages():
                return super().invoke(ctx)
        except SionnaPartialError as error:
            typer.echo(f"error: {opt.in_options(str(error))}", err=True)
        except BrokenPipeError:
            raise
        except OSError as error:
            where = f"'{error.filename}'" if error.filename else "a file, or the output"
            typer.echo(f"error: {where} cannot be used ({error.strerror or error}): check path and disk.", err=True)
        except MemoryError as error:
            typer.echo(f"error: memory ran out ({error}): close other programs, or give a smaller job.", err=True)
        raise typer.Exit(2)


class _WarningLine(logging.Handler):
    """Writes each warning as one line to the current stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record."""
        _warn(record.levelname.lower(), record.getMessage())


def _warn(level: str, message: str) -> None:
    typer.echo(f"{level}: {opt.in_options(one_line(message))}", err=True)


app = typer.Typer(
    cls=_ErrorLineGroup,
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run the command line (entry point `sionna-partial`)."""
    end_at_signals()
    code: object = 0
    try:
        app(prog_name="sionna-partial")
    except SystemExit as end:
        code = end.code
    try:
        if sys.stdout:
            sys.stdout.flush()
    except OSError as error:
        code = code or 2
        with suppress(OSError):
            os.write(2, f"error: the output cannot be written ({error.strerror or error}).\n".encode())
    logging.shutdown()
    end_process(code if isinstance(code, int) else 0 if code is None else 1)  # native libraries may abort at the end


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _prepare(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Predict radio coverage from a robot's partial map."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ["MPLBACKEND"] = "agg"  # pictures are files, whatever the variable was
    logger = logging.getLogger("sionna_partial")
    if not any(isinstance(handler, _WarningLine) for handler in logger.handlers):
        logger.addHandler(_WarningLine(logging.WARNING))
    warnings.showwarning = lambda message, *_, **__: typer.echo(
        f"warning: {opt.in_options(one_line(str(message)))}", err=True
    )


app.command(cls=TransmitterCommand)(predict)
app.command(cls=TransmitterCommand)(channels)
app.command(cls=TransmitterCommand)(network)
app.command("next", cls=TransmitterCommand)(next_views)
app.command(cls=TransmitterCommand)(explore)
app.command(cls=TransmitterCommand)(live)
app.command("app", cls=OnceCommand)(open_app)
for _command in (export_scene, dataset, train, evaluate, calibrate, place, demo, info):
    app.command(cls=OnceCommand)(_command)
