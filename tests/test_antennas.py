"""Antennas in coverage maps: against stock Sionna RT, known patterns, and what the unseen paths see of them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from test_trace import _half_seen_room, _room
from typer.testing import CliRunner

import sionna_partial as sp
from sionna_partial.cli.app import app
from sionna_partial.errors import SettingsError
from sionna_partial.llvm import load_sionna
from sionna_partial.scene.export import export_scene
from sionna_partial.tracing.power import gain_at_azimuth, gain_between, gain_towards

TX, DEPTH = (1.03, 2.93, 1.4), 2
SECTOR = sp.Antenna("tr38901", azimuth_deg=-70.0, downtilt_deg=25.0)
PANEL = sp.Antenna("tr38901", azimuth_deg=200.0, downtilt_deg=-10.0, rows=2, columns=4, beam=5)
LINES = "".join(f"{angle} {min(30.0, 12 * (min(angle, 360 - angle) / 65) ** 2):.2f}\n" for angle in range(360))
MSI = f"NAME made\nGAIN 5.0 dBd\nTILT ELECTRICAL\nHORIZONTAL 360\n{LINES}VERTICAL 360\n{LINES}"


def coverage_of(partial: sp.PartialMap, antenna: Any = None, **options: Any) -> xr.Dataset:
    settings = sp.TraceSettings(max_depth=DEPTH, diffraction=False)
    return sp.predict_map(partial, TX, tx_antenna=antenna, spacing_m=0.9, trace_settings=settings, **options)


def stock_gain_db(antenna: sp.Antenna, rx_m: np.ndarray, folder: Path) -> np.ndarray:
    """Gains that Sionna RT's public solver finds, with phases of the array as the beam has them."""
    rt = load_sionna()
    scene = rt.load_scene(str(export_scene(_room(), folder / "scene") / "scene.xml"), merge_shapes=False)
    scene.frequency = 28e9
    scene.tx_array = rt.PlanarArray(
        num_rows=antenna.rows, num_cols=antenna.columns, pattern="tr38901", polarization="V"
    )
    scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    turned = [float(angle) for angle in np.radians([antenna.azimuth_deg, antenna.downtilt_deg, 0.0])]
    scene.add(rt.Transmitter("tx", position=[*TX], orientation=turned))
    gains_db, weights = [], sp.channels.dft_codebook(antenna.rows, antenna.columns)[antenna.beam]
    for position in rx_m:
        scene.remove("rx")
        scene.add(rt.Receiver("rx", position=position.tolist()))
        options = {"refraction": False, "samples_per_src": 200_000, "max_num_paths_per_src": 1_000_000}
        paths = rt.PathSolver(deterministic=True)(scene, max_depth=DEPTH, **options)
        real, imaginary = (part.numpy()[0, 0, 0] for part in paths.a)
        power = np.sum(np.abs(weights @ (real + 1j * imaginary)) ** 2)
        gains_db.append(10 * np.log10(max(power, 1e-15)))
    return np.array(gains_db)


@pytest.mark.parametrize("antenna", [SECTOR, PANEL], ids=str)
def test_a_complete_map_is_stock_sionna_rt(antenna: sp.Antenna, tmp_path: Path) -> None:
    rows = coverage_of(_room(), antenna).stack(at=("y", "x"))
    rows = rows.isel(at=np.flatnonzero(rows["valid"] == 1)[::4])
    rx_m = np.stack([rows["x"], rows["y"], np.full(rows.sizes["at"], 1.5)], axis=1)
    expected_db = stock_gain_db(antenna, rx_m, tmp_path)
    for name in ("gain_mean_db", "partial_gain_db"):
        np.testing.assert_allclose(rows[name], expected_db, atol=0.1)


