"""LinkModel: one way from a map to a prediction, the same warm as new."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import trimesh
import xarray as xr
from extruded import drawn
from predictor_links import QUIET

import sionna_partial as sp
from sionna_partial.maps.mesh.scene_mesh import SceneMesh
from sionna_partial.measurements.assimilation import Assimilation
from sionna_partial.prediction import predictor as predictors

pytestmark = QUIET

TX, RX = (2.05, 2.05, 1.5), [(2.6, 2.4, 1.5), (3.05, 2.05, 1.2)]


@pytest.fixture(scope="module")
def maps():
    """A home as a robot sees it after 30 and 60 steps."""
    return sp.explore(sp.make_home(7), steps=(30, 60), seed=0)


@pytest.fixture(scope="module")
def tx(maps):
    """A position in a cell that is free on both maps."""
    cells = np.argwhere((maps[0].state == sp.CellState.FREE) & (maps[1].state == sp.CellState.FREE))
    row, column = cells[len(cells) // 2]
    x, y = maps[0].origin_m + (np.array([column, row]) + 0.5) * maps[0].resolution_m
    return float(x), float(y), 1.5


def half_open(cell):
    """A room of 6 x 6 m in walls, a third of its cells of one kind, and rows of unknown cells beyond the wall."""
    state = np.pad(np.zeros((60, 60), dtype=np.uint8), 1, constant_values=sp.CellState.WALL)
    state[41:61, 1:61] = cell
    return sp.PartialMap(np.pad(state, ((0, 20), (0, 0)), constant_values=sp.CellState.UNKNOWN), 0.1)


def test_updated_as_new_to_the_byte(maps, tx):
    model = sp.LinkModel(maps[0])
    first = sp.predict_map(model, tx, spacing_m=0.5)
    xr.testing.assert_identical(first, sp.predict_map(maps[0], tx, spacing_m=0.5))
    for partial in (maps[1], maps[0]):
        model.update(partial)
        fresh = sp.predict_map(sp.LinkModel(partial), tx, spacing_m=0.5)
        warm = sp.predict_map(model, tx, spacing_m=0.5)
        xr.testing.assert_identical(warm, fresh)


def test_coverage_is_predict(maps, tx):
    model = sp.LinkModel(maps[0], "paper")
    coverage = sp.predict_map(model, tx, spacing_m=1.0)
    y, x = np.nonzero(coverage["valid"].to_numpy())
    rx = np.column_stack([coverage.x[x], coverage.y[y], np.full(len(x), 1.5)])
    prediction = model.predict([tx, tx], rx)
    assert prediction.p_los.shape == (2, len(rx))
    assert len(model.features(tx, rx)) == len(rx)
    expected = coverage["gain_mean_db"].to_numpy()[y, x]
    np.testing.assert_allclose(prediction.gain_mean_db[1], expected, rtol=0, atol=1e-4)  # products of other sizes


def test_complete_is_decided_per_link():
    """Links between unknown cells are uncertain, in whatever order transmitters come; others are as traced."""
    model, beyond = sp.LinkModel(half_open(sp.CellState.FREE)), (3.0, 7.0, 1.5)
    for order in ([TX, beyond], [beyond, TX]):
        std_db = dict(zip(order, model.predict(order, [(1.0, 1.0, 1.5), (2.0, 7.5, 1.5)]).gain_std_db, strict=True))
        assert std_db[TX].tolist() == [0.0, 0.0]
        assert std_db[beyond][0] == 0.0 < std_db[beyond][1]


def test_is_taken_in_place_of_a_map():
    model = sp.LinkModel(half_open(sp.CellState.UNKNOWN))
    assert sp.channels.sample_channels(model, TX, RX, n=4).gain_db.shape == (4, 2)
    assert sp.trace_links(model, TX, RX).gain_db.shape == (2,)
    assert sp.place_transmitter(model).partial is model.partial
    assert sp.next_views(model, goal="area").partial is model.partial
    model = sp.LinkModel(half_open(sp.CellState.UNKNOWN), trace_settings=sp.TraceSettings(power_tolerance_db=0.0))
    gain_db = sp.DifferentiableScene(model).links(TX, RX)().gain_mean_db
    assert gain_db.numpy() == pytest.approx(model.predict(TX, RX).gain_mean_db, abs=1e-6)


def test_has_its_own_settings():
    with pytest.raises(sp.SionnaPartialError, match=r"predictor = .*has its own: leave it out"):
        sp.predict_map(sp.LinkModel(half_open(sp.CellState.FREE)), TX, predictor="paper")


def test_a_predictor_is_read_once(tmp_path, monkeypatch):
    read = []
    path = tmp_path / "own.keras"
    sp.Predictor.load("paper").save(path)
    read_files = predictors.read_files
    monkeypatch.setattr(predictors, "read_files", lambda path: read.append(path) or read_files(path))
    for _ in range(2):
        sp.LinkModel(half_open(sp.CellState.UNKNOWN), path).predict(TX, RX)
    assert read == [path]
    sp.Predictor.load("map").save(path)
    assert sp.LinkModel(half_open(sp.CellState.UNKNOWN), path).predictor.has_gate


TWO_ROOMS = """
##########
#...#....#
#...#....#
#........#
##########
"""
WIFI = sp.TraceSettings(5.2e9)
ENDS = (1.0, 1.0, 1.5), [(3.0, 1.3, 1.5), (4.2, 2.0, 1.0)]


def two_rooms(name):
    """Two rooms of cells without a material, of brick, or of the triangles of a mesh."""
    plan = drawn(TWO_ROOMS)
    if name == "brick":
        return replace(plan, material=sp.Material.named("brick"))
    if name == "mesh":
        box = trimesh.creation.box((2.0, 0.1, 2.5)).apply_translation((2.5, 1.9, 1.25))
        mesh = SceneMesh(box.vertices, box.faces, np.zeros(12, np.uint8), height_range_m=(0.0, 2.5))
        return sp.PartialMap(np.zeros((5, 10), np.uint8), 0.5, mesh=mesh)
    return plan


@cache
def fresh_gains_db(name):
    """Resolved settings and gains of a new model of two rooms."""
    fresh = sp.LinkModel(two_rooms(name), trace_settings=WIFI)
    return fresh.simulation.resolved, fresh.predict(*ENDS).gain_mean_db


@pytest.mark.parametrize(("start", "first"), [("path", "brick"), ("simulation", "mesh")])
def test_any_chain_of_updates_is_a_new_model(first, start, tmp_path):
    """What a map has of its own, such as a material, or paths that meshes lack, does not outlive the map."""
    scene, settings = two_rooms(first), {"trace_settings": WIFI}
    if start == "path":
        sp.save_map(scene, tmp_path / "map.npz")
        scene = tmp_path / "map.npz"
    else:
        scene, settings = sp.Simulation(scene, **settings), {}
    model = sp.LinkModel(scene, **settings)
    for name in ("plan", "mesh", "brick", "plan"):
        model.update(two_rooms(name))
        resolved, gains_db = fresh_gains_db(name)
        assert model.simulation.resolved == resolved
        assert (model.simulation.trace_settings, model.simulation.scene_settings) == (WIFI, sp.SceneSettings())
        np.testing.assert_array_equal(model.predict(*ENDS).gain_mean_db, gains_db)


def test_positions_are_float64_in_any_form():
    model = sp.LinkModel(two_rooms("plan"))
    forms = [(1, 1), np.float32([1, 1]), np.array([1, 1], np.uint8), (1.0, 1.0, 1.5)]
    found = [sp.predict_map(model, {"a": form, "b": form}, spacing_m=1.0) for form in forms]
    for coverage in found:
        assert np.all(coverage["tx_z"] == 1.5)
        np.testing.assert_array_equal(coverage["gain_mean_db"], found[0]["gain_mean_db"])


@pytest.mark.parametrize("frequency_hz", [28e9, 5e9])
def test_unknown_cells_around_a_map_change_no_prediction(maps, tx, frequency_hz):
    """Padded or cropped: a map that grows does not make predictions jump, nor measured ones."""
    x0, y0, x1, y1 = maps[1].bounds_m
    points = np.random.default_rng(2).uniform((x0 + 0.7, y0 + 0.7, 1.4), (x1 - 0.7, y1 - 0.7, 1.6), (40, 3))
    rx = points[maps[1].radios_can_stand(points) & (np.linalg.norm(points - tx, axis=1) > 0.2)]
    settings, known = sp.TraceSettings(frequency_hz), np.argwhere(maps[1].state != sp.CellState.UNKNOWN)
    spare = np.minimum(known.min(axis=0), np.array(maps[1].shape) - 1 - known.max(axis=0)).min()
    found = []
    for below, left in ((0, 0), (1, 13), (7, 2), (-min(spare, 5), -min(spare, 7))):
        state = np.pad(maps[1].state, ((max(below, 0), 3), (max(left, 0), 1)), constant_values=sp.CellState.UNKNOWN)
        state = state[max(-below, 0) :, max(-left, 0) :]
        corner_m = np.array(maps[1].origin_m) - maps[1].resolution_m * np.array([left, below])
        partial = sp.PartialMap(state, maps[1].resolution_m, tuple(corner_m.tolist()))
        model = sp.LinkModel(partial, trace_settings=settings)
        prediction = model.predict(tx, rx)
        measured = sp.Measurements(tx, rx[:10], prediction.gain_mean_db[:10] - 6.0)
        posterior = Assimilation.fit(partial, tx, measured, prediction.take(slice(10)), frequency_hz=frequency_hz)
        found.append((prediction.gain_mean_db, posterior.update(rx, prediction).gain_mean_db))
    assert len(rx) > 15
    np.testing.assert_allclose(found, np.broadcast_to(found[0], np.shape(found)), rtol=0, atol=0.005)
