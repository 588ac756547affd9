"""Public dataclasses hold arrays that nobody can change, whoever built them, also after pickling."""

import pickle
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
from extruded import drawn
from public_names import EVERY

import sionna_partial as sp

ARRAY_TYPES = ("ndarray", "NDArray", "Floats", "Bools", "Indices", "States")


def array_fields(public: type) -> list[str]:
    types = {field.name: str(field.type) for field in fields(public)}
    return [name for name, text in types.items() if any(word in text for word in ARRAY_TYPES)]


DATACLASSES = [public for public in EVERY.values() if is_dataclass(public)]
WITH_ARRAYS = [public for public in DATACLASSES if array_fields(public)]

CHECKED: dict[type, dict[str, Any]] = {
    sp.AntennaPattern: {"name": "own", "horizontal_db": np.ones(360), "vertical_db": np.ones(360), "gain_dbi": 3.0},
    sp.LinkFeatures: {
        "link_state": np.ones(2, dtype=np.uint8),
        **dict.fromkeys(("unobserved_distance_m", "distance_m"), np.ones(2)),
        "gain_db": np.full(2, -80.0),
    },
    sp.Measurements: {"tx": np.ones(3), "rx": np.zeros((2, 3)), "gain_db": np.full(2, -80.0)},
    sp.PartialMap: {"state": drawn("..\n.#").state.copy(), "resolution_m": 0.5},
}
"""Valid fields of the classes that check them; the others take any."""


@pytest.mark.parametrize("public", WITH_ARRAYS, ids=lambda public: public.__name__)
def test_arrays_of_public_classes_are_read_only_copies(public: type) -> None:
    given = CHECKED.get(public) or {field.name: np.ones(3) for field in fields(public)}
    names = [name for name in array_fields(public) if isinstance(given.get(name), np.ndarray)]
    before = {name: given[name].copy() for name in names}
    made = public(**given)
    for name in names:
        given[name].flat[0] = 77
    for instance in (made, replace(made), pickle.loads(pickle.dumps(made))):
        for name in names:
            values = getattr(instance, name)
            np.testing.assert_array_equal(np.ravel(values)[: before[name].size], np.ravel(before[name]))
            with pytest.raises(ValueError, match="read-only"):
                values[...] = 0
