"""Progress of long work: in a terminal, in a command without one, and silent elsewhere."""

import io
from contextlib import redirect_stderr
from typing import Any

import pytest

from sionna_partial.errors import SettingsError
from sionna_partial.progress import WAIT_S, counting, rate_and_rest, reporting


class Terminal(io.StringIO):
    """A terminal that keeps what is written."""

    def isatty(self) -> bool:
        return True


@pytest.fixture
def now(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, which a test sets."""
    now = [100.0]
    monkeypatch.setattr("sionna_partial.progress.monotonic", lambda: now[0])
    return now


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    return Terminal()


class TestCallables:
    def test_a_callable_hears_all_of_it(self) -> None:
        calls: list[Any] = []
        with reporting(lambda *call: calls.append(call)) as report:
            report(0.5, "half")
        with counting(lambda *call: calls.append(call), "homes") as count:
            count(1, 2, "one")
        assert calls == [(0.5, "half"), (1, 2, "one")]

    @pytest.mark.parametrize("value", ["yes", 1, 0.5])
    def test_other_values_are_refused(self, value: Any) -> None:
        with pytest.raises(SettingsError, match=r"progress = .* is not allowed: give True, False or a callable"):
            reporting(value).__enter__()


def fail_half_way() -> None:
    with reporting(None, command=True) as report:
        report(0.5, "half")
        raise ValueError("stop")


class TestTerminal:
    @pytest.mark.parametrize("progress", [None, True])
    def test_a_bar_after_2_s(self, progress: bool | None, now: list[float], terminal: Terminal) -> None:
        with redirect_stderr(terminal), reporting(progress) as report:
            now[0] += WAIT_S - 0.1
            report(0.2, "too soon")
            assert terminal.getvalue() == ""
            now[0] += 2.1
            report(0.5, "half [of it]")
        shown = terminal.getvalue()
        assert "50% half [of it] 0:00:04 left" in shown
        assert "done" in shown

    def test_short_work_shows_nothing(self, terminal: Terminal) -> None:
        with redirect_stderr(terminal), reporting(None) as report:
            report(1.0, "done")
        assert terminal.getvalue() == ""

    def test_false_is_silent(self, now: list[float], terminal: Terminal) -> None:
        with redirect_stderr(terminal), reporting(False) as report, counting(False, "homes") as count:
            now[0] += 60.0
            report(0.5, "half")
            count(1, 2, "one")
        assert terminal.getvalue() == ""

    def test_things_are_counted(self, now: list[float], terminal: Terminal) -> None:
        with redirect_stderr(terminal), counting(None, "homes") as count:
            count(0, 4, "starting")
            now[0] += 6.0
            count(1, 4, "one")
        assert "1 of 4 homes (10/min, 0:00:18 left) one" in terminal.getvalue()

    def test_a_bar_vanishes_before_an_error(self, terminal: Terminal) -> None:
        with redirect_stderr(terminal), pytest.raises(ValueError, match="stop"):
            fail_half_way()
        assert "50% half" in terminal.getvalue()
        assert "done" not in terminal.getvalue()
        assert terminal.getvalue().endswith("\x1b[2K")


class TestWithoutTerminal:
    def test_a_call_is_silent(self, now: list[float], capsys: pytest.CaptureFixture[str]) -> None:
        with reporting(None) as report:
            now[0] += 300.0
            report(0.5, "half")
        assert capsys.readouterr() == ("", "")

    def test_a_command_prints_a_line_a_minute(self, now: list[float], capsys: pytest.CaptureFixture[str]) -> None:
        with reporting(None, command=True) as report:
            for now[0], done in ((130.0, 0.1), (161.0, 0.25), (200.0, 0.5), (222.0, 0.75)):
                report(done, f"at {now[0]:g}")
        assert capsys.readouterr().err.splitlines() == ["25% at 161 0:03:03 left", "75% at 222 0:00:41 left"]

    def test_an_error_stands_alone(self, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(ValueError, match="float"), reporting(None, command=True) as report:
            report(float("half"), "never said")
        assert capsys.readouterr().err == ""

    def test_what_was_there_does_not_count(self, now: list[float], capsys: pytest.CaptureFixture[str]) -> None:
        with counting(None, "homes", command=True) as report:
            report(50, 60, "starting")
            now[0] = 110.0
            report(52, 60, "too soon for another line")
            now[0] = 130.0
            report(55, 60, "too soon too")
            now[0] = 190.0
            report(60, 60, "the end")
        lines = ["50 of 60 homes starting", "60 of 60 homes (6.67/min, 0:00:00 left) the end"]
        assert capsys.readouterr().err.splitlines() == lines


@pytest.mark.parametrize(
    ("done", "rest", "elapsed_s", "text"),
    [
        (0, 10, 5.0, ""),
        (10, 20, 30.0, "(20/min, 0:01:00 left)"),
        (3, 5000, 6.0, "(30/min, 2:46:40 left)"),
        (4, 0, 6.0, "(40/min, 0:00:00 left)"),
    ],
)
def test_rate_and_rest(done: int, rest: int, elapsed_s: float, text: str) -> None:
    assert rate_and_rest(done, rest, elapsed_s) == text
