"""Commands run in this process, and the arguments with which they call a function of the package."""

import functools
import inspect
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
import typer
from click.testing import CliRunner, Result

import sionna_partial as sp
from sionna_partial import cli


class Called(Exception):
    """A function was called, with these arguments by name."""


@functools.cache
def _command() -> Any:
    """Build the command line once, which takes longer than to run most of its commands."""
    return typer.main.get_command(cli.app)


def run(*words: object, exit_code: int = 0) -> Result:
    result = CliRunner().invoke(_command(), [str(word) for word in words])
    assert result.exit_code == exit_code, result.output
    return result


def arguments_of(monkeypatch: pytest.MonkeyPatch, functions: str, *words: object) -> dict[str, Any]:
    """Run a command up to the last of some functions; those before return None."""
    *before, last = functions.split()
    signature = inspect.signature(attrgetter(last)(sp))

    def record(*arguments: Any, **options: Any) -> None:
        raise Called(dict(signature.bind(*arguments, **options).arguments))

    with monkeypatch.context() as patch:
        for name in before:
            patch.setattr(f"sionna_partial.{name}", lambda *_, **__: None)
        patch.setattr(f"sionna_partial.{last}", record)
        result = run(*words, exit_code=1)
    assert isinstance(result.exception, Called), result.output
    found: dict[str, Any] = result.exception.args[0]
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in found.items()}
