"""Coverage in two passes over the receivers, coarse and then fine, that give way to newer requests."""

from collections.abc import Iterator
from typing import NamedTuple

from sionna_partial.checks import Progress, no_progress

COARSER = 4
"""Receiver spacing of the coarse pass, as a multiple of the final spacing."""


class GivenWay(Exception):
    """A computation was ended from within its progress report: it was cancelled, or a newer request waits."""


class Pass(NamedTuple):
    """One pass: spacing of the receivers [m], and the progress report, which may raise `GivenWay`."""

    spacing_m: float
    is_final: bool
    report: Progress


def coarse_then_fine(spacing_m: float, coarse: Progress = no_progress, fine: Progress = no_progress) -> Iterator[Pass]:
    """Yield the coarse pass, then the final one with the spacing `spacing_m`, each with its report."""
    yield Pass(COARSER * spacing_m, False, coarse)
    yield Pass(spacing_m, True, fine)
