import dataclasses
import json
import re

import pytest
from link_tables import fitted_baselines, make_table
from predictor_links import QUIET, quick_predictor

from sionna_partial.lab.evaluation import WITH_INDOOR, evaluate
from sionna_partial.lab.metrics import DEFINITIONS
from sionna_partial.lab.reports import REPORT_FILES, as_json, markdown, markdown_table, save_report, summary

pytestmark = QUIET


@pytest.fixture(scope="module")
def evaluation():
    predictor = dataclasses.replace(quick_predictor(), homes=("home 1",))
    return evaluate(predictor, make_table(homes=3), baselines=fitted_baselines())


def tables(text):
    sections = re.findall(r"### (.+)\n\n((?:\|.*\|\n?)+)", text)
    return {
        title: [[cell.strip() for cell in line.strip("|").split("|")] for line in lines.splitlines()]
        for title, lines in sections
    }


class TestSummary:
    def test_figures_stand_where_they_belong(self, evaluation):
        found = tables(summary(evaluation))
        for receivers, where in (("indoor", "indoors"), ("anywhere", "anywhere on the map, outage outdoors")):
            rows = found[f"Test homes (2), receivers {where}"]
            assert rows[0] == ["accuracy, RMSE", "0 steps", "100 steps"]
            measured = evaluation.select(homes="test", receivers=receivers, ends_seen="all")
            assert len(rows) - 2 == len({row.model for row in measured})
            for row in measured:
                (cells,) = (cells for cells in rows if cells[0] == row.model)
                cell = cells[rows[0].index(f"{row.stage:g} steps")]
                accuracy = f"{row.metrics.accuracy:.3f} ± {row.accuracy_error:.3f}"
                assert cell == f"{accuracy}, {row.metrics.rmse_db:.2f} ± {row.rmse_error_db:.2f} dB"

        text = summary(dataclasses.replace(evaluation, notes=("one note", "another")))
        assert DEFINITIONS["accuracy"] in text
        assert text.endswith("one note\n\nanother")
        assert "±: standard error over homes" in text
        assert summary(evaluation).count("2 test homes are too few to compare predictors") == 1


class TestMarkdown:
    def test_figures_stand_where_they_belong(self, evaluation):
        rows = tables(markdown(evaluation))["Test homes, receivers indoors"]
        (row,) = (cells for cells in rows if cells[:2] == ["100 steps", "predictor"])
        (found,) = evaluation.select(homes="test", stage=100, model="predictor", ends_seen="all")
        assert rows[0][2:5] == ["links", "accuracy ± error", "RMSE ± error [dB]"]
        accuracy = f"{found.metrics.accuracy:.3f} ± {found.accuracy_error:.3f}"
        assert row[2:5] == ["600", accuracy, f"{found.metrics.rmse_db:.2f} ± {found.rmse_error_db:.2f}"]

    def test_every_definition_and_every_part_is_there(self, evaluation):
        text = markdown(evaluation)
        assert all(definition in text for definition in DEFINITIONS.values())
        assert evaluation.fingerprint in text
        assert "2 test and 1 train homes" in text
        assert list(tables(text)).count("Test homes, receivers indoors, one end seen") == 1
        (cells, *_) = next(rows[2:] for title, rows in tables(text).items() if "standard error" in title)
        assert re.fullmatch(r"[+-]\d\.\d{3} ± \d\.\d{3}", cells[3])
        assert re.fullmatch(r"[+-]\d+\.\d{2} ± \d+\.\d{2}", cells[4])


class TestMarkdownTable:
    def test_names_to_the_left_and_figures_to_the_right(self):
        rows = [["a", "long name", "1.5"], ["bb", "b", "100.25"]]
        assert markdown_table(["x", "name", "figure"], rows, names=2).splitlines() == [
            "| x  | name      | figure |",
            "| -- | --------- | -----: |",
            "| a  | long name |    1.5 |",
            "| bb | b         | 100.25 |",
        ]


class TestAsJson:
    def test_it_is_json_without_nan(self, evaluation):
        content = json.loads(json.dumps(as_json(evaluation), allow_nan=False))
        assert content["homes"] == {"test": ["home 0", "home 2"], "train": ["home 1"]}
        assert len(content["rows"]) == len(evaluation.rows)
        assert {row["metrics"]["coverage_90"] for row in content["rows"] if row["model"] == "partial trace"} == {None}
        assert content["differences"][-1]["baseline"] == "always outage"
        assert sum(content["calibration"]["0"]["links"]) == 600
        assert WITH_INDOOR in {row["model"] for row in content["rows"]}


class TestSaveReport:
    def test_files_are_equal_every_time(self, evaluation, tmp_path):
        files = save_report(evaluation, tmp_path / "one")
        assert [file.name for file in files] == list(REPORT_FILES)
        assert all(file.read_bytes().startswith(b"\x89PNG") for file in files[2:])
        for file, again in zip(files, save_report(evaluation, tmp_path / "two"), strict=True):
            assert file.read_bytes() == again.read_bytes()
