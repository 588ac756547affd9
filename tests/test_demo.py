import numpy as np
import pytest
import xarray as xr
from coverage_fakes import COMPLETE, PICTURE, TX, FakePredictor, map_of, use_fakes
from PIL import Image

from sionna_partial import demo
from sionna_partial.constants import CellState, LinkState
from sionna_partial.coverage import predict_map
from sionna_partial.demo import NOTHING, PARTIAL, TRUTH, comparison_table, demo_scene, run_demo
from sionna_partial.errors import OutputError, SceneError
from sionna_partial.maps.map_files import save_map
from sionna_partial.maps.partial_map import PartialMap

FILES = ["comparison.png", "coverage.csv", "coverage.html", "coverage.nc", "coverage.pgm", "coverage.png"]
FILES += ["coverage.tif", "coverage.yaml", "table.txt"]


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A scenes folder with one home, the fake tracer and the fake predictor."""
    folder = tmp_path_factory.mktemp("demo") / "scenes"
    for stage, picture in (("complete", COMPLETE), ("step050", PICTURE)):
        save_map(map_of(picture), folder / "hut" / stage / "map.yaml")
        (folder / "hut" / stage / "scene.xml").write_text("")
    with pytest.MonkeyPatch.context() as patch:
        use_fakes(patch)
        patch.setattr(demo, "scenes_folder", lambda: folder)
        patch.setattr(demo, "demo_homes", lambda: {"hut": {"transmitter": (*TX, 1.5)}})
        patch.setattr(demo, "Predictor", FakePredictor)
        yield folder


@pytest.fixture(scope="module")
def run(scenes):
    """Result, folder and progress of one run."""
    fractions = []
    out = scenes.parent / "out"
    return run_demo(out, lambda fraction, message: fractions.append(fraction), home="hut", step=50), out, fractions


def test_the_demo_writes_every_file_and_returns_their_names(run):
    (names, table), out, fractions = run
    assert sorted(file.name for file in out.iterdir()) == FILES
    assert set(names) == set(FILES) - {"coverage.pgm"}
    assert (out / "table.txt").read_text() == table
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    with Image.open(out / "comparison.png") as image:
        assert image.width >= 1200


def test_the_coverage_files_are_of_the_partial_map(run):
    _, out, _ = run
    expected = predict_map(map_of(PICTURE), TX)
    xr.testing.assert_allclose(xr.load_dataset(out / "coverage.nc"), expected)


def test_the_table_compares_three_answers_in_three_areas(run):
    (_, table), _, _ = run
    rows = {line[:22].strip(): line[22:] for line in table.splitlines()[3:]}
    assert list(rows) == ["nothing observed", "partial trace alone", "partial map"]
    assert all(row.count("%") == row.count("dB") == 3 for row in rows.values())


def test_accuracy_and_error_are_those_of_the_receivers_inside_the_home(monkeypatch):
    use_fakes(monkeypatch)
    complete, known = map_of(COMPLETE), map_of(PICTURE)
    nothing = PartialMap(np.full_like(complete.state, CellState.UNKNOWN), 0.5, (-1.0, 2.0))
    maps = {TRUTH: complete, NOTHING: nothing, PARTIAL: known}
    coverages = {title: predict_map(scene, TX, spacing_m=0.5) for title, scene in maps.items()}
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


def test_an_area_without_receivers_has_no_score(monkeypatch):
    use_fakes(monkeypatch)
    complete = predict_map(map_of(COMPLETE), TX, spacing_m=0.5)
    table = comparison_table({TRUTH: complete, NOTHING: complete, PARTIAL: complete})
    assert "not observed (0)" in table
    assert table.splitlines()[-1].split()[2:] == ["100.0", "%", "0.0", "dB", "100.0", "%", "0.0", "dB", "-"]


def test_an_unknown_home_or_stage_is_named(scenes):
    with pytest.raises(SceneError, match=r"home = 'castle' is not in '.*scenes': choose one of hut\."):
        demo_scene("castle", 50)
    with pytest.raises(SceneError, match=r"step = 99 is not in '.*hut': choose one of 50\."):
        demo_scene("hut", 99)


def test_an_unwritable_folder_is_named(scenes, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        run_demo(tmp_path / "file" / "out", home="hut", step=50)
