"""Paths as functions of the materials: what a new trace would give, without one."""

from dataclasses import replace

import numpy as np
import pytest
from meshes import OBSERVED, room
from numpy.typing import NDArray
from pillar_room import RX_M, TX_M, small_room

import sionna_partial as sp
from sionna_partial.calibration import material_paths
from sionna_partial.calibration.material_paths import MaterialPaths, find_material_paths, link_gains_db
from sionna_partial.maps.mesh.cells import MeshReading, mesh_map
from sionna_partial.maps.mesh.mesh import SceneMesh, merged_mesh
from sionna_partial.tracing.fixed_paths import PathScene
from sionna_partial.tracing.trace import trace_links

SETTINGS = sp.TraceSettings(max_depth=2, power_tolerance_db=0.0)
TX = TX_M + np.array([[0.0, 0.0, 0.0]] * 3 + [[0.31, 0.11, 0.2]])
RX = np.array([*RX_M[:3], RX_M[1]])


def quiet(share: float, message: str) -> None:
    assert 0.0 <= share <= 1.0
    assert message


def found(tx: NDArray[np.float64] = TX, rx: NDArray[np.float64] = RX) -> MaterialPaths:
    base = sp.Material(10.0, 1.0, 0.02)
    scene = PathScene(small_room(), settings=SETTINGS, scene_settings=sp.SceneSettings(material=base))
    return find_material_paths(scene, scene.materials, tx, rx, quiet)


@pytest.fixture(scope="module")
def paths() -> MaterialPaths:
    return found()


def traced_db(material: sp.Material) -> NDArray[np.float64]:
    settings = sp.SceneSettings(material=material)
    return np.array(
        [
            trace_links(small_room(), tx, [rx], settings=SETTINGS, scene_settings=settings).gain_db[0]
            for tx, rx in zip(TX, RX, strict=True)
        ]
    )


def gains_db(paths: MaterialPaths, permittivity: float, conductivity_s_m: float) -> NDArray[np.float64]:
    power = paths.power(np.array([permittivity]), np.array([conductivity_s_m]))
    return link_gains_db(power, paths.link, len(RX))


