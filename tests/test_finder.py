"""Scenes and where their paths come from: plans, meshes, and Sionna RT's public path solver in place of both."""

from pathlib import Path

import numpy as np
import pytest
from meshes import box, room, scene_mesh
from test_trace import all_paths

import sionna_partial as sp
from sionna_partial.errors import SettingsError
from sionna_partial.maps.mesh.cells import MeshReading, mesh_map
from sionna_partial.maps.mesh.scene_mesh import SceneMesh
from sionna_partial.tracing import simulation

TX = np.array([1.03, 1.52, 1.4])
RX = np.array([[1.47, 2.51, 1.7], [4.35, 0.61, 1.2], [3.82, 3.57, 1.3], [2.02, 0.33, 2.2]])


def _plan() -> sp.PartialMap:
    """Two rooms and a door, 5 m x 4 m."""
    state = np.zeros((40, 50), np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = state[:30, 30] = sp.CellState.WALL
    return sp.PartialMap(state, 0.1)


def test_weak_paths_of_a_mesh_are_left_out_within_the_tolerance() -> None:
    whole = scene_mesh(*room().geometry.values())
    materials = sp.Material(itu="glass"), sp.Material(itu="metal")
    parts = SceneMesh(whole.vertices_m, whole.triangles, np.repeat([0, 1], 12), materials)
    partial, rx = mesh_map(parts, MeshReading(resolution_m=0.1)), np.concatenate([RX, RX * [1.0, 1.0, 0.3]])
    settings = [sp.TraceSettings(power_tolerance_db=each, samples_per_tx=100_000) for each in (0.0, 0.1)]
    every, some = (sp.trace_links(partial, TX, rx, trace_settings=each) for each in settings)
    assert len(some.a) < 0.8 * len(every.a)
    np.testing.assert_array_equal(some.link_state, every.link_state)
    every_db, some_db = (
        10 * np.log10(np.bincount(each.path_rx, np.abs(each.a) ** 2 * (each.interactions > 0).any(axis=1)))
        for each in (every, some)
    )
    assert (every_db - some_db >= -1e-6).all()
    assert (every_db - some_db).max() <= 0.1


def test_materials_of_a_mesh_must_cover_the_frequency() -> None:
    solid = box((0, 0, 0), (5, 4, 3))
    ground = SceneMesh(solid.vertices, solid.faces, np.zeros(12, int), (sp.Material(itu="wet_ground"),))
    partial = mesh_map(ground, MeshReading(resolution_m=0.1))
    for call in (sp.trace_links, sp.gain_gradients):
        with pytest.raises(SettingsError, match=r"^frequency_hz = 2.* 'wet_ground' is defined for 1-10 GHz"):
            call(partial, TX, RX)


def test_the_public_way_finds_no_other_kinds_of_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = all_paths(max_depth=4, samples_per_tx=20_000)
    exact = sp.trace_links(_plan(), TX, RX[:2], trace_settings=settings)
    monkeypatch.setattr(simulation, "engine_fault", lambda: "broken")
    public = sp.trace_links(_plan(), TX, RX[:2], trace_settings=settings)
    np.testing.assert_array_equal(public.link_state, exact.link_state)
    diffracted = (public.interactions == 8).any(axis=1)
    assert diffracted.any()
    assert ((public.interactions == 1)[diffracted].sum(axis=1) <= 2).all()
    pairs = zip(public.path_rx, public.delay_s, strict=True)
    found = [np.abs(exact.delay_s[exact.path_rx == rx] - delay).min() < 1e-11 for rx, delay in pairs]
    assert len(found) > 50
    assert np.mean(found) > 0.99


def test_settings_say_how_many_walls_mirror_beside_a_diffraction() -> None:
    """Bends over one edge with no wall, with one before or after, and with up to two."""
    words, no_floor = [], sp.SceneSettings(floor_extent="none")
    for walls in (0, 1, 2):
        settings = all_paths(max_depth=3, diffraction_walls=walls)
        links = sp.trace_links(_plan(), TX, RX, trace_settings=settings, scene_settings=no_floor)
        words.append({"".join("D" if kind == 8 else "R" for kind in row if kind) for row in links.interactions})
    assert {word for word in words[0] if "D" in word} == {"D"}
    assert {word for word in words[1] if "D" in word} == {"D", "DR", "RD", "RDR"}
    assert {word for word in words[2] if "D" in word} == {"D", "DR", "RD", "RDR", "DRR", "RRD"}


def test_links_in_a_folder_are_those_in_memory_and_the_default_tolerance_is_as_written(tmp_path: Path) -> None:
    default, written = (sp.Simulation(_plan(), sp.TraceSettings(power_tolerance_db=each)) for each in (None, 0.1))
    expected = default.links(TX, RX)
    for links in (written.links(TX, RX), default.links(TX, RX, folder=tmp_path / "links")):
        for name in ("gain_db", "link_state", "path_rx", "transfer", "delay_s", "interactions"):
            np.testing.assert_array_equal(getattr(links, name), getattr(expected, name))
