"""Settings and constants: defaults with their source, and every refusal."""

import math
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from typing import get_type_hints

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sionna_partial as sp
from sionna_partial.checks import Checked, shown
from sionna_partial.constants import CellState, LinkState
from sionna_partial.errors import SettingsError
from sionna_partial.settings import (
    ITU_BANDS_GHZ,
    DatasetSettings,
    Material,
    PredictorSettings,
    SceneSettings,
    SensorSettings,
    TraceSettings,
)

ITU_BANDS_OF_SIONNA = """
from sionna_partial.llvm import load_llvm
load_llvm()
from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES
from sionna_partial.settings import ITU_BANDS_GHZ
assert {name: tuple(bands) for name, bands in ITU_MATERIALS_PROPERTIES.items()} == ITU_BANDS_GHZ
"""


def test_link_and_cell_states() -> None:
    """The numbers are part of every file that we write."""
    assert {state.name: state.value for state in LinkState} == {"OUTAGE": 0, "LOS": 1, "NLOS": 2}
    assert {state.name: state.value for state in CellState} == {"FREE": 0, "WALL": 1, "UNKNOWN": 2}


NO_NUMBERS = (math.nan, math.inf, -math.inf, "1", None, True, [1.0])
RANGES = {
    (Material, "relative_permittivity"): ("[1, 1e+06]", (1, 1.0, 1e6), (0.999, -1, 1.1e6)),
    (Material, "conductivity_s_m"): ("[0, 1e+09]", (0, 0.0, 1e9), (-1e-9, 2e9)),
    (Material, "thickness_m"): ("(0, 10]", (1e-9, 10), (0, -0.1, 10.1)),
    (Material, "conductivity_exponent"): ("[0, 2]", (0, 0.0, 2), (-0.1, 2.1)),
    (SceneSettings, "bridge_gap_m"): ("[0, 1]", (0, 1.0), (-0.1, 1.1)),
    (SensorSettings, "range_noise_m"): ("[0, 1]", (0, 1.0), (-0.1, 1.1)),
    (SensorSettings, "drift_m_per_m"): ("[0, 1]", (0, 1.0), (-0.1, 1.1)),
    (SensorSettings, "missed_wall_fraction"): ("[0, 1]", (0, 1.0), (-0.1, 1.1)),
    (SensorSettings, "missed_return_fraction"): ("[0, 1]", (0, 1.0), (-0.1, 1.1)),
    (SensorSettings, "heading_noise_deg"): ("[0, 180]", (0, 180.0), (-0.1, 180.1)),
    (SensorSettings, "field_of_view_deg"): ("(0, 360]", (1e-9, 90, 360.0), (0, -0.1, 360.1)),
    (SensorSettings, "range_m"): ("(0, 100]", (1e-9, 3.2, 100), (0, -0.1, 100.1)),
    (TraceSettings, "frequency_hz"): ("[1e+06, 1e+12]", (1e6, 28e9, 1e12), (0, -28e9, 1.1e12)),
    (TraceSettings, "max_depth"): ("[0, 10]", (0, 10), (-1, 11)),
    (TraceSettings, "diffraction_walls"): ("[0, 2]", (0, 2), (-1, 3)),
    (TraceSettings, "samples_per_tx"): ("[1, 100000000]", (1, 10**8), (0, 10**8 + 1)),
    (TraceSettings, "seed"): ("[0, 2147483647]", (0, 2**31 - 1), (-1, 2**31)),
}
WHOLE = ("max_depth", "diffraction_walls", "samples_per_tx", "seed")


@pytest.mark.parametrize(("kind", "name"), RANGES)
def test_ranges(kind: type, name: str) -> None:
    """Both ends are allowed; each message has the name, the value and what is allowed."""
    span, allowed, refused = RANGES[kind, name]
    for value in allowed:
        assert getattr(kind(**{name: value}), name) == value
    for value in NO_NUMBERS:
        with pytest.raises(SettingsError, match=re.escape(f"{name} = {value!r} is not allowed: give a ")):
            kind(**{name: value})
    for value in refused:
        number = "whole number" if name in WHOLE else "number"
        expected = f"{name} = {value!r} is not allowed: give a {number} in {span}."
        with pytest.raises(SettingsError, match=f"^{re.escape(expected)}$"):
            kind(**{name: value})


SWITCHES = {
    (TraceSettings, "diffraction"): None,
    (TraceSettings, "open_ends"): False,
    (TraceSettings, "refraction"): None,
    (TraceSettings, "diffuse_reflection"): False,
    (SceneSettings, "ceiling"): True,
}


@pytest.mark.parametrize(("kind", "name"), SWITCHES)
def test_switches(kind: type, name: str) -> None:
    default = SWITCHES[kind, name]
    assert getattr(kind(), name) is default
    for allowed in (True, False, default):
        assert getattr(kind(**{name: allowed}), name) is allowed
    assert getattr(kind(**{name: np.bool_(True)}), name) is True
    for value in (1, 0, "yes", *([] if default is None else [None])):
        expected = f"{name} = {value!r} is not allowed: give True or False."
        with pytest.raises(SettingsError, match=f"^{re.escape(expected)}$"):
            kind(**{name: value})


