"""Links of one home: positions, truth, features, and what does not depend on what."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from link_tables import assert_same

from sionna_partial.constants import GAIN_FLOOR_DB, SPEED_OF_LIGHT_M_S, CellState, LinkState
from sionna_partial.errors import MapError, PredictorError, SettingsError
from sionna_partial.lab.datasets.home_links import (
    NEAREST_M,
    HomeSource,
    enclosed_map,
    home_links,
    home_sensor,
    home_sources,
    map_area,
)
from sionna_partial.lab.datasets.settings import MIXED_SENSORS, SHORT_LINK_M, DatasetSettings
from sionna_partial.lab.datasets.shards import read_shard, write_shard
from sionna_partial.lab.datasets.table import CIR, LinkTable
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.prediction.features import link_features
from sionna_partial.settings import SensorSettings, TraceSettings
from sionna_partial.tracing.trace import trace_links
from sionna_partial.worlds.homes import make_home

SETTINGS = DatasetSettings(
    links_per_home=31, transmitters_per_home=3, stages=(0, 3, 40), trace=TraceSettings(max_depth=2)
)


def two_rooms(grid: tuple[int, int] = (50, 70), corner: tuple[int, int] = (2, 3)) -> PartialMap:
    """6 m x 4 m of free cells in walls, parted by a wall with a door of 1 m, somewhere in a grid."""
    state = np.full(grid, CellState.UNKNOWN, dtype=np.uint8)
    room = np.full((42, 62), CellState.WALL, dtype=np.uint8)
    room[1:-1, 1:-1] = CellState.FREE
    room[1:15, 30] = room[25:-1, 30] = CellState.WALL
    state[corner[0] : corner[0] + 42, corner[1] : corner[1] + 62] = room
    return PartialMap(state, 0.1, (-7.0, 11.0))


@pytest.fixture(scope="module")
def home() -> PartialMap:
    return two_rooms()


@pytest.fixture(scope="module")
def table(home: PartialMap) -> LinkTable:
    return home_links(home, "two rooms", SETTINGS)


class TestPlaces:
    def test_counts(self, home: PartialMap, table: LinkTable) -> None:
        assert len(table) == 2 * 31 * 3
        assert set(table.home) == {"two rooms"}
        assert table.take(slice(3)).complete_maps == {"two rooms": map_area(home, SETTINGS.margin_m)}
        first = table.take(table.stage == 0)
        for stage in SETTINGS.stages:
            here = table.take(table.stage == stage)
            _, counts = np.unique(here.context.tx_m, axis=0, return_counts=True)
            assert sorted(counts) == [20, 20, 22]
            for name in ("link_state", "gain_db", "inside", "anywhere"):
                np.testing.assert_array_equal(getattr(here, name), getattr(first, name))
            np.testing.assert_array_equal(here.context.rx_m, first.context.rx_m)
        outside = first.take(~first.inside)
        assert len(outside)
        assert (outside.link_state == LinkState.OUTAGE).all()
        assert (outside.gain_db == GAIN_FLOOR_DB).all()

    def test_where_they_are(self, home: PartialMap, table: LinkTable) -> None:
        state = home.state_at(table.context.rx_m)
        assert (home.state_at(table.context.tx_m) == CellState.FREE).all()
        assert (state[~table.anywhere] == CellState.FREE).all()
        assert not (state == CellState.WALL).any()
        np.testing.assert_array_equal(table.inside, state == CellState.FREE)
        x0, y0, x1, y1 = map_area(home, SETTINGS.margin_m).bounds_m
        assert (table.context.rx_m[:, :2] >= (x0, y0)).all()
        assert (table.context.rx_m[:, :2] <= (x1, y1)).all()

    def test_none_is_at_its_transmitter(self) -> None:
        state = np.full((5, 5), CellState.WALL, dtype=np.uint8)
        state[1:4, 1:4] = CellState.FREE
        settings = DatasetSettings(links_per_home=300, transmitters_per_home=1, stages=(0,), margin_m=0.0)
        table = home_links(PartialMap(state, 0.1), "closet", settings)
        assert table.phi.distance_m.min() >= NEAREST_M
        assert table.phi.distance_m.min() < NEAREST_M + 0.02

    def test_short_links(self) -> None:
        state = np.full((22, 1002), CellState.WALL, dtype=np.uint8)
        state[1:-1, 1:-1] = CellState.FREE
        settings = DatasetSettings(30, 1, (0,), short_link_fraction=0.5, trace=TraceSettings(max_depth=0))
        table = home_links(PartialMap(state, 0.1), "corridor", settings)
        for anywhere in (False, True):
            distance_m = table.phi.distance_m[table.anywhere == anywhere]
            assert len(distance_m) == 30
            assert 15 <= (distance_m <= SHORT_LINK_M + 0.2).sum() < 30

    def test_impulse_responses(self, home: PartialMap, table: LinkTable, tmp_path: Path) -> None:
        write_shard(home_links(home, "two rooms", replace(SETTINGS, cir_paths=400)), tmp_path / "home.parquet", {})
        found = read_shard(tmp_path / "home.parquet")
        np.testing.assert_array_equal(found.gain_db, table.gain_db)
        assert table.cir == {}
        real, imaginary, delay_s = (found.cir[name] for name in CIR)
        power = real.astype(float) ** 2 + imaginary.astype(float) ** 2
        has_path = found.gain_db > GAIN_FLOOR_DB
        np.testing.assert_allclose(10 * np.log10(power.sum(axis=1)[has_path]), found.gain_db[has_path], atol=0.2)
        np.testing.assert_array_equal(np.isnan(delay_s), power == 0.0)
        assert (np.diff(power, axis=1) <= 1e-6 * power[:, :1]).all()
        in_sight = found.link_state == LinkState.LOS
        distance_m = np.nanmin(delay_s[in_sight], axis=1) * SPEED_OF_LIGHT_M_S
        np.testing.assert_allclose(distance_m, found.features.distance_m[in_sight], rtol=1e-5)
        assert LinkTable.concatenate([found, table]).cir == {}

    def test_stages_by_observed_fraction(self, home: PartialMap) -> None:
        table = home_links(home, "two rooms", replace(SETTINGS, stages=(0, 0.3, 0.6)))
        assert np.unique(table.stage).tolist() == [0.0, 0.3, 0.6]
        assert (table.observed_fraction >= table.stage).all()


def test_a_stage_of_1_is_a_map_that_is_closed_where_the_robot_saw_nothing(home: PartialMap) -> None:
    """What is known stays, walls come between the free cells and the unknown; truth is of the home."""
    settings = replace(SETTINGS, stages=(0.3, 1), sensor=SensorSettings(field_of_view_deg=90.0))
    table = home_links(home, "two rooms", settings)
    seen, closed = table.maps
    assert closed.is_complete
    assert not seen.is_complete
    known = seen.state != CellState.UNKNOWN
    np.testing.assert_array_equal(closed.state[known & (closed.state != CellState.UNKNOWN)], seen.state[known])
    (enclosed,) = {each.is_complete for each in [enclosed_map(seen)]}
    assert enclosed
    changed = enclosed_map(seen).state != seen.state
    assert changed.any()
    assert (seen.state[changed] == CellState.UNKNOWN).all()
    assert (enclosed_map(seen).state[changed] == CellState.WALL).all()
    last, first = (table.take(table.stage == stage) for stage in (1, 0.3))
    np.testing.assert_array_equal(last.gain_db, first.gain_db)


class TestTruthAndFeatures:
    def test_truth_is_the_trace_on_the_complete_home(self, home: PartialMap, table: LinkTable) -> None:
        here = table.take((table.stage == 40) & table.inside)
        for tx in np.unique(here.context.tx_m, axis=0):
            mine = here.take((here.context.tx_m == tx).all(axis=1))
            links = trace_links(home, tx, mine.context.rx_m, trace_settings=SETTINGS.trace)
            np.testing.assert_array_equal(mine.link_state, links.link_state)
            np.testing.assert_allclose(mine.gain_db, links.gain_db, atol=1e-3)

    def test_features_are_those_of_the_partial_map(self, home: PartialMap, table: LinkTable) -> None:
        assert_same(home_links(home, "two rooms", SETTINGS), table)
        area = map_area(home, SETTINGS.margin_m)
        for before, after in itertools.pairwise((*table.maps, area)):
            known = before.state != CellState.UNKNOWN
            np.testing.assert_array_equal(before.state[known], after.state[known])
            assert before.observed_fraction < after.observed_fraction
        np.testing.assert_array_equal(np.array(SETTINGS.stages)[table.map_index], table.stage)
        for number, partial in enumerate(table.maps):
            here = table.take(table.map_index == number)
            links, tx = here.context, here.context.tx_m[0]
            assert here.observed_fraction == pytest.approx(partial.observed_fraction)
            for seen, places_m in ((links.tx_seen, links.tx_m), (links.rx_seen, links.rx_m)):
                np.testing.assert_array_equal(seen, partial.state_at(places_m) != CellState.UNKNOWN)
            mine = here.take((links.tx_m == tx).all(axis=1))
            phi = link_features(partial, trace_links(partial, tx, mine.context.rx_m, trace_settings=SETTINGS.trace))
            for found, expected, names in (
                (mine.phi, phi, ("link_state", "unobserved_distance_m", "gain_db")),
                (mine.context, phi.context, ("indirect_gain_db", "strongest_unobserved_m")),
            ):
                for name in names:
                    np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


class TestSeeds:
    @pytest.mark.parametrize(("name", "seed"), [("other", 0), ("two rooms", 1)])
    def test_places_depend_on_name_and_seed(self, home: PartialMap, table: LinkTable, name: str, seed: int) -> None:
        settings = replace(SETTINGS, stages=(0,), seed=seed)
        assert not np.isin(home_links(home, name, settings).context.rx_m[:, 0], table.context.rx_m[:, 0]).any()

    def test_sensor_is_that_of_the_settings(self, home: PartialMap, table: LinkTable) -> None:
        far = replace(SETTINGS, sensor=SensorSettings(field_of_view_deg=360.0, range_m=20.0))
        seen = home_links(home, "two rooms", far).observed_fraction
        assert (seen > table.observed_fraction).any()
        wrong = home_links(home, "two rooms", replace(SETTINGS, sensor=SensorSettings(0.1, 0.1)))
        for number, partial in enumerate(wrong.maps):
            here = wrong.map_index == number
            for places_m in (wrong.context.tx_m[here], wrong.context.rx_m[here]):
                assert (partial.state_at(places_m) != CellState.WALL).all()

    def test_mixed_sensors_are_drawn_by_name_and_seed(self) -> None:
        settings = replace(SETTINGS, sensor="mixed")
        drawn = [home_sensor(f"home {number}", settings) for number in range(40)]
        assert drawn == [home_sensor(f"home {number}", settings) for number in range(40)]
        assert drawn[0] != home_sensor("home 0", replace(settings, seed=1))
        around = np.mean([sensor.field_of_view_deg == 360.0 for sensor in drawn])
        assert 0.5 < around < 0.85
        for name, (low, high) in MIXED_SENSORS.items():
            values = [getattr(sensor, name) for sensor in drawn]
            within = [low <= value <= high or value == 360.0 for value in values]
            assert all(within), name
        assert home_sensor("home 0", SETTINGS) == SETTINGS.sensor

    def test_size_of_the_grid_is_of_no_account(self, home: PartialMap, table: LinkTable) -> None:
        moved = two_rooms((200, 300), (120, 44))
        shift = (np.array([44, 120]) - [3, 2]) * 0.1
        moved = replace(moved, origin_m=tuple(np.array(moved.origin_m) - shift))
        other = home_links(moved, "two rooms", SETTINGS)
        np.testing.assert_allclose(other.context.rx_m, table.context.rx_m, atol=1e-9)
        np.testing.assert_array_equal(other.link_state, table.link_state)
        assert map_area(home, 0.25).shape == (42 + 2 * 3, 62 + 2 * 3)


class TestRefused:
    @pytest.mark.parametrize(
        ("cells", "message"),
        [
            ([[1, 1], [1, 1]], "has no free cell: give maps of whole homes, with rooms"),
            ([[1, 1, 1], [1, 0, 1], [1, 1, 1]], r"is too small, all of it is within 0\.1 m of a transmitter: leave"),
            ([[0, 2]], "is not complete, a free cell touches an unknown one: give maps of"),
        ],
    )
    def test_homes(self, cells: list[list[int]], message: str) -> None:
        with pytest.raises(MapError, match=f"home 'ruin' {message}"):
            home_links(PartialMap(cells, 0.1), "ruin", SETTINGS)

    def test_home_that_is_cut_off_at_the_border_of_its_grid_is_closed_there(
        self, home: PartialMap, caplog: pytest.LogCaptureFixture
    ) -> None:
        column = int(np.flatnonzero((home.state == CellState.FREE).any(axis=0))[-3])
        table = home_links(replace(home, state=home.state[:, :column]), "cut", replace(SETTINGS, stages=(0,)))
        assert len(table) > 0
        assert "home 'cut' has free cells at the border of its grid" in caplog.text

    def test_tables(self, table: LinkTable) -> None:
        with pytest.raises(PredictorError, match="features has no context: give the LinkFeatures of"):
            replace(table, features=replace(table.features, context=None))
        with pytest.raises(PredictorError, match=r"gain_db\[1\] = nan"):
            replace(table, gain_db=np.where(np.arange(len(table)) == 1, np.nan, table.gain_db))
        with pytest.raises(PredictorError, match=r"parts is empty: give at least one LinkTable\."):
            LinkTable.concatenate([])


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    (tmp_path / "house").mkdir()
    (tmp_path / "scene").mkdir()
    (tmp_path / "empty").mkdir()
    for name in ("one.yaml", "two.npz", "picture.png", "house/map.yaml", "scene/map.yaml", "scene/scene.xml"):
        (tmp_path / name).touch()
    return tmp_path


def test_seeds() -> None:
    assert home_sources(range(3, 5)) == [HomeSource("make_home(3)", 3), HomeSource("make_home(4)", 4)]
    assert home_sources([(3, None)]) == home_sources([3])
    (source,) = home_sources([(3, "hall")])
    assert source.record == {"name": "make_home(3, hall)", "seed": 3, "kind": "hall"}
    assert source.load() == make_home(3, "hall")


def test_folder_of_maps(maps: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = {source.name: source.origin for source in home_sources([maps])}
    expected = {"house": "house/map.yaml", "one": "one.yaml", "scene": "scene/scene.xml", "two": "two.npz"}
    assert found == {name: str(maps / file) for name, file in expected.items()}
    source = HomeSource("house", found["house"])
    monkeypatch.chdir(maps)
    assert home_sources(["house"]) == home_sources([maps / "house" / "map.yaml"]) == [source]
    assert source.record == {"name": "house", "path": found["house"]}


@pytest.mark.parametrize(
    ("homes", "message"),
    [
        ([], "homes is empty: give seeds of make_home, or paths of complete maps"),
        ([(-1, "hall")], "seed = -1 is not allowed"),
        ([(3, "castle")], "kind = 'castle' is not allowed"),
        (["empty"], r"empty' holds no map: give a folder with maps \(\.yaml, \.yml, \.npz\), or with"),
        (["nowhere"], "nowhere' is not there: give complete maps"),
        (["house", "house/map.yaml"], r"two homes are called '.*', .* and .*: leave one out, or rename"),
        *(([home], f"home = {home} is neither a seed nor a path: give a seed") for home in (True, 1.5)),
    ],
)
def test_refused(maps: Path, monkeypatch: pytest.MonkeyPatch, homes: list[Any], message: str) -> None:
    monkeypatch.chdir(maps)
    with pytest.raises((MapError, SettingsError), match=message):
        home_sources(homes)
