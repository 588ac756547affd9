"""A path set has the paths of the trace, and follows transmitters, materials and frequency as new traces do."""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
from meshes import box
from numpy.typing import ArrayLike, NDArray
from pillar_room import RX_M, TX_M, small_room

import sionna_partial as sp
from sionna_partial.constants import SPEED_OF_LIGHT_M_S, CellState
from sionna_partial.errors import BackendError, SettingsError
from sionna_partial.maps.mesh.cells import MeshReading, mesh_map
from sionna_partial.maps.mesh.scene_mesh import merged_mesh
from sionna_partial.settings import DRYWALL
from sionna_partial.tracing import path_set
from sionna_partial.tracing.path_set import MATERIAL_PARAMETERS, PARAMETERS, PathParameters, PathSet

SETTINGS = sp.TraceSettings(power_tolerance_db=0.0, max_depth=1)
FIELD = sp.PartialMap(np.zeros((40, 60), dtype=np.uint8), 0.1)
FLOOR = sp.SceneSettings(ceiling=False)
NOTHING = sp.SceneSettings(floor_extent="none")
CONCRETE_AT_5_GHZ = sp.SceneSettings(material=sp.Material(itu="concrete", thickness_m=0.1))
MESH_TX_M, MESH_RX_M = np.array([1.03, 1.92, 1.4]), np.array([[2.2, 2.4, 1.1], [1.9, 0.9, 1.3]])
STEPS = {"relative_permittivity": 4e-3, "conductivity_s_m": 4e-3, "thickness_m": 3e-5, "frequency_hz": 1e7}


def mesh_room() -> sp.PartialMap:
    """A room of 5 x 4 x 3 m of concrete, and in it walls of two other materials."""
    solids = [box((0, 0, 0), (5, 4, 3)), box((2.95, 0, 0), (3.05, 3, 3)), box((1.2, 3.0, 0), (2.2, 3.1, 2))]
    vertices = np.concatenate([solid.vertices for solid in solids])
    first = np.cumsum([0, *(len(solid.vertices) for solid in solids)])[:-1]
    faces = np.concatenate([solid.faces + start for solid, start in zip(solids, first, strict=True)])
    kind = np.repeat(np.arange(3), [len(solid.faces) for solid in solids])
    materials = (sp.Material(itu="concrete"), None, sp.Material(6.0, 0.3, 0.01))
    return mesh_map(merged_mesh(vertices, faces, kind, materials), MeshReading())


def changed(paths: PathSet, **changes: ArrayLike) -> PathParameters:
    """Parameters at which paths were found, with something added to some."""
    return replace(paths.base, **{name: getattr(paths.base, name) + np.array(by) for name, by in changes.items()})


def entries(paths: PathSet, name: str, step: float) -> list[NDArray[np.float64]]:
    """Steps (K, ...) along each entry of a parameter."""
    value = getattr(paths.base, name)
    return [step * along.reshape(value.shape) for along in np.eye(value.size)]


def by_differences(
    of: Callable[[PathParameters], NDArray[np.float64]], paths: PathSet, name: str, step: float
) -> NDArray[np.float64]:
    """Central differences (..., K) of a function with respect to the entries of a parameter."""
    steps = entries(paths, name, step)
    return np.stack(
        [(of(changed(paths, **{name: s})) - of(changed(paths, **{name: -s}))) / (2 * step) for s in steps], -1
    )


