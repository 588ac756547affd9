"""Materials from measured gains: found again, with an honest uncertainty, from any start."""

import functools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from meshes import OBSERVED, room
from numpy.typing import NDArray

import sionna_partial as sp
from sionna_partial.calibration import material_fit
from sionna_partial.calibration.calibration import MaterialCalibration
from sionna_partial.errors import MeasurementError, SionnaPartialError
from sionna_partial.maps.mesh.cells import MeshReading, mesh_map
from sionna_partial.maps.mesh.scene_mesh import merged_mesh
from sionna_partial.tracing.power import reflection_loss_db

SETTINGS = sp.TraceSettings(max_depth=2)
THIN_M = 0.01
HIDDEN = sp.Material(4.4, 2.0, THIN_M)
START = sp.Material(2.94, 0.1226, THIN_M)
ANGLES_DEG = np.array([0.0, 30.0, 45.0, 60.0])


def flat() -> sp.PartialMap:
    """Two rooms with a wide door: most links have no line of sight."""
    state = np.zeros((50, 80), dtype=np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = sp.CellState.WALL
    state[:30, 40] = sp.CellState.WALL
    return sp.PartialMap(state, 0.1)


FLAT = flat()
TX = np.array([[1.03, 1.02, 1.4], [6.91, 0.93, 1.6]])


def positions(count: int = 60) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    rng = np.random.default_rng(3)
    rx = rng.uniform([0.3, 0.3, 1.0], [7.7, 4.7, 2.0], (count, 3))
    rx[np.abs(rx[:, 0] - 4.05) < 0.15, 0] += 0.4
    return TX[np.arange(count) % 2], rx


@functools.cache
def traced_db(hidden: sp.Material) -> NDArray[np.float64]:
    """Return the gains of the links between walls of a hidden material."""
    rx = positions()[1]
    links = sp.trace_links(FLAT, TX, rx, trace_settings=SETTINGS, scene_settings=sp.SceneSettings(material=hidden))
    return np.asarray(links.gain_db[np.arange(len(rx)) % 2, np.arange(len(rx))])


def measured(hidden: sp.Material = HIDDEN, noise_db: float = 1.0) -> dict:
    tx, rx = positions()
    noise = np.random.default_rng(4).standard_normal(len(rx))
    return {"tx": tx, "rx": rx, "gain_db": traced_db(hidden) + noise_db * noise}


def calibrate(measurements: object, **arguments: object) -> MaterialCalibration:
    return sp.calibrate_materials(FLAT, measurements, **{"start": START, "trace_settings": SETTINGS, **arguments})  # type: ignore[arg-type]


pytestmark = pytest.mark.usefixtures("short_search")
"""A slab of 1 cm has few fringes: few cells are enough."""


@pytest.fixture(scope="module")
def result(short_search: None) -> MaterialCalibration:
    return calibrate(measured())


class TestHiddenMaterial:
    def test_losses_and_parameters_within_their_spread(self, result: MaterialCalibration) -> None:
        for polarisation in ("te", "tm"):
            found_db, std_db = result.reflection_loss_db(ANGLES_DEG, polarisation)
            hidden_db = reflection_loss_db(4.4, 2.0, THIN_M, 28e9, ANGLES_DEG, polarisation)
            shown = hidden_db < 25.0
            assert (np.abs(found_db - hidden_db) <= np.maximum(0.5, 2.5 * std_db))[shown].all()
        assert abs(result.permittivity - 4.4) <= 2.5 * result.permittivity_std
        assert abs(result.conductivity_s_m - 2.0) <= 2.5 * result.conductivity_std_s_m
        assert 0.0 < result.permittivity_std < 1.0
        assert result.noise_db == pytest.approx(1.0, abs=0.3)

    def test_links_fit_better(self, result: MaterialCalibration) -> None:
        record = json.loads(json.dumps(result.record()))
        assert record["rmse_db"]["after"] < 1.3 < record["rmse_db"]["before"]
        assert (record["permittivity"], record["materials"][0]["thickness_m"]) == (result.permittivity, THIN_M)
        assert result.scene == replace(FLAT, material=result.materials[0])
        assert (np.diff(result.loss) <= 0.0).all()
        assert result.loss[-1] < result.loss[0] - 0.1
        assert result.used.sum() + sum(result.left_out.values()) == len(result.gain_db) == 60

        links = sp.trace_links(result.scene, TX[0], positions()[1][::2], trace_settings=SETTINGS)
        np.testing.assert_allclose(links.gain_db, result.gain_after_db[::2], atol=0.3)


class TestSameAnswer:
    def test_for_identical_repetitions(self, result: MaterialCalibration) -> None:
        """Gains that repeat exactly are no news: their errors are those of the links."""
        repeated = calibrate({name: np.repeat(values, 3, axis=0) for name, values in measured().items()})
        assert repeated.permittivity == pytest.approx(result.permittivity)
        assert repeated.permittivity_std == pytest.approx(result.permittivity_std, rel=1e-3)
        np.testing.assert_allclose(repeated.gain_after_db, np.repeat(result.gain_after_db, 3), atol=1e-3)
        assert repeated.used.sum() == 3 * result.used.sum()

    def test_from_a_poor_start(self, result: MaterialCalibration) -> None:
        poor = calibrate(measured(), start=sp.Material(30.0, 20.0, THIN_M))
        assert poor.loss[0] > result.loss[0]
        assert poor.materials == result.materials
        assert poor.permittivity_std == result.permittivity_std


class TestWhatCannotBeDetermined:
    def test_is_said(self, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
        """Thick lossy slabs are opaque: how lossy, hardly shows. Their fringes are narrow, and matter little."""
        monkeypatch.setattr(material_fit, "FRINGE_CELLS", 3)
        opaque = sp.Material(5.0, 1.5, 0.04)
        found = calibrate(measured(hidden=opaque, noise_db=3.0), start=replace(opaque, conductivity_s_m=0.1))
        assert "conductivity" in found.undetermined
        pattern = r"cannot determine the conductivity: its 95 % interval is [\d.]+ to [\d.]+ S/m"
        assert re.search(pattern, caplog.text)
        assert found.conductivity_std_s_m > 0.2

    @pytest.mark.parametrize(
        ("cell", "message"), [(sp.CellState.FREE, "no reflection"), (sp.CellState.UNKNOWN, "no walls")]
    )
    def test_nothing_reflects(self, cell: int, message: str) -> None:
        field = sp.PartialMap(np.full((50, 80), cell, dtype=np.uint8), 0.1)
        tx, rx = positions(20)
        measurements = {"tx": tx, "rx": rx, "gain_db": np.full(20, -70.0)}
        with pytest.raises(MeasurementError, match=message):
            sp.calibrate_materials(field, measurements, trace_settings=sp.TraceSettings(max_depth=0))


class TestPartialMap:
    def test_links_through_the_unseen_are_left_out(
        self, result: MaterialCalibration, caplog: pytest.LogCaptureFixture
    ) -> None:
        """Powers are measured here, and their offset is subtracted."""
        state, powers = FLAT.state.copy(), measured()
        state[5:45, 42:60] = sp.CellState.UNKNOWN
        powers["gain_db"] = powers["gain_db"] - 30.0
        found = sp.calibrate_materials(replace(FLAT, state=state), powers, start=START, trace_settings=SETTINGS)
        assert found.left_out["runs through unobserved space"] > 5
        assert (~found.used).sum() == sum(found.left_out.values())
        assert "30." in caplog.text or "29." in caplog.text
        assert found.offset_db == pytest.approx(-30.0, abs=1.5)
        assert result.offset_db == 0.0

    def test_uncertainty_is_larger_where_paths_may_be_missing(self, result: MaterialCalibration) -> None:
        """One unknown corner changes no link, but makes the map incomplete."""
        state = FLAT.state.copy()
        state[48, 78] = sp.CellState.UNKNOWN
        found = sp.calibrate_materials(replace(FLAT, state=state), measured(), start=START, trace_settings=SETTINGS)
        assert found.used.all()
        ratio = found.reflection_loss_db(ANGLES_DEG)[1] / result.reflection_loss_db(ANGLES_DEG)[1]
        assert (ratio > 1.2).all()

    def test_outages_are_left_out(self, result: MaterialCalibration) -> None:
        assert result.left_out == {"measured outage": 0, "no path on the map": 0, "runs through unobserved space": 0}
        measurements = measured()
        gain_db = np.array(measurements["gain_db"])
        gain_db[:52] = -151.0
        message = r"has 8 usable links of 60, fewer than 10; left out: 52 \(measured outage\)\. Measure more links"
        with pytest.raises(MeasurementError, match=message):
            calibrate({**measurements, "gain_db": gain_db})


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ({"rx": [(9.0, 1.0, 1.5)] * 60}, {}, r"rx\[0\] = \(9.0, 1.0, 1.5\) .* is outside the map"),
        ({"rx": positions()[0]}, {}, r"rx\[0\] = .* is 0 m from its transmitter, where .* shorter than 0.011 m"),
        ({}, {"start": "brick"}, "start = 'brick' is not allowed: give a Material, or None for the s"),
        ({}, {"trace_settings": sp.TraceSettings(diffuse_reflection=True)}, "diffuse_reflection = True is not all"),
    ],
)
def test_wrong_arguments(changes: dict, arguments: dict, message: str) -> None:
    with pytest.raises(SionnaPartialError, match=message):
        calibrate(measured() | changes, **arguments)


