"""Every check of input, whose error names the field, its value and the remedy; and the type of progress reports."""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, is_dataclass
from numbers import Integral, Real
from types import NoneType
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from sionna_partial.errors import SettingsError

Progress = Callable[[float, str], None]
"""Called with the fraction of the work that is done, and a message."""

_Settings = TypeVar("_Settings")


def no_progress(fraction: float, message: str) -> None:
    """Report nothing."""


def require(condition: bool, name: str, value: object, remedy: str) -> None:
    """Raise a SettingsError that names the setting, its value and the remedy unless `condition` holds."""
    if not condition:
        raise SettingsError(f"{name} = {value!r} is not allowed: {remedy}")


def require_number(name: str, value: object, low: float, high: float, *, open_low: bool = False) -> None:
    """Raise a SettingsError unless `value` is a finite number in [low, high], or (low, high] with `open_low`."""
    number = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    inside = (low < number if open_low else low <= number) and number <= high
    require(inside, name, value, f"give a number in {'(' if open_low else '['}{low:g}, {high:g}].")


def require_whole(name: str, value: object, low: int, high: int) -> None:
    """Raise a SettingsError unless `value` is a whole number in [low, high]."""
    inside = is_whole(value, low) and int(value) <= high  # type: ignore[call-overload]
    require(inside, name, value, f"give a whole number in [{low}, {high}].")


def is_whole(value: object, low: int = 0) -> bool:
    """Whether `value` is a whole number of `low` or more."""
    return isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= low


def are_stages(value: object) -> bool:
    """Whether `value` has increasing whole numbers (of steps), or increasing fractions in [0, 1), one at least."""
    stages = list(value) if isinstance(value, Iterable) else []
    numbers = all(isinstance(each, Real) and not isinstance(each, bool) for each in stages)
    rising = bool(stages) and numbers and all(low < high for low, high in itertools.pairwise(stages))
    return rising and (all(map(is_whole, stages)) or (stages[0] >= 0 and stages[-1] < 1))


def settings_or_default(name: str, value: _Settings | None, kind: type[_Settings]) -> _Settings:
    """Return `value`, or the default settings for None; raise a SettingsError if it is of another kind."""
    if value is None:
        return kind()
    require(isinstance(value, kind), name, value, f"give {kind.__name__}(...), or None for the default.")
    return value


@dataclass(frozen=True)
class Within:
    """Range of a number, as an annotation of a field: [low, high], or (low, high] with `open_low`."""

    low: float
    high: float
    open_low: bool = False


class Checked:
    """Base of dataclasses whose fields are checked against their annotations.

    Checked are ranges (`Annotated[float, Within(0, 1)]`, whole numbers for int), bool, Literal and dataclasses.
    """

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            _check(name, getattr(self, name), hint)


def _check(name: str, value: object, hint: Any) -> None:
    arguments = get_args(hint)
    if get_origin(hint) is Annotated:
        number, allowed = arguments
        if number is int:
            require_whole(name, value, allowed.low, allowed.high)
        else:
            require_number(name, value, allowed.low, allowed.high, open_low=allowed.open_low)
    elif get_origin(hint) is Literal:
        require(value in arguments, name, value, f"choose one of {arguments}.")
    elif hint is bool or arguments == (bool, NoneType):
        require(isinstance(value, bool) or (value is None and hint is not bool), name, value, "give True or False.")
    elif isinstance(hint, type) and is_dataclass(hint):
        require(isinstance(value, hint), name, value, f"give {hint.__name__}(...).")
