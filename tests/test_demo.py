from functools import partial

import numpy as np
import pytest
from coverage_cases import COMPLETE, PICTURE, TX, map_of, shipped
from PIL import Image
from typer.testing import CliRunner

from sionna_partial import cli, demo
from sionna_partial.constants import CellState, LinkState
from sionna_partial.coverage.job import predict_map
from sionna_partial.demo import NOTHING, PARTIAL, TRUTH, comparison_table, demo_scene
from sionna_partial.errors import SceneError
from sionna_partial.export import load_coverage
from sionna_partial.maps.partial_map import PartialMap

NAMES = ["coverage.nc", "coverage.tif", "coverage.csv", "coverage.png", "coverage.html", "coverage.yaml"]
NAMES += ["comparison.png", "table.txt"]


@pytest.fixture(scope="module")
def coverages():
    complete = map_of(COMPLETE)
    nothing = PartialMap(np.full_like(complete.state, CellState.UNKNOWN), 0.5, (-1.0, 2.0))
    maps = {TRUTH: complete, NOTHING: nothing, PARTIAL: map_of(PICTURE)}
    return {title: predict_map(scene, TX, spacing_m=0.5, predictor=shipped()) for title, scene in maps.items()}


@pytest.mark.usefixtures("command_line")
def test_the_demo_writes_every_file_and_prints_the_table_and_their_names(tmp_path, monkeypatch):
    monkeypatch.setattr(demo, "predict_map", partial(predict_map, spacing_m=0.4))
    out = tmp_path / "out"
    result = CliRunner().invoke(cli.app, ["demo", "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert {file.name for file in out.iterdir()} == {*NAMES, "coverage.pgm"}
    table = (out / "table.txt").read_text()
    assert result.stdout == table + "\n" + "".join(f"wrote {out / name}\n" for name in NAMES)
    rows = {line[:22].strip(): line[22:] for line in table.splitlines()[3:]}
    assert list(rows) == ["nothing observed", "partial trace alone", "partial map"]
    assert all(row.count("%") == row.count("dB") == 3 for row in rows.values())
    with Image.open(out / "comparison.png") as image:
        assert image.width >= 1200
    _, known, tx = demo_scene("apartment", 100)
    attributes = load_coverage(out / "coverage.nc").attrs
    assert attributes["map_observed_fraction"] == known.observed_fraction < 1.0
    assert tuple(attributes["transmitter_m"]) == tx


def test_accuracy_and_error_are_those_of_the_receivers_inside_the_home(coverages):
    truth = coverages[TRUTH]
    inside = (truth["cell_state"] == CellState.FREE).to_numpy()
    seen = inside & coverages[PARTIAL]["observed"].to_numpy()
    changed = coverages[PARTIAL].copy(deep=True)
    changed["link_state"].to_numpy()[inside] = truth["link_state"].to_numpy()[inside]
    changed["gain_mean_db"].to_numpy()[inside] = truth["gain_mean_db"].to_numpy()[inside] + 3.0
    changed["gain_mean_db"].to_numpy()[seen] += 1.0
    wrong = np.argwhere(seen)[:3]
    changed["link_state"].to_numpy()[tuple(wrong.T)] = (truth["link_state"].to_numpy()[tuple(wrong.T)] + 1) % len(
        LinkState
    )
    row = comparison_table(coverages | {PARTIAL: changed}).splitlines()[-1]
    unseen = int(inside.sum() - seen.sum())
    rmse_db = np.sqrt((16 * seen.sum() + 9 * unseen) / inside.sum())
    expected = [
        f"{100 * (1 - 3 / inside.sum()):.1f}", "%", f"{rmse_db:.1f}", "dB",
        f"{100 * (1 - 3 / seen.sum()):.1f}", "%", "4.0", "dB",
        "100.0", "%", "3.0", "dB",
    ]  # fmt: skip
    assert row.split()[2:] == expected
    assert comparison_table(dict.fromkeys((TRUTH, NOTHING, PARTIAL), truth)).splitlines()[-1].split()[-1] == "-"


def test_an_unknown_home_or_stage_is_named():
    with pytest.raises(SceneError, match=r"home = 'castle' is not in '.*scenes': choose one of .*apartment"):
        demo_scene("castle", 50)
    with pytest.raises(SceneError, match=r"step = 99 is not in '.*office': choose one of 50, 100, 150, 200\."):
        demo_scene("office", 99)
