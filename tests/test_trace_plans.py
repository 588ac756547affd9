"""Traces of plans in which beams or rays might go astray, against the textbook image method."""

from pathlib import Path

import numpy as np
import pytest
from extruded import ROOM, SPLINTERS, drawn, extrude, specular_blocks, specular_lengths_m
from numpy.typing import NDArray
from test_trace import _grid, _half_seen_room, _room, all_paths

from sionna_partial.constants import SPEED_OF_LIGHT_M_S, LinkState
from sionna_partial.scene.scene import SceneGeometry, write_scene
from sionna_partial.settings import SceneSettings
from sionna_partial.tracing.engine import SceneSolver
from sionna_partial.tracing.paths import SolvedPaths, join_paths
from sionna_partial.tracing.trace import trace_links

MARGIN_M = 1e-3
"""Paths that pass the end of a wall by less than this may be found or not: the solver has single precision."""

SHORTEST_M = 0.011
"""Paths with a leg shorter than this may be left out: Sionna RT refuses those below 1 cm."""

ARRAYS = ("a", "delay_s", "departure_rad", "arrival_rad", "interactions", "vertices_m")
GAP = np.array([[(1.0, 2.0), (2.99, 2.0)], [(3.01, 2.0), (5.0, 2.0)]])
FLOOR = ((-10.0, -10.0, 16.0, 14.0),)
PLANS = {
    "no walls": (extrude(np.zeros((0, 2, 2)), floor_m=FLOOR), (1.07, 1.93, 1.2)),
    "crossing walls": (extrude(SPLINTERS, floor_m=FLOOR), (1.07, 1.93, 1.2)),
    "collinear walls with a gap": (extrude(GAP, floor_m=FLOOR), (2.97, 0.5, 1.2)),
    "2 cm from a corner": (extrude(ROOM), (0.02, 0.02, 1.2)),
    "in the door": (extrude(ROOM), (3.0, 2.0, 1.2)),
    "in line with a wall": (extrude(GAP, floor_m=FLOOR), (0.5, 2.0, 1.2)),
    "no ceiling": (extrude(ROOM, ceiling=False), (1.07, 1.93, 1.2)),
    "no floor": (extrude(ROOM, floor_m=()), (1.07, 1.93, 1.2)),
}
LATTICE = np.array([[x, y, 1.2] for x in (0.5, 1.0, 2.0, 4.0, 5.0, 5.5) for y in (0.5, 1.0, 1.5, 2.5, 3.5)])
"""Receivers in line with walls, door jambs and each other, at the height of the transmitter."""


def _trace(geometry: SceneGeometry, tx: NDArray[np.float64], rx: NDArray[np.float64], folder: Path) -> SolvedPaths:
    solver = SceneSolver(write_scene(geometry, folder, offset_m=(0.0, 0.0)), geometry.shapes, all_paths())
    blocks = specular_blocks(geometry, tx, rx, 2)
    return join_paths([solver.verify(block, tx, rx)[0] for block, _ in blocks], 2)


def _matched(lengths: NDArray[np.float64], others: NDArray[np.float64]) -> bool:
    """Whether each length is among the others; single precision, and walls are seen 0.1 mm wide."""
    return all(np.abs(others - length).min(initial=np.inf) < 2e-4 for length in lengths)


@pytest.mark.parametrize("name", PLANS)
def test_every_path_of_the_image_method_and_no_other(name: str, tmp_path: Path) -> None:
    geometry, position = PLANS[name]
    tx = np.array(position)
    away = np.random.default_rng(1).uniform((0.1, 0.1, 0.2), (5.9, 3.9, 2.3), (25, 3))
    rx = np.concatenate([LATTICE, away])
    paths = _trace(geometry, tx, rx, tmp_path)
    total = 0
    for index in range(len(rx)):
        found = np.sort(paths.delay_s[paths.path_rx == index]) * SPEED_OF_LIGHT_M_S
        sure = specular_lengths_m(geometry, tx, rx[index], 2, MARGIN_M, SHORTEST_M)
        possible = specular_lengths_m(geometry, tx, rx[index], 2, -MARGIN_M)
        assert len(sure) <= len(found) <= len(possible), rx[index]
        assert _matched(sure, found), rx[index]
        assert _matched(found, possible), rx[index]
        total += len(sure)
    assert total >= len(rx) / 2


