"""Links through Parquet files: nothing is lost, equal links give equal bytes, and damage is no empty file."""

import base64
import json
import re
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from dataset_fakes import fake_links
from link_tables import assert_same, make_dataset, make_table

from sionna_partial.datasets import shards
from sionna_partial.datasets.shards import (
    COLUMNS,
    FORMAT,
    LinkTable,
    LinkTraces,
    file_stem,
    open_links,
    read_dataset,
    read_shard,
    require_like,
    settings_for,
    shard_metadata,
    shard_path,
    write_shard,
)
from sionna_partial.errors import PredictorError
from sionna_partial.settings import DatasetSettings, Material, PredictorSettings

PLAIN = {"shape": [2, 3], "resolution_m": 0.5, "origin_m": [0, 0], "wall_height_m": 3.0, "interior_cells": None}
NOTES = {"home": {"name": "villa", "seed": 3}, "settings": {"stages": [0, 50]}}


def packed(cells: bytes) -> str:
    return base64.b64encode(zlib.compress(cells)).decode()


@pytest.fixture
def links() -> LinkTable:
    return fake_links(None, "villa (north)", DatasetSettings(links_per_home=7, stages=(0, 50)))


@pytest.fixture
def shard(links: LinkTable, tmp_path: Path) -> Path:
    write_shard(links, tmp_path / "villa.parquet", NOTES)
    return tmp_path / "villa.parquet"


class TestShard:
    def test_materials_of_maps_come_back(self, links: LinkTable, tmp_path: Path) -> None:
        brick = Material(itu="brick", thickness_m=0.12)
        maps = {name: replace(each, material=brick) for name, each in links.complete_maps.items()}
        write_shard(replace(links, complete_maps=maps), tmp_path / "brick.parquet", NOTES)
        assert read_shard(tmp_path / "brick.parquet").complete_maps == maps

    def test_round_trip(self, links: LinkTable, shard: Path) -> None:
        assert_same(read_shard(shard), links)

    def test_every_column_of_the_table_is_in_the_file_with_its_unit(self, shard: Path) -> None:
        names = set(pq.read_schema(shard).names)
        positions = {f"{end}_{axis}_m" for end in ("tx", "rx") for axis in "xyz"}
        phi = {"partial_link_state", "partial_gain_db", "unobserved_distance_m", "distance_m"}
        indirect = {f"indirect_gain_reach_{reach}_m_db" for reach in ("inf", "4", "1", "0.25", "0")}
        straight = {"straight_gain_db", "straight_walls", "wall_loss_db"}
        others = {"strongest_unobserved_m", "map_index"}
        assert names == {*COLUMNS} | positions | phi | indirect | straight | others

    def test_columns_hold_what_they_say(self, links: LinkTable, shard: Path) -> None:
        columns = pq.read_table(shard)
        np.testing.assert_array_equal(columns["rx_y_m"], links.context.rx_m[:, 1])
        np.testing.assert_array_equal(columns["indirect_gain_reach_4_m_db"], links.context.indirect_gain_db[:, 1])
        np.testing.assert_array_equal(columns["partial_gain_db"], links.phi.gain_db)
        np.testing.assert_array_equal(columns["gain_db"], links.gain_db)
        np.testing.assert_array_equal(columns["partial_link_state"], links.phi.link_state)

    def test_notes(self, shard: Path) -> None:
        notes = shard_metadata(shard)
        expected = {"format": FORMAT, "frequency_hz": None, **NOTES}
        assert {name: notes[name] for name in notes if name != "maps"} == expected

    def test_frequency_comes_back(self, links: LinkTable, tmp_path: Path) -> None:
        wifi = replace(links, features=replace(links.features, frequency_hz=5e9))
        write_shard(wifi, tmp_path / "wifi.parquet", NOTES)
        assert read_shard(tmp_path / "wifi.parquet").features.frequency_hz == 5e9

    def test_equal_links_give_equal_bytes(self, links: LinkTable, shard: Path, tmp_path: Path) -> None:
        write_shard(links, tmp_path / "again.parquet", dict(reversed(NOTES.items())))
        assert (tmp_path / "again.parquet").read_bytes() == shard.read_bytes()
        write_shard(replace(links, gain_db=links.gain_db + 1e-9), tmp_path / "other.parquet", NOTES)
        assert (tmp_path / "other.parquet").read_bytes() != shard.read_bytes()


