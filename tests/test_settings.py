"""Settings and constants: defaults with their source, and every refusal."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from typing import Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import sionna_partial as sp
from sionna_partial.checks import Checked, shown
from sionna_partial.constants import CellState, LinkState
from sionna_partial.errors import SettingsError
from sionna_partial.lab.datasets.settings import DatasetSettings
from sionna_partial.settings import ITU_BANDS_GHZ, Material, SceneSettings, TraceSettings


def test_link_and_cell_states() -> None:
    """The numbers are part of every file that we write."""
    assert {state.name: state.value for state in LinkState} == {"OUTAGE": 0, "LOS": 1, "NLOS": 2}
    assert {state.name: state.value for state in CellState} == {"FREE": 0, "WALL": 1, "UNKNOWN": 2}


NO_NUMBERS = (math.nan, math.inf, -math.inf, "1", None, True, [1.0])
RANGES = """
Material relative_permittivity number [1, 1e+06], conductivity_s_m number [0, 1e+09], thickness_m number (0, 10],
    conductivity_exponent number [0, 2]
SceneSettings bridge_gap_m number [0, 1]
TraceSettings frequency_hz number [1e+06, 1e+12], max_depth whole [0, 10], diffraction_walls whole [0, 2],
    power_tolerance_db number [0, 1], max_walls whole [1, 16], wall_depth_m number [0, 10],
    samples_per_tx whole [1, 100000000], seed whole [0, 2147483647]
SensorSettings range_noise_m number [0, 1], drift_m_per_m number [0, 1], missed_wall_fraction number [0, 1],
    field_of_view_deg number (0, 360], range_m number (0, 100], heading_noise_deg number [0, 180],
    missed_return_fraction number [0, 1]
DatasetSettings links_per_home whole [1, 1000000], transmitters_per_home whole [1, 1000], seed whole [0, 2147483647],
    tx_height_m number (0, 1000], rx_height_m number (0, 1000], margin_m number [0, 1000],
    short_link_fraction number [0, 1], cir_paths whole [0, 1000]
PredictorSettings frequency_hz number [1e+06, 1e+12], passes whole [1, 1000000], steps whole [1, 1000000],
    batch_size whole [1, 1000000], learning_rate number (0, 1], minimum_links whole [1, 1000000],
    seed whole [0, 1000000000]
PlacementSettings threshold_db number (-150, 0], seed whole [0, 9223372036854775807]
Antenna azimuth_deg number [-360, 360], downtilt_deg number [-90, 90], rows whole [1, 64], columns whole [1, 64],
    beam whole [0, 4095]
Transmitter x_m number [-1e+06, 1e+06], y_m number [-1e+06, 1e+06], z_m number [0, 1000], eirp_dbm number [-200, 200]
RadioSettings frequency_hz number [1e+06, 1e+12], rx_height_m number [0, 1000], spacing_m number [0.02, 10],
    bandwidth_hz number [1000, 1e+11], threshold_dbm number [-200, 100], eirp_dbm number [-200, 200],
    client_dbm number [-200, 200]
LinkBudget noise_figure_db number [0, 100], bandwidth_hz number [1, 1e+11], load number [0, 1],
    sinr_threshold_db number [-200, 200]
LiveSettings threshold_db number [-150, 0], spacing_m number (0, 10], rx_height_m number [0, 100],
    tx_power_dbm number [-200, 200], refresh_s number [0.1, 1e+06], views_every_s number [0, 1e+06],
    max_cost whole [1, 100]
