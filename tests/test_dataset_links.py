import json
import re
from dataclasses import replace

import pytest
from link_tables import make_dataset, make_table

from sionna_partial.datasets.shards import LinkTraces, open_links, require_like, settings_for
from sionna_partial.errors import PredictorError
from sionna_partial.settings import PredictorSettings

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
