"""Every internal part of Sionna RT that `chain` and `solver` lean on, and whether this version still has it.

Sionna RT documents its path solver, not the chain inside it. `solver` fills a `PathsBuffer` by its private fields and
runs `ImageMethod` and `FieldCalculator` on it. Each of these parts is named here, and looked for once in each process.
Versions that were not tested are tried as well (see `probe`). If the contract is broken, paths come from `stock`, more
slowly.
"""

import functools
import inspect
import logging
from collections.abc import Iterator
from importlib import import_module, metadata
from types import ModuleType
from typing import Any

import numpy as np

from sionna_partial.errors import SionnaPartialError
from sionna_partial.tracing.sionna_rt import load_sionna

TESTED_VERSIONS = ("2.2.0",)
"""Versions of Sionna RT with which all tests pass."""

ARGUMENTS = {
    "sionna.rt.path_solvers.paths_buffer.PathsBuffer.__init__": ("buffer_size", "max_depth", "diffraction"),
    "sionna.rt.path_solvers.image_method.ImageMethod.__init__": (),
    "sionna.rt.path_solvers.image_method.ImageMethod.__call__": (
        *("scene", "paths", "diffraction", "diffraction_lit_region", "src_positions", "tgt_positions"),
    ),
    "sionna.rt.path_solvers.field_calculator.FieldCalculator.__init__": (),
    "sionna.rt.path_solvers.field_calculator.FieldCalculator.__call__": (
        *("wavelength", "paths", "samples_per_src", "diffraction", "src_positions", "tgt_positions"),
        *("src_orientations", "tgt_orientations", "src_antenna_patterns", "tgt_antenna_patterns"),
    ),
    "sionna.rt.utils.wedges.WedgeGeometry.__init__": (
        *("shape", "prim0", "primn", "local_edge", "o", "e_hat", "length", "n0", "nn"),
    ),
}
"""Functions that are called, and all arguments that they are given; those of `PathsBuffer` by position."""

BUFFER_FIELDS = {
    "_vertices_x": ("TensorXf", (2, 3)),
    "_vertices_y": ("TensorXf", (2, 3)),
    "_vertices_z": ("TensorXf", (2, 3)),
    "_shapes": ("TensorXu", (2, 3)),
    "_primitives": ("TensorXu", (2, 3)),
    "_interaction_types": ("TensorXu", (2, 3)),
    "_src_indices": ("UInt", (2,)),
    "_tgt_indices": ("UInt", (2,)),
    "_paths_counter": ("UInt", (1,)),
    "_diffracting_wedges": ("WedgeGeometry", None),
}
"""Private fields of `PathsBuffer` that are filled: type, and shape in a buffer of 2 paths of 3 interactions."""

ATTRIBUTES = {
    "sionna.rt.path_solvers.paths_buffer.PathsBuffer": (
        *("schedule", "shrink", "valid", "a", "tau", "target_indices", "interaction_types"),
        *("vertices_x", "vertices_y", "vertices_z"),
    ),
    "sionna.rt.path_solvers.image_method.ImageMethod": ("loop_mode",),
    "sionna.rt.path_solvers.field_calculator.FieldCalculator": ("loop_mode",),
    "sionna.rt.Scene": ("mi_scene", "objects", "tx_array", "wavelength", "frequency", "radio_materials"),
    "sionna.rt.RadioMaterial": ("relative_permittivity", "conductivity", "thickness"),
    "sionna.rt.SceneObject": ("mi_mesh", "object_id"),
    "sionna.rt.AntennaArray": ("antenna_pattern",),
    "sionna.rt.AntennaPattern": ("patterns",),
}
"""Methods and properties that are used."""

NUMBERS = {
    "sionna.rt.constants.INVALID_SHAPE": 0xFFFFFFFF,
    "sionna.rt.constants.INVALID_PRIMITIVE": 0xFFFFFFFF,
    "sionna.rt.constants.InteractionType.NONE": 0,
    "sionna.rt.constants.InteractionType.SPECULAR": 1,
    "sionna.rt.constants.InteractionType.DIFFUSE": 2,
    "sionna.rt.constants.InteractionType.REFRACTION": 4,
    "sionna.rt.constants.InteractionType.DIFFRACTION": 8,
}
"""Constants, and what they must be."""

_log = logging.getLogger(__name__)