def sums(paths: PathSet, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Sum (N, K) of the values (P, K) of paths over the receivers."""
    total = np.zeros((len(paths.rx_m), values.shape[1]))
    np.add.at(total, paths.path_rx, values)
    return total


def as_traced(paths: PathSet, links: sp.TracedLinks) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power and vertices of the traced paths, in the order of fixed ones: receivers and kinds of interactions first."""
    order = np.lexsort((links.delay_s, *links.interactions.T, links.path_rx))
    return np.abs(links.a[order]) ** 2, links.vertices_m[order]


def in_order(paths: PathSet, power: NDArray[np.float64], vertices_m: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
    """The same order of the fixed paths themselves, by the lengths of paths with the vertices (P, D, 3)."""
    tx_m = paths.base.tx_m
    delay = np.zeros(len(paths))
    for index, (positions, rx) in enumerate(zip(vertices_m, paths.path_rx, strict=True)):
        chain = np.array([tx_m, *positions[~np.isnan(positions[:, 0])], paths.rx_m[rx]])
        delay[index] = np.linalg.norm(np.diff(chain, axis=0), axis=1).sum()
    order = np.lexsort((delay, *paths.interactions.T, paths.path_rx))
    return power[order], vertices_m[order]


@pytest.fixture(scope="module")
def room() -> sp.Simulation:
    return sp.Simulation(small_room(), trace_settings=SETTINGS)


@pytest.fixture(scope="module")
def paths(room: sp.Simulation) -> PathSet:
    return room.paths(TX_M, RX_M)


@pytest.fixture(scope="module")
def mesh_paths() -> PathSet:
    return sp.Simulation(mesh_room(), trace_settings=SETTINGS).paths(MESH_TX_M, MESH_RX_M)


@pytest.fixture(scope="module")
def itu_paths() -> PathSet:
    settings = replace(SETTINGS, frequency_hz=5e9)
    return sp.Simulation(small_room(), trace_settings=settings, scene_settings=CONCRETE_AT_5_GHZ).paths(TX_M, RX_M)


class TestLinks:
    @staticmethod
    def assert_same(found: sp.TracedLinks, links: sp.TracedLinks) -> None:
        for field in fields(links):
            ours, theirs = getattr(found, field.name), getattr(links, field.name)
            if field.name == "transfer":  # a PathSet has the power between vertically polarised antennas alone
                np.testing.assert_array_equal(found.a, links.a)
            elif field.name == "gain_db":
                np.testing.assert_allclose(ours, theirs, rtol=1e-13)
            elif isinstance(theirs, np.ndarray):
                np.testing.assert_array_equal(ours, theirs, err_msg=field.name)
                assert ours.dtype == theirs.dtype, field.name
            else:
                assert ours == theirs

    def test_plan(self, paths: PathSet) -> None:
        links = sp.trace_links(small_room(), TX_M, RX_M, trace_settings=SETTINGS)
        assert {0, 1, 8} <= {*links.interactions.ravel().tolist()}
        self.assert_same(paths.links(), links)
        self.assert_same(paths.links(), links)  # a second time, too

    def test_mesh(self, mesh_paths: PathSet) -> None:
        self.assert_same(mesh_paths.links(), sp.trace_links(mesh_room(), MESH_TX_M, MESH_RX_M, trace_settings=SETTINGS))

    def test_map_elsewhere(self, paths: PathSet) -> None:
        move = np.array([5e5, 4.5e6, 0.0])
        moved = replace(small_room(), origin_m=(5e5, 4.5e6))
        there = sp.Simulation(moved, trace_settings=SETTINGS).paths(TX_M + move, RX_M + move)
        self.assert_same(there.links(), sp.trace_links(moved, TX_M + move, RX_M + move, trace_settings=SETTINGS))
        power, vertices_m = there.at(changed(there, tx_m=[0.01, -0.02, 0.03]))
        expected, expected_m = paths.at(changed(paths, tx_m=[0.01, -0.02, 0.03]))
        np.testing.assert_allclose(power, expected, rtol=1e-3, atol=1e-6 * expected.max())
        np.testing.assert_allclose(vertices_m - move, expected_m, atol=1e-5)


class TestAt:
    @pytest.mark.parametrize("which", ["paths", "mesh_paths"])
    def test_where_they_were_found(self, which: str, request: pytest.FixtureRequest) -> None:
        """Verified again, or only evaluated again, when hardly anything changes."""
        paths = request.getfixturevalue(which)
        assert paths.at(paths.base)[0].tobytes() == paths.power.tobytes()
        for changes in ({"tx_m": 1e-9}, {"frequency_hz": 1.0}):
            power, vertices_m = paths.at(changed(paths, **changes))
            np.testing.assert_allclose(power, paths.power, rtol=1e-5)
            np.testing.assert_allclose(vertices_m, paths.vertices_m, atol=1e-5)
            np.testing.assert_array_equal(np.isnan(vertices_m[..., 0]), paths.interactions == 0)

    @pytest.mark.parametrize("which", ["paths", "mesh_paths"])
    def test_transmitter_moved_as_a_new_trace(self, which: str, request: pytest.FixtureRequest) -> None:
        """Where the new position has the same kinds of paths; here it has."""
        paths = request.getfixturevalue(which)
        there = changed(paths, tx_m=[4e-3, -3e-3, 5e-3])
        partial = paths._simulation.partial
        links = sp.trace_links(partial, there.tx_m, paths.rx_m, trace_settings=SETTINGS)
        assert len(links.a) == len(paths)
        moved = replace(paths.base, tx_m=there.tx_m)
        power, vertices_m = paths.at(moved)
        mine, mine_m = in_order(paths, power, vertices_m)
        expected, expected_m = as_traced(paths, links)
        np.testing.assert_allclose(mine, expected, rtol=2e-3, atol=1e-6 * expected.max())
        np.testing.assert_allclose(mine_m, expected_m, atol=2e-5)

    def test_constants_changed_as_a_new_trace(self, paths: PathSet) -> None:
        by = {"relative_permittivity": 1.7, "conductivity_s_m": -0.1, "thickness_m": -0.05}
        settings = replace(SETTINGS, frequency_hz=19e9, refraction=False)
        changes = {name: getattr(sp.Material(), name) + step for name, step in by.items()}
        material = sp.Material(**changes, conductivity_exponent=DRYWALL.conductivity_exponent)
        scene_settings = sp.SceneSettings(material=material)
        links = sp.trace_links(small_room(), TX_M, RX_M, trace_settings=settings, scene_settings=scene_settings)
        power, _ = paths.at(changed(paths, **by, frequency_hz=-9e9))
        expected = as_traced(paths, links)[0]
        np.testing.assert_allclose(in_order(paths, power, paths.vertices_m)[0], expected, rtol=1e-3)
        assert np.abs(power / paths.power - 1).max() > 0.01

    def test_itu_materials_follow_the_frequency(self, itu_paths: PathSet) -> None:
        power, _ = itu_paths.at(changed(itu_paths, frequency_hz=3e9))
        settings = replace(SETTINGS, frequency_hz=8e9)
        there = sp.Simulation(small_room(), trace_settings=settings, scene_settings=CONCRETE_AT_5_GHZ).paths(TX_M, RX_M)
        np.testing.assert_allclose(power, there.power, rtol=1e-4)

    def test_same_bytes_whatever_came_between(self, paths: PathSet) -> None:
        """Dr.Jit replays recorded kernels for other materials, also while another scene is open."""
        there = replace(paths.base, relative_permittivity=np.array([4.0]), conductivity_s_m=np.array([0.3]))
        first = paths.at(there)[0]
        other = sp.Simulation(FIELD, SETTINGS, FLOOR).paths((1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)])
        other.at(changed(other, conductivity_s_m=0.1))
        paths.at(changed(paths, relative_permittivity=5.0))
        assert paths.at(there)[0].tobytes() == first.tobytes()
        elsewhere = replace(there, tx_m=there.tx_m + 1e-7)  # too little to matter: verified again
        np.testing.assert_allclose(paths.at(elsewhere)[0], first, rtol=1e-4, atol=1e-7 * first.max())

    def test_no_path_through_a_wall(self, paths: PathSet) -> None:
        """In the pillar, and far from all of it."""
        for position in ([2.3, 1.6, 1.4], [1e4, 1.0, 1.0], [1e9, -1e9, 1e9]):
            there = replace(paths.base, tx_m=np.array(position))
            power, vertices_m = paths.at(there)
            assert not power.any()
            assert np.isfinite(vertices_m[paths.interactions > 0]).all()
            slopes, of_vertices = paths.transmitter_slopes(there)
            assert not slopes.any()
            assert np.isfinite(of_vertices).all()

    def test_ends_of_the_range(self, paths: PathSet) -> None:
        dense = {"relative_permittivity": 1e6, "conductivity_s_m": 1e9, "thickness_m": 10.0}
        for values in (dense, {"relative_permittivity": 1.0, "conductivity_s_m": 0.0}):
            there = replace(paths.base, **{name: np.array([value]) for name, value in values.items()})
            power, _ = paths.at(there)
            assert np.isfinite(power).all()
            assert all(np.isfinite(slope).all() for slope in paths.slopes(there).values())
        assert not power[(paths.interactions == 1).any(axis=1)].any()  # vacuum reflects nothing


class TestSlopes:
    @pytest.mark.parametrize(
        ("which", "name"),
        [*(("mesh_paths", name) for name in STEPS), ("itu_paths", "conductivity_s_m"), ("itu_paths", "frequency_hz")],
    )
    def test_constants_by_differences(self, name: str, which: str, request: pytest.FixtureRequest) -> None:
        paths = request.getfixturevalue(which)
        found = sums(paths, paths.slopes(paths.base, [name])[name])
        expected = by_differences(
            lambda there: sums(paths, paths.at(there)[0][:, None])[:, 0], paths, name, STEPS[name]
        )
        np.testing.assert_allclose(found, expected, rtol=0.01, atol=1e-3 * np.abs(expected).max())

    @pytest.mark.parametrize("which", ["paths", "mesh_paths"])
    def test_transmitter_by_differences(self, which: str, request: pytest.FixtureRequest) -> None:
        paths = request.getfixturevalue(which)
        power, vertices_m = paths.transmitter_slopes(paths.base)
        np.testing.assert_array_equal(power, paths.slopes(paths.base, ["tx_m"])["tx_m"])
        expected = by_differences(lambda there: sums(paths, paths.at(there)[0][:, None])[:, 0], paths, "tx_m", 2e-3)
        off = np.linalg.norm(sums(paths, power) - expected, axis=1)
        assert (off <= 0.01 * np.linalg.norm(expected, axis=1)).all()
        positions = by_differences(lambda there: np.nan_to_num(paths.at(there)[1]), paths, "tx_m", 2e-3)
        np.testing.assert_allclose(vertices_m, positions, atol=2e-3)
        assert (np.abs(vertices_m).max(axis=(1, 2, 3)) > 0.1).any()

    def test_together(self, mesh_paths: PathSet) -> None:
        apart, together = (mesh_paths.slopes(mesh_paths.base, together=each) for each in (False, True))
        assert [*apart] == [*together] == [*PARAMETERS]
        assert [each.shape[1] for each in apart.values()] == [3, 3, 3, 3, 1]
        assert [each.shape[1] for each in together.values()] == [3, 1, 1, 1, 1]
        for name in PARAMETERS:
            expected = apart[name].sum(axis=1, keepdims=True) if name in MATERIAL_PARAMETERS else apart[name]
            scale = np.abs(apart[name]).max()
            np.testing.assert_allclose(together[name], expected, rtol=1e-4, atol=1e-6 * scale)

    def test_two_runs_give_the_same_bytes(self, room: sp.Simulation, paths: PathSet) -> None:
        again = sp.Simulation(small_room(), trace_settings=SETTINGS).paths(TX_M, RX_M)
        there = changed(paths, tx_m=[1e-3, 0.0, 0.0])
        for one, other in ((again, paths), (paths, paths)):
            assert one.power.tobytes() == other.power.tobytes()
            mine, theirs = one.slopes(there), other.slopes(there)
            assert all(mine[name].tobytes() == theirs[name].tobytes() for name in PARAMETERS)
            assert one.at(there)[0].tobytes() == other.at(there)[0].tobytes()

    def test_blocks_change_nothing(self, room: sp.Simulation, paths: PathSet, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(path_set, "PATHS_PER_BLOCK", 17)
        assert len(paths) > 17
        cut, there = room.paths(TX_M, RX_M), changed(paths, tx_m=[1e-3, 0.0, 0.0])
        found, expected = ([*each.at(there), *each.transmitter_slopes(there)] for each in (cut, paths))
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6 * np.nanmax(np.abs(other)))
        thicker = changed(paths, thickness_m=[0.01])
        np.testing.assert_allclose(cut.at(thicker)[0], paths.at(thicker)[0], rtol=1e-5)


class TestNothingIsLeftBehind:
    def test_after_an_error(self, room: sp.Simulation, paths: PathSet) -> None:
        """Sionna RT refuses a negative conductivity when the permittivity has been changed."""
        before = room.paths(TX_M, RX_M).links().a.tobytes()
        there = changed(paths, relative_permittivity=[3.0], conductivity_s_m=[-1.0], frequency_hz=-2e9)
        for call in (paths.at, paths.slopes, paths.transmitter_slopes):
            with pytest.raises(ValueError, match="conductivity must be greater"):
                call(there)
        assert room.paths(TX_M, RX_M).links().a.tobytes() == before
        assert all(np.isfinite(each).all() for each in paths.slopes(paths.base).values())


class TestNothingThere:
    def test_no_paths(self) -> None:
        state = np.zeros((22, 60), dtype=np.uint8)
        state[[0, -1], :] = state[:, [0, 29, -1]] = CellState.WALL
        paths = sp.Simulation(sp.PartialMap(state, 0.1)).paths((1.0, 1.1, 1.5), [(4.5, 0.8, 1.2)])
        assert paths.links().gain_db.tolist() == [-150.0]
        assert [each.shape for each in paths.at(paths.base)] == [(0,), (0, 6, 3)]
        assert [each.shape for each in paths.transmitter_slopes(paths.base)] == [(0, 3), (0, 6, 3, 3)]

    def test_no_materials(self) -> None:
        scene = sp.Simulation(FIELD, scene_settings=NOTHING)
        paths = scene.paths((1.0, 1.0, 1.5), [(3.0, 1.0, 1.5)])
        assert scene.materials == ()
        assert (paths.base.relative_permittivity.shape, paths.is_direct.tolist()) == ((0,), [True])
        free = (SPEED_OF_LIGHT_M_S / 28e9 / (8 * np.pi)) ** 2
        np.testing.assert_allclose(paths.at(changed(paths, frequency_hz=1.0))[0], free, rtol=1e-5)
        np.testing.assert_allclose(paths.slopes(paths.base)["tx_m"], [[free, 0.0, 0.0]], rtol=1e-5)
        together = paths.slopes(paths.base, together=True)
        assert [together[name].tolist() for name in MATERIAL_PARAMETERS] == [[[0.0]]] * 3


def test_broken_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "sionna_partial.tracing.simulation.engine_fault", lambda: "sionna-rt 3.0 is not of the release 2.2"
    )
    with pytest.raises(BackendError, match=r'Gradients need the fast engine, and .* 2.2: run pip install "sionna-rt=='):
        sp.Simulation(FIELD).paths((1.0, 1.0, 1.5), [])


def test_frequency_that_a_material_does_not_cover(itu_paths: PathSet) -> None:
    there = replace(itu_paths.base, frequency_hz=np.array(5e8))
    for call in (itu_paths.at, itu_paths.slopes, itu_paths.transmitter_slopes):
        with pytest.raises(SettingsError, match="ITU material 'concrete' is defined for"):
            call(there)