def all_settings(kind: type = Checked) -> list[type]:
    """Return the settings classes of all modules."""
    for module in ("app.session", "coverage.link_budget", "live.topics", "tracing.antennas"):
        import_module(f"sionna_partial.{module}")
    return [each for own in kind.__subclasses__() for each in (own, *all_settings(own))]


def texts() -> list[tuple[type, str]]:
    """Return each settings class, and a field of it that holds text."""
    fields = [(kind, name, str(hint)) for kind in all_settings() for name, hint in get_type_hints(kind).items()]
    return [(kind, name) for kind, name, hint in fields if re.search(r"\bstr\b", hint)]


@pytest.mark.parametrize(("kind", "name"), texts())
def test_texts(kind: type, name: str) -> None:
    for value in (3, 2.5, True, b"map", ["map"]):
        with pytest.raises(SettingsError, match=f"^{name}.* is not allowed: "):
            kind(**{name: value})


def test_texts_are_found() -> None:
    assert {"LiveSettings.frame", "Topics.robot_frame", "Antenna.pattern"} <= {
        f"{kind.__name__}.{name}" for kind, name in texts()
    }


def test_scene_choices() -> None:
    with pytest.raises(SettingsError, match=r"material = 5 is not allowed: give Material\(\.\.\.\)"):
        SceneSettings(material=5)  # type: ignore[arg-type]
    for extent in ("observed", "none"):
        assert SceneSettings(floor_extent=extent).floor_extent == extent  # type: ignore[arg-type]
    expected = "floor_extent = 'all' is not allowed: choose one of observed, none."
    with pytest.raises(SettingsError, match=re.escape(expected)):
        SceneSettings(floor_extent="all")  # type: ignore[arg-type]
    for outline in ("lines", "cells"):
        assert SceneSettings(outline=outline).outline == outline  # type: ignore[arg-type]
    expected = "outline = 'walls' is not allowed: choose one of lines, cells."
    with pytest.raises(SettingsError, match=f"^{re.escape(expected)}$"):
        SceneSettings(outline="walls")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("frequency_hz", "end"),
    [
        (28, " Did you mean 28e9?"),
        (3.5, " Did you mean 3.5e9?"),
        (3500, " Did you mean 3500e6?"),
        (0, "."),
        (2e12, "]."),
    ],
)
def test_frequency_in_another_unit(frequency_hz: float, end: str) -> None:
    with pytest.raises(SettingsError, match=re.escape("is not allowed: give a number in [1e+06, 1e+12].")) as error:
        TraceSettings(frequency_hz=frequency_hz)
    assert str(error.value).endswith(end)


def test_itu_names() -> None:
    assert {Material(itu=name).itu for name in ITU_BANDS_GHZ} == set(ITU_BANDS_GHZ)
    with pytest.raises(SettingsError, match="itu = 'cheese' is not allowed: choose one of vacuum, concrete, brick, "):
        Material(itu="cheese")


@pytest.mark.parametrize(
    ("name", "frequency_hz", "spans"),
    [
        ("brick", 60e9, "1-40 GHz or 110-330 GHz"),
        ("concrete", 0.9e9, "1-100 GHz or 110-330 GHz"),
        ("concrete", 105e9, "1-100 GHz or 110-330 GHz"),
        ("wet_ground", 28e9, "1-10 GHz"),
        ("floorboard", 28e9, "50-100 GHz or 220-300 GHz"),
    ],
)
def test_frequency_outside_the_material(name: str, frequency_hz: float, spans: str) -> None:
    message = f"frequency_hz = {frequency_hz!r} is not allowed: ITU material {name!r} is defined for {spans}"
    with pytest.raises(SettingsError, match=rf"{re.escape(message)}.*; choose a frequency there or a custom"):
        Material(itu=name).require_frequency(frequency_hz)


@given(st.sampled_from(sorted(ITU_BANDS_GHZ)), st.floats(0.001, 1000.0))
def test_frequency_is_allowed_inside_a_band_alone(name: str, frequency_ghz: float) -> None:
    inside = any(low <= frequency_ghz * 1e9 / 1e9 <= high for low, high in ITU_BANDS_GHZ[name])
    if inside:
        Material(itu=name).require_frequency(frequency_ghz * 1e9)
    else:
        with pytest.raises(SettingsError, match="frequency_hz"):
            Material(itu=name).require_frequency(frequency_ghz * 1e9)