@functools.cache
def contract_breaches() -> tuple[str, ...]:
    """Look for every internal part that `solver` leans on; it takes milliseconds, and never raises.

    Returns
    -------
    tuple of str
        What is missing or different, each in plain words; empty if the contract holds.
    """
    try:
        load_sionna()
        checks = (_argument_breaches, _attribute_breaches, _number_breaches, _buffer_breaches)
        return tuple(dict.fromkeys(breach for check in checks for breach in check()))
    except SionnaPartialError as error:
        return (str(error),)
    except Exception as error:
        return (f"Sionna RT cannot be examined ({error!r})",)


def sionna_version() -> str:
    """Version of Sionna RT that is installed, "" if none is."""
    try:
        return metadata.version("sionna-rt")
    except metadata.PackageNotFoundError:
        return ""


def contract_remedy() -> str:
    """Say what to do about a broken contract."""
    return f"""run pip install "sionna-rt=={TESTED_VERSIONS[-1]}" to have the fast engine back."""


@functools.cache
def warn_of_breaches(breaches: tuple[str, ...]) -> None:
    """Log what is broken, what it costs and what to do; once for each process.

    Parameters
    ----------
    breaches : tuple of str
        As `contract_breaches` gives them.
    """
    _log.warning(
        "sionna-rt %s is not what the fast engine was made for (%s). Its public path solver is used instead: it gives "
        "most paths, and takes seconds for each receiver: %s",
        sionna_version(),
        "; ".join(breaches),
        contract_remedy(),
    )


def _find(name: str) -> Any:
    """Look a full name up; None where a part of it is missing."""
    parts = name.split(".")
    found: Any = None
    for count, part in enumerate(parts, 1):
        inner = getattr(found, part, None)
        if inner is None and (found is None or isinstance(found, ModuleType)):
            try:
                inner = import_module(".".join(parts[:count]))
            except ImportError:
                inner = None
        if inner is None:
            return None
        found = inner
    return found


def _short(name: str) -> str:
    """Name without its modules: they are written in small letters."""
    parts = name.split(".")
    first = next((k for k, part in enumerate(parts) if part[0].isupper()), len(parts) - 1)
    return ".".join(parts[first:])


def _argument_breaches() -> Iterator[str]:
    for name, given in ARGUMENTS.items():
        function = _find(name)
        if function is None:
            yield f"{name} is missing"
            continue
        parameters = dict(list(inspect.signature(function).parameters.items())[1:])
        if any(each.kind is inspect.Parameter.VAR_KEYWORD for each in parameters.values()):
            continue
        yield from (f"{_short(name)} takes no argument {each}" for each in given if each not in parameters)
        for other, parameter in parameters.items():
            required = parameter.default is inspect.Parameter.empty and parameter.kind is not parameter.VAR_POSITIONAL
            if other not in given and required:
                yield f"{_short(name)} needs another argument, {other}"


def _attribute_breaches() -> Iterator[str]:
    for name, attributes in ATTRIBUTES.items():
        found = _find(name)
        if found is None:
            yield f"{name} is missing"
        else:
            yield from (f"{_short(name)} has no {each}" for each in attributes if not hasattr(found, each))


def _number_breaches() -> Iterator[str]:
    for name, number in NUMBERS.items():
        found = _find(name)
        if found is None:
            yield f"{name} is missing"
        elif found != number:
            yield f"{_short(name)} is {found}, not {number}"


def _buffer_breaches() -> Iterator[str]:
    """Look into a small buffer, for its fields exist only once it is made."""
    buffer_type = _find("sionna.rt.path_solvers.paths_buffer.PathsBuffer")
    if buffer_type is None:
        return
    try:
        buffer = buffer_type(2, 3, True)
    except Exception as error:
        yield f"PathsBuffer(2, 3, True) fails ({error!r})"
        return
    for name, (kind, shape) in BUFFER_FIELDS.items():
        if not hasattr(buffer, name):
            yield f"PathsBuffer has no field {name}"
            continue
        field = getattr(buffer, name)
        if type(field).__name__ != kind:
            yield f"PathsBuffer.{name} is a {type(field).__name__}, not a {kind}"
        elif shape is not None and tuple(np.shape(field)) != shape:
            yield f"PathsBuffer.{name} has shape {tuple(np.shape(field))} in place of {shape}"
