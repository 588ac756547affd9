"""Meshes: checked, compared, and cut at the border of an area."""

import re
from dataclasses import replace

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import areas_m2, box, open_edges, scene_mesh, surface_m2

from sionna_partial.errors import MapError
from sionna_partial.maps.mesh.scene_mesh import SceneMesh
from sionna_partial.settings import Material

CONCRETE = Material(itu="concrete")
SQUARE = {
    "vertices_m": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
    "triangles": [[0, 1, 2], [0, 2, 3]],
    "material": [1, 0],
    "materials": (None, CONCRETE),
}
ROOM = scene_mesh(box((0, 0, 0), (5, 4, 3)))


def bumpy(seed: int) -> SceneMesh:
    """A closed surface without a vertical or horizontal triangle."""
    solid = box((0, 0, 0), (5, 4, 3)).subdivide().subdivide().subdivide()
    solid.vertices += np.random.default_rng(seed).normal(0.0, 0.02, solid.vertices.shape)
    return scene_mesh(solid)


def random_cells(seed: int, count: int = 300):  # type: ignore[no-untyped-def]
    """Union of random cells of 0.1 m."""
    cells = np.random.default_rng(seed).integers(-2, (52, 42), (count, 2))
    return shapely.union_all(shapely.box(*(cells * 0.1).T, *(cells * 0.1 + 0.1).T))


class TestSceneMesh:
    def test_order_and_degenerate_triangles(self) -> None:
        mesh = SceneMesh(**SQUARE)
        np.testing.assert_array_equal(mesh.material, [0, 1])
        np.testing.assert_array_equal(mesh.triangles, [[0, 1, 2], [0, 3, 1]])
        np.testing.assert_array_equal(mesh.vertices_m, [[0, 0, 0], [1, 1, 0], [0, 1, 0], [1, 0, 0]])
        assert mesh.materials == (None, CONCRETE)
        vertices = [*SQUARE["vertices_m"], [2, 0, 0], [9, 9, 9]]
        triangles = [[0, 1, 2], [0, 1, 4], [1, 1, 2], [0, 2, 3]]
        mesh = SceneMesh(vertices, triangles, [0, 0, 0, 0])
        assert mesh == SceneMesh(SQUARE["vertices_m"], SQUARE["triangles"], [0, 0])
        mesh = SceneMesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros(0, int))
        assert np.isnan(mesh.bounds_m).all()
        assert mesh.corners_m.shape == (0, 3, 3)
        assert mesh.within(shapely.box(0, 0, 1, 1)) == mesh

    def test_equal_meshes(self) -> None:
        mesh = SceneMesh(**SQUARE)
        assert mesh == SceneMesh(**SQUARE)
        assert mesh == replace(mesh, triangles=mesh.triangles)
        for change in ({"material": [0, 0]}, {"materials": (None, None)}, {"height_range_m": (0.0, 9.0)}):
            assert mesh != SceneMesh(**(SQUARE | change))
        assert mesh != SceneMesh(**(SQUARE | {"vertices_m": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]]}))
        assert mesh != "mesh"

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"vertices_m": [[0, 0]]}, "vertices_m has shape (1, 2): give x, y, z in metres, (V, 3)."),
            ({"vertices_m": [[0, 0, np.nan]]}, "vertices_m[0] = (0.0, 0.0, nan) is not allowed: give finite numbers"),
            ({"triangles": [[0, 1]]}, "triangles is int64 of shape (1, 2): give integers (F, 3)."),
            ({"triangles": [[0, 1, 4]]}, "triangles holds the index 4, but vertices_m has 4 entries: give 0 to 3;"),
            ({"material": [0, 2]}, "material holds the index 2, but materials has 2 entries: give 0 to 1;"),
            ({"material": [0]}, "material has 1 entries for 2 triangles: give one for each."),
            ({"materials": ("brick", None)}, "materials = ('brick', None) is not allowed: give Material(...) or None"),
            ({"materials": (None,) * 257}, "materials has 257 entries, more than 256: give like ones the same"),
            ({"height_range_m": (3, 3)}, "height_range_m = (3, 3) is not allowed: give (low, high), z in metres"),
        ],
    )
    def test_refused(self, change: dict, message: str) -> None:  # type: ignore[type-arg]
        with pytest.raises(MapError, match=re.escape(message)):
            SceneMesh(**(SQUARE | change))