def test_materials_of_a_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    """The walls of the room and the one inside are of different materials, and a third one is not used."""
    monkeypatch.setattr(material_fit, "COARSE_CELLS", 12)
    monkeypatch.setattr(material_fit, "MOST_FRINGES", 2)
    walls, inner = room().geometry.values()
    vertices = np.concatenate([walls.vertices, inner.vertices])
    triangles = np.concatenate([walls.faces, inner.faces + len(walls.vertices)])
    unused, hidden = sp.Material(itu="wood"), (sp.Material(6.0, 0.8, THIN_M), sp.Material(2.2, 0.3, THIN_M))
    mesh = merged_mesh(vertices, triangles, np.repeat([0, 2], 12), (hidden[0], unused, hidden[1]))
    partial = mesh_map(mesh, MeshReading(observed=OBSERVED, resolution_m=0.1))
    rng = np.random.default_rng(5)
    tx, rx = np.tile([1.5, 1.0, 1.5], (24, 1)), rng.uniform([0.3, 0.3, 1.0], [4.7, 3.7, 2.0], (24, 3))
    rx[np.abs(rx[:, 0] - 3.0) < 0.2, 0] -= 0.4
    gain_db = sp.trace_links(partial, tx[0], rx, trace_settings=SETTINGS).gain_db
    blank = replace(partial, mesh=replace(mesh, materials=(None, unused, None)), material=START)
    found = sp.calibrate_materials(blank, {"tx": tx, "rx": rx, "gain_db": gain_db}, trace_settings=SETTINGS)
    assert found.permittivity.shape == found.conductivity_std_s_m.shape == (2,)
    assert found.permittivity[0] == pytest.approx(6.0, abs=1.5)
    assert found.record()["rmse_db"]["after"] < found.record()["rmse_db"]["before"]
    assert found.scene.mesh is not None
    assert found.scene.mesh.materials == (found.materials[0], unused, found.materials[1])
    assert all("[" in name for name in found.undetermined)
