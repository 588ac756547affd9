"""A few hostile inputs of each family; `make hostile` runs many more."""

from pathlib import Path

import pytest
from attack import attack
from cases import cases_of
from inputs import valid

from sionna_partial.errors import MapError
from sionna_partial.maps.map_files import load_map

EVERY = {"settings": 80, "files": 62}
"""One case out of so many is run here."""

QUICK = (
    *("deeply_nested_json", "predictor_whose_units_are_1e9", "weights_that_are_not_finite"),
    *("same_dataset_twice", "shard_whose_map_inflates_to_gigabytes", "scheduler_file_damaged"),
    *("read_only_package_and_home",),
)
"""Cases of the corpus that take about a second."""


def test_hostile_inputs_work_or_are_refused() -> None:
    cases = [case for family, step in EVERY.items() for case in cases_of(family, seed=7)[3::step]]
    cases += [case for case in cases_of("corpus", seed=7) if case.name in QUICK]
    assert len({case.name for case in cases} & set(QUICK)) == len(QUICK)
    assert [f"{end.ending}: {end.case.name}: {end.message}" for end in attack(cases) if end.is_defect] == []


@pytest.mark.parametrize(
    "kind", ["cloud.las", "cloud.laz", "cloud.pcd", "plan.dxf", "drive.bag", "drive.db3", "drive.mcap"]
)
def test_cut_files_are_refused(kind: str, tmp_path: Path) -> None:
    path = valid(kind, tmp_path)
    content = path.read_bytes()
    for size in range(0, len(content) - 100, len(content) // 12):
        path.write_bytes(content[:size])
        with pytest.raises(MapError, match=r"is damaged or no|has 0 Occ|has no map|holds no finite point"):
            load_map(path)