def test_what_is_seen_and_unseen_changes_as_the_pattern_says() -> None:
    """Seven dB everywhere are seven dB of every state; turned away, what is unseen loses less than the direct line."""
    flat = sp.AntennaPattern("flat", 7.0, np.zeros(360), np.zeros(360))
    alone, louder = (coverage_of(_half_seen_room(), each) for each in (None, flat))
    for name in ("gain_los_mean_db", "gain_nlos_mean_db"):
        np.testing.assert_allclose(louder[name] - alone[name], np.where(alone["valid"], 7.0, np.nan), atol=2e-5)
    away = coverage_of(_half_seen_room(), sp.Antenna(sp.AntennaPattern.sector(0.0, 30.0, 90.0), 180.0))
    unseen = (alone["observed"] == 0) & (alone["x"] > 4.5)
    los_db, nlos_db = ((away[f"gain_{state}_mean_db"] - alone[f"gain_{state}_mean_db"]) for state in ("los", "nlos"))
    assert float(los_db.where(unseen).mean()) < float(nlos_db.where(unseen).mean()) - 3.0
    assert -30.0 < float(nlos_db.where(unseen).mean()) < -3.0
    np.testing.assert_allclose(away["p_los"], alone["p_los"], atol=0.02)


def test_paths_are_left_out_that_are_weak_with_the_antenna() -> None:
    """Behind a sector, the strongest path without the antenna may be the weakest with it."""
    settings = sp.TraceSettings(frequency_hz=5e9, max_depth=3, diffraction=False)
    rx_m = np.array([(x, y, 1.5) for x in (0.6, 2.1, 4.6) for y in (0.6, 2.2, 3.4)])
    power, count = {}, {}
    for tolerance_db in (0.0, 0.1):
        simulation = sp.Simulation(_room(), replace(settings, power_tolerance_db=tolerance_db))
        paths = list(simulation.blocks(np.array(TX), rx_m, lambda *_: None, SECTOR))
        of_path = [(each.path_rx, SECTOR.power(each, 5e9)) for each in paths]
        power[tolerance_db] = sum(np.bincount(rx, weights, len(rx_m)) for rx, weights in of_path)
        count[tolerance_db] = sum(len(rx) for rx, _ in of_path)
    missing_db = 10.0 * np.log10(power[0.0] / power[0.1])
    assert missing_db.min() > -1e-6
    assert missing_db.max() < 0.1
    assert count[0.1] < 0.6 * count[0.0]


def test_no_gain_exceeds_its_bound() -> None:
    gains = PANEL.largest_gains(28e9)
    zenith, azimuth = np.random.default_rng(0).uniform((0.0, -np.pi), np.pi, (300, 2)).T
    x, y, z = np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)
    field = PANEL.fields(np.stack([zenith, azimuth], axis=1), 28e9)
    for direction, gain in zip(zip(x, y, z, strict=True), (np.abs(field) ** 2).sum(axis=1), strict=True):
        assert gain <= 1.001 * gain_towards(gains, *direction) + 1e-9
        assert gain_towards(gains, *direction) <= gain_at_azimuth(gains, *direction[:2])
    within = [gain_at_azimuth(gains, np.cos(angle), np.sin(angle)) for angle in np.linspace(3.0, 2 * np.pi - 2.5, 99)]
    assert gain_between(gains.by_azimuth, np.degrees(3.0), np.degrees(-2.5)) == pytest.approx(max(within))


def test_a_warm_model_keeps_antennas_apart() -> None:
    model = sp.LinkModel(_room(), trace_settings=sp.TraceSettings(max_depth=1, diffraction=False))
    first, other, again = (sp.predict_map(model, TX, spacing_m=1.0, tx_antenna=each) for each in ("iso", SECTOR, "iso"))
    xr.testing.assert_identical(first, again)
    assert float(abs(other["gain_mean_db"] - first["gain_mean_db"]).max()) > 5.0


def test_links_are_traced_from_either_end() -> None:
    """Localisation traces from the measured positions: the antenna is then where paths arrive."""
    settings = sp.TraceSettings(max_depth=DEPTH, diffraction=False, power_tolerance_db=0.0)
    model = sp.LinkModel(_room(), trace_settings=settings)
    tx_m, rx_m = np.array(TX), np.array([[1.6, 1.2, 1.5], [4.2, 3.3, 1.2]])
    there = model.links(tx_m, rx_m, antenna=SECTOR)
    back = [model.links(each_m, tx_m[None], antenna=SECTOR, at_rx=True) for each_m in rx_m]
    np.testing.assert_allclose(np.ravel([links.antenna_db for links in back]), there.antenna_db, atol=1e-3)
    assert np.ptp(there.antenna_db) > 4.0