"""
"""Class, fields, and for each a number (or a whole number) in an interval."""

BESIDE = {
    ("DatasetSettings", "links_per_home"): {"transmitters_per_home": 1},
    ("DatasetSettings", "transmitters_per_home"): {"links_per_home": 1000},
    ("Antenna", "beam"): {"rows": 64, "columns": 64},
    **{
        ("Transmitter", name): {"x_m": 0.0, "y_m": 0.0}
        for name in ("x_m", "y_m", "z_m", "eirp_dbm", "model", "channel")
    },
}
"""Other fields that make the ends of an interval valid."""


def settings_classes(kind: type = Checked) -> dict[str, type]:
    for module in ("apps.app.session", "coverage.link_budget", "apps.live.topics", "tracing.antennas"):
        import_module(f"sionna_partial.{module}")
    own = {each.__name__: each for each in kind.__subclasses__()}
    return own | {name: each for child in own.values() for name, each in settings_classes(child).items()}


CLASSES = settings_classes()
FIELDS = {
    (name, field): hint
    for name, kind in CLASSES.items()
    for field, hint in get_type_hints(kind, include_extras=True).items()
}


def ranges() -> list[tuple[str, str, str, str]]:
    """Return class, field, kind of number and interval of each entry of RANGES."""
    return [
        (row.split()[0], *entry)
        for row in re.sub(r",\n +", ", ", RANGES.strip()).splitlines()
        for entry in re.findall(r"(\w+) (number|whole) ([\[(].*?\])", row)
    ]


def test_every_range_is_in_the_table() -> None:
    assert {(name, field) for name, field, *_ in ranges()} == {
        key for key, hint in FIELDS.items() if "Within" in str(hint)
    }


@pytest.mark.parametrize(("name", "field", "number", "span"), ranges())
def test_ranges(name: str, field: str, number: str, span: str) -> None:
    kind, beside = CLASSES[name], BESIDE.get((name, field), {})
    low, high = map(int if number == "whole" else float, span[1:-1].split(", "))
    if number == "whole":
        first, below, above = low, low - 1, high + 1
    else:
        first, below, above = low, math.nextafter(low, -math.inf), math.nextafter(high, math.inf)
    if span[0] == "(":
        first, below = math.nextafter(low, math.inf), low
    for value in (first, high):
        assert getattr(kind(**beside | {field: value}), field) == value
    default = kind.__dataclass_fields__[field].default
    wrong = [below, above, -1e300, 1e300, *[low + 0.5] * (number == "whole"), *NO_NUMBERS]
    for value in (value for value in wrong if value is not default):
        with pytest.raises(SettingsError) as caught:
            kind(**beside | {field: value})
        words = f"{field} = {value!r} is not allowed: give a {number.replace('whole', 'whole number')} in {span}."
        assert str(caught.value).partition(" Did you mean ")[0] == words


@pytest.mark.parametrize(
    ("name", "field"), [key for key, hint in FIELDS.items() if hint is bool or hint == bool | None]
)
def test_switches(name: str, field: str) -> None:
    kind = CLASSES[name]
    default = kind.__dataclass_fields__[field].default
    for allowed in (True, False, default):
        assert getattr(kind(**{field: allowed}), field) is allowed
    assert getattr(kind(**{field: np.bool_(True)}), field) is True
    for value in (1, 0, "yes", *([] if default is None else [None])):
        with pytest.raises(SettingsError, match=f"^{field} = {value!r} is not allowed: give True or False.$"):
            kind(**{field: value})


@pytest.mark.parametrize(("name", "field"), [key for key, hint in FIELDS.items() if re.search(r"\bstr\b", str(hint))])
def test_texts(name: str, field: str) -> None:
    for value in (3, b"map", ["map"]):
        with pytest.raises(SettingsError, match=f"^{field}.* is not allowed: "):
            CLASSES[name](**BESIDE.get((name, field), {}), **{field: value})


@pytest.mark.parametrize(
    ("name", "field", "words"), [(*key, get_args(hint)) for key, hint in FIELDS.items() if get_origin(hint) is Literal]
)
def test_choices(name: str, field: str, words: tuple[str, ...]) -> None:
    for word in words:
        assert getattr(CLASSES[name](**{field: word}), field) == word
    for value in ("all", None):
        with pytest.raises(SettingsError, match=f"^{field} = .* is not allowed: choose one of {', '.join(words)}.$"):
            CLASSES[name](**{field: value})


STAGES = "give increasing whole numbers of 0 or more, such as (0, 50, 100, 150, 200), or fractions in [0, 1]."
FREQUENCIES = "give a number in [1e+06, 1e+12]."


@pytest.mark.parametrize(
    ("name", "field", "value", "remedy"),
    [
        ("SceneSettings", "material", 5, "give Material(...)."),
        ("SceneSettings", "material", "cheese", "choose one of drywall, brick"),
        ("Material", "itu", "cheese", "choose one of vacuum, concrete, brick, "),
        ("TraceSettings", "frequency_hz", 28, f"{FREQUENCIES} Did you mean 28e9?"),
        ("TraceSettings", "frequency_hz", 3500, f"{FREQUENCIES} Did you mean 3500e6?"),
        ("TraceSettings", "frequency_hz", 0, f"{FREQUENCIES}$"),
        ("DatasetSettings", "links_per_home", 3, "give at least 4, one for each of the transmitters_per_home."),
        *(("DatasetSettings", "stages", value, STAGES) for value in ((), [0, 50], (50, 0), (0, 2.5), (-1, 2))),
        ("DatasetSettings", "sensor", TraceSettings(), "give SensorSettings(...), or 'mixed'."),
        ("DatasetSettings", "trace", SceneSettings(), "give TraceSettings(...)."),
        ("Topics", "map", "map", "give the full name of a topic, such as /map."),
        ("Topics", "powers", {"rssi": None}, "give the full name of a topic"),
        ("Topics", "powers", 3, "give a mapping of topics to transmitters."),
        ("Topics", "robot_frame", "", "give a frame, such as base_link."),
    ],
)
def test_refused(name: str, field: str, value: object, remedy: str) -> None:
    given = "'rssi'" if value == {"rssi": None} else shown(value)
    message = f"{re.escape(given)} is not allowed: {re.escape(remedy)}".replace(r"\$", "$")
    with pytest.raises(SettingsError, match=f"^{field}.* = {message}"):
        CLASSES[name](**{field: value})


@pytest.mark.parametrize(
    ("name", "frequency_hz", "spans"),
    [("brick", 60e9, "1-40 GHz or 110-330 GHz"), ("concrete", 0.9e9, "1-100 GHz or 110-330 GHz")],
)
def test_frequency_outside_the_material(name: str, frequency_hz: float, spans: str) -> None:
    for frequency_ghz in np.ravel(ITU_BANDS_GHZ[name]):
        Material(itu=name).require_frequency(frequency_ghz * 1e9)
    message = f"frequency_hz = {frequency_hz!r} is not allowed: ITU material {name!r} is defined for {spans}"
    with pytest.raises(SettingsError, match=rf"{re.escape(message)}.*; choose a frequency there or a custom"):
        Material(itu=name).require_frequency(frequency_hz)


def test_material_that_the_frequency_does_not_suit() -> None:
    with pytest.raises(SettingsError, match=r"ITU material 'carpet_tile' is defined for 1-40 GHz"):
        DatasetSettings(scene=SceneSettings(Material(itu="carpet_tile")), trace=TraceSettings(frequency_hz=60e9))


def test_materials_by_name() -> None:
    assert SceneSettings(material="concrete") == SceneSettings(material=Material(itu="concrete", thickness_m=0.2))  # type: ignore[arg-type]
    assert Material.named("drywall") == SceneSettings().traced_material
    assert replace(Material.named("drywall"), conductivity_exponent=0.0) == Material() == Material(thickness_m=0.1)
    assert repr(Material.named("brick")) == "Material(itu='brick', thickness_m=0.11)"
    custom = Material(4.0, 0.05, 0.2)
    assert eval(repr(custom)) == custom


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sp.predict_map(None, frequency_hz=5e9), "frequency_hz = 5000000000.0 is a setting: give trace_sett"),
        (lambda: sp.predict_map(None, ceiling=False), "give scene_settings=SceneSettings(ceiling=...)."),
        (lambda: sp.Simulation(None, material="brick"), "give scene_settings=SceneSettings(material=...)."),
    ],
)
def test_settings_given_as_arguments(call: Callable[[], object], message: str) -> None:
    for kind in (SettingsError, TypeError):
        with pytest.raises(kind, match=re.escape(message)):
            call()
    with pytest.raises(TypeError, match="unexpected keyword argument 'frequency'"):
        sp.predict_map(None, frequency=5e9)  # type: ignore[call-arg]
