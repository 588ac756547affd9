import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from coverage_fakes import map_of
from placement_fakes import HALF_SEEN, TOP_M, TWO_ROOMS, FakeScene, FakeViews, small_placement, use_fake_search

import sionna_partial as sp
from sionna_partial.errors import OutputError, PositionError, SettingsError
from sionna_partial.maps.map_files import save_map
from sionna_partial.placement import placement
from sionna_partial.placement.area import placement_area
from sionna_partial.placement.placement import Effort, TransmitterPlacement, place_transmitter

HOME = map_of(HALF_SEEN, 0.5, (0.0, 0.0))


def placed_bytes(found: TransmitterPlacement, folder: Path) -> bytes:
    found.save(folder / "placement.json")
    return (folder / "placement.json").read_bytes()


class TestSearch:
    def test_climbs_to_the_top(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(placement, "STEPS", (20, 20))
        found = small_placement(monkeypatch)
        assert np.linalg.norm(found.position_m[:2] - TOP_M) < 0.15
        assert found.position_m[2] == 1.5
        assert found.score == found.climb_scores.max() == found.scores[-1]
        np.testing.assert_array_equal(found.trajectory_m[-1], found.position_m)

    @pytest.mark.parametrize("edge_smoothing_m", [0.0, 0.25])
    def test_stays_where_a_transmitter_may_stand(
        self, edge_smoothing_m: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(placement, "CLIMBS", (4, 4))
        monkeypatch.setattr(placement, "STARTS", (8, 8))
        monkeypatch.setattr(placement, "STEPS", (5, 5))
        found = small_placement(monkeypatch, edge_smoothing_m=edge_smoothing_m)
        area = placement_area(HOME, 1.5, 1.5, None)
        assert len(found.climbs) > 1
        for climb in found.climbs:
            assert all(area.reaches(*ends) for ends in itertools.pairwise(climb.trajectory_m))
            assert (np.diff(climb.scores) > 0.0).all()
        apart_m = np.linalg.norm(found.climbs[0].trajectory_m[0] - found.climbs[1].trajectory_m[0])
        assert apart_m >= placement.APART_M

    def test_climbs_from_the_best_of_the_starts(self, monkeypatch: pytest.MonkeyPatch) -> None:
        found = small_placement(monkeypatch)
        assert len(found.starts_m) == len(found.start_scores) >= 2
        best = found.starts_m[found.start_scores.argmax()]
        np.testing.assert_array_equal(found.climbs[0].trajectory_m[0], best)

    def test_another_climb_begins_where_one_ends(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for name, limits in (("STARTS", (8, 8)), ("CLIMBS", (1, 1)), ("STEPS", (2, 2))):
            monkeypatch.setattr(placement, name, limits)
        monkeypatch.setattr(FakeViews, "slope", lambda self, place_m: (np.zeros(2), np.zeros((0, 3))))
        found = small_placement(monkeypatch, edge_smoothing_m=0.0)
        assert [(len(climb.scores), climb.ended) for climb in found.climbs] == [(1, True), (1, True)]
        first, second = (climb.scores[0] for climb in found.climbs)
        assert first == found.start_scores.max() > second

    def test_says_what_it_covers(self, monkeypatch: pytest.MonkeyPatch) -> None:
        found = small_placement(monkeypatch, threshold_db=-90.0, objective="percentile")
        assert len(found.rx_m) == len(found.weight) == len(found.values)
        assert found.partial == HOME
        assert (found.objective.name, found.objective.threshold_db) == ("percentile", -90.0)
        assert found.objective.softness_db == 0.0

    def test_certain_gains_are_softened_while_it_climbs(self, monkeypatch: pytest.MonkeyPatch) -> None:
        seen: list[float] = []

        class Views(FakeViews):
            def __init__(self, scene: Any, area: Any, objective: Any) -> None:
                super().__init__(scene, area, objective)
                seen.append(objective.softness_db)

        use_fake_search(monkeypatch)
        monkeypatch.setattr(placement, "PlacementViews", Views)
        place_transmitter(map_of(TWO_ROOMS, 0.5))
        place_transmitter(HOME)
        assert seen == [placement.SOFTNESS_DB, 0.0, 0.0, 0.0]

    def test_path_of_a_map(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        use_fake_search(monkeypatch)
        save_map(HOME, tmp_path / "map.yaml")
        np.testing.assert_array_equal(
            place_transmitter(tmp_path / "map.yaml").position_m, place_transmitter(HOME).position_m
        )

    def test_height(self, monkeypatch: pytest.MonkeyPatch) -> None:
        found = small_placement(monkeypatch, height_m=2.5, rx_height_m=0.7)
        assert found.position_m[2] == 2.5
        assert (found.trajectory_m[:, 2] == 2.5).all()
        assert (found.rx_m[:, 2] == 0.7).all()

    def test_progress_rises_to_one(self, monkeypatch: pytest.MonkeyPatch) -> None:
        calls: list[tuple[float, str]] = []
        small_placement(monkeypatch, progress=lambda share, message: calls.append((share, message)))
        shares = [share for share, _ in calls]
        assert shares == sorted(shares)
        assert (shares[0], shares[-1]) == (0.0, 1.0)
        assert any("climbing" in message for _, message in calls)


class TestRepeats:
    def test_same_seed_same_bytes(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        first, second, other = (small_placement(monkeypatch, seed=seed) for seed in (4, 4, 5))
        assert placed_bytes(first, tmp_path) == placed_bytes(second, tmp_path) != placed_bytes(other, tmp_path)

    def test_goes_on_where_it_was_stopped(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        """Wherever it is stopped, it ends with the same bytes, and looks at nothing twice but in the step it was in."""
        monkeypatch.setattr(placement, "STEPS", (4, 4))
        whole = placed_bytes(small_placement(monkeypatch), tmp_path)
        looks = FakeViews.looked
        for stop in range(0, looks, 3):
            checkpoint = tmp_path / f"{stop}.json"
            monkeypatch.setattr(FakeViews, "stop_at", stop)
            with pytest.raises(KeyboardInterrupt):
                small_placement(monkeypatch, checkpoint=checkpoint)
            monkeypatch.setattr(FakeViews, "stop_at", 10**9)
            assert placed_bytes(small_placement(monkeypatch, checkpoint=checkpoint), tmp_path) == whole
            assert FakeViews.looked <= looks
        assert FakeViews.looked < looks / 2

    def test_checkpoint_of_other_arguments(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        small_placement(monkeypatch, checkpoint=tmp_path / "search.json")
        for other in ({"seed": 1}, {"threshold_db": -99.0}, {"height_m": 1.4}, {"edge_smoothing_m": 0.0}):
            with pytest.raises(OutputError, match="is that of another map or other arguments"):
                small_placement(monkeypatch, checkpoint=tmp_path / "search.json", **other)

    def test_record(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        found = small_placement(monkeypatch)
        record = json.loads(placed_bytes(found, tmp_path))
        assert record["position_m"] == found.position_m.tolist()
        assert record["score"] == found.score
        assert record["trajectory_m"] == found.trajectory_m.tolist()
        assert record["settings"]["trace_settings"]["frequency_hz"] == 28e9
        assert len(record["climbs"]) == len(found.climbs)


class TestEffort:
    def test_grows_with_the_area(self) -> None:
        efforts = [Effort.of_area(area_m2, 300) for area_m2 in (1.0, 10.0, 30.0, 100.0, 1000.0, 1e5)]
        for name in ("starts", "climbs", "steps"):
            counts = [getattr(effort, name) for effort in efforts]
            assert counts == sorted(counts)
        assert efforts[0] == Effort(6, 1, 1)
        assert efforts[-1] == Effort(16, 4, 4)

    def test_is_a_tenth_of_an_exhaustive_search_or_less(self) -> None:
        for area_m2 in (30.0, 100.0, 300.0):
            effort = Effort.of_area(area_m2, 500)
            looks = effort.starts + 6 * effort.climbs * effort.steps + (0.7 + 500 / 400)
            assert looks <= 0.1 * area_m2 / 0.25 * (0.7 + 500 / 400)


class TestErrors:
    @pytest.fixture(autouse=True)
    def fakes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        use_fake_search(monkeypatch)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"objective": "all"}, "objective = 'all' is not allowed: give 'coverage' or 'percentile'"),
            ({"threshold_db": -150.0}, r"threshold_db = -150\.0 is not allowed: give a number in \(-150, 0\]"),
            ({"threshold_db": 0.1}, r"threshold_db = 0\.1 is not allowed"),
            ({"height_m": 0.0}, r"height_m = 0\.0 is not allowed: give a number in \(0, 3\]"),
            ({"height_m": 3.0}, r"height_m = 3\.0 is not allowed: stay below the ceiling at 3 m"),
            ({"rx_height_m": 4.0}, r"rx_height_m = 4\.0 is not allowed: give a number in \(0, 3\]"),
            ({"seed": -1}, "seed = -1 is not allowed: give a whole number of 0 or more"),
            ({"edge_smoothing_m": -0.1}, r"edge_smoothing_m = -0\.1 is not allowed: give a number in \[0, 10\]"),
        ],
    )
    def test_settings(self, options: dict[str, Any], message: str) -> None:
        with pytest.raises(SettingsError, match=message):
            place_transmitter(HOME, **options)

    def test_no_free_cell(self) -> None:
        with pytest.raises(PositionError, match="a transmitter can stand nowhere: the map has 0 free cells"):
            place_transmitter(map_of("??#\n###", 0.5))

    def test_paths_that_only_rays_find(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.undo()
        with pytest.raises(SettingsError, match="refraction = True is not allowed: paths that are found by shooting"):
            place_transmitter(HOME, trace_settings=sp.TraceSettings(refraction=True))


class TestWithSionna:
    @pytest.mark.parametrize("objective", ["coverage", "percentile"])
    def test_finds_the_door(self, objective: str, tmp_path: Path) -> None:
        """Two closed rooms with a door: from the door both are seen, from nowhere else are as many places."""
        state = np.zeros((34, 62), dtype=np.uint8)
        state[[0, -1], :] = state[:, [0, -1]] = state[:, 30] = sp.CellState.WALL
        state[14:20, 30] = sp.CellState.FREE
        home = sp.PartialMap(state, 0.1)
        options: dict[str, Any] = {"trace_settings": sp.TraceSettings(max_depth=1, diffraction=False)}
        found, again = (
            place_transmitter(home, objective=objective, threshold_db=-90.0, seed=1, **options) for _ in range(2)
        )
        assert placed_bytes(found, tmp_path) == placed_bytes(again, tmp_path)
        corner = (1.0, 0.6, 1.5)
        rx = found.rx_m[np.linalg.norm(found.rx_m - found.position_m, axis=1) > 0.02]
        gains_db = [
            sp.trace_links(home, place, rx, settings=options["trace_settings"]).gain_db
            for place in (found.position_m, corner)
        ]
        if objective == "coverage":
            assert found.score == pytest.approx(np.mean(gains_db[0] > -90.0), abs=1.5 / len(rx))
            assert found.score > np.mean(gains_db[1] > -90.0)
        assert np.sort(gains_db[0])[: len(rx) // 10].mean() >= np.sort(gains_db[1])[: len(rx) // 10].mean()

    def test_fake_scene_is_built_like_the_true_one(self) -> None:
        scene = sp.DifferentiableScene(HOME, predictor="paper", trace_settings=None, scene_settings=None)
        fake = FakeScene(HOME, predictor=None, trace_settings=None, scene_settings=None)
        assert {*vars(fake)} <= {*vars(scene)}
        assert scene.paths.settings.frequency_hz == fake.paths.settings.frequency_hz