def test_itu_bands_are_those_of_sionna() -> None:
    """In a process of its own, since Sionna starts Dr.Jit."""
    done = subprocess.run([sys.executable, "-c", ITU_BANDS_OF_SIONNA], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


class TestDatasetSettings:
    def test_defaults_are_the_papers(self) -> None:
        settings = DatasetSettings()
        assert (settings.links_per_home, settings.stages) == (400, (0, 50, 100, 150, 200))
        assert (settings.tx_height_m, settings.rx_height_m) == (1.5, 1.5)
        assert (settings.sensor, settings.scene, settings.trace) == (SensorSettings(), SceneSettings(), TraceSettings())

    @pytest.mark.parametrize(
        ("name", "value", "remedy"),
        [
            ("links_per_home", 0, "give a whole number in [1, 1000000]."),
            ("links_per_home", 3, "give at least 4, one for each of the transmitters_per_home."),
            ("links_per_home", 400.0, "give a whole number in [1, 1000000]."),
            ("transmitters_per_home", 0, "give a whole number in [1, 1000]."),
            ("seed", -1, "give a whole number in [0, 2147483647]."),
            ("stages", (), "give increasing whole numbers of 0 or more"),
            ("stages", [0, 50], "give increasing whole numbers of 0 or more"),
            ("stages", (50, 0), "give increasing whole numbers of 0 or more"),
            ("stages", (0, 0), "give increasing whole numbers of 0 or more"),
            ("stages", (0, 2.5), "give increasing whole numbers of 0 or more"),
            ("stages", (-1, 2), "give increasing whole numbers of 0 or more"),
            ("tx_height_m", 0.0, "give a number in (0, 1000]."),
            ("rx_height_m", math.nan, "give a number in (0, 1000]."),
            ("margin_m", -0.1, "give a number in [0, 1000]."),
            ("sensor", TraceSettings(), "give SensorSettings(...), or 'mixed'."),
            ("scene", None, "give SceneSettings(...)."),
            ("trace", SceneSettings(), "give TraceSettings(...)."),
        ],
    )
    def test_refused(self, name: str, value: object, remedy: str) -> None:
        with pytest.raises(SettingsError, match=re.escape(f"{name} = {shown(value)} is not allowed: {remedy}")):
            DatasetSettings(**{name: value})

    def test_material_that_the_frequency_does_not_suit(self) -> None:
        with pytest.raises(SettingsError, match=r"ITU material 'carpet_tile' is defined for 1-40 GHz"):
            DatasetSettings(scene=SceneSettings(Material(itu="carpet_tile")), trace=TraceSettings(frequency_hz=60e9))


class TestPredictorSettings:
    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"frequency_hz": 0.0}, "frequency_hz = 0.0 is not allowed"),
            ({"learning_rate": 0.0}, "learning_rate = 0.0 is not allowed: give a number in (0, 1]"),
            ({"networks": "Map"}, "networks = 'Map' is not allowed: choose one of paper, paths, map."),
            ({"networks": None}, "networks = None is not allowed: choose one of"),
            ({"diffraction": 1}, "diffraction = 1 is not allowed: give True or False."),
            ({"passes": 0}, "passes = 0 is not allowed: give a whole number in [1, 1000000]."),
            ({"steps": 1.5}, "steps = 1.5 is not allowed: give a whole number in [1, 1000000]."),
            ({"batch_size": 0}, "batch_size = 0 is not allowed: give a whole number in [1, 1000000]."),
            ({"minimum_links": True}, "minimum_links = True is not allowed: give a whole number in [1, 1000000]."),
            ({"seed": -1}, "seed = -1 is not allowed: give a whole number in [0, 1000000000]."),
        ],
    )
    def test_refused(self, change: dict[str, object], message: str) -> None:
        with pytest.raises(SettingsError, match=re.escape(message)):
            PredictorSettings(**change)


def test_materials_by_name() -> None:
    assert SceneSettings(material="concrete") == SceneSettings(material=Material(itu="concrete", thickness_m=0.2))  # type: ignore[arg-type]
    assert Material.named("drywall") == SceneSettings().traced_material
    assert replace(Material.named("drywall"), conductivity_exponent=0.0) == Material() == Material(thickness_m=0.1)
    assert repr(Material.named("brick")) == "Material(itu='brick', thickness_m=0.11)"
    custom = Material(4.0, 0.05, 0.2)
    assert eval(repr(custom)) == custom
    with pytest.raises(SettingsError, match="material = 'cheese' is not allowed: choose one of drywall, brick"):
        SceneSettings(material="cheese")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sp.predict_map(None, frequency_hz=5e9), "frequency_hz = 5000000000.0 is a setting: give trace_sett"),
        (lambda: sp.predict_map(None, ceiling=False), "give scene_settings=SceneSettings(ceiling=...)."),
        (lambda: sp.LinkModel(None, max_depth=3), "give trace_settings=TraceSettings(max_depth=...)."),
        (lambda: sp.Simulation(None, material="brick"), "give scene_settings=SceneSettings(material=...)."),
        (lambda: sp.trace_links(None, None, None, refraction=True), "give trace_settings=TraceSettings(refraction="),
    ],
)
def test_settings_given_as_arguments(call: Callable[[], object], message: str) -> None:
    for kind in (SettingsError, TypeError):
        with pytest.raises(kind, match=re.escape(message)):
            call()
    with pytest.raises(TypeError, match="unexpected keyword argument 'frequency'"):
        sp.predict_map(None, frequency=5e9)  # type: ignore[call-arg]
