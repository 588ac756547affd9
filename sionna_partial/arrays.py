"""Short names for the types of arrays, and dataclasses whose arrays cannot be changed."""

from dataclasses import fields
from functools import wraps
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]
Indices: TypeAlias = NDArray[np.intp]

States: TypeAlias = NDArray[np.uint8]
"""CellState or LinkState of each entry."""

_Class = TypeVar("_Class", bound=type)


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array that cannot be written to: the array itself if it is read-only, otherwise a copy."""
    if array.flags.writeable:
        array = array.copy()
        array.setflags(write=False)
    return array


def read_only(cls: _Class) -> _Class:
    """Decorate a frozen dataclass so that the arrays in its fields are read-only, also after unpickling.

    Arrays that can be written to are copied (`frozen`): a caller who changes them later does not change the object.
    """
    build: Any = cls.__init__  # type: ignore[misc]

    def freeze(instance: Any) -> None:
        for field in fields(cls):
            value = getattr(instance, field.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(instance, field.name, frozen(value))

    @wraps(build)
    def __init__(self: Any, *args: Any, **kwargs: Any) -> None:
        build(self, *args, **kwargs)
        freeze(self)

    def __setstate__(self: Any, state: dict[str, Any]) -> None:
        vars(self).update(state)
        freeze(self)

    cls.__init__, cls.__setstate__ = __init__, __setstate__  # type: ignore[misc, attr-defined]
    return cls
