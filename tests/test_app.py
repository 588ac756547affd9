"""The app: what a window computes and in which order, what is sent to it, who may open it, the page in a browser."""

import base64
import io
import itertools
import json
import math
import os
import re
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import replace
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
import pytest
from bokeh.document import Document
from browser import CHROMIUM, Tab, chromium
from PIL import Image
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin

import sionna_partial as sp
from sionna_partial.apps.app import answer as answer_module
from sionna_partial.apps.app import planning, predicting
from sionna_partial.apps.app.answer import LEVELS, Answer, View
from sionna_partial.apps.app.drawing import Stroke
from sionna_partial.apps.app.files import FILES, stored_map
from sionna_partial.apps.app.jobs import Status
from sionna_partial.apps.app.page import Page
from sionna_partial.apps.app.picture import Picture
from sionna_partial.apps.app.radio import OTHER_CHANNELS, Transmitter
from sionna_partial.apps.app.server import AppServer
from sionna_partial.apps.app.session import Session
from sionna_partial.errors import MapError, PositionError, SettingsError
from sionna_partial.files import unzipped, zipped
from sionna_partial.maps.grid import cell_centres_m
from sionna_partial.plots.report import plot_report

pytestmark = pytest.mark.usefixtures("few_paths")

ROOM = np.pad(np.zeros((30, 40), int), 1, constant_values=1)
ROOM[1:20, 20] = 1
PARTIAL = sp.map_from_array(ROOM, 0.1)


class Window:
    def __init__(self) -> None:
        self.waiting: list[Callable[[], None]] = []
        self.seen: list[tuple[bool, tuple[str, ...]]] = []
        self.session = Session(self._later, self._look)

    def _later(self, function: Callable[[], None]) -> None:
        self.waiting.append(function)

    def _look(self) -> None:
        answer = self.session.answer
        if answer is not None:
            now = answer.is_final, tuple(answer.coverage["tx"].to_numpy())
            self.seen += [now] if self.seen[-1:] != [now] else []

    @property
    def answer(self) -> Answer:
        assert self.session.answer is not None
        return self.session.answer

    def put(self, *places_m: tuple[float, float]) -> str:
        self.session.radios.put([("", x_m, y_m) for x_m, y_m in places_m])
        return self.settle()

    def settle(self) -> str:
        end = time.monotonic() + 600.0
        while self.session.jobs.status.fraction is not None and time.monotonic() < end:
            while self.waiting:
                self.waiting.pop(0)()
            time.sleep(0.005)
        return self.session.jobs.status.message


@pytest.fixture
def window() -> Iterator[Window]:
    made = Window()
    made.session.maps.open_map(PARTIAL, "room.yaml")
    made.session.settings = replace(made.session.settings, spacing_m=0.5)
    yield made
    made.session.jobs.close()