class TestDamaged:
    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(PredictorError, match=r"no\.parquet' cannot be read \(No such file"):
            read_shard(tmp_path / "no.parquet")

    @pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
    def test_truncated(self, shard: Path, share: float) -> None:
        content = shard.read_bytes()
        shard.write_bytes(content[: int(share * len(content))])
        with pytest.raises(PredictorError, match=r"villa\.parquet' is damaged, or no Parquet file .*: delete it and"):
            read_shard(shard)

    def test_one_byte_of_a_column(self, shard: Path) -> None:
        content = bytearray(shard.read_bytes())
        column = pq.read_metadata(shard).row_group(0).column(5)
        content[column.dictionary_page_offset + column.total_compressed_size - 1] ^= 0xFF
        shard.write_bytes(content)
        with pytest.raises(PredictorError, match=r"villa\.parquet' is damaged"):
            read_shard(shard)

    @pytest.mark.parametrize("start", [b"rx_x_m", b"ARROW:schema"])
    def test_one_byte_of_the_names_or_notes(self, shard: Path, start: bytes) -> None:
        content = shard.read_bytes()
        first, refused = content.rindex(start), list[str]()
        for offset in range(first, min(first + 1000, len(content)), 3):
            shard.write_bytes(content[:offset] + bytes([content[offset] ^ 0x80]) + content[offset + 1 :])
            try:
                shard_metadata(shard)
            except PredictorError as error:
                refused.append(str(error))
        assert len(refused) > 100
        assert all(re.search("is damaged|is no shard", message) for message in refused)

    def test_foreign(self, tmp_path: Path) -> None:
        pq.write_table(pa.table({"a": [1]}), tmp_path / "foreign.parquet")
        with pytest.raises(PredictorError, match=r"foreign\.parquet' is no shard of this version .* build the data"):
            read_shard(tmp_path / "foreign.parquet")

    def test_values_that_no_link_has(self, shard: Path) -> None:
        table = pq.read_table(shard)
        column = table.column_names.index("distance_m")
        field = table.schema.field("distance_m")
        pq.write_table(table.set_column(column, field, pa.array(-np.ones(len(table)))), shard)
        with pytest.raises(PredictorError, match=r"is damaged, or no Parquet file \(distance_m\[0\] = -1"):
            read_shard(shard)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"partial": None}, "NoneType"),
            ({"partial": []}, "tuple index out of range"),
            ({"complete": {"villa": {}}}, "shape"),
            ({"complete": {"villa": {"cells": "AAAA", **PLAIN}}}, "Error -3"),
            ({"complete": {"villa": {"cells": packed(b"\0" * 7), **PLAIN}}}, "reshape"),
            ({"complete": {"villa": {"shape": [20_000, 20_000]}}}, "more than 100,000,000"),
            ({"complete": {"villa": {"cells": packed(b"\0" * 5), **PLAIN}}}, "reshape"),
            ({"complete": {"villa": {"cells": packed(b"\7" * 6), **PLAIN}}}, "state has values 7 to 7"),
        ],
    )
    def test_maps_that_are_none(self, shard: Path, change: dict[str, object], words: str) -> None:
        maps = json.dumps(shard_metadata(shard)["maps"] | change)  # type: ignore[operator]
        table = pq.read_table(shard)
        pq.write_table(table.replace_schema_metadata({**table.schema.metadata, b"sionna_partial.maps": maps}), shard)
        with pytest.raises(PredictorError, match=rf"is damaged, or no Parquet file \(.*{words}"):
            read_shard(shard)

    def test_too_many_links(self, shard: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(shards, "_MAX_LINKS", 1)
        with pytest.raises(PredictorError, match="has more than 1 links: give a shard of one home"):
            read_shard(shard)

    def test_no_maps(self, shard: Path) -> None:
        table = pq.read_table(shard)
        metadata = {name: text for name, text in table.schema.metadata.items() if name != b"sionna_partial.maps"}
        pq.write_table(table.replace_schema_metadata(metadata), shard)
        with pytest.raises(PredictorError, match=r"is damaged, or no Parquet file \('maps'\)"):
            read_shard(shard)


def test_names_of_files_are_short() -> None:
    long = [f"{'ä' * 150}{end}" for end in "ab"]
    assert file_stem("villa") == "villa"
    assert len({file_stem(name) for name in long}) == 2
    assert all(len(file_stem(name).encode()) < 200 for name in long)


class TestDataset:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        names = ("b", "a", "missing", "c")
        (tmp_path / "dataset.json").write_text(json.dumps({"homes": [{"name": name} for name in names]}))
        for name in ("a", "b", "c"):
            write_shard(fake_links(None, name, DatasetSettings(links_per_home=4)), shard_path(tmp_path, name), {})
        return tmp_path

    def test_all_homes_in_the_order_of_the_list(self, folder: Path) -> None:
        links = read_dataset(folder)
        assert list(dict.fromkeys(links.home.tolist())) == ["b", "a", "c"]
        assert_same(links.take(links.home == "a"), read_shard(shard_path(folder, "a")))

    def test_some_homes(self, folder: Path) -> None:
        assert list(dict.fromkeys(read_dataset(folder, ["c", "b"]).home.tolist())) == ["c", "b"]

    @pytest.mark.parametrize("name", ["missing", "d"])
    def test_home_that_is_not_there(self, folder: Path, name: str) -> None:
        with pytest.raises(PredictorError, match=rf"home '{name}' is not in '.*': choose from 'b', 'a', 'c'\."):
            read_dataset(folder, [name])

    @pytest.mark.parametrize("homes", ["b", 5, [1], np.full((2, 2), 7)])
    def test_homes_that_are_no_names(self, folder: Path, homes: object) -> None:
        with pytest.raises(PredictorError, match=r"homes = .* is not allowed: give names of homes, or None for all\."):
            read_dataset(folder, homes)  # type: ignore[arg-type]

    def test_nothing_built(self, folder: Path) -> None:
        for name in ("a", "b", "c"):
            shard_path(folder, name).unlink()
        with pytest.raises(PredictorError, match="has no home yet: run `sionna-partial dataset` again"):
            read_dataset(folder)

    def test_no_dataset(self, tmp_path: Path) -> None:
        with pytest.raises(PredictorError, match=r"is no data set, it has no dataset\.json: give a folder that"):
            read_dataset(tmp_path)

    @pytest.mark.parametrize("text", ["", "[]", '{"homes": [3]}'])
    def test_damaged_list(self, tmp_path: Path, text: str) -> None:
        (tmp_path / "dataset.json").write_text(text)
        with pytest.raises(PredictorError, match=r"dataset\.json' is damaged .*: build the data set again in a new"):
            read_dataset(tmp_path)


_AT = (("one", 28e9), ("two", 60e9))


class TestOpenLinks:
    def test_table_does_not_say_how_it_was_traced(self):
        table = make_table(homes=1)
        assert open_links(table) == (table, None)

    @pytest.mark.parametrize(("noted", "found"), [(None, True), (True, True), (False, False)])
    def test_folder_says_how_it_was_traced(self, noted, found, tmp_path):
        table = make_table(homes=2)
        links, traces = open_links(make_dataset(tmp_path, table, frequency_hz=60e9, diffraction=noted))
        assert len(links) == len(table)
        assert traces == LinkTraces(60e9, found)

    def test_no_links_with_receivers_indoors(self):
        table = make_table(homes=1)
        for part in (table.take(table.anywhere), table.take(slice(0))):
            with pytest.raises(PredictorError, match="dataset has no links with receivers drawn indoors: build one"):
                open_links(part)

    def test_homes_explored_anew_in_each_of_several_folders(self, tmp_path):
        table = make_table(homes=2)
        folders = [make_dataset(tmp_path / name, table) for name in ("one", "two")]
        links, traces = open_links(folders)
        assert len(links) == 2 * len(table)
        assert set(links.home) == set(table.home)
        assert traces == open_links(folders[0])[1]

    def test_folders_traced_differently(self, tmp_path):
        folders = [make_dataset(tmp_path / name, make_table(homes=1), frequency_hz=hz) for name, hz in _AT]
        message = f"'{folders[1]}' was traced at 60 GHz with diffraction, '{folders[0]}' at 28 GHz with diffraction"
        with pytest.raises(PredictorError, match=re.escape(message)):
            open_links(folders)

    def test_another_home_of_the_same_name(self, tmp_path):
        table = make_table(homes=1)
        ((name, home),) = table.complete_maps.items()
        other = replace(table, complete_maps={name: replace(home, origin_m=(1.0, 2.0))})
        folders = [make_dataset(tmp_path / name, each) for name, each in (("one", table), ("two", other))]
        message = f"'{folders[1]}' has another home {name!r} than those before: give one of the two."
        with pytest.raises(PredictorError, match=re.escape(message)):
            open_links(folders)

    @pytest.mark.parametrize("dataset", [3, [], [3]])
    def test_something_else(self, dataset):
        message = (
            f"dataset = {dataset!r} is not allowed: give a LinkTable, or one or more folders that "
            "`sionna-partial dataset` wrote."
        )
        with pytest.raises(PredictorError, match=re.escape(message)):
            open_links(dataset)

    def test_no_data_set_there(self, tmp_path):
        with pytest.raises(PredictorError, match="is no data set"):
            open_links(tmp_path)

    def test_index_without_settings(self, tmp_path):
        folder = make_dataset(tmp_path, make_table(homes=1))
        index = json.loads((folder / "dataset.json").read_text())
        (folder / "dataset.json").write_text(json.dumps({"homes": index["homes"]}))
        with pytest.raises(PredictorError, match=r"dataset\.json' is damaged \(KeyError\('settings'\)\): build"):
            open_links(folder)


class TestSettingsFor:
    def test_those_of_the_data_set(self):
        found = settings_for(LinkTraces(60e9, False), networks="paths", passes=7, seed=8)
        assert found == PredictorSettings("paths", frequency_hz=60e9, diffraction=False, passes=7, seed=8)

    def test_by_default_it_sees_the_map(self):
        assert settings_for(None) == PredictorSettings("map")


class TestRequireLike:
    TRACES = LinkTraces(28e9, True)

    @pytest.mark.parametrize("found", [None, LinkTraces(28e9, True), LinkTraces(28e9 + 1.0, True)])
    def test_the_same(self, found):
        require_like(found, self.TRACES, "predictor 'x' was trained", "choose another.")

    @pytest.mark.parametrize(
        ("found", "words"),
        [
            (LinkTraces(60e9, True), "at 60 GHz with diffraction"),
            (LinkTraces(28e9, False), "at 28 GHz without diffraction"),
            (LinkTraces(28e9, True, True), "at 28 GHz through walls with diffraction"),
        ],
    )
    def test_others(self, found, words):
        message = f"dataset was traced {words}, predictor 'x' was trained at 28 GHz with diffraction: choose another."
        with pytest.raises(PredictorError, match=re.escape(message)):
            require_like(
                found, LinkTraces.of_settings(PredictorSettings()), "predictor 'x' was trained", "choose another."
            )
