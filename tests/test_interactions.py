"""The table of interactions, against Sionna RT and the settings."""

from dataclasses import replace
from inspect import signature

import pytest

import sionna_partial as sp
from sionna_partial.tracing.engine import load_sionna
from sionna_partial.tracing.interactions import (
    DIFFRACTION,
    DIFFUSE,
    INTERACTIONS,
    REFLECTION,
    REFRACTION,
    Interaction,
    only_by_rays,
    with_defaults,
)


def test_the_numbers_are_those_of_sionna_rt() -> None:
    theirs = load_sionna().constants.InteractionType
    numbers = theirs.SPECULAR, theirs.DIFFUSE, theirs.REFRACTION, theirs.DIFFRACTION
    assert numbers == (REFLECTION, DIFFUSE, REFRACTION, DIFFRACTION)


@pytest.mark.parametrize("kind", INTERACTIONS, ids=lambda kind: kind.setting or "specular_reflection")
def test_each_kind_is_complete(kind: Interaction) -> None:
    assert {*kind.arguments} < {*signature(load_sionna().PathSolver.__call__).parameters}
    assert not kind.setting or hasattr(sp.TraceSettings(), kind.setting)


def test_by_default_candidates_alone_find_the_paths() -> None:
    for settings in (sp.TraceSettings(5e9), sp.TraceSettings(28e9)):
        for environment in ("plan", "mesh"):
            assert only_by_rays(with_defaults(settings, environment), environment) == []
    asked = replace(settings, diffuse_reflection=True, refraction=True, diffraction=True)
    assert [kind.setting for kind in only_by_rays(asked, "plan")] == ["diffuse_reflection"]
    assert [kind.setting for kind in only_by_rays(asked, "mesh")] == ["diffuse_reflection", "diffraction"]
