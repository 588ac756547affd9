"""Scenes in Sionna RT whose numbers are no part of kernels: Dr.Jit would compile each kernel for each scene."""

import functools
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sionna_partial.llvm import load_sionna
from sionna_partial.scene.scene import PowerLaw, power_laws
from sionna_partial.settings import Material

_PLACES = 256
"""Least number up to which kernels count shapes and materials."""

_placeholders: dict[tuple[str, int], Any] = {}
_holding = threading.Lock()


def open_scene(scene_xml: Path, frequency_hz: float, materials: Mapping[str, Material] | None = None) -> Any:
    """Load a scene with separate shapes and vertical isotropic antennas.

    `materials`, by their names in the scene, follow the frequency.
    """
    scene = load_sionna().load_scene(str(scene_xml), merge_shapes=False)
    import drjit as dr
    import mitsuba as mi

    with _holding:
        _hold_places(scene.mi_scene.shapes())
    set_antennas(scene, 1)
    set_frequency(scene, dr.opaque(mi.Float, frequency_hz))
    _follow_frequency(scene, materials or {}, frequency_hz)
    for own in scene.radio_materials.values():
        dr.make_opaque(own.relative_permittivity, own.conductivity, own.thickness)
    return scene


def set_antennas(scene: Any, polarisations: int) -> None:
    """Give a scene isotropic antennas: vertical, or V and H for 2 polarisations."""
    polarization = "V" if polarisations == 1 else "VH"
    array = load_sionna().PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization=polarization)
    scene.tx_array = scene.rx_array = array


def set_frequency(scene: Any, frequency_hz: Any) -> None:
    """Set the carrier frequency, a `mitsuba.Float` [Hz], with all materials.

    Frozen functions refer to materials of all scenes that there are, and find their variables in attributes only.
    """
    scene.frequency = frequency_hz
    for material in scene.radio_materials.values():
        material.frequency_of_scene = scene.frequency


def _follow_frequency(scene: Any, materials: Mapping[str, Material], frequency_hz: float) -> None:
    """Give all materials their dependence on frequency in the same form, for which Dr.Jit compiles once."""
    import drjit as dr
    import mitsuba as mi

    def update(laws: Sequence[PowerLaw], at_hz: Any) -> tuple[Any, ...]:
        return tuple(opaque(law.value) * (at_hz / opaque(frequency_hz)) ** opaque(law.exponent) for law in laws)

    opaque = functools.partial(dr.opaque, mi.Float)
    for name in materials.keys() & scene.radio_materials.keys():
        laws = power_laws(materials[name], frequency_hz)
        scene.radio_materials[name].frequency_update_callback = functools.partial(update, laws)


def _hold_places(shapes: Sequence[Any]) -> None:
    """Let the largest numbers of shapes and of materials in this process, which Dr.Jit reuses, be powers of two.

    Kernels have tables of as many places, so that each number of scenes and each mesh would compile them again.
    """
    import drjit as dr
    import mitsuba as mi

    def placeholder(kind: str, make: Callable[[], Any], pointer: Any, objects: Sequence[Any]) -> Any:
        place = max(_PLACES, 1 << max(number_of(pointer(each)) for each in objects).bit_length())
        waiting = []
        while (kind, place) not in _placeholders:
            waiting.append(make())
            if number_of(pointer(waiting[-1])) >= place:
                _placeholders[kind, place] = waiting[-1]
        return _placeholders[kind, place]

    def number_of(pointer: Any) -> int:
        numbers: Any = dr.reinterpret_array(mi.UInt, pointer)
        return int(numbers[0])

    def new_material() -> Any:
        return mi.load_dict({"type": "null"})

    def new_shape() -> Any:
        properties: Any = mi.Properties()
        properties["bsdf"] = material
        return mi.Mesh("placeholder", 3, 1, properties)

    if len(shapes):
        material = placeholder("material", new_material, mi.BSDFPtr, [each.bsdf() for each in shapes])
        placeholder("shape", new_shape, mi.ShapePtr, shapes)
