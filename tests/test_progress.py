"""Progress of long work: in a terminal, in a command without one, and silent elsewhere."""

import io
from contextlib import redirect_stderr
from typing import Any

import pytest

from sionna_partial import display
from sionna_partial.display import counting, reporting
from sionna_partial.errors import SettingsError


class Terminal(io.StringIO):
    """A terminal that keeps what is written."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("WAIT_S", "COMMAND_WAIT_S", "LINE_S"):
        monkeypatch.setattr(display, name, 0.0)


def test_a_callable_is_called() -> None:
    calls: list[Any] = []
    with reporting(lambda *call: calls.append(call)) as report:
        report(0.5, "half")
    with counting(lambda *call: calls.append(call), "homes") as count:
        count(1, 2, "one")
    assert calls == [(0.5, "half"), (1, 2, "one")]


@pytest.mark.parametrize("value", ["yes", 1, 0.5])
def test_other_values_are_refused(value: Any) -> None:
    with pytest.raises(SettingsError, match=r"progress = .* is not allowed: give True, False or a callable"):
        reporting(value).__enter__()


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize("progress", [None, True])
def test_a_bar_in_a_terminal(progress: bool | None) -> None:
    with redirect_stderr(Terminal()) as terminal, reporting(progress) as report:
        report(0.5, "half [of it]")
    assert "100%|" in terminal.getvalue()
    assert "half [of it]" in terminal.getvalue()


@pytest.mark.usefixtures("at_once")
def test_things_are_counted() -> None:
    with redirect_stderr(Terminal()) as terminal, counting(None, "homes") as count:
        count(2, 4, "starting")
        count(4, 4, "the end")
    assert "2 of 4 homes" in terminal.getvalue()
    assert "the end" in terminal.getvalue().rpartition("4 of 4 homes")[2]


def test_short_work_shows_nothing() -> None:
    with redirect_stderr(Terminal()) as terminal, reporting(None) as report:
        report(1.0, "done")
    assert terminal.getvalue() == ""


@pytest.mark.usefixtures("at_once")
@pytest.mark.parametrize(("shown", "terminal"), [(False, Terminal()), (None, io.StringIO())])
def test_false_and_a_call_without_a_terminal_are_silent(shown: bool | None, terminal: io.StringIO) -> None:
    with redirect_stderr(terminal), reporting(shown) as report, counting(shown, "homes") as count:
        report(0.5, "half")
        count(1, 2, "one")
    assert terminal.getvalue() == ""


@pytest.mark.usefixtures("at_once")
def test_a_command_reports_without_a_terminal() -> None:
    with redirect_stderr(io.StringIO()) as log, reporting(None, command=True) as report:
        report(1.0, "the end")
    assert log.getvalue().rstrip().endswith("the end")


@pytest.mark.usefixtures("at_once")
def test_a_bar_vanishes_before_an_error() -> None:
    def fail_half_way() -> None:
        with reporting(None, command=True) as report:
            report(0.5, "half")
            raise ValueError("stop")

    with redirect_stderr(Terminal()) as terminal, pytest.raises(ValueError, match="stop"):
        fail_half_way()
    assert terminal.getvalue().endswith(" \r")