class TestJobs:
    def test_coarse_then_fine(self, window: Window) -> None:
        window.session.radios.put([("", 1.0, 1.0)])
        with pytest.raises(SettingsError, match="no coverage yet"):
            window.session.file("nc")
        assert window.settle() == "Ready."
        assert window.seen == [(False, ("tx1",)), (True, ("tx1",))]

    def test_what_an_older_job_has_found_is_dropped(self, window: Window) -> None:
        window.session.radios.put([("", 1.0, 1.0)])
        while not window.waiting or window.session.jobs.status.fraction is None:
            time.sleep(0.01)
        window.session.radios.remove("tx1")
        window.settle()
        for late in window.waiting:
            late()
        assert window.session.answer is None
        assert "Click on the map" in window.session.jobs.status.message

    def test_cancel_ends_a_job_and_its_thread(self, window: Window) -> None:
        running, ended = threading.Event(), threading.Event()

        def work(report: Any) -> Iterator[Callable[[], None]]:
            try:
                while True:
                    running.set()
                    report(0.5, "working")
            finally:
                ended.set()
            yield lambda: None

        window.session.jobs.begin(work)
        assert running.wait(60)
        window.session.jobs.cancel()
        assert ended.wait(60)
        assert window.session.jobs.status.message == "Cancelled."
        assert window.put((1.0, 1.0)) == "Ready."

    def test_searches_take_turns_with_other_windows(self, window: Window, monkeypatch: pytest.MonkeyPatch) -> None:
        other, ended, steps, search = Window(), threading.Event(), list[str](), planning.place_transmitter

        def counted(*given: Any, progress: Any, **named: Any) -> Any:
            def report(fraction: float, message: str) -> None:
                steps.append("search")
                progress(fraction, message)

            return search(*given, progress=report, **named)

        def endless(report: Any) -> Iterator[Callable[[], None]]:
            while not ended.is_set():
                report(0.5, "working")
                steps.append("other")
            yield lambda: None

        monkeypatch.setattr(planning, "place_transmitter", counted)
        other.session.jobs.begin(endless)
        window.session.searches.place()
        assert window.settle() == "Ready."
        ended.set()
        assert other.settle() == "Ready."
        other.session.jobs.close()
        during = steps[steps.index("search") : len(steps) - steps[::-1].index("search")]
        assert during.count("search") > 4
        assert ("search", "search") not in {*itertools.pairwise(during)}

    def test_a_drag_keeps_the_model_and_the_warning_of_the_predictor(
        self, window: Window, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made: list[Any] = []
        monkeypatch.setattr(
            predicting, "LinkModel", lambda *given, **named: made.append(sp.LinkModel(*given, **named)) or made[-1]
        )
        unseen = ROOM.copy()
        unseen[:, 30:] = 2
        window.session.maps.open_map(sp.map_from_array(unseen, 0.1), "unseen.yaml")
        window.session.radios.set(frequency_hz=60e9)
        for x_m in (1.0, 1.5):
            window.session.radios.put([("tx1" if made else "", x_m, 1.0)])
            assert window.settle() == "Ready."
            (warning,) = window.session.warnings
            assert "at 28 GHz, and is used at 60 GHz" in warning
        assert len(made) == 1
        window.session.radios.set(frequency_hz=28e9)
        window.settle()
        assert (len(made), window.session.warnings) == (2, [])


class TestTransmitters:
    def test_name_height_and_power(self, window: Window) -> None:
        window.session.radios.put([("", 1.0, 1.0)])
        window.session.radios.change("tx1", new_name="door", z_m=2.0, eirp_dbm=30.0)
        window.session.radios.put([("door", 1.5, 1.0)])
        assert window.session.transmitters == {"door": Transmitter(1.5, 1.0, 2.0, 30.0)}
        window.session.radios.put([("door", 1.5, 1.0), ("", 3.0, 1.0)])
        for name in ("", "a b", "../x", "tx1", "<b>"):
            with pytest.raises(SettingsError, match="name = "):
                window.session.radios.change("door", new_name=name)
        with pytest.raises(PositionError, match="not between floor and ceiling"):
            window.session.radios.change("door", z_m=9.0)
        window.settle()
        assert window.session.transmitters["door"].z_m == 2.0
        window.session.maps.open_map(replace(PARTIAL, wall_height_m=1.2), "low.yaml")
        assert window.put((1.0, 1.0)) == "Ready."
        assert window.session.transmitters["tx1"].z_m == window.session.settings.rx_height_m == 0.6

    def test_one_in_a_wall_or_outside_moves_to_the_nearest_free_cell(self, window: Window) -> None:
        session = window.session
        session.radios.put([("", 1.0, 1.0), ("", 3.0, 1.0)])
        for x_m, free in ((2.02, (1.95, 1.05)), (99.0, (4.05, 1.05))):
            session.radios.put([("tx1", 1.0, 1.0), ("tx2", x_m, 1.02)])
            assert window.settle() == "Ready."
            assert [each.position_m[:2] for each in session.transmitters.values()] == [(1.0, 1.0), free]
            where = f"({free[0]:g}, {free[1]:g}) is the nearest free cell."
            assert session.warnings == [f"tx2 cannot be at ({x_m:g}, 1.02): {where}"]
            assert [*window.answer.coverage["tx"].to_numpy()] == ["tx1", "tx2"]
        session.radios.put([("tx1", 1.0, 1.2), ("tx2", *free)])
        assert (session.warnings, session.chosen) == ([], "tx1")
        session.radios.remove("tx1")
        assert session.chosen == "tx2"
        window.settle()


def test_it_fills_the_fields_of_all_transmitters_present_and_new(window: Window) -> None:
    session = window.session
    session.radios.put([("", 1.0, 1.0)])
    assert session.settings.preset == "Wi-Fi 5 GHz"
    session.radios.use_preset("5G, 28 GHz")
    assert session.settings.text(PARTIAL) == "5G, 28 GHz, opaque walls"
    session.radios.use_preset("Wi-Fi 5 GHz")
    assert session.settings.text(PARTIAL) == "Wi-Fi 5 GHz, walls of unknown material"
    session.radios.put([("tx1", 1.0, 1.0), ("", 3.0, 1.0)])
    assert window.settle() == "Ready."
    assert [each.eirp_dbm for each in session.transmitters.values()] == [23.0, 23.0]
    assert (session.settings.frequency_hz, session.settings.threshold_dbm) == (5.21e9, -67.0)
    assert session.settings.preset == "Wi-Fi 5 GHz"
    scales = [window.answer.scale(name, "tx1", -67.0) for name in LEVELS]
    assert [scale.ticks[3] for scale in scales if scale] == [-67.0, -90.0, 21.0]
    session.radios.set(bandwidth_hz=40e6)
    assert (session.settings.preset, session.settings.channels) == ("", OTHER_CHANNELS)


def test_layers_and_scales_of_two_transmitters(window: Window) -> None:
    window.session.radios.put([("", 1.0, 1.0), ("", 3.0, 1.0)])
    window.session.radios.change("tx2", new_name="hall", eirp_dbm=40.0)
    window.settle()
    answer = window.answer
    each = [answer.layers_of(name, -60.0)["p_above"].to_numpy() for name in ("tx1", "hall")]
    np.testing.assert_array_equal(answer.layers_of("", -60.0)["p_above"], np.fmax(*each))
    best = answer.layers_of("", -60.0)
    one, two = (answer.layers_of(name, -60.0) for name in ("tx1", "hall"))
    powers = [each["power_mean_dbm"].to_numpy() for each in (one, two)]
    np.testing.assert_array_equal(best["power_mean_dbm"], np.where(powers[1] > powers[0], powers[1], powers[0]))
    above = answer.coverage.isel(tx=1).radio.probability_above(-100.0)
    np.testing.assert_allclose(two["p_above"], above, atol=1e-6)
    assert np.isfinite(best["sinr_mean_db"].to_numpy()[best["valid"].to_numpy()]).all()
    picture = Picture()
    picture.show_answer(answer, View(), -67.0)
    power, server = (picture.parts[name][1] for name in ("power_mean_dbm", "best_server"))
    assert power.ticker.ticks == [-97.0, -87.0, -77.0, -67.0, -57.0, -47.0, -37.0, -27.0]
    assert (power.color_mapper.low, power.color_mapper.high, len(power.color_mapper.palette)) == (-97.0, -27.0, 14)
    assert server.major_label_overrides == {0: "tx1", 1: "hall"}
    assert (len(server.color_mapper.palette), server.color_mapper.high) == (2, 1.5)
    drawn = {name: column[0] for name, column in picture.values.data.items()}
    levels = drawn["power_mean_dbm"]
    row, column = np.unravel_index(np.nanargmax(levels), levels.shape)
    x_m = drawn["x"] + (column + 0.5) / levels.shape[1] * drawn["dw"]
    y_m = drawn["y"] + (row + 0.5) / levels.shape[0] * drawn["dh"]
    assert math.dist((x_m, y_m), (3.0, 1.0)) < 0.5


def test_rates_of_one_and_of_interfering_transmitters(window: Window) -> None:
    session = window.session
    window.put((1.0, 1.0))
    alone = window.answer.layers_of("tx1", -67.0)["rate_mbit_s"]
    assert float(alone.max()) == pytest.approx(600.5, abs=0.1)  # MCS 11 at 80 MHz
    session.radios.put([("tx1", 1.0, 1.0), ("", 3.0, 1.0)])
    window.settle()
    assert float(window.answer.layers_of("", -67.0)["rate_mbit_s"].mean()) < 0.9 * float(alone.mean())
    scale = window.answer.scale("rate_mbit_s", "", -67.0)
    assert scale is not None
    assert (scale.title, scale.names[-1]) == ("Mbit/s; wifi6, one spatial stream", "600")
    session.look(layer="rate_mbit_s")
    session.radios.set(bandwidth_hz=321e6)  # no standard has it
    assert (session.shown_view.layer, window.settle()) == ("p_above", "Ready.")


def test_rooms_are_listed_with_their_coverage(window: Window) -> None:
    room = np.where(ROOM == 0, 1 + (np.arange(ROOM.shape[1]) > 20), 0)
    window.session.maps.open_map(replace(PARTIAL, room=room.astype(np.uint8), room_names=("west", "<east>")), "rooms")
    window.session.radios.set(material="metal", threshold_dbm=-20.0)
    window.put((1.0, 1.0))
    page = Page(Document(), "/files/key")
    page.session.partial, page.session.jobs.answer = window.session.partial, window.answer
    page.session.settings = window.session.settings
    page.show()
    assert re.search(r"Rooms, the least covered first: &lt;east&gt; \d+%, west \d+%\.", page.summary.text)
    text = plot_report(window.answer.coverage, eirp_dbm=23.0, threshold_dbm=-20.0).axes[-1].texts[0].get_text()
    assert re.search(r"Rooms above -20 dBm, the least covered first: <east> \d+%, west \d+%", text)
    page.session.jobs.close()


def test_kinds_of_access_points_keep_limits_and_weak_clients_decide(window: Window) -> None:
    session = window.session
    session.radios.put([("", 1.0, 1.0)])
    session.radios.change("tx1", model="ceiling access point")
    assert session.transmitters["tx1"].eirp_dbm == 23.0  # the limit of Europe
    session.radios.set(region="FCC")
    assert session.transmitters["tx1"].eirp_dbm == 30.5
    session.radios.set(both_ways=True, client_dbm=10.0)
    assert window.settle() == "Ready."
    assert window.answer.eirp_dbm.tolist() == [15.5]  # the client, and the antenna that hears it
    assert "client_dbm=[15.5]" in session.python()
    session.radios.change("tx1", eirp_dbm=12.0)
    assert (session.transmitters["tx1"].model, session.transmitters["tx1"].eirp_dbm) == ("", 12.0)
    with pytest.raises(SettingsError, match="model = 'toaster'"):
        session.radios.change("tx1", model="toaster")


def test_several_are_placed_for_a_goal_and_get_channels(window: Window) -> None:
    session = window.session
    session.radios.use_preset("5G, 28 GHz")
    session.radios.put([("", 1.0, 1.0)])
    session.radios.set(threshold_dbm=-36.0)
    with pytest.raises(SettingsError, match="two or more transmitters"):
        session.searches.plan_channels()
    session.searches.place_several(1.0, 2)
    assert window.settle() == "Ready."
    assert [*session.transmitters] == ["tx1", "tx2"]
    assert re.match(r"Expected covered floor \d+%; each adds: tx1 \d+%, tx2 \d+%\.", session.warnings[0])
    session.searches.plan_channels()
    assert window.settle() == "Ready."
    assert {each.channel for each in session.transmitters.values()} == {"1", "2"}
    assert window.answer.network["channel"].values.tolist() == ["1", "2"]
    assert "channels={'tx1': '1', 'tx2': '2'}" in session.python()


def test_layers_of_a_drawing_have_materials(window: Window, tmp_path: Path) -> None:
    session, drawing = window.session, ezdxf.new(units=6)
    for layer, ends in (("A-WALL", [(0, 0), (4, 0), (4, 3), (0, 3), (0, 0)]), ("I-WALL", [(2, 0), (2, 2)])):
        drawing.modelspace().add_lwpolyline(ends, dxfattribs={"layer": layer})
    drawing.saveas(tmp_path / "flat.dxf")
    content = (tmp_path / "flat.dxf").read_bytes()
    session.maps.upload_map([("flat.dxf", content)])
    window.settle()
    assert {each.name for each in session.partial.import_source.used} == {"A-WALL", "I-WALL"}
    session.radios.put([("", 1.0, 1.0)])
    session.maps.change_source(materials={"I-WALL": "brick"})
    assert window.settle() == "Ready."
    assert session.partial == sp.load_map(tmp_path / "flat.dxf", layer_materials={"I-WALL": "brick"})
    assert [*session.transmitters] == ["tx1"]
    assert "sp.load_map('flat.dxf', layer_materials={'I-WALL': 'brick'})" in session.python()
    session.look(layer="power_mean_dbm")
    content = session.file("project")
    session.maps.open_map(PARTIAL, "room.yaml")
    session.maps.upload_map([("mine.zip", content)])
    window.settle()
    assert session.source.materials == {"I-WALL": "brick"}
    assert session.view == View("power_mean_dbm")
    session.maps.change_source(materials={})
    window.settle()
    assert session.partial.wall_material is None


def test_a_plan_keeps_shade_strokes_and_view_in_a_project(window: Window) -> None:
    session, other = window.session, Window()
    open_plan(window)
    session.maps.change_source(threshold=190)
    window.settle()
    session.maps.draw(Stroke("free", ((3.05, 0.5), (3.05, 1.0)), 0.3))
    session.look(outline="power_mean_dbm")
    content, after = session.file("project"), other.session
    after.maps.upload_map([("mine.zip", content)])
    other.settle()
    assert after.plan is not None
    assert (after.plan.threshold, after.plan.pixel_m, after.strokes) == (190, 0.01, session.strokes)
    assert (after.partial, after.view) == (session.partial, View(outline="power_mean_dbm"))
    assert after.file("project") == content
    after.maps.undo()
    assert after.partial.state_at(np.array([[3.05, 0.7]])).tolist() == [1]
    after.jobs.close()


def test_the_png_is_the_picture_of_the_page(window: Window, monkeypatch: pytest.MonkeyPatch) -> None:
    session = window.session
    session.radios.put([("", 1.0, 1.0), ("", 3.0, 1.0)])
    session.maps.draw(Stroke("brush", ((2.05, 0.5), (2.05, 1.5)), 0.4, "concrete"))
    session.radios.change("tx2", eirp_dbm=-30.0)
    session.radios.set(threshold_dbm=-45.0)
    window.settle()
    drawn: list[Any] = []
    monkeypatch.setattr(answer_module, "figure_png", lambda figure: drawn.append(figure) or b"")
    for view in (View(), View("power_mean_dbm", "tx2", outline="power_mean_dbm"), View("best_server", outline="")):
        session.view = view
        session.file("png")
    any_of, second, servers = drawn
    assert [figure.axes[0].get_title() for figure in drawn] == [
        "P(power > -45 dBm), any transmitter",
        "Mean received power, tx2",
        "Strongest transmitter",
    ]
    assert all(
        "room.yaml\nWi-Fi 5 GHz, walls of concrete and unknown material" in each.get_suptitle() for each in drawn
    )
    labels = [{text.get_text() for text in figure.legends[0].get_texts()} for figure in drawn]
    assert {"concrete", "wall", "transmitter", "mean below -45 dBm"} <= labels[1]
    assert not {text for text in labels[2] if "dBm" in text}
    (bar,) = second.axes[1:]
    assert bar.get_ylabel() == "dBm; colours break at -45"
    assert [text.get_text() for text in servers.axes[1].get_yticklabels()] == ["tx1", "tx2"]
    covered = np.fmax(*(window.answer.layers_of(name, -45.0)["p_above"].to_numpy() for name in ("tx1", "tx2")))
    assert np.nanmax(np.abs(np.unique(any_of.axes[0].images[0].get_array()) - np.unique(covered[covered >= 0]))) == 0


def test_the_page_shows_answers_and_takes_values(window: Window) -> None:
    window.put((1.0, 1.0))
    page = Page(Document(), "/files/key")
    session = page.session
    session.maps.open_map(PARTIAL, "room.yaml")
    session.radios.set(material="brick", threshold_dbm=-67.0)
    session.jobs.answer = replace(
        window.answer, coverage=window.answer.coverage.assign_attrs(wall_material="brick .69")
    )
    session.jobs.status = Status("Ready.")
    page.show()
    assert "Ready. Probability of wall materials: brick .69." in page.message.text
    assert (page.material.value, page.threshold.value, page.preset.value) == ("brick", -67.0, "Wi-Fi 5 GHz")
    assert page.links.text.count("<a ") == len(FILES)
    session.radios.put([("", 1.0, 1.0)])
    page.show()
    page.transmitters.fields["x_m"].set_from_json("value_throttled", 3.0)
    page.transmitters.pattern.value = "tr38901"
    page.transmitters.aims["azimuth_deg"].set_from_json("value_throttled", 90.0)
    changed = Transmitter(3.0, 1.0, antenna=sp.Antenna("tr38901", azimuth_deg=90.0))
    assert session.transmitters == {"tx1": changed}
    session.jobs.close()


def test_prediction_meets_the_truth(window: Window) -> None:
    with pytest.raises(SettingsError, match="examples alone"):
        window.session.maps.explore_more()
    window.session.radios.use_preset("5G, 28 GHz")
    window.session.maps.open_example("apartment")
    window.settle()
    session = window.session
    assert (session.steps, [*session.transmitters]) == (100, ["tx1"])
    wall_m = cell_centres_m(session.partial, np.argwhere(session.partial.state == 1)[:1])[0]
    session.radios.set(spacing_m=0.6)
    session.maps.draw(Stroke("brush", ((float(wall_m[0]), float(wall_m[1])),), 0.3, "metal"))
    session.maps.explore_more(400)
    window.settle()
    assert session.steps == 500
    assert session.partial.wall_materials == (sp.Material.named("metal"),)
    found = window.answer.agreement()
    assert found[0] > 0.9
    session.searches.find_views()
    window.settle()
    assert session.views is not None


class TestFiles:
    def test_each_kind(self, window: Window) -> None:
        window.put((1.0, 1.0))
        starts = b"\x89PNG", b"<!doctype html", b"\x89HDF", b"II*", b"PK", b"%PDF", b"PK"
        for kind, start in zip(FILES, starts, strict=True):
            content = window.session.file(kind)
            assert content.startswith(start)
            assert content == window.session.file(kind)
        costs = unzipped(window.session.file("yaml"), 10**7)
        assert [*costs] == ["coverage.pgm", "coverage.yaml"]
        assert costs["coverage.pgm"].startswith(b"P5\n%d %d\n" % PARTIAL.shape[::-1])  # the cells of the map

    def test_measurements_are_counted_kept_dropped_and_forgotten(self, window: Window) -> None:
        session = window.session
        session.radios.put([("", 1.0, 1.0)])
        session.surveys.learn(b"x,y,rssi\n1.5,2.0,-20\n3.0,2.5,-30\n2.05,1.0,-30\n")
        assert window.settle() == "Ready."
        assert "measured.csv" in session.python()
        points_m, used = session.measured_points()
        assert (len(points_m), used.tolist()) == (3, [True, True, False])
        unused, offset = session.warnings
        assert unused.startswith("1 of 3 measurements are not used")
        assert "taken for an offset" in offset
        before = session.measured, session.answer
        for csv, message in (
            (b"x,y,rssi\n2.05,1.0,-60\n", "are in walls"),
            (b"x,y,rssi\n70,1,-60\n", "is outside the map"),
            (b"\xff\x00", "measured.csv"),
        ):
            session.surveys.learn(csv)
            assert message in window.settle()
            assert session.jobs.status.is_error
            assert (session.measured, session.answer, session.warnings) == (*before, [unused, offset])
        session.radios.put([("tx1", 3.0, 1.0)])
        window.settle()
        assert session.measured is None
        assert "no transmitter is within" in session.warnings[0]
        session.measured = sp.Measurements((3.0, 1.0, 1.5), [(2.05, 1.0, 1.5)], [-60.0])
        session.jobs.predict()
        assert window.settle() == "Ready."
        assert session.measured is None
        assert "are in walls" in session.warnings[0]
        session.surveys.learn(b"x,y,rssi\n1.5,2.0,-60\n")
        window.settle()
        session.surveys.forget_measurements()
        window.settle()
        assert "measured_links" not in window.answer.coverage.attrs
        assert (len(session.measured_points()[0]), session.warnings) == (0, [])


def uploaded(tmp_path: Path) -> list[tuple[str, bytes]]:
    sp.save_map(PARTIAL, tmp_path / "room.yaml")
    return [(name, (tmp_path / name).read_bytes()) for name in ("room.yaml", "room.pgm")]


class TestUploads:
    def test_ros_map_under_names_of_ours(self, window: Window, tmp_path: Path) -> None:
        (sheet, text), (image, pixels) = uploaded(tmp_path)
        files = [("../../etc/" + sheet, text), ("C:\\" + image, pixels)]
        (tmp_path / "in").mkdir()
        stored_map(files, tmp_path / "in")
        assert sorted(path.name for path in (tmp_path / "in").iterdir()) == ["map.pgm", "map.yaml"]
        for given in (files, [("room.zip", zipped(dict(files)))]):
            window.session.maps.upload_map(given)
            window.settle()
            assert window.session.partial == PARTIAL

    def test_other_files_are_refused(self, tmp_path: Path) -> None:
        for names, message in (
            ("map.exe", "cannot be read"),
            ("a.yaml b.yml", "cannot be read"),
            ("a.pgm b.png c.yaml", "cannot be read"),
            ("a.zip", "zip cannot be read"),
            ("room.yaml", "room.yaml' alone is not a map: choose the YAML and the image"),
        ):
            with pytest.raises(MapError, match=message):
                stored_map([(name, b"") for name in names.split()], tmp_path)
        assert not [*tmp_path.iterdir()]

    def test_damaged_zip(self, tmp_path: Path) -> None:
        content = zipped(dict(uploaded(tmp_path)))
        (tmp_path / "in").mkdir()
        for at in range(len(content)):
            damaged = content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]
            with suppress(MapError):
                stored_map([("room.zip", damaged)], tmp_path / "in")

    def test_warnings_of_a_reader_stay_with_the_map(self, window: Window, tmp_path: Path) -> None:
        (sheet, text), (image, pixels) = uploaded(tmp_path)
        header, grey = pixels[: -PARTIAL.state.size], bytearray(pixels[-PARTIAL.state.size :])
        grey[:600] = bytes([205]) * 600
        text = re.sub(rb"free_thresh: .*", b"free_thresh: 0.25", text)
        for _ in range(2):  # Python shows the same warning of a line once
            window.session.maps.upload_map([(sheet, text), (image, header + grey)])
            window.settle()
            assert "205" in window.session.warnings[0]
        window.put((1.0, 1.0))
        assert "205" in window.session.warnings[0]
        window.session.maps.open_map(PARTIAL, "room.yaml")
        assert window.session.warnings == []

    def test_damaged_files_and_images_of_the_server_change_nothing(self, window: Window, tmp_path: Path) -> None:
        (_, text), _ = uploaded(tmp_path)
        white = io.BytesIO()
        Image.new("L", (9, 9), 255).save(white, "PNG")
        for name, content, message in (
            ("a.yaml", text.replace(b"room.pgm", str(tmp_path / "room.pgm").encode()), ""),
            ("a.npz", b"PK\x03\x04 nothing", ""),
            ("white.png", white.getvalue(), "one shade alone"),
        ):
            window.session.maps.upload_map([(name, content)])
            assert message in window.settle()
            assert window.session.jobs.status.is_error
            assert window.session.partial is PARTIAL


