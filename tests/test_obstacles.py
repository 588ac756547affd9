"""Obstacles that end below the ceiling: on the map, in its files, and for radios."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import sionna_partial as sp
from sionna_partial.constants import CellState
from sionna_partial.errors import MapError


def hall() -> sp.PartialMap:
    """A hall of 6 x 4 m with a table, a shelf at its wall, and a box beside unknown cells."""
    state = np.zeros((42, 62), dtype=np.uint8)
    state[[0, -1]], state[:, [0, -1]] = 1, 1
    state[10:20, 20:36] = 1
    state[12:18, 22:34] = 2
    state[30:41, 10:20] = 1
    state[30:35, 45:50] = 1
    state[30:36, 50:55] = 2
    return sp.PartialMap(state, 0.1, (1.0, -1.0))


def low() -> sp.PartialMap:
    shelf = [(2.0, 2.0), (3.0, 2.0), (3.0, 3.1), (2.0, 3.1)]
    return hall().with_obstacle_height(0.75).with_obstacle_height(1.8, shelf)


class TestMap:
    def test_what_stands_free_is_low(self) -> None:
        partial = hall().with_obstacle_height(0.75)
        assert partial.obstacle is not None
        rows, columns = np.nonzero(partial.obstacle)
        assert (rows.min(), rows.max(), columns.min(), columns.max()) == (10, 19, 20, 35)
        assert len(rows) == 10 * 16 - 6 * 12
        assert hall().with_obstacle_height(3.0).obstacle is None

    def test_radios_stand_above(self) -> None:
        on_table = (2.05 + 1.0, 1.05 - 1.0)
        heights = np.array([0.7, 0.8, 2.9])
        assert low().radios_can_stand(np.array([(*on_table, z) for z in heights])).tolist() == [False, True, True]
        assert not hall().radios_can_stand(np.array([(*on_table, 0.8)])).any()

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"obstacle": np.ones((3, 3), int)}, r"obstacle has shape \(3, 3\)"),
            ({"obstacle_heights_m": (0.0,)}, r"obstacle_heights_m = 0\.0 is not allowed"),
            ({"obstacle_heights_m": (0.75,)}, "obstacle has values 0 to 2, and obstacle_heights_m has 1 entries"),
        ],
    )
    def test_what_is_refused(self, changes: dict[str, object], message: str) -> None:
        with pytest.raises(MapError, match=message):
            replace(low(), **changes)  # type: ignore[arg-type]

    def test_heights(self) -> None:
        with pytest.raises(MapError, match=r"height_m = -1.0 is not allowed: give a number of metres"):
            hall().with_obstacle_height(-1.0)
        partial = replace(low(), obstacle_heights_m=tuple(0.1 + 0.001 * k for k in range(255)))
        with pytest.raises(MapError, match="obstacle_heights_m has 256 entries: give at most 255"):
            partial.with_obstacle_height(2.0)


class TestFiles:
    @pytest.mark.parametrize("name", ["map.yaml", "map.npz", "scene"])
    def test_read_back_as_they_were(self, name: str, tmp_path: Path) -> None:
        partial = low().with_wall_material("brick", low().state == CellState.WALL)
        (sp.export_scene if name == "scene" else sp.save_map)(partial, tmp_path / name)
        assert sp.load_map(tmp_path / name) == partial
        sp.save_map(hall(), tmp_path / "hall.yaml")
        assert sp.load_map(tmp_path / "hall.yaml", obstacle_height_m=0.75) == hall().with_obstacle_height(0.75)

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            ([0.75], "obstacle has shades up to 2 for 1 heights"),
            (0.75, "give an image and a list of heights"),
        ],
    )
    def test_damaged_ones_are_refused(self, value: object, message: str, tmp_path: Path) -> None:
        sp.save_map(low(), tmp_path / "map.yaml")
        sheet = yaml.safe_load((tmp_path / "map.yaml").read_text())
        sheet["obstacle"]["heights"] = value
        (tmp_path / "map.yaml").write_text(yaml.safe_dump(sheet))
        with pytest.raises(MapError, match=message):
            sp.load_map(tmp_path / "map.yaml")


class TestTrace:
    def test_an_edge_of_a_table_diffracts_below_its_top(self) -> None:
        partial, settings = low(), sp.TraceSettings(max_depth=1)
        links = sp.trace_links(partial, (2.5, 1.5, 0.4), [(4.8, 0.5, 0.4), (4.8, 0.5, 1.2)], trace_settings=settings)
        diffracted = links.interactions[:, 0] == 8
        assert (links.path_rx[diffracted] == 0).any()
        assert links.vertices_m[diffracted, 0, 2].max() < 0.75
        assert links.link_state.tolist() == [sp.LinkState.NLOS, sp.LinkState.LOS]

    def test_links_above_obstacles_are_in_sight(self) -> None:
        partial = low()
        phi = sp.link_features(partial, sp.trace_links(partial, (2.0, 0.4, 1.2), [(5.5, 0.6, 1.2), (5.5, 0.6, 0.3)]))
        assert phi.context is not None
        assert phi.context.possible[:, sp.LinkState.LOS].tolist() == [True, False]
        assert phi.context.walled_m[0] == 0.0 < phi.context.walled_m[1] < 1.6

    def test_what_does_not_know_of_obstacles_says_so(self) -> None:
        with pytest.raises(MapError, match="scene has obstacles below the ceiling"):
            sp.DifferentiableScene(low(), trace_settings=sp.TraceSettings(max_depth=0))
