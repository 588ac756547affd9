"""Scenes and where their paths come from: plans, meshes, and Sionna RT's public path solver in place of both."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from meshes import box, room, scene_mesh
from numpy.typing import NDArray
from test_trace import all_paths

import sionna_partial as sp
from sionna_partial.errors import SettingsError
from sionna_partial.maps.environment import SceneMesh
from sionna_partial.maps.mesh.cells import MeshReading, mesh_map
from sionna_partial.tracing import simulation
from sionna_partial.tracing.finder import PlanScene, write_scene_of
from sionna_partial.tracing.paths import SolvedPaths, Wedges
from sionna_partial.tracing.stock import diffracted_as_exact

TX = np.array([1.03, 1.52, 1.4])
RX = np.array([[1.47, 2.51, 1.7], [4.35, 0.61, 1.2], [3.82, 3.57, 1.3], [2.02, 0.33, 2.2]])


def _plan() -> sp.PartialMap:
    """Two rooms and a door, 5 m x 4 m."""
    state = np.zeros((40, 50), np.uint8)
    state[[0, -1], :] = state[:, [0, -1]] = state[:30, 30] = sp.CellState.WALL
    return sp.PartialMap(state, 0.1)


def _as_mesh(plan: sp.PartialMap, folder: Path) -> sp.PartialMap:
    """The exported scene of a plan, read as a scan."""
    sp.export_scene(plan, folder / "scene")
    parts = [trimesh.load(path, force="mesh") for path in sorted((folder / "scene" / "meshes").glob("*.ply"))]
    trimesh.util.concatenate(parts).export(folder / "scan.ply")
    return sp.load_map(folder / "scan.ply", resolution_m=0.1)


def _delays(links: sp.TracedLinks, rx: int) -> NDArray[np.float64]:
    return np.sort(links.delay_s[links.path_rx == rx])


def test_a_plan_traced_as_a_mesh_has_the_same_paths(tmp_path: Path) -> None:
    plan = _plan()
    settings = all_paths(max_depth=4, diffraction=False, samples_per_tx=100_000)
    exact = sp.trace_links(plan, TX, RX, trace_settings=settings)
    scan = sp.trace_links(_as_mesh(plan, tmp_path), TX, RX, trace_settings=settings)
    np.testing.assert_array_equal(scan.link_state, exact.link_state)
    np.testing.assert_allclose(scan.gain_db, exact.gain_db, atol=1e-3)
    for index in range(len(RX)):
        np.testing.assert_allclose(_delays(scan, index), _delays(exact, index), atol=1e-12)


@pytest.mark.parametrize("tolerance_db", [0.02, 0.1, 0.5])
def test_weak_paths_of_a_mesh_are_left_out_within_the_tolerance(tmp_path: Path, tolerance_db: float) -> None:
    scan = _as_mesh(_plan(), tmp_path).mesh
    assert scan is not None
    high = scan.vertices_m[scan.triangles][:, :, 2].min(axis=1) > 2.0
    metal, glass = sp.Material(itu="metal"), sp.Material(itu="glass")
    parts = SceneMesh(scan.vertices_m, scan.triangles, high.astype(int), (glass, metal))
    partial = mesh_map(parts, MeshReading(resolution_m=0.1))
    rx = np.concatenate([RX, RX * [1.0, 1.0, 0.3]])
    every, some = (
        sp.trace_links(
            partial, TX, rx, trace_settings=sp.TraceSettings(power_tolerance_db=each, samples_per_tx=100_000)
        )
        for each in (0.0, tolerance_db)
    )
    assert len(some.a) < 0.8 * len(every.a)
    np.testing.assert_array_equal(some.link_state, every.link_state)
    indirect_db = [
        10 * np.log10(np.bincount(each.path_rx, np.abs(each.a) ** 2 * (each.interactions > 0).any(axis=1)))
        for each in (every, some)
    ]
    lost_db = indirect_db[0] - indirect_db[1]
    assert (lost_db >= -1e-6).all()
    assert lost_db.max() <= tolerance_db


def test_a_mesh_far_away_has_the_same_paths() -> None:
    mesh, far = scene_mesh(*room().geometry.values()), np.array([5e5, 4.5e6, 0.0])
    there = SceneMesh(mesh.vertices_m + far, mesh.triangles, mesh.material)
    settings = all_paths(max_depth=3, samples_per_tx=50_000)
    near, moved = (
        sp.trace_links(mesh_map(each, MeshReading(resolution_m=0.1)), TX + shift, RX + shift, trace_settings=settings)
        for each, shift in ((mesh, 0.0), (there, far))
    )
    assert len(near.a) > 50
    np.testing.assert_allclose(moved.gain_db, near.gain_db, atol=1e-3)
    np.testing.assert_allclose(moved.vertices_m - far, near.vertices_m, atol=1e-3)


def test_diffraction_is_on_for_plans_and_off_for_meshes(tmp_path: Path) -> None:
    settings = all_paths(max_depth=2, samples_per_tx=10_000)
    for partial, diffracts in ((_plan(), True), (_as_mesh(_plan(), tmp_path), False)):
        links = sp.trace_links(partial, TX, RX, trace_settings=settings)
        assert links.trace_settings.diffraction is diffracts
        assert (8 in links.interactions) is diffracts


def test_materials_of_a_mesh_must_cover_the_frequency() -> None:
    solid = box((0, 0, 0), (5, 4, 3))
    ground = SceneMesh(solid.vertices, solid.faces, np.zeros(12, int), (sp.Material(itu="wet_ground"),))
    partial = mesh_map(ground, MeshReading(resolution_m=0.1))
    for call in (sp.trace_links, sp.gain_gradients):
        with pytest.raises(SettingsError, match=r"^frequency_hz = 2.* 'wet_ground' is defined for 1-10 GHz"):
            call(partial, TX, RX)
    with pytest.raises(SettingsError, match=r"^frequency_hz = 2.* 'wet_ground' is defined for 1-10 GHz"):
        sp.predict_map(partial, TX)


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
    found = [np.abs(_delays(exact, rx) - delay).min() < 1e-11 for rx, delay in pairs]
    assert len(found) > 50
    assert np.mean(found) > 0.99


@pytest.fixture
def wedges(tmp_path: Path) -> Wedges:
    scene = write_scene_of(_plan(), tmp_path, all_paths(), sp.SceneSettings())
    assert isinstance(scene, PlanScene)
    return scene.wedges


def _counted(wedges: Wedges, kinds: np.ndarray, vertices: np.ndarray, walls_a_side: int) -> list[bool]:
    zeros = np.zeros(len(kinds))
    rx, transfer = zeros.astype(np.int32), zeros.reshape(-1, 1, 1).astype(complex)
    paths = SolvedPaths.of_vertices(rx, transfer, zeros, kinds, vertices, tx_m=TX, rx_m=RX)
    return diffracted_as_exact(wedges, paths, walls_a_side).tolist()


def test_bends_count_only_at_upright_edges(wedges: Wedges) -> None:
    edge_x, edge_y = wedges.edge_m[0]
    kinds = np.array([[8, 0, 0, 0], [8, 0, 0, 0], [8, 0, 0, 0], [1, 8, 1, 1], [1, 8, 4, 1], [1, 1, 1, 1]], np.uint8)
    vertices = np.full((6, 4, 3), 1.0)
    vertices[[0, 1, 2], 0] = [(edge_x, edge_y, 1.0), (edge_x, edge_y, 0.0), (edge_x + 0.1, edge_y, 1.0)]
    vertices[[3, 4], 1] = (edge_x, edge_y, 1.0)
    assert _counted(wedges, kinds, vertices, 2) == [True, False, False, False, True, True]


@pytest.mark.parametrize(
    ("walls_a_side", "expected"),
    [(0, (True, False, False, False, True, False)), (1, (True, True, True, False, True, True)), (2, (True,) * 6)],
)
def test_bends_count_with_so_many_walls_a_side(wedges: Wedges, walls_a_side: int, expected: tuple[bool, ...]) -> None:
    """Floor and ceiling are no walls."""
    kinds = np.array([[8, 0, 0], [1, 8, 0], [8, 1, 0], [1, 1, 8], [1, 8, 1], [1, 8, 1]], np.uint8)
    vertices = np.full((6, 3, 3), 1.0)
    vertices[4, [0, 2], 2] = 0.0, wedges.height_m[0]
    for path, at in enumerate((kinds == 8).argmax(axis=1)):
        vertices[path, at, :2] = wedges.edge_m[0]
    assert tuple(_counted(wedges, kinds, vertices, walls_a_side)) == expected


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


def test_powers_are_averaged_over_geometries(tmp_path: Path) -> None:
    """A link in sight is as mapped, another has the mean power of the mapped walls and of drawn ones."""
    plan = _plan()
    one, three, again = (sp.Simulation(plan, None, sp.SceneSettings(geometries=count)) for count in (1, 3, 3))
    mapped, mean = one.links(TX, RX), three.links(TX, RX)
    hidden = mapped.link_state == sp.LinkState.NLOS
    assert 0 < hidden.sum() < len(RX)
    np.testing.assert_array_equal(mean.link_state, mapped.link_state)
    np.testing.assert_array_equal(mean.gain_db[~hidden], mapped.gain_db[~hidden])
    np.testing.assert_array_equal(mean.gain_db, again.links(TX, RX).gain_db)
    assert (mean.gain_db != mapped.gain_db)[hidden].all()
    drawn = [three._finder_of(draw) for draw in (1, 2)]
    found = [paths for finder in drawn for _, paths in finder.paths(TX, RX, 1, lambda *_: None)]
    power = 10.0 ** (mapped.gain_db / 10.0)
    for paths in found:
        np.add.at(power, paths.path_rx, paths.power)
    np.testing.assert_allclose(10.0 * np.log10(power[hidden] / 3.0), mean.gain_db[hidden], atol=0.6)
    for links in (three.paths(TX, RX).links(), three.links(TX, RX, folder=tmp_path / "links")):
        np.testing.assert_allclose(links.gain_db, mapped.gain_db, atol=0.1)
    assert three.links(TX, RX).cir().paths.sum() == mapped.cir().paths.sum()


@pytest.mark.parametrize(
    ("noise", "pocket", "settings", "count"),
    [
        (1.0, True, sp.TraceSettings(), simulation.GEOMETRIES),
        (0.0, True, sp.TraceSettings(), 1),
        (1.0, False, sp.TraceSettings(), simulation.GEOMETRIES),
        (1.0, True, sp.TraceSettings(refraction=True), 1),
        (1.0, True, sp.TraceSettings(power_tolerance_db=0.1), 1),
    ],
)
def test_geometries_are_drawn_where_a_nearly_complete_map_is_noisy(
    noise: float, pocket: bool, settings: sp.TraceSettings, count: int
) -> None:
    state = _plan().state.copy()
    state[8:11, 8:11] = sp.CellState.UNKNOWN if pocket else sp.CellState.FREE
    partial = sp.PartialMap(state, 0.1)
    vars(partial)["wall_noise"] = noise
    assert sp.Simulation(partial, settings).resolved.scene_settings.geometries == count
