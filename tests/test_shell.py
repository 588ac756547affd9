"""Progress of long commands where there is no terminal."""

import pytest

from sionna_partial.cli.shell import show_progress


class TestProgress:
    def test_a_line_a_minute(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        now = [100.0]
        monkeypatch.setattr("sionna_partial.cli.shell.monotonic", lambda: now[0])
        with show_progress() as report:
            for now[0], share in ((130.0, 0.1), (161.0, 0.25), (200.0, 0.5), (222.0, 0.75)):
                report(share, f"at {now[0]:g}")
        assert capsys.readouterr().err.splitlines() == ["25% at 161 0:03:03 left", "75% at 222 0:00:41 left"]

    def test_an_error_stands_alone(self, capsys: pytest.CaptureFixture[str]) -> None:
        with pytest.raises(ValueError, match="float"), show_progress() as report:
            report(float("half"), "never said")
        assert capsys.readouterr().err == ""