def test_blocks_of_candidates_together_hold_what_one_block_holds() -> None:
    tx, rx = np.array([1.1, 0.7, 1.2]), np.array([[2.3, 3.1, 2.1], [4.7, 1.2, 0.4]])
    ((whole, _),) = specular_blocks(extrude(ROOM), tx, rx, 3)
    parts, shares = zip(*specular_blocks(extrude(ROOM), tx, rx, 3, pairs_at_once=3), strict=True)
    assert len(parts) > 3
    assert list(shares) == sorted(shares)
    assert shares[-1] == 1.0
    for name in ("rx", "kind", "face", "vertices_m"):
        np.testing.assert_array_equal(np.concatenate([getattr(part, name) for part in parts]), getattr(whole, name))


class TestJunctions:
    def test_no_path_bends_where_three_walls_meet(self) -> None:
        partial = _half_seen_room()
        settings = all_paths(open_ends=True)
        links = trace_links(partial, (1.05, 2.95, 1.5), _grid(partial, 0.5), trace_settings=settings)
        edges = np.unique(links.vertices_m[links.interactions == 8][:, :2].round(2), axis=0)
        jambs = [[3.05, 1.45], [3.05, 2.55]]
        assert {tuple(edge) for edge in jambs} <= {tuple(edge) for edge in edges.tolist()}
        for y in (0.05, 4.15):
            assert not (np.abs(edges - [3.05, y]) < 0.02).all(axis=1).any()


class TestOpenEnds:
    def test_a_wall_that_ends_unseen_bends_nothing_unless_asked(self) -> None:
        partial = drawn("...... ...... ###??? ...... ......", 1.0)
        tx, rx = (1.5, 0.5, 1.5), [[0.5, 4.5, 1.5]]
        scene = SceneSettings(floor_extent="none")
        quiet, asked = (
            trace_links(partial, tx, rx, trace_settings=all_paths(open_ends=each), scene_settings=scene)
            for each in (False, True)
        )
        assert quiet.link_state.tolist() == [LinkState.OUTAGE]
        assert asked.link_state.tolist() == [LinkState.NLOS]
        assert 8 in asked.interactions


class TestTransmitters:
    TX = ((1.05, 2.95, 1.5), (5.03, 0.64, 2.1), (2.2, 1.1, 1.2))

    def test_several_are_the_same_as_one_by_one(self) -> None:
        rx = _grid(_room(), 1.0)
        together, listed = trace_links(_room(), self.TX, rx), trace_links(_room(), self.TX[:1], rx)
        np.testing.assert_array_equal(listed.gain_db, together.gain_db[:1])
        for index, tx in enumerate(self.TX):
            links = trace_links(_room(), tx, rx)
            assert together.gain_db[index].tobytes() == links.gain_db.tobytes()
            own = together.path_tx == index
            assert together.path_rx[own].tobytes() == links.path_rx.tobytes()
            for name in ARRAYS:
                assert getattr(together, name)[own].tobytes() == getattr(links, name).tobytes()


def test_coefficients_do_not_depend_on_how_deep_others_go() -> None:
    """Sionna RT makes a path longer that has fewer interactions after its diffraction than others in its buffer."""
    walls = drawn("............. .###########. .#....#....#. .#....#....#. .#.........#. .###########. .............")
    tx, rx = np.array([1.3, 1.7, 1.2]), np.array([[4.4, 2.2, 1.5], [3.9, 1.4, 1.9]])
    shallow, deep = (trace_links(walls, tx, rx, trace_settings=all_paths(max_depth=depth)) for depth in (2, 3))
    diffracted = np.flatnonzero((shallow.interactions[:, 0] == 8) & (shallow.interactions[:, 1] == 1))
    assert len(diffracted) > 3
    for path in diffracted:
        positions = np.abs(deep.vertices_m[:, :2] - shallow.vertices_m[path]).max(axis=(1, 2))
        same = (deep.path_rx == shallow.path_rx[path]) & (deep.interactions[:, 2] == 0) & (positions < 1e-4)
        assert abs(deep.a[same]) == pytest.approx(abs(shallow.a[path]), rel=1e-3)
