"""A few hostile inputs of each family; `make hostile` runs many more."""

from attack import attack
from cases import cases_of

EVERY = {"settings": 133, "files": 61}
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
