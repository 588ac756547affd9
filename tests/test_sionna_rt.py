"""Sionna RT as our traces load it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from extruded import ROOM, extrude

from sionna_partial.scene.scene import write_scene
from sionna_partial.tracing.engine import MITSUBA_VARIANT, load_sionna, open_scene

WITH_VARIANT = """
import sys
from sionna_partial.errors import BackendError
from sionna_partial.llvm import load_llvm
from sionna_partial.tracing.engine import load_sionna
load_llvm()
import mitsuba
mitsuba.set_variant(sys.argv[1])
try:
    print(load_sionna().__name__)
except BackendError as error:
    print(error)
"""


def _load_after(variant: str) -> str:
    """What loading gives in a process of its own, where someone else set the variant."""
    command = [sys.executable, "-c", WITH_VARIANT, variant]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


class TestLoadSionna:
    def test_variant_of_someone_else_is_refused(self) -> None:
        remedy = f"call mitsuba.set_variant('{MITSUBA_VARIANT}') before the first trace, or import sionna_partial in a"
        expected = f"mitsuba variant = 'scalar_rgb' is not supported: {remedy} process of its own."
        assert _load_after("scalar_rgb") == expected

    def test_our_variant_may_be_set_already(self) -> None:
        assert _load_after(MITSUBA_VARIANT) == "sionna.rt"

    def test_gives_the_module(self) -> None:
        assert load_sionna() is load_sionna()
        assert load_sionna().__name__ == "sionna.rt"


class TestOpenScene:
    @pytest.mark.parametrize("frequency_hz", [3.5e9, 28e9])
    def test_frequency_shapes_and_antennas(self, frequency_hz: float, tmp_path: Path) -> None:
        scene = open_scene(write_scene(extrude(ROOM), tmp_path, offset_m=(0.0, 0.0)), frequency_hz)
        assert float(scene.frequency.numpy().ravel()[0]) == pytest.approx(frequency_hz)
        assert set(scene.objects) == {"walls", "floor", "ceiling"}
        assert scene.tx_array is scene.rx_array
        assert scene.tx_array.num_ant == 1
        (pattern,) = scene.tx_array.antenna_pattern.patterns
        import mitsuba as mi

        zenith, azimuth = mi.Float([0.3, 1.5, 2.9]), mi.Float([0.0, 2.0, -3.0])
        gain = [part.numpy() for part in pattern(zenith, azimuth)]
        np.testing.assert_allclose(np.abs(gain[0]), 1.0, rtol=1e-6)  # isotropic,
        np.testing.assert_allclose(np.abs(gain[1]), 0.0, atol=1e-7)  # vertically polarised