class TestWithin:
    def test_areas_inside_outside_and_on_the_border(self) -> None:
        assert ROOM.within(shapely.box(-1, -1, 9, 9)) == ROOM.within(shapely.box(0, 0, 5, 4)) == ROOM
        assert not len(ROOM.within(shapely.box(6, 6, 9, 9)).triangles)
        assert not len(ROOM.within(shapely.Polygon()).triangles)
        moved = replace(ROOM, vertices_m=ROOM.vertices_m.astype(np.float32) * np.float32(1 + 1e-6))
        floorless = moved.within(shapely.box(5, 0, 6, 4))
        assert surface_m2(floorless) == pytest.approx(12.0, rel=1e-4)
        wall = scene_mesh(box((0, 1, 0), (4, 1.2, 3)))
        cut = wall.within(shapely.union_all([shapely.box(0, 0, 1, 1), shapely.box(2, 0, 3, 1)]))
        assert surface_m2(cut) == pytest.approx(6.0 + 0.0)
        np.testing.assert_allclose(cut.bounds_m, [[0, 1, 0], [3, 1, 3]], atol=1e-12)

    def test_slopes_keep_their_plane_and_materials_their_triangles(self) -> None:
        slope = SceneMesh([[0, 0, 0], [4, 0, 2], [4, 4, 6], [0, 4, 4]], [[0, 1, 2], [0, 3, 2]], [0, 0])
        cut = slope.within(shapely.Point(2, 2).buffer(1.0, quad_segs=8))
        x, y, z = cut.vertices_m.T
        np.testing.assert_allclose(z, x / 2 + y, atol=1e-12)
        a, b, c = cut.corners_m.transpose(1, 0, 2)
        up = np.cross(b - a, c - a)[:, 2] > 0
        np.testing.assert_array_equal(up, a[:, 0] + b[:, 0] + c[:, 0] > a[:, 1] + b[:, 1] + c[:, 1])
        cut = SceneMesh(**SQUARE).within(shapely.Polygon([(0, 0), (1, 0), (1, 1), (0.5, 1)]))
        below = cut.corners_m.mean(axis=1)[:, 0] > cut.corners_m.mean(axis=1)[:, 1]
        np.testing.assert_array_equal(cut.material, below)
        assert areas_m2(cut)[cut.material == 0].sum() == pytest.approx(0.25)

    @settings(max_examples=10)
    @given(st.integers(0, 2**32 - 1))
    def test_an_area_and_the_rest_share_the_surface(self, seed: int) -> None:
        mesh, area = bumpy(seed), random_cells(seed)
        cut, rest = mesh.within(area), mesh.within(shapely.box(-1, -1, 6, 5) - area)
        assert surface_m2(cut) + surface_m2(rest) == pytest.approx(surface_m2(mesh), rel=1e-5)
        middle = shapely.points(cut.corners_m.mean(axis=1)[:, :2])
        assert shapely.distance(area, middle).max() < 1e-4

    @settings(max_examples=10)
    @given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-6]))
    def test_a_closed_surface_opens_at_the_border_alone(self, seed: int, noise_m: float) -> None:
        solid = box((0, 0, 0), (5, 4, 3)).subdivide().subdivide().subdivide()
        solid.vertices += np.random.default_rng(seed).normal(0.0, noise_m, solid.vertices.shape)
        area = random_cells(seed, 900)
        rims = open_edges(scene_mesh(solid).within(area))
        assert shapely.distance(area.boundary, shapely.points(rims.mean(axis=1)[:, :2])).max() < 1e-4
