"""The HTML page of a coverage map: what is in it, and what a browser without network makes of it."""

import base64
import gzip
import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_rgb
from PIL import Image

from sionna_partial.constants import LinkState
from sionna_partial.coverage.dataset import ATTRIBUTES, probability_above
from sionna_partial.export import save_coverage
from sionna_partial.plots.style import STATE_COLOURS

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")

FLAGS = """--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking
--disable-component-update --disable-sync --enable-logging=stderr --window-size=1000,900 --virtual-time-budget=30000"""

PROBE = """<pre id="found"></pre><script>
const timer = setInterval(() => {
    const page = Bokeh.documents[0], named = name => page?.get_model_by_name(name)
    if (!named("threshold")) return
    named("threshold").value = -80
    named("layer").value = "p_above"
    if (named("transmitter")) named("transmitter").value = "1"
    if (!named("plot").title.text.includes("-80")) return
    clearInterval(timer)
    const images = named("plot").renderers.filter(each => each.visible && each.glyph?.image)
    const found = {p_above: named("values").data.p_above.map(each => Array.from(each)),
        best: Array.from(named("values").data.best_server?.[0] ?? []), title: named("plot").title.text,
        shown: images.map(each => [each.glyph.image.field, Array.from(each.view.indices ?? [])])}
    document.getElementById("found").textContent = JSON.stringify(found)
}, 200)
</script>"""
"""Moves the slider, chooses a layer and the second transmitter, and writes what came of it."""

ROUNDING = 1 / 2048


def browse(page: Path, *flags: str) -> str:
    """Open a page, and return what the browser printed; whatever it logs to the console fails the test."""
    command = [str(CHROMIUM), *FLAGS.split(), f"--user-data-dir={page.parent / 'profile'}", *flags, page.as_uri()]
    result = subprocess.run(command, capture_output=True, text=True, timeout=240)
    console = [line for line in result.stderr.splitlines() if "CONSOLE" in line]
    expected = re.compile(r'"\[bokeh [\d.]+\] (setting log level|document idle)')
    assert console
    assert [line for line in console if not expected.search(line)] == []
    return result.stdout


def probe(coverage: xr.Dataset, page: Path) -> dict:
    """What a page shows after the slider was moved and something else was chosen."""
    save_coverage(coverage, page)
    with page.open("a", encoding="utf-8") as stream:
        stream.write(PROBE)
    (found,) = re.findall(r'<pre id="found">(.*?)</pre>', browse(page, "--dump-dom"))
    return json.loads(html.unescape(found))


def screenshot(page: Path) -> np.ndarray:
    """Colours of the page in the browser, 0 to 255."""
    browse(page, f"--screenshot={page.with_suffix('.png')}")
    with Image.open(page.with_suffix(".png")) as image:
        return np.asarray(image.convert("RGB")).astype(int)


@pytest.mark.skipif(not CHROMIUM, reason="there is no browser")
class TestInABrowser:
    def test_the_likeliest_states_are_seen_first(self, coverage, tmp_path):
        save_coverage(coverage, tmp_path / "coverage.html")
        picture = screenshot(tmp_path / "coverage.html")
        for state in (LinkState.LOS, LinkState.NLOS, LinkState.OUTAGE):
            colour = np.rint(255 * np.array(to_rgb(STATE_COLOURS[state]))).astype(int)
            assert (np.abs(picture - colour).max(axis=2) < 2).sum() > 2000, state
        assert (picture.max(axis=2) == 0).sum() > 5000

    def test_a_map_without_walls_has_no_black_area(self, coverage, tmp_path):
        save_coverage(coverage.assign(wall_parts=0 * coverage["wall_parts"]), tmp_path / "coverage.html")
        assert (screenshot(tmp_path / "coverage.html").max(axis=2) == 0).sum() < 5000

    def test_the_slider_moves_the_threshold_of_the_transmitter_that_is_shown_and_of_the_best_server(
        self, several, tmp_path
    ):
        found = probe(several, tmp_path / "coverage.html")
        assert [layer for layer, _ in found["shown"]] == ["p_above", "image"]
        assert found["shown"][0] == ["p_above", [1]]
        assert found["title"] == "P(path gain > -80 dB): <b>east$}$"
        shape, valid = several["p_los"].shape, several["valid"].all("tx").to_numpy()
        west, east, best = np.array(found["p_above"], dtype=float).reshape(3, *shape[1:])
        np.testing.assert_allclose([west, east], probability_above(several, -80.0), atol=0.01)
        assert 0.1 < np.nanmean([west, east]) < np.nanmean(probability_above(several, -100.0))
        strongest = several["gain_mean_db"].fillna(-200.0).argmax("tx").to_numpy()
        assert set(strongest[valid]) == {0, 1}
        np.testing.assert_array_equal(np.array(found["best"], dtype=float).reshape(shape[1:])[valid], strongest[valid])
        np.testing.assert_array_equal(best[valid], np.where(strongest == 0, west, east)[valid])


