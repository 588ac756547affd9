"""Notebooks: what a cell ends with is shown, once."""

from typing import Any

import pytest
from coverage_cases import small_coverage
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_notebook

import sionna_partial as sp

CELLS = {
    "map": "import sionna_partial as sp\nfrom sionna_partial.resources import scenes_folder\n"
    "partial = sp.load_map(scenes_folder() / 'apartment' / 'step100')\npartial",
    "plot-map": "tx = (7.0, 9.8, 1.5)\nsp.plots.plot_map(partial, tx=tx)",
    "pyplot": "import sys\n'matplotlib.pyplot' in sys.modules",
    "coverage": "coverage = sp.load_coverage('coverage.nc')\ncoverage.radio",
    "plot-coverage": "sp.plots.plot_coverage(coverage)",
    "inline": "%matplotlib inline\nimport matplotlib.pyplot as plt\nfigure = sp.plots.plot_map(partial)",
    "again": "figure",
    "open": "plt.get_fignums()",
    "short": "from sionna_partial import display\nwith display.reporting(None) as report:\n    report(0.5, 'half')",
    "bar": "display.WAIT_S = 0.0\nwith display.reporting(None) as report:\n    report(0.5, 'half <of it>')",
    "silent": "with display.reporting(False) as report:\n    report(0.5, 'half')",
}


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    folder = tmp_path_factory.mktemp("notebook")
    sp.save_coverage(small_coverage(), folder / "coverage.nc")
    notebook = new_notebook(cells=[new_code_cell(source, id=name) for name, source in CELLS.items()])
    with pytest.MonkeyPatch.context() as patch:
        for name in ("JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
            patch.setenv(name, str(folder / name))
        patch.delenv("MPLBACKEND", raising=False)
        client = NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": folder}})
        client.execute()
    return {cell.id: cell.outputs for cell in notebook.cells}


pytestmark = [
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]


def images(shown: list[Any]) -> int:
    return sum("image/png" in each.get("data", {}) for each in shown)


@pytest.mark.parametrize("cell", ["plot-map", "plot-coverage", "again"])
def test_a_figure_is_shown_once(outputs: dict[str, list[Any]], cell: str) -> None:
    assert len(outputs[cell]) == images(outputs[cell]) == 1


@pytest.mark.parametrize(("cell", "line"), [("map", "PartialMap(state="), ("coverage", "&lt;coverage: ")])
def test_a_result_is_shown_with_a_picture(outputs: dict[str, list[Any]], cell: str, line: str) -> None:
    html = outputs[cell][-1]["data"]["text/html"]
    assert line in html
    assert html.count("data:image/png;base64,") == 1
    assert len(html) < 250_000
    assert images(outputs[cell]) == 0


def test_pyplot_has_no_part_in_it(outputs: dict[str, list[Any]]) -> None:
    assert outputs["pyplot"][0]["data"]["text/plain"] == "False"
    assert outputs["inline"] == []
    assert outputs["open"][0]["data"]["text/plain"] == "[]"


def test_a_bar_of_long_work(outputs: dict[str, list[Any]]) -> None:
    assert {each.get("name") for each in outputs["bar"]} == {"stderr"}
    assert "half <of it>" in "".join(each["text"] for each in outputs["bar"])
    assert outputs["short"] == outputs["silent"] == []
