"""Progress of long commands where there is no terminal."""

import pytest

from sionna_partial.cli.progress import rate_and_rest, show_progress, show_rate


class TestProgress:
    def test_a_line_a_minute(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        now = [100.0]
        monkeypatch.setattr("sionna_partial.cli.progress.monotonic", lambda: now[0])
        with show_progress() as report:
            for now[0], done in ((130.0, 0.1), (161.0, 0.25), (200.0, 0.5), (222.0, 0.75)):
                report(done, f"at {now[0]:g}")
        assert capsys.readouterr().err.splitlines() == ["25% at 161 0:03:03 left", "75% at 222 0:00:41 left"]

    def test_an_error_stands_alone(self, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(ValueError, match="float"), show_progress() as report:
            report(float("half"), "never said")
        assert capsys.readouterr().err == ""


class TestRate:
    @pytest.mark.parametrize(
        ("done", "rest", "elapsed_s", "text"),
        [
            (0, 10, 5.0, ""),
            (10, 20, 30.0, "(20/min, 0:01:00 left)"),
            (3, 5000, 6.0, "(30/min, 2:46:40 left)"),
            (4, 0, 6.0, "(40/min, 0:00:00 left)"),
        ],
    )
    def test_rate_and_rest(self, done: int, rest: int, elapsed_s: float, text: str) -> None:
        assert rate_and_rest(done, rest, elapsed_s) == text

    def test_what_was_there_does_not_count(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        now = 100.0
        monkeypatch.setattr("sionna_partial.cli.progress.monotonic", lambda: now)
        with show_rate("homes") as report:
            report(50, 60, "starting")
            now = 110.0
            report(52, 60, "too soon for another line")
            now = 130.0
            report(55, 60, "too soon too")
            now = 190.0
            report(60, 60, "the end")
        lines = ["50 of 60 homes starting", "60 of 60 homes (6.67/min, 0:00:00 left) the end"]
        assert capsys.readouterr().err.splitlines() == lines