def test_nothing_is_loaded_from_elsewhere(coverage, tmp_path):
    save_coverage(coverage, tmp_path / "coverage.html")
    text = (tmp_path / "coverage.html").read_text(encoding="utf-8")
    assert "default-src 'none'" in text
    assert not re.search(r"<(script|link|img|iframe)[^>]*\b(src|href)=", re.sub(r"(?s)<script>.*?</script>", "", text))


def test_the_outside_of_a_complete_map_has_no_values(coverage, tmp_path):
    pages = []
    for complete in (0, 1):
        coverage.attrs["map_complete"] = complete
        save_coverage(coverage, tmp_path / "coverage.html")
        pages.append(values_of(tmp_path / "coverage.html", coverage))
    expected = np.where(coverage["observed"], coverage["p_los"], np.nan)
    np.testing.assert_allclose(pages[0], coverage["p_los"], atol=ROUNDING)
    np.testing.assert_allclose(pages[1], expected, atol=ROUNDING)


def values_of(page: Path, coverage: xr.Dataset) -> np.ndarray:
    """P(LOS) as the page has it."""
    text = page.read_text(encoding="utf-8")
    (data,) = re.findall(r'\["p_los", \[\{"type": "ndarray", "array": \{"type": "bytes", "data": "([^"]+)"', text)
    values = np.frombuffer(gzip.decompress(base64.b64decode(data)), dtype=np.float32)
    return values.reshape(coverage["p_los"].shape)


def test_names_are_text(coverage, several, tmp_path):
    script = "<script>alert(1)</script>"
    several["tx"] = ["p123456", f"<!--<script></script>{script}"]
    for data, shown in ((coverage.assign_attrs(predictor=script), html.escape(script)), (several, '"p123456"')):
        save_coverage(data, tmp_path / "coverage.html")
        text = (tmp_path / "coverage.html").read_text(encoding="utf-8")
        assert "<script>alert" not in text
        assert shown in text


@pytest.mark.parametrize(("columns", "name"), [(200, "coverage"), (100, "several")])
def test_thirty_thousand_values_take_less_than_5_mb(columns, name, request, tmp_path):
    small, rng = request.getfixturevalue(name), np.random.default_rng(0)
    cells = {"x": np.arange(columns), "y": np.arange(150)}
    large = small.isel({axis: index % small.sizes[axis] for axis, index in cells.items()})
    large = large.assign_coords({axis: 0.25 * index for axis, index in cells.items()})
    large["valid"][:] = 1
    for name, attributes in ATTRIBUTES.items():
        if "units" in attributes:
            large[name][:] = rng.random(large["p_los"].shape)
    large["p_nlos"][:], large["p_outage"][:] = 0.0, 1.0 - large["p_los"]
    save_coverage(large, tmp_path / "coverage.html")
    assert large["p_los"].size == 30_000
    assert (tmp_path / "coverage.html").stat().st_size < 5e6
