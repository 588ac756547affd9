"""The kinds of interactions of paths: who finds them, and which setting switches them on.

This table decides everything that depends on the kind of an interaction. One more kind is one more row. Sionna RT's
rays then find its paths. To find every path, on a plan or a mesh, it takes candidates as well: a `Kind` of `select.py`
in `tracing/plan` or `tracing/mesh`, which lists candidates with a bound of their power (`power.py`) and writes the
selected ones, with the number of the kind in `Candidates.kind`. The scenes in `finder.py` return their kinds. Sionna RT
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
        Field of `TraceSettings` that switches it on; "" where it always is.
    arguments : tuple of str
        Arguments of Sionna RT's path solver that switch it on where rays find its paths.
    exact_on : tuple
        Kinds of maps on which candidates find every path. These paths can be differentiated; paths of rays cannot.
    default : callable
        Returns whether paths have it where the setting is None and candidates find it.
    """

    number: int
    setting: str
    arguments: tuple[str, ...]
    exact_on: tuple[EnvironmentKind, ...]
    default: Callable[[TraceSettings], bool] = lambda _: True

    def is_on(self, settings: TraceSettings) -> bool:
        """Return whether settings without None ask for it."""
        return not self.setting or bool(getattr(settings, self.setting))


INTERACTIONS = (
    Interaction(1, "", ("specular_reflection",), ("plan", "mesh")),
    Interaction(2, "diffuse_reflection", ("diffuse_reflection",), ()),
    Interaction(4, "refraction", ("refraction",), ("plan", "mesh"), lambda settings: settings.through_walls),
    Interaction(8, "diffraction", ("diffraction", "edge_diffraction"), ("plan",)),
)
"""All kinds of interactions."""

REFLECTION, DIFFUSE, REFRACTION, DIFFRACTION = (kind.number for kind in INTERACTIONS)


def with_defaults(settings: TraceSettings, environment: EnvironmentKind) -> TraceSettings:
    """Return settings with values in place of None: by default, candidates alone find the paths."""
    unset = [kind for kind in INTERACTIONS if kind.setting and getattr(settings, kind.setting) is None]
    values: dict[str, Any] = {kind.setting: environment in kind.exact_on and kind.default(settings) for kind in unset}
    return replace(settings, **values, power_tolerance_db=settings.tolerance_db)


def only_by_rays(settings: TraceSettings, environment: EnvironmentKind) -> list[Interaction]:
    """Return the kinds that settings without None ask for and that only rays find on a kind of map."""
    return [kind for kind in INTERACTIONS if kind.is_on(settings) and environment not in kind.exact_on]
