"""Surveys, marks and logos in a window of the app: powers of several access points, at pixels of a plan."""

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure
from PIL import Image
from test_app import PARTIAL, Window, open_plan

import sionna_partial as sp
from sionna_partial.apps.app import answer as answer_module
from sionna_partial.apps.app import state
from sionna_partial.apps.app.answer import measured_powers_dbm
from sionna_partial.apps.app.server import _take_upload
from sionna_partial.errors import SettingsError
from sionna_partial.files import unzipped
from sionna_partial.plots.report import plot_report

pytestmark = pytest.mark.usefixtures("few_paths")

BOTH = "x,y,bssid,ssid,rssi\n" + "".join(
    f"{x_m},{y_m},{bssid},home,{rssi}\n"
    for x_m, y_m, bssid, rssi in ((1.5, 2.0, "02:0a", -40), (3.0, 2.5, "02:0a", -50), (1.5, 2.5, "02:0b", -55))
)


@pytest.fixture
def window() -> Iterator[Window]:
    made = Window()
    made.session.maps.open_map(PARTIAL, "room.yaml")
    made.session.settings = replace(made.session.settings, spacing_m=0.5)
    made.put((1.0, 1.0), (3.0, 1.0))
    yield made
    made.session.jobs.close()


def png(columns: int, rows: int) -> bytes:
    content = io.BytesIO()
    Image.new("RGB", (columns, rows), "navy").save(content, "PNG")
    return content.getvalue()