def test_one_antenna_for_each_transmitter(tmp_path: Path) -> None:
    tx = {"a": TX, "b": (4.5, 1.0, 1.4)}
    found = sp.predict_map(_room(), tx, tx_antenna={"a": SECTOR, "b": None}, spacing_m=1.0)
    sp.save_coverage(found, tmp_path / "coverage.nc")
    for each in (sp.load_coverage(tmp_path / "coverage.nc"), sp.predict_network(found, n=2)):
        assert each["tx_antenna"].to_numpy().tolist() == [str(SECTOR), "iso"]
    alone = sp.predict_map(_room(), TX, tx_antenna=SECTOR, spacing_m=1.0)
    np.testing.assert_array_equal(found["gain_mean_db"].sel(tx="a"), alone["gain_mean_db"])
    with pytest.raises(SettingsError, match=r"tx_antenna = .* one for each of a, b"):
        sp.predict_map(_room(), tx, tx_antenna=[SECTOR], spacing_m=1.0)
    with pytest.raises(SettingsError, match="beam = 1 is not allowed"):
        sp.Antenna(beam=1)
    with pytest.raises(SettingsError, match="tx_antenna = "):
        sp.predict_map(_room(), TX, tx_antenna=3)


def test_an_msi_file_is_the_pattern_that_it_lists(tmp_path: Path) -> None:
    path = tmp_path / "made.msi"
    path.write_text(MSI.replace("GAIN 5.0 dBd", "GAIN 5.0").replace("\n90 23.01\n", "\n90 5.0\n"), encoding="ascii")
    read, sector = sp.load_antenna(path), sp.AntennaPattern.sector(7.15)
    assert (read.name, read.gain_dbi) == ("made", 7.15)
    expected_db = sector.horizontal_db.copy()
    expected_db[270] = 5.0
    np.testing.assert_allclose(read.horizontal_db, expected_db, atol=0.006)  # clockwise in the file
    assert (read.vertical_db[90], read.vertical_db[270].round(1)) == (5.0, 23.0)
    antenna = sp.Antenna(read, azimuth_deg=30.0, downtilt_deg=20.0)
    at_rad = np.radians([[110.0, 30.0], [90.0, 30.0], [110.0, -60.0]])
    gain_dbi = 10 * np.log10(antenna.gain(at_rad, 28e9))
    assert gain_dbi[:2] == pytest.approx([7.15, 7.15 - 12 * (20 / 65) ** 2], abs=0.02)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("GAIN 5.0 dBd", "GAIN 1 furlong", "dBd or dBi"),
        ("GAIN 5.0 dBd\n", "", r"without = \['GAIN'\]"),
        ("VERTICAL 360", "VERTICAL 999999999", "2 to 3600"),
        ("\n10 0.28", "\n10 -3", "vertical_db|horizontal_db"),
        ("\n10 0.28", "\n10 inf", "increasing"),
        ("GAIN 5.0 dBd", "GAIN 25.0 dBi", "gain_dbi = 25.0 .* would radiate 32.9 times the power that it is fed"),
        ("GAIN 5.0 dBd\n", "GAIN 5.0 dBd\nGAIN 3.0 dBd\n", "GAIN is there twice: keep one"),
        ("TILT", "POLARISATION Horizontal\nTILT", "horizontally polarised"),
        (f"VERTICAL 360\n{LINES}", "VERTICAL 2\n0 0\n90 3\n", "0 to 90 degrees, with a gap of 270 degrees"),
    ],
)
def test_hostile_files_are_refused_by_name(old: str, new: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "odd.msi").write_text(MSI.replace(old, new), encoding="ascii")
    with pytest.raises(SettingsError, match=message):
        sp.load_antenna(tmp_path / "odd.msi")


