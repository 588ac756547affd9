"""The HTML page of a coverage map: what is in it, and what a browser without network makes of it."""

import html
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from browser import CHROMIUM, Tab, chromium
from matplotlib.colors import to_rgb
from PIL import Image

from sionna_partial.constants import LinkState
from sionna_partial.coverage.dataset import probability_above
from sionna_partial.export import save_coverage
from sionna_partial.plots.style import STATE_COLOURS

MODEL = "Bokeh.documents[0].get_model_by_name"

FRAME = f"""(() => {{ const view = Bokeh.index.find_one({MODEL}("plot"))
const {{left, top}} = view.el.getBoundingClientRect(), {{x, y, width, height}} = view.frame.bbox
return [left + x + 2, top + y + 2, width - 4, height - 4] }})()"""
"""Place of the map on the page, without its axes."""

FOUND = f"""(() => {{
    const [plot, values] = ["plot", "values"].map(name => {MODEL}(name))
    const images = plot.renderers.filter(each => each.visible && each.glyph?.image)
    return {{p_above: values.data.p_above.map(each => Array.from(each)),
        best: Array.from(values.data.best_server?.[0] ?? []), title: plot.title.text,
        shown: images.map(each => [each.glyph.image.field, Array.from(each.view.indices ?? [])])}}
}})()"""


@pytest.fixture(scope="module")
def open_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[xr.Dataset], Tab]]:
    """Return a function that opens the page of a coverage map; the page may not log a fault."""
    folder, tabs = tmp_path_factory.mktemp("pages"), []
    with chromium(folder) as open_tab:

        def open_coverage(coverage: xr.Dataset) -> Tab:
            page = folder / f"{len(tabs)}.html"
            save_coverage(coverage, page)
            tabs.append(open_tab(page.as_uri()))
            tabs[-1].wait(f"Bokeh.index.find_one({MODEL}('plot')).frame.bbox.width > 100 && Bokeh.documents[0].is_idle")
            return tabs[-1]

        yield open_coverage
        assert [tab.faults() for tab in tabs] == [[]] * len(tabs)


def pixels(tab: Tab, path: Path) -> np.ndarray:
    tab.screenshot(path, part=tab.run(FRAME))
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


@pytest.mark.skipif(not CHROMIUM, reason="there is no browser")
class TestInABrowser:
    def test_states_are_seen_first_and_walls_are_black(self, coverage, tmp_path, open_page):
        pictures = []
        for walls in (1, 0):
            shown = coverage.assign(wall_parts=walls * coverage["wall_parts"])
            pictures.append(pixels(open_page(shown), tmp_path / "map.png"))
        for state in (LinkState.LOS, LinkState.NLOS, LinkState.OUTAGE):
            colour = np.rint(255 * np.array(to_rgb(STATE_COLOURS[state]))).astype(int)
            assert (np.abs(pictures[0] - colour).max(axis=2) < 12).mean() > 0.05, (
                state
            )  # hatched areas are a little paler
        black = [(picture.max(axis=2) == 0).mean() for picture in pictures]
        assert black[0] > 0.2
        assert black[1] < 0.01  # the outline of the transmitter

    def test_the_slider_moves_the_threshold_of_the_transmitter_that_is_shown_and_of_the_best_server(
        self, several, open_page
    ):
        tab = open_page(several)
        for name, value in (("threshold", -80), ("layer", "p_above"), ("transmitter", "1")):
            tab.run(f"{MODEL}({name!r}).value = {value!r}, 0")
        found = tab.run(FOUND)
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


def test_names_are_text(coverage, several, tmp_path):
    script = "<script>alert(1)</script>"
    several["tx"] = ["p123456", f"<!--<script></script>{script}"]
    for data, shown in ((coverage.assign_attrs(predictor=script), html.escape(script)), (several, '"p123456"')):
        save_coverage(data, tmp_path / "coverage.html")
        text = (tmp_path / "coverage.html").read_text(encoding="utf-8")
        assert "<script>alert" not in text
        assert shown in text