def picture() -> bytes:
    """A plan of `ROOM`, 10 pixels a cell, with a pale line across it."""
    shade = np.flipud(np.where(ROOM == 1, 20, 250)).repeat(10, axis=0).repeat(10, axis=1).astype(np.uint8)
    shade[:, 300:310] = np.minimum(shade[:, 300:310], 180)
    content = io.BytesIO()
    Image.fromarray(shade).save(content, "PNG")
    return content.getvalue()


def open_plan(window: Window) -> None:
    """Open `picture`, with the length of its lower wall."""
    window.session.maps.upload_map([("flat.png", picture())])
    window.settle()
    window.session.maps.measure([(0.0, 5.0), (420.0, 5.0)], 4.2)
    window.settle()


class TestDrawing:
    def test_a_plan_is_shown_above_its_coverage(self, window: Window, monkeypatch: pytest.MonkeyPatch) -> None:
        session, shown, figures = window.session, Picture(), list[Any]()
        open_plan(window)
        session.radios.set(spacing_m=0.5)
        window.put((1.0, 1.0))
        shown.show_map(session.partial, session.plan)
        assert (shown.ink.visible, shown.plan.visible) == (True, False)
        monkeypatch.setattr(answer_module, "figure_png", lambda figure: figures.append(figure) or b"")
        session.file("png")
        (ink,) = (each for each in figures[0].axes[0].images if each.get_extent() == [0.0, 4.2, 0.0, 3.2])
        opacity = ink.get_array()[..., 3]
        assert opacity[150, 305] > opacity[150, 100]  # the pale line, which is no wall
        shown.show_map(PARTIAL, None)
        assert not shown.ink.visible

    def test_a_plan_gets_its_scale_from_a_known_length(self, window: Window, tmp_path: Path) -> None:
        session = window.session
        session.maps.upload_map([("C:\\flat.PNG", picture())])
        message = window.settle()
        assert (session.partial, session.plan is not None) == (None, True)
        for act in (session.radios.add, session.jobs.predict, lambda: session.file("project")):
            with pytest.raises(MapError, match="Drag along a length"):
                act()
        with pytest.raises(SettingsError, match="drag along it"):
            session.maps.measure([(5.0, 5.0)], 4.0)
        assert message == session.jobs.status.message
        session.maps.measure([(0.0, 5.0), (420.0, 5.0)], 4.2)
        window.settle()
        (tmp_path / "flat.png").write_bytes(picture())
        assert session.partial == sp.load_map(tmp_path / "flat.png", resolution_m=0.01)
        assert session.partial.state_at(np.array([[2.05, 1.0], [3.05, 1.0]])).tolist() == [1, 0]
        session.radios.put([("", 1.0, 1.0)])
        session.maps.draw(Stroke("free", ((0.5, 0.05), (0.7, 0.05)), 0.3))
        session.maps.change_source(threshold=190)
        assert window.settle() == "Ready."
        assert session.partial.state_at(np.array([[2.05, 1.0], [3.05, 1.0], [0.6, 0.05]])).tolist() == [1, 1, 0]
        assert [*session.transmitters] == ["tx1"]
        before = session.partial, session.plan
        session.maps.measure([(0.0, 1.0), (0.0, 2.0)], 500.0)
        assert "draw a known length again" in window.settle()
        assert (session.jobs.status.is_error, session.partial, session.plan) == (True, *before)

    def test_strokes_are_undone_saved_and_in_python(
        self, window: Window, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        session = window.session
        session.radios.put([("", 1.0, 1.0), ("", 3.0, 1.0)])
        session.radios.change("tx2", eirp_dbm=30.0, antenna=sp.Antenna("tr38901", azimuth_deg=90.0))
        session.radios.set(frequency_hz=5.2e9, through_walls=False, material="brick")
        assert "partial = sp.load_map('room.yaml')" in session.python()
        session.maps.draw(Stroke("brush", ((2.05, 0.5),), 0.4, "metal"))
        session.maps.draw(Stroke("area", ((1.9, 0.0), (1.9, 1.0), (2.2, 1.0), (2.2, 0.0)), material="brick"))
        session.maps.draw(Stroke("wall", ((2.05, 1.9), (2.05, 3.0)), 9.0))
        session.maps.draw(Stroke("free", ((2.05, 0.8), (2.05, 1.2)), 0.3))
        assert window.settle() == "Ready."
        partial = session.partial
        column = partial.state[:, 20].tolist()
        assert column == [1] * 7 + [0] * 6 + [1] * 19
        assert partial.state[20:, 19:22].sum() == 14
        assert [partial.wall_materials[number - 1].itu for number in partial.wall_material[1:7, 20]] == ["brick"] * 6
        monkeypatch.chdir(tmp_path)
        Path("map.npz").write_bytes(unzipped(session.file("project"), 10**7)["map.npz"])
        names: dict[str, Any] = {}
        exec(session.python(), names)
        assert names["partial"] == partial
        assert names["coverage"].identical(window.answer.coverage)
        for _ in range(4):
            session.maps.undo()
        window.settle()
        assert session.partial == PARTIAL
        for stroke, message in (
            (Stroke("cheese", ((1.0, 1.0),)), "stroke = 'cheese'"),
            (Stroke("area", ((1.0, 1.0), (2.0, 1.0)), material="brick"), "corners of an area = 2"),
        ):
            with pytest.raises(SettingsError, match=message):
                session.maps.draw(stroke)


def test_projects_are_opened_as_they_were_saved_or_refused(window: Window) -> None:
    before, other = window.session, Window()
    before.radios.put([("", 1.0, 1.0), ("", 3.0, 1.0)])
    before.radios.change("tx2", new_name="hall", antenna=sp.Antenna("tr38901", azimuth_deg=90.0))
    before.radios.use_preset("60 GHz (WiGig)")
    before.measured = sp.Measurements((1.0, 1.0, 1.5), [(1.5, 2.5, 1.5)], [-60.0], sensitivity_db=-120.0)
    content, after = before.file("project"), other.session
    after.maps.upload_map([("mine.zip", content)])
    assert other.settle() == "Ready."
    assert (after.partial, after.title) == (before.partial, before.title)
    assert (after.transmitters, after.settings) == (before.transmitters, before.settings)
    assert after.measured is not None
    assert (after.measured.rx.tolist(), after.measured.sensitivity_db) == ([[1.5, 2.5, 1.5]], -120.0)
    assert after.file("project") == content
    contents, transmitters = unzipped(content, 10**7), after.transmitters
    for old, new, message in (
        (b'"version": 1', b'"version": 2', "version = 2"),
        (b'"hall"', b'"<b>"', "name = '<b>'"),
        (b"60480000000.0", b"1e99", "frequency_hz"),
        (b'"tr38901"', b'"/etc/passwd"', "pattern"),
        (b'"x_m": 3.0', b'"x_m": NaN', "x_m"),
        (b'"x_m": 3.0', b'"y": 3.0', "damaged"),
        (b'"title"', b"[" * 100_000, "damaged"),
        (b"2.5,\n", b"1e9,\n", "rx of the measurements[0] = (1.5, 1000000000.0, 1.5) is outside the map"),
    ):
        text = contents["project.json"]
        assert old in text
        after.maps.upload_map([("mine.zip", zipped(contents | {"project.json": text.replace(old, new, 1)}))])
        assert message in other.settle()
        assert after.jobs.status.is_error
        assert after.transmitters is transmitters

    def fail() -> None:
        raise ValueError("a fault of ours")

    after.jobs.do(fail)
    other.waiting.pop()()
    assert after.jobs.status == Status("this failed (ValueError: 'a fault of ours').", is_error=True)
    after.maps.upload_map([("mine.zip", content)])
    assert other.settle() == "Ready."
    after.jobs.close()


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of an app with a room, in a process of its own."""
    folder = tmp_path_factory.mktemp("app")
    sp.save_map(PARTIAL, folder / "room.yaml")
    command = [sys.executable, "-m", "sionna_partial", "app", "room.yaml", "--no-browser"]
    root = str(Path(sp.__file__).parents[1])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([root, *filter(None, sys.path)])}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder, env=environment) as server:
        yield server.stdout.readline().split()[1]
        server.terminate()


@pytest.fixture(scope="module")
def page(url: str) -> str:
    with urllib.request.urlopen(url, timeout=60) as answer:
        assert answer.status == 200
        return answer.read().decode()


def status_of(url: str, body: bytes | None = None, **headers: str) -> int:
    parts = urllib.parse.urlsplit(url)
    with closing(HTTPConnection(parts.netloc, timeout=60)) as connection:
        names = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request("GET" if body is None else "POST", parts.path, body, names)
        return connection.getresponse().status


class TestServer:
    def test_its_address_cannot_be_guessed(self, url: str, page: str) -> None:
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{32}", url)
        host = url.rpartition("/")[0]
        assert "<title>Radio coverage</title>" in page
        assert {status_of(host + path) for path in ("/", "/wrong", "/wrong/ws", "/files/x/png")} == {404}
        assert status_of(f"{url}/files/guessed/png") == status_of(f"{url}/files/guessed/map", b"") == 404

    def test_uploads(self, url: str, page: str) -> None:
        (key,) = {*re.findall(r"/files/([\w-]+)", page)}
        maps, form = f"{url}/files/{key}/map", "multipart/form-data; boundary=x"
        assert status_of(f"{url}/wrong", b"", Content_Length="190000000") == 400
        assert status_of(f"{url}/files/guessed/map", b"", Transfer_Encoding="chunked") == 404
        assert status_of(maps, b"", Content_Length="190000000") == 415
        assert status_of(maps, b"", Content_Length="202000000", Content_Type=form) == 413
        assert status_of(maps, b"", Transfer_Encoding="chunked", Content_Type=form) == 411
        content = b'--x\r\nContent-Disposition: form-data; name="file"; filename="a.npz"\r\n\r\n' + bytes(10**6)
        for body, code in ((content + b"\r\n--x--\r\n", 200), (b"--x--\r\n", 404), (b"nothing", 400)):
            assert status_of(maps, body, Content_Type=form) == code

    def test_other_sites_get_no_socket(self, url: str) -> None:
        with pytest.raises(InvalidStatus, match="403"):
            connect(url.replace("http", "ws", 1) + "/ws", origin=Origin("http://evil.example"))

    def test_port_that_is_taken(self, url: str) -> None:
        with pytest.raises(SettingsError, match=r"cannot be listened at .*: choose another --port"):
            AppServer(port=int(url.split(":")[2].split("/")[0]))


_MODEL = "Bokeh.documents[0].get_model_by_name"
_READY = f"{_MODEL}('message').text.includes('Ready')"
_WALK = "const walk = n => [n, ...[...(n.shadowRoot?.children ?? []), ...n.children].flatMap(walk)]"
_PIXEL = f"""(() => {{ const view = Bokeh.index.get({_MODEL}('picture')), box = view.el.getBoundingClientRect()
return [box.left + view.frame.x_scale.compute(X), box.top + view.frame.y_scale.compute(Y)] }})()"""


def pixel(tab: Tab, x_m: float, y_m: float) -> tuple[float, float]:
    x, y = tab.run(_PIXEL.replace("X", str(x_m)).replace("Y", str(y_m)))
    return x, y


def press(tab: Tab, label: str) -> None:
    button = f"walk(document.body).find(n => n.tagName == 'BUTTON' && n.textContent.trim() == {label!r})"
    there = f"(async () => {{ {_WALK}; while (!{button}?.offsetWidth) await new Promise(done => setTimeout(done, 10))"
    tab.run(f"{there}; {button}.click() }})()")


def type_into(tab: Tab, label: str, text: str) -> None:
    """Replace the text of the field with this label, and press Enter."""
    field = f"walk(document.body).find(n => n.tagName == 'LABEL' && n.textContent.trim() == {label!r})"
    tab.run(f"(() => {{ {_WALK}; {field}.getRootNode().querySelector('input').select() }})()")
    tab.send("Input.insertText", text=text)
    tab.send("Input.dispatchKeyEvent", type="keyDown", key="Enter", code="Enter", windowsVirtualKeyCode=13, text="\r")


def box(tab: Tab, selector: str) -> list[float]:
    edges = "['left', 'top', 'right', 'bottom'].map(edge => box[edge])"
    code = f"(() => {{ const box = document.querySelector({selector!r}).getBoundingClientRect(); return {edges} }})()"
    return list(tab.run(code))


def check_layout(tab: Tab) -> None:
    """The plot with its colour bar, the controls and the downloads fit the window, and stay where they are."""
    before = box(tab, "#plot")
    texts = {"message": "'A long text. '.repeat(99)", "warnings": "'A note.<br>'.repeat(9)"}
    tab.run(", ".join(f"{_MODEL}('{name}').text = {text}" for name, text in texts.items()) + ", 0")
    tab.run("new Promise(done => setTimeout(done, 300))")
    assert box(tab, "#plot") == before
    for selector in ("#status", "#plot", "#summary", "#files", "#controls"):
        left, top, right, bottom = box(tab, selector)
        assert 0.0 <= left < right <= 1400.0
        assert 0.0 <= top < bottom <= 950.0
    drawn = tab.run(f"(({{width, height}}) => [width, height])(Bokeh.index.get({_MODEL}('picture')).bbox)")
    assert drawn == pytest.approx([before[2] - before[0], before[3] - before[1]], abs=2.0)
    assert tab.run("[document.documentElement.scrollWidth, document.documentElement.scrollHeight]") == [1400, 950]


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_put_drag_download_upload_cancel(url: str, tmp_path: Path) -> None:
    with chromium(tmp_path) as open_tab:
        tab = open_tab(url, 1400, 950)
        tab.wait(f"{_MODEL}('message').text.includes('Click on the map')")
        tab.wait(f"Bokeh.index.get({_MODEL}('picture')).frame.bbox.width > 100")
        tab.click(*pixel(tab, 1.0, 1.0))
        tab.wait(_READY)
        before = tab.run(f"{_MODEL}('python').value")
        for x_m, y_m, held_s in ((3.0, 2.0, 0.0), (1.5, 2.5, 0.5), (3.0, 2.0, 0.0)):
            at = tab.run(f"['x', 'y'].map(axis => {_MODEL}('points').data[axis][0])")
            tab.drag(*pixel(tab, *at), *pixel(tab, x_m, y_m), held_s=held_s)
            tab.wait(f"Math.hypot({_MODEL}('points').data.x[0] - {x_m}, {_MODEL}('points').data.y[0] - {y_m}) < 0.1")
        tab.click(*pixel(tab, 1.0, 1.0))
        tab.wait(f"{_MODEL}('points').data.name[1] == 'tx2' && {_READY}")
        tab.click(*pixel(tab, 3.0, 2.0))  # what is clicked does not move with what is dragged next
        tab.drag(*pixel(tab, 1.0, 1.0), *pixel(tab, 1.0, 2.5))
        tab.wait(f"Math.abs({_MODEL}('points').data.y[1] - 2.5) < 0.1")
        assert abs(tab.run(f"{_MODEL}('points').data.x[0]") - 3.0) < 0.1
        press(tab, "Remove")
        tab.wait(f"{_MODEL}('points').data.name.length == 1")
        tab.run(f"{_MODEL}('measured').data = {{x: [99], y: [1], colour: ['white']}}, 0")
        tab.run("new Promise(done => setTimeout(done, 300))")
        assert tab.run(f"{_MODEL}('picture').x_range.end") < 6.0  # the axes stay with the map
        tab.wait(f"{_MODEL}('python').value != {json.dumps(before)} && {_READY}")
        assert tab.run(f"{_MODEL}('points').data.name.length") == 1
        check_layout(tab)
        links = re.findall('href="([^"]+)"', tab.run(f"{_MODEL}('links').text"))
        assert {link.rpartition("/")[2] for link in links} == {*FILES}
        picture, end = url.rpartition("/")[0] + links[0], time.monotonic() + 60.0
        while status_of(picture) == 409 and time.monotonic() < end:  # the page may be behind its session: a late drag
            time.sleep(0.1)
        assert status_of(picture) == 200

        uploaded(tmp_path)
        tab.choose_files("#map-file", tmp_path / "room.yaml", tmp_path / "room.pgm")
        tab.wait(f"{_MODEL}('points').data.name.length == 0")
        other = open_tab(url, 390, 844)
        other.wait(f"{_MODEL}('message').text.includes('Click on the map')")
        assert other.run("document.documentElement.scrollWidth <= 390")
        other.send("Emulation.setDeviceMetricsOverride", width=1280, height=720, deviceScaleFactor=1, mobile=False)
        label = "walk(document.body).find(n => n.tagName == 'LABEL' && n.textContent.trim() == 'Band')"
        bottom = other.run(f"(() => {{ {_WALK}; return {label}.getBoundingClientRect().bottom }})()")
        assert 0.0 < bottom < box(other, "#plot")[1] < 720.0  # the band stands above the map
        assert "Wi-Fi 5 GHz" in other.run(f"{_MODEL}('picture').title.text")
        for part, label in (("bk-spin-btn-up", "more"), ("noUi-handle", "Threshold [dBm]"), ("bk-events", "Map; ")):
            found = f"walk(document.body).find(n => n.classList.contains({part!r}))"
            focus = "n.dispatchEvent(new FocusEvent('focusin', {bubbles: true, composed: true}))"  # none comes behind
            assert label in other.run(f"(() => {{ {_WALK}; const n = {found}; {focus}; return n.ariaLabel }})()")
        tab.send("Page.bringToFront")
        press(tab, "Place it for me")
        press(tab, "Cancel")
        tab.wait(f"{_MODEL}('message').text.includes('Cancelled')")
        assert other.run(f"{_MODEL}('points').data.name.length") == 0


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_plan_is_dropped_measured_and_corrected(url: str, tmp_path: Path) -> None:
    with chromium(tmp_path) as open_tab:
        tab = open_tab(url, 1400, 950)
        tab.wait(f"{_MODEL}('message').text.includes('Click on the map')")
        content = base64.b64encode(picture()).decode()
        tab.run(
            f"""(() => {{ const data = new DataTransfer()
            data.items.add(new File([Uint8Array.from(atob('{content}'), c => c.charCodeAt())], 'flat.png'))
            document.body.dispatchEvent(new DragEvent('drop', {{dataTransfer: data, bubbles: true}})) }})()"""
        )
        tab.wait(f"{_MODEL}('stroke').value == 'length' && {_MODEL}('picture').x_range.end > 400")
        tab.drag(*pixel(tab, 5, 5), *pixel(tab, 415, 5))
        type_into(tab, "Known length [m]", "4.1")
        tab.wait(f"{_MODEL}('message').text.includes('Click on the map') && {_MODEL}('stroke').value == ''")
        tab.wait(f"{_MODEL}('picture').x_range.end < 9")
        tab.click(*pixel(tab, 1.0, 1.0))
        tab.wait(_READY)
        tab.run(f"{_MODEL}('paint').value = 'brick', 0")
        for kind in ("brush", "area"):
            tab.run(f"{_MODEL}('stroke').value = '{kind}', 0")
            if kind == "brush":
                tab.drag(*pixel(tab, 2.05, 0.5), *pixel(tab, 2.05, 1.5))
            else:
                for x_m, y_m, clicks in ((1.8, 0.5, 1), (2.3, 0.5, 1), (2.3, 1.5, 1), (1.8, 1.5, 2)):
                    tab.click(*pixel(tab, x_m, y_m), clicks)
                    time.sleep(0.4)  # two clicks within it are a double click
            tab.wait(f"{_MODEL}('map_text').text.includes('brick') && {_READY}")
            assert tab.run(f"[{_MODEL}('points').data.x.length, {_MODEL}('stroke').value]") == [1, kind]
            press(tab, "Undo")
            tab.wait(f"!{_MODEL}('map_text').text.includes('brick') && {_READY}")
        tab.run(f"{_MODEL}('stroke').value = '', 0")
        tab.drag(*pixel(tab, 1.0, 1.0), *pixel(tab, 3.0, 2.0))
        tab.wait(f"Math.abs({_MODEL}('points').data.x[0] - 3.0) < 0.1")
        assert tab.faults() == []
