"""Kinds of interactions of paths, their finders and settings.

A new kind is one row, and Sionna RT's rays find its paths. To find every path, it also needs a `Kind` of `select.py`,
which lists candidates with a bound of their power (`power.py`), and which the scenes of `finder.py` return. Sionna RT
verifies candidates of any kind.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from sionna_partial.maps.environment import EnvironmentKind
from sionna_partial.settings import TraceSettings


@dataclass(frozen=True)
class Interaction:
    """A kind of interaction.

    Parameters
    ----------
    number : int
        Sionna RT's `InteractionType`.
    setting : str
        Field of `TraceSettings` that switches it on; "" if always on.
    arguments : tuple of str
        Arguments of Sionna RT's path solver that switch it on.
    exact_on : tuple
        Kinds of maps on which candidates find every path. Only these paths can be differentiated.
    default : callable
        Returns the value in place of None where candidates find it.
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
    """Return settings with values in place of None: by default, candidates alone find the paths."""
    unset = [kind for kind in INTERACTIONS if kind.setting and getattr(settings, kind.setting) is None]
    values: dict[str, Any] = {kind.setting: environment in kind.exact_on and kind.default(settings) for kind in unset}
    return replace(settings, **values, power_tolerance_db=settings.tolerance_db)


def only_by_rays(settings: TraceSettings, environment: EnvironmentKind) -> list[Interaction]:
    """Return the kinds that settings without None ask for and that only rays find."""
    return [kind for kind in INTERACTIONS if kind.is_on(settings) and environment not in kind.exact_on]