class TestSurveys:
    def test_access_points_are_given_to_transmitters(self, window: Window) -> None:
        session = window.session
        session.chosen = "tx1"
        _take_upload(session, "map", [("survey.csv", BOTH.encode())])
        window.settle()
        assert session.measured is None
        assert session.survey.options == [("", "none"), ("02:0a", "home (02:0a)"), ("02:0b", "home (02:0b)")]
        assert session.warnings == ['survey.csv has 2 access points: choose them in "Access point of the survey".']
        for name, access_point in (("tx1", "02:0a"), ("tx2", "02:0b")):
            session.chosen = name
            session.surveys.assign(access_point)
            assert window.settle() == "Ready."
        assert session.measured.tx.tolist() == [[1.0, 1.0, 1.5]] * 2 + [[3.0, 1.0, 1.5]]
        assert session.measured.gain_db.tolist() == [-40.0, -50.0, -55.0]
        assert window.answer.coverage.attrs["measured_links"] == 3
        assert session.measured_names() == ["tx1", "tx1", "tx2"]
        assert [name for name, _ in measured_powers_dbm(window.answer)] == ["tx1", "tx2"]
        session.surveys.assign("02:0a")  # an access point is at one place
        window.settle()
        assert session.measured.tx.tolist() == [[3.0, 1.0, 1.5]] * 2
        csv = unzipped(session.file("project"), 10**7)["measured.csv"].decode()
        assert csv.splitlines()[:2] == ["tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,gain_db", "3.0,1.0,1.5,1.5,2.0,1.5,-40.0"]
        session.surveys.assign("")
        window.settle()
        assert (session.measured, session.survey.positions_m) == (None, {})
        session.surveys.forget_measurements()
        assert session.survey is None

    def test_transmitters_that_are_named_as_access_points(self, window: Window) -> None:
        window.session.radios.change("tx2", new_name="Attic")
        window.session.surveys.learn(b"x,y,ssid,rssi\n1.5,2.0,attic,-40\n3.0,2.5,cellar,-50\n", "survey.csv")
        window.settle()
        assert window.session.measured.tx.tolist() == [[3.0, 1.0, 1.5]]

    def test_transmitters_of_the_survey_are_added(self, window: Window, monkeypatch: pytest.MonkeyPatch) -> None:
        session, head = window.session, "ap,tx_x,tx_y,tx_z,x,y,rssi\n"
        rows = ("Attic,1.2,1.0,1.5,1.5,2.0,-40\n", "02:0a,1.0,2.5,2.0,3.0,2.5,-50\n", "02:0a,1.0,2.5,2.0,3.0,2.0,-51\n")
        session.surveys.learn((head + "".join(rows)).encode())
        assert window.settle() == "Ready."
        assert session.positions_m == {"tx1": (1.0, 1.0, 1.5), "tx2": (3.0, 1.0, 1.5), "tx3": (1.0, 2.5, 2.0)}
        assert session.measured_names() == ["tx1", "tx3", "tx3"]
        assert session.warnings == ["Transmitters of the survey are added: tx3."]
        session.surveys.learn((head + rows[0]).encode())
        for name in ("tx1", "tx2", "tx3"):
            session.radios.remove(name)
        session.surveys.learn((head + "".join(rows)).encode())
        assert window.settle() == "Ready."
        assert [*session.transmitters] == ["tx1", "Attic"]  # the most measured one first
        session.surveys.learn((head + "ap,9.0,9.0,1.5,1.5,2.0,-40\n").encode())
        assert "none within 0.5 m" in window.settle()
        assert session.jobs.status.is_error
        assert len(session.measured) == 3
        monkeypatch.setattr(state, "MOST_TRANSMITTERS", 3)
        many = [f"a{at},{1.0 + 0.6 * at},2.3,1.5,1.5,2.9,-40\n" for at in range(5)]
        session.surveys.learn((head + "".join(many)).encode())
        window.settle()
        assert len(session.transmitters) == 3
        assert any("are not added" in each for each in session.warnings)

    def test_powers_without_any_transmitter(self) -> None:
        window = Window()
        window.session.maps.open_map(PARTIAL, "room.yaml")
        window.session.surveys.learn(b"x,y,rssi\n1.5,2.0,-40\n")
        assert "there is no transmitter yet" in window.settle()
        window.session.jobs.close()

    def test_powers_at_pixels_of_the_plan(self, window: Window) -> None:
        session = window.session
        points = [{"x": 150, "y": 120, "result": {"rssi": -40}}, {"x": 300, "y": 220, "result": {"rssi": -52}}]
        survey = json.dumps({"img_path": "/home/me/flat.png", "survey_points": points}).encode()
        _take_upload(session, "map", [("survey.json", survey)])
        assert "'survey.json' has powers at pixels of a floor plan: open the plan as a picture" in window.settle()
        assert session.jobs.status.is_error
        open_plan(window)
        session.radios.set(spacing_m=0.5)
        window.put((1.0, 1.0))
        _take_upload(session, "map", [("survey.json", survey)])
        assert window.settle() == "Ready."
        np.testing.assert_allclose(session.measured.rx[:, :2], [(1.5, 2.0), (3.0, 1.0)])  # y of pixels is down

    def test_points_antennas_and_views_are_on_the_png(self, window: Window, monkeypatch: pytest.MonkeyPatch) -> None:
        session, figures = window.session, list[Figure]()
        session.chosen = "tx1"
        session.radios.change("tx1", antenna=sp.Antenna("tr38901", azimuth_deg=90.0))
        session.surveys.learn(b"x,y,rssi\n1.5,2.0,-20\n3.0,2.5,-30\n2.05,1.0,-30\n")
        window.settle()
        monkeypatch.setattr(answer_module, "figure_png", lambda figure: figures.append(figure) or b"")
        session.file("png")
        lines = [line.get_xydata().tolist() for line in figures[0].axes[0].lines]
        assert [[1.5, 2.0], [3.0, 2.5]] in lines
        assert [[2.05, 1.0]] in lines
        assert [[1.0, 1.0], [1.0, 1.0 + 0.06 * 4.2]] in [np.round(line, 6).tolist() for line in lines]
        labels = {text.get_text() for text in figures[0].legends[0].get_texts()}
        assert {"measured", "measured, not used"} <= labels


