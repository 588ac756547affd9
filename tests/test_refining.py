"""Coarse, then fine: spacings and reports of both passes, and giving way in the fine one alone."""

import pytest

from sionna_partial.apps.refining import GivenWay, coarse_then_fine


def test_both_passes_have_their_spacing_and_report() -> None:
    told: list[tuple[str, float]] = []
    passes = coarse_then_fine(
        0.15,
        coarse=lambda fraction, _: told.append(("coarse", fraction)),
        fine=lambda fraction, _: told.append(("fine", fraction)),
    )
    seen = []
    for each in passes:
        each.report(0.5, "tracing")
        seen.append((each.spacing_m, each.is_final))
    assert seen == [(0.6, False), (0.15, True)]
    assert told == [("coarse", 0.5), ("fine", 0.5)]


def test_the_fine_pass_gives_way_and_the_coarse_one_does_not() -> None:
    def newer_waits(_fraction: float, _message: str) -> None:
        raise GivenWay

    coarse, fine = coarse_then_fine(1.0, fine=newer_waits)
    coarse.report(0.0, "tracing")
    with pytest.raises(GivenWay):
        fine.report(0.0, "tracing")
