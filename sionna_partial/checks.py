"""Checks of input; types of progress reports."""

import itertools
import math
import reprlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, is_dataclass
from numbers import Integral, Real
from types import NoneType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from sionna_partial.constants import DEFAULT_HEIGHT_M
from sionna_partial.errors import PositionError, SettingsError, SionnaPartialError

if TYPE_CHECKING:
    from numpy.typing import NDArray

Progress = Callable[[float, str], None]
"""Receiver of the fraction of the work that is done, and a message."""

CountProgress = Callable[[int, int, str], None]
"""Receiver of the number of items that are done, their total, and a message."""

_Settings = TypeVar("_Settings")

_short = reprlib.Repr()
_short.maxstring, _short.maxother, _short.maxlevel = 200, 200, 2


def no_progress(fraction: float, message: str) -> None:
    """Report nothing."""


def reason_of(error: Exception) -> str:
    known = isinstance(error, SionnaPartialError | OSError | MemoryError)
    return str(error) if known else f"this failed ({type(error).__name__}: {shown(str(error))})."


def shown(value: object) -> str:
    try:
        return " ".join(_short.repr(plain(value)).split())
    except ValueError:  # whole numbers of thousands of digits
        return f"a value of type {type(value).__name__}"


def require(condition: bool, name: str, value: object, remedy: str) -> None:
    if not condition:
        raise SettingsError(f"{name} = {shown(value)} is not allowed: {remedy}")


def require_number(name: str, value: object, low: float, high: float, *, open_low: bool = False) -> None:
    number = number_of(value)
    inside = (low < number if open_low else low <= number) and number <= high
    meant = next((f"{number:g}e{power}" for power in (9, 6) if low <= number * 10**power <= high), None)
    hint = f" Did you mean {meant}?" if name.endswith("_hz") and 1 <= number < low and meant else ""
    require(inside, name, value, f"give a number in {'(' if open_low else '['}{low:g}, {high:g}].{hint}")


def require_memory(memory_gb: object) -> None:
    require_number("memory_gb", memory_gb, 0.0, 1e6, open_low=True)


def require_whole(name: str, value: object, low: int, high: int) -> None:
    inside = is_whole(value, low) and int(value) <= high  # type: ignore[call-overload]
    require(inside, name, value, f"give a whole number in [{low}, {high}].")


def require_names(name: str, values: Sequence[str]) -> None:
    """Require different texts, at least one, that can be names of files."""
    good = len(values) == len({*values}) > 0 and all(text and text.isprintable() for text in values)
    require(good, name, values, "give each a name of its own, of printable characters.")


def require_bool(name: str, value: object) -> None:
    require(isinstance(value, bool), name, value, "give True or False.")


def require_type(name: str, value: object, kind: type, remedy: str) -> None:
    require(isinstance(value, kind), name, value, remedy)


def require_choice(name: str, value: object, choices: Iterable[str]) -> None:
    words = tuple(choices)
    require(isinstance(value, str) and value in words, name, value, f"choose one of {', '.join(words)}.")


def transmitter_names(count: int) -> list[str]:
    return [f"tx{number}" for number in range(1, count + 1)]


def plain(value: Any) -> Any:
    """Return a NumPy scalar as a Python number, times as texts, anything else as it is."""
    if getattr(getattr(value, "dtype", None), "kind", "") in tuple("mM"):
        return str(value)
    return value.item() if getattr(value, "ndim", None) == 0 and hasattr(value, "item") else value


def number_of(value: object) -> float:
    """Return a real number; NaN for anything else, including True and "1"."""
    number = plain(value)
    try:
        return float(number) if isinstance(number, Real) and not isinstance(number, bool) else math.nan
    except OverflowError:
        return math.nan


def real_array(
    name: str, values: Any, error: type[SionnaPartialError], remedy: str, kinds: str = "iuf"
) -> "NDArray[Any]":
    import numpy as np

    parts = values if isinstance(values, list | tuple) else [values]
    if any(np.ma.is_masked(part) for part in parts):
        raise error(f"{name} has masked values, whose data would be read: fill them first, and {remedy}")
    try:
        array = np.asarray(values)
        array = array.astype(np.float64) if array.dtype == object else array
    except (TypeError, ValueError, OverflowError) as cause:
        raise error(f"{name} = {shown(values)} is not numeric: {remedy}") from cause
    if array.dtype.kind not in kinds:
        what = f"has dtype {array.dtype}" if array.dtype.kind in "iufb" else f"= {shown(values)} is not numeric"
        raise error(f"{name} {what}: {remedy}")
    return array


def float_array(name: str, values: Any, error: type[SionnaPartialError], remedy: str) -> "NDArray[Any]":
    return real_array(name, values, error, remedy).astype("float64")


def is_whole(value: object, low: int = 0) -> bool:
    number = plain(value)
    return isinstance(number, Integral) and not isinstance(number, bool) and int(number) >= low


def are_stages(value: Any) -> bool:
    """Return whether `value` has increasing whole numbers (of steps) or increasing fractions in [0, 1]."""
    stages = list(value) if isinstance(value, Sequence) or getattr(value, "ndim", 0) == 1 else []
    numbers = all(isinstance(stage, Real) and not isinstance(stage, bool) for stage in stages)
    rising = bool(stages) and numbers and all(low < high for low, high in itertools.pairwise(stages))
    return rising and (all(map(is_whole, stages)) or (stages[0] >= 0 and stages[-1] <= 1))


def position_array(name: str, points_m: object, *, least: int = 1) -> "NDArray[Any]":
    """Return positions (3,) or (N, 3) [m] as a float64 array; a PositionError names them."""
    points = float_array(name, points_m, PositionError, "give x, y, z in metres.")
    if points.shape[-1:] != (3,) or points.ndim not in (1, 2):
        raise PositionError(f"{name} has shape {points.shape}: give x, y, z in metres, (3,) or (N, 3).")
    if points.size < 3 * least:
        raise PositionError(f"{name} has shape {points.shape}: give at least {least} position.")
    return points


def with_height(points_m: "NDArray[Any]") -> "NDArray[Any]":
    """Return positions (..., 3) [m]; positions (..., 2) get the default height."""
    import numpy as np

    return np.insert(points_m, 2, DEFAULT_HEIGHT_M, axis=-1) if points_m.shape[-1:] == (2,) else points_m


def settings_or_default(name: str, value: _Settings | None, kind: type[_Settings]) -> _Settings:
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

    NumPy numbers become Python numbers, so that settings can be written as JSON.
    """

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            object.__setattr__(self, name, _checked(name, plain(getattr(self, name)), hint))


def _checked(name: str, value: Any, hint: Any) -> Any:
    arguments = get_args(hint)
    if NoneType in arguments:
        return None if value is None else _checked(name, value, arguments[0])
    if get_origin(hint) is Annotated:
        number, allowed = arguments
        if number is int:
            require_whole(name, value, allowed.low, allowed.high)
        else:
            require_number(name, value, allowed.low, allowed.high, open_low=allowed.open_low)
        return number(value)
    if get_origin(hint) is Literal:
        require_choice(name, value, arguments)
    elif hint is bool:
        require_bool(name, value)
    elif hint is str:
        require(isinstance(value, str), name, value, "give a text.")
    elif isinstance(hint, type) and is_dataclass(hint):
        if isinstance(value, str) and hasattr(hint, "named"):
            value = hint.named(value)
        require(isinstance(value, hint), name, value, f"give {hint.__name__}(...).")
    return value
