"""Links through Parquet files: nothing is lost, equal links give equal bytes, and damage is no empty file."""

import base64
import json
import re
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dataset_fakes import fake_links
from link_tables import assert_same, make_dataset, make_table

from sionna_partial.errors import PredictorError
from sionna_partial.lab.datasets import shards
from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.lab.datasets.shards import (
    FORMAT,
    file_stem,
    read_dataset,
    read_shard,
    shard_metadata,
    shard_path,
    write_shard,
)
from sionna_partial.lab.datasets.table import COLUMNS, LinkTable
from sionna_partial.lab.datasets.traces import LinkTraces, open_links, require_like, settings_for
from sionna_partial.settings import Material, PredictorSettings

NOTES = {"home": {"name": "villa", "seed": 3}, "settings": {"stages": [0, 50]}}


@pytest.fixture
def links() -> LinkTable:
    return fake_links(None, "villa (north)", DatasetSettings(links_per_home=7, stages=(0, 50)))


@pytest.fixture
def shard(links: LinkTable, tmp_path: Path) -> Path:
    write_shard(links, tmp_path / "villa.parquet", NOTES)
    return tmp_path / "villa.parquet"


class TestShard:
    def test_round_trip(self, links: LinkTable, shard: Path, tmp_path: Path) -> None:
        assert_same(read_shard(shard), links)
        brick = Material(itu="brick", thickness_m=0.12)
        maps = {name: replace(each, material=brick) for name, each in links.complete_maps.items()}
        wifi = replace(links, complete_maps=maps, features=replace(links.features, frequency_hz=5e9))
        write_shard(wifi, tmp_path / "wifi.parquet", NOTES)
        assert read_shard(tmp_path / "wifi.parquet").complete_maps == maps
        assert read_shard(tmp_path / "wifi.parquet").features.frequency_hz == 5e9

    def test_columns_and_notes_of_the_file(self, links: LinkTable, shard: Path) -> None:
        columns = pq.read_table(shard)
        positions = {f"{end}_{axis}_m" for end in ("tx", "rx") for axis in "xyz"}
        phi = {"partial_link_state", "partial_gain_db", "unobserved_distance_m", "distance_m"}
        indirect = {f"indirect_gain_reach_{reach}_m_db" for reach in ("inf", "4", "1", "0.25", "0")}
        others = {"straight_gain_db", "straight_walls", "wall_loss_db", "strongest_unobserved_m", "map_index"}
        assert {*columns.column_names} == {*COLUMNS} | positions | phi | indirect | others
        np.testing.assert_array_equal(columns["indirect_gain_reach_4_m_db"], links.context.indirect_gain_db[:, 1])
        np.testing.assert_array_equal(columns["partial_gain_db"], links.phi.gain_db)
        notes = shard_metadata(shard)
        del notes["maps"]
        assert notes == {"format": FORMAT, "frequency_hz": None, **NOTES}

    def test_equal_links_give_equal_bytes(self, links: LinkTable, shard: Path, tmp_path: Path) -> None:
        write_shard(links, tmp_path / "again.parquet", dict(reversed(NOTES.items())))
        assert (tmp_path / "again.parquet").read_bytes() == shard.read_bytes()
        write_shard(replace(links, gain_db=links.gain_db + 1e-9), tmp_path / "other.parquet", NOTES)
        assert (tmp_path / "other.parquet").read_bytes() != shard.read_bytes()


def rewrite(path: Path, distance_m: float | None = None, partial: object = None, **of_home: object) -> None:
    """Write a shard again with other distances, partial maps, or entries of the complete map."""
    table = pq.read_table(path)
    notes = {**table.schema.metadata}
    maps = json.loads(notes[b"sionna_partial.maps"])
    maps["partial"] = maps["partial"] if partial is None else partial
    maps["complete"] = {name: home | of_home for name, home in maps["complete"].items()}
    notes[b"sionna_partial.maps"] = json.dumps(maps).encode()
    if distance_m is not None:
        column = table.column_names.index("distance_m")
        field = table.schema.field("distance_m")
        table = table.set_column(column, field, pa.array(np.full(len(table), distance_m)))
    pq.write_table(table.replace_schema_metadata(notes), path)


def flip_a_byte_of_a_column(path: Path) -> None:
    content = bytearray(path.read_bytes())
    column = pq.read_metadata(path).row_group(0).column(5)
    content[column.dictionary_page_offset + column.total_compressed_size - 1] ^= 0xFF
    path.write_bytes(content)


SEVENS = base64.b64encode(zlib.compress(b"\7" * 15)).decode()
DAMAGED = "is damaged, or no Parquet file"
SPOILS: list[tuple[Callable[[Path], object], str]] = [
    (Path.unlink, r"villa\.parquet' cannot be read \(No such file"),
    (lambda path: path.write_bytes(path.read_bytes()[:-20]), f"{DAMAGED} .*: delete"),
    (flip_a_byte_of_a_column, DAMAGED),
    (lambda path: pq.write_table(pa.table({"a": [1]}), path), "is no shard of this version .* build the data"),
    (lambda path: rewrite(path, distance_m=-1.0), rf"{DAMAGED} \(distance_m\[0\] = -1"),
    (lambda path: rewrite(path, partial=[]), rf"{DAMAGED} \(.*tuple index out of range"),
    (lambda path: rewrite(path, cells="AAAA"), rf"{DAMAGED} \(.*Error -3"),
    (lambda path: rewrite(path, shape=[3, 4]), rf"{DAMAGED} \(.*reshape"),
    (lambda path: rewrite(path, shape=[20_000, 20_000]), rf"{DAMAGED} \(.*more than 100,000,000"),
    (lambda path: rewrite(path, cells=SEVENS), rf"{DAMAGED} \(.*state has values 7 to 7"),
]


