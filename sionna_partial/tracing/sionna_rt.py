"""Sionna RT on the CPU: loaded after LLVM, and scenes as our traces need them."""

from pathlib import Path
from types import ModuleType
from typing import Any

from sionna_partial.errors import BackendError
from sionna_partial.llvm import load_llvm

MITSUBA_VARIANT = "llvm_ad_mono_polarized"
"""Mitsuba variant of Sionna RT on a CPU."""


def load_sionna() -> ModuleType:
    """Import Sionna RT on the CPU, with a working LLVM.

    Raises
    ------
    BackendError
        If LLVM or Sionna RT cannot be used; the message says what to do.
    """
    load_llvm()
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant(MITSUBA_VARIANT)
    if mi.variant() != MITSUBA_VARIANT:
        raise BackendError(
            f"mitsuba variant = {mi.variant()!r} is not supported: call mitsuba.set_variant('{MITSUBA_VARIANT}') "
            "before the first trace, or import sionna_partial in a process of its own."
        )
    import sionna.rt

    return sionna.rt


def open_scene(scene_xml: Path, frequency_hz: float) -> Any:
    """Load a scene into Sionna RT, its shapes kept apart, with isotropic, vertically polarised antennas.

    Parameters
    ----------
    scene_xml : Path
    frequency_hz : float
        Carrier frequency [Hz].

    Returns
    -------
    sionna.rt.Scene
    """
    rt = load_sionna()
    scene = rt.load_scene(str(scene_xml), merge_shapes=False)
    scene.frequency = frequency_hz
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, vertical_spacing=0.5, horizontal_spacing=0.5, pattern="iso", polarization="V"
    )
    return scene