def test_a_file_with_tabs_band_and_slant_is_read_with_a_message(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    header = "GAIN\t5.0 dBd\nFREQUENCY\t824-960\nPOLARIZATION\t+45"
    (tmp_path / "slant.pln").write_text(MSI.replace("GAIN 5.0 dBd", header), encoding="ascii")
    read = sp.load_antenna(tmp_path / "slant.pln")
    assert (read.gain_dbi, round(read.frequency_hz / 1e6)) == (7.15, 889)
    assert "POLARIZATION +45 is computed as vertical" in caplog.text
    sp.Antenna(read).warn_of_frequency(1.0e9)
    assert "GHz, where its pattern is another one" not in caplog.text
    sp.Antenna(read).warn_of_frequency(28e9)
    assert "was measured at 0.889404 GHz, and is used at 28 GHz" in caplog.text


def test_radiated_power(caplog: pytest.LogCaptureFixture) -> None:
    """The pattern of TR 38.901 radiates two thirds; beamwidths and gain that contradict each other are refused."""
    angle_deg = (np.arange(360.0) + 180.0) % 360.0 - 180.0
    dipole_db = -20.0 * np.log10(np.maximum(np.cos(np.radians(angle_deg)), 1e-3))
    assert sp.AntennaPattern("short dipole", 1.76, np.zeros(360), dipole_db).radiated == pytest.approx(1.0, abs=0.01)
    assert sp.AntennaPattern.sector().radiated == pytest.approx(0.657, abs=0.002)
    assert not caplog.records
    with pytest.raises(SettingsError, match=r"gain_dbi = .* would radiate .* times .*, or at most 0\.0 dBi"):
        sp.AntennaPattern.sector(7.0, 360.0, 360.0, 0.0)
    sp.AntennaPattern("amplified", 7.0, np.zeros(360), np.zeros(360))
    assert "a gain of 7 dBi in all directions is no antenna" in caplog.text
    assert sp.AntennaPattern.sector(9.0, 90.0, 90.0).radiated > 1.25
    assert caplog.text.count("radiates 1.43 times the power") == 1
    narrow = sp.AntennaPattern.sector(15.0, 65.0, 10.0)
    with pytest.raises(SettingsError, match=r"rows, columns = \(8, 1\) .* would radiate 3.56 times the power"):
        sp.Antenna(narrow, rows=8)
    beside = sp.Antenna(narrow, columns=4, rows=2, beam=3)
    angles_rad = np.radians([[90.0, 0.0], [70.0, 30.0], [100.0, -50.0], [80.0, 120.0]])
    expected = beside.gain(angles_rad, 28e9) / np.abs(narrow.amplitude(angles_rad)) ** 2
    np.testing.assert_allclose(beside._array_gain(angles_rad), expected, rtol=1e-4, atol=1e-6)
    assert sp.Antenna("dipole", downtilt_deg=20.0).averaged(28e9).uniform_gain_dbi == pytest.approx(0.0, abs=0.01)
    assert sp.Antenna("tr38901").averaged(28e9).uniform_gain_dbi == pytest.approx(-1.83, abs=0.02)
    assert sp.Antenna().averaged(28e9) == sp.Antenna()


@pytest.mark.usefixtures("command_line")
def test_the_commands_take_antennas(tmp_path: Path) -> None:
    (tmp_path / "made.msi").write_text(MSI, encoding="ascii")
    sp.save_map(_room(), tmp_path / "room.npz")
    antenna = ["--tx-antenna", str(tmp_path / "made.msi"), "--azimuth", "-90", "--tilt", "10", "--spacing", "1"]
    several = ["network", str(tmp_path / "room.npz"), "--tx=1 3 1.4", "--tx=4 1 1.4", "--out", str(tmp_path / "net")]
    result = CliRunner().invoke(app, [*several, *antenna, "--azimuth", "90"])
    assert result.exit_code == 0, result.output
    texts = sp.load_coverage(tmp_path / "net/coverage.nc")["tx_antenna"].to_numpy().tolist()
    assert texts == [f"made, 7.15 dBi, azimuth {azimuth} deg, downtilt 10 deg" for azimuth in (-90, 90)]
