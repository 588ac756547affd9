"""Notebooks: the shipped one runs, and what a cell ends with is shown, once."""

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "notebooks" / "coverage.ipynb"

PYPLOT = "import sys\n'matplotlib.pyplot' in sys.modules"
"""A cell that is run after the first figure; later, `sionna.rt` imports pyplot."""

MORE = {
    "inline": "%matplotlib inline\nimport matplotlib.pyplot as plt\nfigure = sp.plot_map(partial)",
    "again": "figure",
    "open": "plt.get_fignums()",
    "bar": "import time\nfrom sionna_partial.progress import reporting\n"
    "with reporting(None) as report:\n    time.sleep(2.1)\n    report(0.5, 'half <of it>')",
    "short": "with reporting(None) as report:\n    report(0.5, 'half')",
    "silent": "with reporting(False) as report:\n    time.sleep(2.1)\n    report(0.5, 'half')",
}
"""Cells that are run after those of the notebook."""


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """Outputs of each cell, by its name."""
    folder = tmp_path_factory.mktemp("notebook")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    after = 1 + [cell.id for cell in notebook.cells].index("plot-map")
    notebook.cells.insert(after, new_code_cell(PYPLOT, id="pyplot"))
    notebook.cells += [new_code_cell(source, id=name) for name, source in MORE.items()]
    with pytest.MonkeyPatch.context() as patch:
        for name in ("JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
            patch.setenv(name, str(folder / name))
        patch.delenv("MPLBACKEND", raising=False)
        client = NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": folder}})
        client.execute()
    return {cell.id: cell.outputs for cell in notebook.cells if cell.cell_type == "code"}


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


def test_numbers_and_tables(outputs: dict[str, list[Any]]) -> None:
    above, gain_db, std_db = eval(outputs["numbers"][0]["data"]["text/plain"])
    assert 0.0 < above < 1.0
    assert -150.0 <= gain_db < -40.0
    assert std_db >= 0.0
    assert "NaN" in outputs["table"][0]["data"]["text/plain"]


def test_a_bar_after_2_s(outputs: dict[str, list[Any]]) -> None:
    (bar,) = outputs["bar"]
    assert bar["data"]["text/html"] == '<progress value="1" max="1"></progress> done in 2 s'
    assert outputs["short"] == outputs["silent"] == []
