"""Kinds of interactions of paths, their finders and settings.

A new kind is one row, and Sionna RT's rays find its paths. To find every path, it also needs a `Kind` of `select.py`
in the scenes of `finder.py`, which lists candidates with a bound of their power (`power.py`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from sionna_partial.maps.environment import EnvironmentKind
from sionna_partial.settings import TraceSettings


@dataclass(frozen=True)
class Interaction:
    """A kind of interaction.

    `number` is Sionna RT's `InteractionType`, `setting` the field of `TraceSettings` that switches it on, "" if always
    on, `arguments` the arguments of Sionna RT's path solver for it. On maps of the kinds `exact_on`, candidates find
    every path: only these paths can be differentiated, and `default` returns the value in place of None.
    """

    number: int
    setting: str
    arguments: tuple[str, ...]
    exact_on: tuple[EnvironmentKind, ...]
    default: Callable[[TraceSettings], bool] = lambda _: True

    def is_on(self, settings: TraceSettings) -> bool:
        return not self.setting or bool(getattr(settings, self.setting))


INTERACTIONS = (
    Interaction(1, "", ("specular_reflection",), ("plan", "mesh")),
    Interaction(2, "diffuse_reflection", ("diffuse_reflection",), ()),
    Interaction(4, "refraction", ("refraction",), ("plan", "mesh"), lambda settings: settings.through_walls),
    Interaction(8, "diffraction", ("diffraction", "edge_diffraction"), ("plan",)),
)

REFLECTION, DIFFUSE, REFRACTION, DIFFRACTION = (kind.number for kind in INTERACTIONS)


def with_defaults(settings: TraceSettings, environment: EnvironmentKind) -> TraceSettings:
    """Return settings with values in place of None; by default, candidates find all paths."""
    unset = [kind for kind in INTERACTIONS if kind.setting and getattr(settings, kind.setting) is None]
    values: dict[str, Any] = {kind.setting: environment in kind.exact_on and kind.default(settings) for kind in unset}
    return replace(settings, **values, power_tolerance_db=settings.tolerance_db)


def only_by_rays(settings: TraceSettings, environment: EnvironmentKind) -> list[Interaction]:
    """Return the enabled kinds that only rays find, for settings without None."""
    return [kind for kind in INTERACTIONS if kind.is_on(settings) and environment not in kind.exact_on]