class TestPower:
    @pytest.mark.parametrize("material", [sp.Material(2.94, 0.1226, 0.02), sp.Material(6.3, 0.001, 0.02)])
    def test_is_that_of_a_new_trace(self, paths: MaterialPaths, material: sp.Material) -> None:
        ours_db = gains_db(paths, material.relative_permittivity, material.conductivity_s_m)
        np.testing.assert_allclose(ours_db, traced_db(material), atol=0.15)

    def test_many_materials_together(self, paths: MaterialPaths, monkeypatch: pytest.MonkeyPatch) -> None:
        permittivity, conductivity_s_m = np.array([[2.0], [9.0], [4.0]]), np.array([[0.5], [0.0], [0.01]])
        together = paths.powers(permittivity, conductivity_s_m)
        alone = np.stack([paths.power(*pair) for pair in zip(permittivity, conductivity_s_m, strict=True)])
        np.testing.assert_allclose(together, alone, rtol=1e-3, atol=1e-5 * alone.max())
        assert paths.at_once > 3
        np.testing.assert_array_equal(paths.powers(permittivity[1:], conductivity_s_m[1:]), together[1:])
        monkeypatch.setattr(material_paths, "MOST_COPIES", 1)
        few = replace(paths)
        assert few.at_once == 1
        np.testing.assert_allclose(few.powers(permittivity[:1], conductivity_s_m[:1]), together[:1], rtol=1e-5)

    def test_all_paths_give_the_same_to_rounding(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(material_paths, "KEPT_SHARE", 1.0 + 1e-9)
        np.testing.assert_allclose(gains_db(found(), 4.0, 0.3), traced_db(sp.Material(4.0, 0.3, 0.02)), atol=2e-3)

    def test_few_paths_have_nearly_all_of_it(self, paths: MaterialPaths, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(material_paths, "KEPT_SHARE", 1.0 + 1e-9)
        assert len(paths) < len(found())

    def test_the_same_bytes_again(self, paths: MaterialPaths) -> None:
        first = gains_db(paths, 3.0, 0.2)
        gains_db(paths, 9.0, 0.0)
        assert gains_db(paths, 3.0, 0.2).tobytes() == first.tobytes()


def test_slopes_are_those_of_the_power(paths: MaterialPaths) -> None:
    at, step = np.array([3.3, 0.4]), 2e-3
    power, slopes = paths.slopes(at[:1], at[1:])
    np.testing.assert_allclose(power, paths.power(at[:1], at[1:]), rtol=1e-4)
    for column, move in enumerate(np.eye(2) * step):
        ends = [paths.power(place[:1], place[1:]) for place in (at + move, at - move)]
        difference = (ends[0] - ends[1]) / (2.0 * step)
        np.testing.assert_allclose(slopes[:, column], difference, atol=0.01 * np.abs(difference).max())


class TestLinks:
    def test_direct_paths_are_marked(self, paths: MaterialPaths) -> None:
        state = trace_links(small_room(), TX[0], RX[:3], settings=SETTINGS).link_state
        assert ({*paths.link[paths.is_direct]} & {0, 1, 2}) == {*np.flatnonzero(state == sp.LinkState.LOS)}

    def test_paths_run_both_ways(self, paths: MaterialPaths) -> None:
        swapped = found(RX, TX)
        assert len(swapped.tx_m) == len(paths.tx_m) == 2
        np.testing.assert_allclose(gains_db(swapped, 4.0, 0.1), gains_db(paths, 4.0, 0.1), atol=1e-3)

    def test_some_links_alone(self, paths: MaterialPaths) -> None:
        chosen = np.array([False, True, False, True])
        some = paths.of_links(chosen)
        power = some.power(np.array([3.0]), np.array([0.1]))
        np.testing.assert_allclose(link_gains_db(power, some.link, 2), gains_db(paths, 3.0, 0.1)[chosen], atol=1e-4)
        assert len(some.unobserved_m) == len(some)

    def test_blocks_change_nothing(self, paths: MaterialPaths, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(material_paths, "PATHS_PER_BLOCK", 60)
        np.testing.assert_allclose(gains_db(found(), 3.0, 0.1), gains_db(paths, 3.0, 0.1), atol=0.1)

    def test_no_path(self) -> None:
        nothing = replace(found(), parts=(), unobserved_m=np.zeros(0))
        assert np.isneginf(gains_db(nothing, 3.0, 0.1)).all()
        assert nothing.slopes(np.ones(1), np.ones(1))[1].shape == (0, 2)


def test_each_material_of_a_mesh_counts_for_itself() -> None:
    walls, inner = room().geometry.values()
    vertices = np.concatenate([walls.vertices, inner.vertices])
    triangles = np.concatenate([walls.faces, inner.faces + len(walls.vertices)])
    kinds = (sp.Material(4.0, 0.2, 0.02), sp.Material(6.0, 1.0, 0.03))
    mesh = merged_mesh(vertices, triangles, np.repeat([0, 1], 12), kinds)
    partial = mesh_map(mesh, MeshReading(observed=OBSERVED, resolution_m=0.1))
    scene = PathScene(partial, settings=sp.TraceSettings(max_depth=2, power_tolerance_db=0.0))
    tx, rx = np.tile([1.5, 1.0, 1.5], (2, 1)), np.array([[2.2, 2.9, 1.2], [4.0, 3.5, 1.5]])
    paths = find_material_paths(scene, scene.materials, tx, rx, quiet)
    new = (sp.Material(2.5, 0.1, 0.02), sp.Material(9.0, 0.05, 0.03))
    power = paths.power(np.array([2.5, 9.0]), np.array([0.1, 0.05]))
    expected = sp.trace_links(
        replace(partial, mesh=replace(mesh_of(partial), materials=new)),
        tx[0],
        rx,
        settings=sp.TraceSettings(max_depth=2, power_tolerance_db=0.0),
    )
    np.testing.assert_allclose(link_gains_db(power, paths.link, 2), expected.gain_db, atol=0.15)
    many = paths.powers(np.array([[4.0, 6.0], [2.5, 9.0]]), np.array([[0.2, 1.0], [0.1, 0.05]]))
    np.testing.assert_allclose(many[1], power, rtol=1e-3, atol=1e-5 * power.max())
    assert np.abs(paths.slopes(np.array([2.5, 9.0]), np.array([0.1, 0.05]))[1]).max(axis=0).min() > 0.0


def mesh_of(partial: sp.PartialMap) -> SceneMesh:
    assert partial.mesh is not None
    return partial.mesh