class TestLogo:
    def test_it_is_on_the_report_and_in_the_project(self, window: Window) -> None:
        session, other = window.session, Window()
        bare = session.file("pdf")
        _take_upload(session, "logo", [("acme.png", png(300, 100))])
        assert session.file("pdf") == session.file("pdf") != bare
        other.session.maps.upload_map([("mine.zip", session.file("project"))])
        other.settle()
        assert other.session.logo == session.logo == ("acme.png", png(300, 100))
        _take_upload(session, "logo", [("acme.txt", b"acme")])
        assert "give a PNG or JPEG of up to 1,000,000 bytes" in session.jobs.status.message
        assert session.logo == ("acme.png", png(300, 100))
        session.take_logo(b"", "")
        assert session.file("pdf") == bare
        other.session.jobs.close()

    def test_it_is_beside_the_title(self, several: xr.Dataset, tmp_path: Path) -> None:
        (tmp_path / "acme.png").write_bytes(png(300, 100))
        levels: dict[str, Any] = {"eirp_dbm": 23.0, "threshold_dbm": -67.0}
        figure = plot_report(several, **levels, heading=("a" * 80,), logo=tmp_path / "acme.png")
        figure.draw_without_rendering()
        logo = next(axis for axis in figure.axes if axis.images and axis.images[0].get_array().shape == (100, 300, 4))
        box, title = logo.get_window_extent(), figure._suptitle.get_window_extent()  # type: ignore[attr-defined]
        assert title.x1 < box.x0
        assert box.width / box.height == pytest.approx(3.0)

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            (b"GIF89a", r"logo of 6 bytes is damaged or of another kind: give a PNG or JPEG of up to 1,000,000 bytes"),
            (b"\x89PNG" + bytes(1_000_000), r"logo of 1,000,004 bytes is not allowed: give a PNG"),
            (png(8000, 4000), r"logo of [\d,]+ bytes has 8,000 x 4,000 pixels: give a PNG or JPEG"),
            ("none.png", r"logo = 'none.png' cannot be read \(No such file or directory\)"),
        ],
    )
    def test_refused(self, several: xr.Dataset, content: bytes | str, message: str) -> None:
        with pytest.raises(SettingsError, match=message):
            plot_report(several, eirp_dbm=23.0, threshold_dbm=-67.0, logo=content)

    def test_one_unnamed_transmitter_and_wrong_powers(self, coverage: xr.Dataset, several: xr.Dataset) -> None:
        figure = plot_report(coverage, eirp_dbm=23.0, threshold_dbm=-67.0)
        assert "tx at (0.60, 3.60, 1.50) m, 23 dBm" in figure.axes[-1].texts[0].get_text()
        with pytest.raises(SettingsError, match=r"eirp_dbm = \[1, 2, 3\] is not allowed: give one power, or 2\."):
            plot_report(several, eirp_dbm=[1, 2, 3], threshold_dbm=-67.0)


def test_one_inside_and_one_outside_of_a_complete_map() -> None:
    """A map is complete for the transmitter that nothing unknown can reach, and not for the other one."""
    partial = sp.map_from_array([[1, 1, 1, 1, 2, 2], [1, 0, 0, 1, 2, 2], [1, 0, 0, 1, 2, 2], [1, 1, 1, 1, 2, 2]], 1.0)
    tx_m = {"inside": (1.5, 1.5, 1.5), "outside": (5.5, 1.5, 1.5)}
    alone = [sp.predict_map(partial, each_m, spacing_m=0.5).attrs for each_m in tx_m.values()]
    assert [each["map_complete"] for each in alone] == [1, 0]
    coverage = sp.predict_map(partial, tx_m, spacing_m=0.5)
    for name in ("map_complete", "predictor", "predictor_sha256"):
        assert coverage.attrs[name] == alone[1][name]
    figure = plot_report(coverage, eirp_dbm=23.0, threshold_dbm=-67.0)
    assert "a distribution learned from other buildings" in figure.axes[-1].texts[0].get_text()
