"""A few hostile inputs of each family; `make hostile` runs many more."""

from attack import attack
from cases import cases_of

EVERY = {"settings": 40, "files": 16}
"""One case out of so many is run here."""


def test_hostile_inputs_work_or_are_refused() -> None:
    cases = [case for family, step in EVERY.items() for case in cases_of(family, seed=7)[3::step]]
    assert [f"{end.ending}: {end.case.name}: {end.message}" for end in attack(cases) if end.is_defect] == []