@pytest.mark.parametrize(("spoil", "message"), SPOILS)
def test_damaged(shard: Path, spoil: Callable[[Path], object], message: str) -> None:
    spoil(shard)
    with pytest.raises(PredictorError, match=message):
        read_shard(shard)


def test_too_many_links(shard: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shards, "_MAX_LINKS", 1)
    with pytest.raises(PredictorError, match="has more than 1 links: give a shard of one home"):
        read_shard(shard)


def test_names_of_files_are_short() -> None:
    long = [f"{'ä' * 150}{end}" for end in "ab"]
    assert file_stem("villa") == "villa"
    assert len({file_stem(name) for name in long}) == 2
    assert all(len(file_stem(name).encode()) < 200 for name in long)


def test_homes_of_a_folder_in_the_order_of_the_list(tmp_path: Path) -> None:
    names = ("b", "a", "missing", "c")
    (tmp_path / "dataset.json").write_text(json.dumps({"homes": [{"name": name} for name in names]}))
    with pytest.raises(PredictorError, match=r"has no home yet: run `sionna-partial dataset` again"):
        read_dataset(tmp_path)
    shard_path(tmp_path, "a").parent.mkdir()
    for name in ("a", "b", "c"):
        write_shard(fake_links(None, name, DatasetSettings(links_per_home=4)), shard_path(tmp_path, name), {})
    links = read_dataset(tmp_path)
    assert list(dict.fromkeys(links.home.tolist())) == ["b", "a", "c"]
    assert_same(links.take(links.home == "a"), read_shard(shard_path(tmp_path, "a")))
    assert list(dict.fromkeys(read_dataset(tmp_path, ["c", "b"]).home.tolist())) == ["c", "b"]
    for homes, message in (
        (["missing"], r"home 'missing' is not in '.*': choose from 'b', 'a', 'c'\."),
        ("b", r"homes = .* is not allowed: give names of homes"),
        (np.full((2, 2), 7), r"homes = .* is not allowed: give names of homes"),
    ):
        with pytest.raises(PredictorError, match=message):
            read_dataset(tmp_path, homes)


def test_folders_without_a_list_of_homes(tmp_path: Path) -> None:
    with pytest.raises(PredictorError, match=r"is no data set, it has no dataset\.json: give a folder that"):
        read_dataset(tmp_path)
    (tmp_path / "dataset.json").write_text('{"homes": [3]}')
    with pytest.raises(PredictorError, match=r"dataset\.json' is damaged .*: build the data set again"):
        read_dataset(tmp_path)


class TestOpenLinks:
    @pytest.mark.parametrize(("noted", "found"), [(None, True), (False, False)])
    def test_folder_says_how_it_was_traced(self, noted, found, tmp_path):
        table = make_table(homes=2)
        links, traces = open_links(make_dataset(tmp_path, table, frequency_hz=60e9, diffraction=noted))
        assert len(links) == len(table)
        assert traces == LinkTraces(60e9, found)
        assert open_links(table) == (table, None)
        learning = settings_for(traces, networks="paths", passes=7, seed=8)
        assert learning == PredictorSettings("paths", frequency_hz=60e9, diffraction=found, passes=7, seed=8)
        assert settings_for(None) == PredictorSettings("map")

    def test_homes_explored_anew_in_each_of_several_folders(self, tmp_path):
        table = make_table(homes=2)
        folders = [make_dataset(tmp_path / name, table) for name in ("one", "two")]
        links, _ = open_links(folders)
        assert len(links) == 2 * len(table)
        assert set(links.home) == set(table.home)

    def test_refused(self, tmp_path):
        table = make_table(homes=1)
        ((name, home),) = table.complete_maps.items()
        moved = replace(table, complete_maps={name: replace(home, origin_m=(1.0, 2.0))})
        one, two = make_dataset(tmp_path / "one", table), make_dataset(tmp_path / "two", moved)
        wifi = make_dataset(tmp_path / "wifi", table, frequency_hz=60e9)
        bare = make_dataset(tmp_path / "bare", table)
        (bare / "dataset.json").write_text(json.dumps({"homes": [{"name": name}]}))
        for dataset, message in (
            (table.take(table.anywhere), "dataset has no links with receivers drawn indoors: build one"),
            ([one, wifi], f"'{wifi}' was traced at 60 GHz with diffraction, '{one}' at 28 GHz with diffraction"),
            ([one, two], f"'{two}' has another home {name!r} than those before: give one of the two."),
            ([one, one], f"dataset has '{one}' twice"),
            ([], "dataset = [] is not allowed: give a LinkTable, or one or more folders"),
            ([3], "dataset = [3] is not allowed: give a LinkTable, or one or more folders"),
            (bare, "dataset.json' is damaged (KeyError('settings')): build"),
        ):
            with pytest.raises(PredictorError, match=re.escape(message)):
                open_links(dataset)


def test_traces_must_be_like_the_predictors() -> None:
    known = LinkTraces.of_settings(PredictorSettings()), "predictor 'x' was trained", "choose another."
    for alike in (None, LinkTraces(28e9 + 1.0, True)):
        require_like(alike, *known)
    for found, words in (
        (LinkTraces(60e9, True), "at 60 GHz with diffraction"),
        (LinkTraces(28e9, False), "at 28 GHz without diffraction"),
        (LinkTraces(28e9, True, True), "at 28 GHz through walls with diffraction"),
    ):
        message = f"was traced {words}, predictor 'x' was trained at 28 GHz with diffraction: choose another."
        with pytest.raises(PredictorError, match=message):
            require_like(found, *known)
