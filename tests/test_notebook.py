"""Notebooks: what a cell ends with is shown, once."""

from typing import Any

import pytest
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_notebook

CELLS = {
    "map": "import sionna_partial as sp\nfrom sionna_partial.resources import scenes_folder\n"
    "partial = sp.load_map(scenes_folder() / 'apartment' / 'step100')\npartial",
    "plot-map": "tx = (7.0, 9.8, 1.5)\nsp.plot_map(partial, tx=tx)",
    "pyplot": "import sys\n'matplotlib.pyplot' in sys.modules",  # later, `sionna.rt` imports it
    "predict": "coverage = sp.predict_map(partial, tx, spacing_m=0.5)\ncoverage.radio",
    "plot-coverage": "sp.plot_coverage(coverage)",
    "table": "links = sp.trace_links(partial, tx, [(6.0, 9.0, 1.5), (30.0, 4.0, 1.5)], invalid='nan')\n"
    "links.to_dataframe()[['rx', 'link_state', 'gain_db', 'distance_m', 'paths']]",
    "inline": "%matplotlib inline\nimport matplotlib.pyplot as plt\nfigure = sp.plot_map(partial)",
    "again": "figure",
    "open": "plt.get_fignums()",
    "bar": "import time\nfrom sionna_partial.progress import reporting\n"
    "with reporting(None) as report:\n    time.sleep(2.1)\n    report(0.5, 'half <of it>')",
    "short": "with reporting(None) as report:\n    report(0.5, 'half')",
    "silent": "with reporting(False) as report:\n    time.sleep(2.1)\n    report(0.5, 'half')",
}


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """Outputs of each cell, by its name."""
    folder = tmp_path_factory.mktemp("notebook")
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


@pytest.mark.parametrize(("cell", "line"), [("map", "PartialMap(state="), ("predict", "&lt;coverage: 29 x 27 ")])
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


def test_a_table(outputs: dict[str, list[Any]]) -> None:
    assert "NaN" in outputs["table"][0]["data"]["text/plain"]


def test_a_bar_after_2_s(outputs: dict[str, list[Any]]) -> None:
    assert {each.get("name") for each in outputs["bar"]} == {"stderr"}
    assert "half <of it>" in "".join(each["text"] for each in outputs["bar"])
    assert outputs["short"] == outputs["silent"] == []
