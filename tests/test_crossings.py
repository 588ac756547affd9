"""Paths through walls of plans and meshes: each wall between has its loss once, and no path that matters is missing."""

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from meshes import box, scene_mesh
from meshes import meshed as mesh_of

import sionna_partial as sp
from sionna_partial.files import temporary_folder
from sionna_partial.tracing.line import are_in_wall, is_free_between
from sionna_partial.tracing.positions import clear_of_walls
from sionna_partial.tracing.power import transmission_coefficients
from sionna_partial.tracing.walls import Interior

BRICK = sp.Material(3.91, 0.031, 0.1)
LONELY = sp.SceneSettings(material=BRICK, floor_extent="none")
STRAIGHT = sp.TraceSettings(frequency_hz=5e9, max_depth=0, power_tolerance_db=0.0)
REFRACTION = 4
BOWLUS = Path(__file__).resolve().parents[1] / ".." / "shared" / "gibson" / "Bowlus" / "map.yaml"
BLEFLAT = Path(__file__).resolve().parents[1] / ".." / "shared" / "measured" / "bleflat" / "map.yaml"


def walled(cells: int, *, unseen: bool = False) -> sp.PartialMap:
    """A field with a wall of some cells across it; of an unseen one only the first cells are known."""
    state = np.zeros((60, 80), dtype=np.uint8)
    state[:, 40 : 40 + cells] = 1
    if unseen:
        state[:, 41:60] = 2
    return sp.PartialMap(state, 0.1)


def two_walls() -> sp.PartialMap:
    return sp.PartialMap(walled(1).state | np.roll(walled(1).state, 4, axis=1), 0.1)


def slab_loss_db(cosine: float) -> float:
    constants = BRICK.relative_permittivity, BRICK.conductivity_s_m, BRICK.thickness_m
    return float(-20.0 * np.log10(np.abs(transmission_coefficients(*constants, 5e9, cosine)[0])))


def loss_db(partial: sp.PartialMap, tx: tuple[float, ...], rx: tuple[float, ...], **changes: object) -> float:
    """Loss of a link beyond free space."""
    links = sp.trace_links(partial, tx, [rx], trace_settings=replace(STRAIGHT, **changes), scene_settings=LONELY)  # type: ignore[arg-type]
    free_db = 20.0 * np.log10(299792458.0 / 5e9 / (4.0 * np.pi * np.linalg.norm(np.subtract(rx, tx))))
    return float(free_db - links.gain_db[0])


def sheet(x: float) -> trimesh.Trimesh:
    """A wall without thickness."""
    return trimesh.Trimesh([(x, 0, 0), (x, 6, 0), (x, 6, 3), (x, 0, 3)], [(0, 1, 2), (0, 2, 3)], process=False)


WALL, BEHIND = box((4.2, 0, 0), (4.5, 6, 3)), box((4.8, 0, 0), (4.9, 6, 3))


def field(*solids: trimesh.Trimesh | None) -> sp.PartialMap:
    """Bodies in a field of free cells; with a None among them, its cells from 4.2 to 4.6 m are unknown."""
    state = np.zeros((60, 80), dtype=np.uint8)
    state[:, 42:46] = 2 * (None in solids)
    return sp.PartialMap(state, 0.1, mesh=scene_mesh(*(solid for solid in solids if solid is not None)))


def test_rays_between_two_that_stay_in_one_wall() -> None:
    """The rule for a bundle of rays is never less strict than the rule for each."""
    rng, agreed = np.random.default_rng(4), 0
    for _ in range(200):
        free = np.zeros((40, 40), dtype=bool)
        free[rng.integers(0, 40, 4), rng.integers(0, 40, 4)] = True
        interior = Interior.of(free, free, 0.05, 0.4)
        near, far = ((x, rng.uniform(0.3, 0.9), rng.uniform(1.0, 1.7)) for x in (0.8, rng.uniform(0.9, 1.5)))
        source, rays = (0.05, rng.uniform(0.4, 1.6)), []

        def ray(part: float, source=source, near=near, far=far) -> tuple[float, ...]:
            y = near[1] + part * (near[2] - near[1])
            length = np.hypot(near[0] - source[0], y - source[1])
            x, y = (near[0] - source[0]) / length, (y - source[1]) / length
            return x, y, x, length, (far[0] - source[0]) / x

        rays = ray(0.0), ray(1.0)
        if not are_in_wall(interior, *source, rays):
            continue
        agreed += 1
        for x, y, cosine, first, last in map(ray, np.linspace(0.0, 1.0, 9)):
            end = source[0] + (last + 0.1) * x, source[1] + (last + 0.1) * y
            assert (last - first) * cosine <= 0.4 + 1e-9
            assert not is_free_between(interior, source, end, first / (last + 0.1), last / (last + 0.1))
    assert 20 < agreed < 180


class TestOneWall:
    @pytest.mark.parametrize(
        ("partial", "angle_deg", "slabs", "changes"),
        [
            (walled(3), 30, 1, {}),
            (walled(6), 60, 1, {}),
            (walled(1, unseen=True), 0, 1, {}),
            (walled(9), 0, 2, {}),
            (walled(9), 0, 1, {"wall_depth_m": 1.0}),
            (walled(3), 0, 2, {"wall_depth_m": 0.0}),
            (two_walls(), 0, 2, {}),
        ],
        ids=["aslant", "more aslant", "one face seen", "deep", "one deep wall", "slabs", "two walls"],
    )
    def test_of_a_plan(self, partial: sp.PartialMap, angle_deg: int, slabs: int, changes: dict[str, float]) -> None:
        aside = 1.5 * np.tan(np.radians(angle_deg))
        loss = loss_db(partial, (3.0, 2.97 - aside, 1.5), (6.0, 2.97 + aside, 1.5), **changes)
        assert loss == pytest.approx(slabs * slab_loss_db(np.cos(np.radians(angle_deg))), abs=0.02)

    @pytest.mark.parametrize(
        ("solids", "slabs", "changes"),
        [
            ([WALL], 1, {}),
            ([WALL], 2, {"wall_depth_m": 0.0}),
            ([trimesh.Trimesh(WALL.vertices, WALL.faces[:, ::-1], process=False)], 1, {}),
            ([box((4, 0, 0), (5, 6, 3))], 2, {}),
            ([WALL, BEHIND], 2, {}),
            ([sheet(4.2)], 1, {}),
            ([sheet(4.2), sheet(4.6)], 2, {}),
            ([sheet(4.2), sheet(4.6), None], 1, {}),
        ],
        ids=["body", "slabs", "inside out", "deep body", "two bodies", "sheet", "sheets", "nothing free between"],
    )
    def test_of_a_mesh(self, solids: list[trimesh.Trimesh | None], slabs: int, changes: dict[str, float]) -> None:
        """A closed body is one wall, and so are faces without a free cell between; None hides what is between them."""
        partial, expected_db = field(*solids), slabs * slab_loss_db(3.0 / np.hypot(3.0, 0.44))
        ends = (3.0, 2.97, 1.5), (6.0, 3.41, 1.5)
        for tx, rx in (ends, ends[::-1]):
            assert loss_db(partial, tx, rx, **changes) == pytest.approx(expected_db, abs=0.02)

    @pytest.mark.parametrize("kind", ["plan", "mesh"])
    def test_more_walls_than_allowed(self, kind: str) -> None:
        partial = two_walls() if kind == "plan" else field(WALL, BEHIND)
        settings, ends = replace(STRAIGHT, max_walls=1), ((2.5, 2.97, 1.5), [(6.5, 2.97, 1.5)])
        links = sp.trace_links(partial, *ends, trace_settings=settings, scene_settings=LONELY)
        assert links.link_state.tolist() == [sp.LinkState.OUTAGE]


def rooms() -> sp.PartialMap:
    """Three rooms next to each other, with a door in one of the walls between them, a pillar and a tilted wall."""
    state = np.zeros((50, 90), dtype=np.uint8)
    state[[0, -1]], state[:, [0, -1]] = 1, 1
    state[:30, 30:32], state[:, 60] = 1, 1
    state[20:24, 12:16] = 1
    state[np.arange(5, 25), np.arange(70, 80).repeat(2)] = 1
    return sp.PartialMap(state, 0.1, (-2.0, 3.0))


TX = np.array([-0.52, 4.13, 1.5])
RX = np.array([[2.51, 7.23, 1.3], [5.3, 6.04, 1.5], [1.93, 3.81, 1.7], [6.6, 3.92, 1.5], [0.61, 7.7, 1.1]])
EVERY = sp.TraceSettings(
    frequency_hz=5e9, max_depth=4, max_walls=4, power_tolerance_db=0.0, wall_depth_m=0.0, diffraction=False
)


def of_several_materials() -> sp.PartialMap:
    """The rooms, with a wall of glass, one of concrete, and half of an outer wall of metal."""
    partial = rooms().with_wall_material("glass", [(0.9, 2.0), (1.3, 2.0), (1.3, 6.1), (0.9, 6.1)])
    partial = partial.with_wall_material("concrete", [(3.9, 3.1), (4.2, 3.1), (4.2, 7.9), (3.9, 7.9)])
    return partial.with_wall_material("metal", [(-2.0, 2.9), (2.03, 2.9), (2.03, 3.1), (-2.0, 3.1)])


@functools.cache
def meshed() -> sp.PartialMap:
    """The rooms as a mesh: the scene of the plan, without its map."""
    with temporary_folder() as folder:
        scene = sp.export_scene(rooms(), folder / "scene", sp.SceneSettings(material=BRICK))
        (scene / "map.yaml").unlink()
        return sp.load_map(scene / "scene.xml")


def flat() -> sp.PartialMap:
    """Four rooms in a row, with walls of 20 cm."""
    cells = np.zeros((34, 98), dtype=np.uint8)
    cells[[0, 1, -2, -1]] = cells[:, [0, 1, 24, 25, 48, 49, 72, 73, -2, -1]] = sp.CellState.WALL
    return sp.PartialMap(cells, resolution_m=0.1)


FLATS = flat, lambda: mesh_of(flat())


def test_reciprocity() -> None:
    settings, partial = replace(EVERY, wall_depth_m=0.6, max_depth=3), of_several_materials()
    there = sp.trace_links(partial, TX, RX, trace_settings=settings)
    back = [sp.trace_links(partial, rx, [TX], trace_settings=settings).gain_db[0] for rx in RX]
    np.testing.assert_allclose(there.gain_db, back, atol=0.02)


@pytest.mark.parametrize("partial", [rooms, meshed])
def test_opaque_paths_stay(partial: Callable[[], sp.PartialMap]) -> None:
    """Those without walls are the same, to the byte, and those with walls have refractions."""
    settings = replace(EVERY, diffraction=None, max_depth=3)
    opaque, leaky = (
        sp.trace_links(partial(), TX, RX, trace_settings=replace(settings, refraction=on)) for on in (False, True)
    )
    through = (leaky.interactions == REFRACTION).any(axis=1)
    assert through.any()
    assert np.sort(leaky.a[~through]).tobytes() == np.sort(opaque.a).tobytes()
    assert (leaky.interactions == REFRACTION).sum(axis=1).max() <= EVERY.max_walls


@pytest.mark.parametrize(
    ("partials", "tx", "rx"),
    [
        ((rooms, meshed), TX, RX),
        (FLATS, (1.0, 1.0, 1.5), [(8.38, 2.83, 1.4), (8.54, 1.0, 1.4), (6.23, 2.54, 1.4)]),
        (FLATS, (2.68, 1.7, 1.4), [(5.03, 1.75, 1.4), (6.2, 1.68, 1.4)]),
    ],
    ids=["rooms", "reflections at corners of crossed walls", "reflections at a wall beside the transmitter"],
)
def test_plans_and_meshes_agree(partials, tx, rx) -> None:
    settings = replace(EVERY, wall_depth_m=0.6)
    plan, mesh = (
        sp.trace_links(partial(), tx, rx, trace_settings=settings, scene_settings=sp.SceneSettings(material=BRICK))
        for partial in partials
    )
    np.testing.assert_allclose(mesh.gain_db, plan.gain_db, atol=0.05)
    assert mesh.to_dataframe("paths")["walls"].max() >= 2


def test_on_by_default_below_24_ghz() -> None:
    for frequency_hz, through in ((23.9e9, True), (24e9, False)):
        for partial in (rooms(), meshed()):
            resolved = sp.Simulation(partial, sp.TraceSettings(frequency_hz)).resolved
            assert resolved.trace_settings.refraction is through
    assert sp.TraceSettings(5e9, refraction=False).through_walls is False


@pytest.mark.skipif(not BOWLUS.is_file(), reason="the home is not here")
def test_one_direct_path_a_link() -> None:
    """Paths over an edge that have a leg of 1 cm are none, and not direct ones."""
    home = sp.load_map(BOWLUS)
    column, row = np.random.default_rng(3).permutation(np.argwhere(home.state == 0)[:, ::-1])[:400].T
    points_m = np.column_stack([home.origin_m[0] + (column + 0.5) * 0.05, home.origin_m[1] + (row + 0.5) * 0.05])
    points_m = np.column_stack([points_m, np.full(len(points_m), 1.5)])
    points_m = points_m[home.radios_can_stand(points_m)]
    settings = sp.TraceSettings(2.4e9, power_tolerance_db=0.01)
    links = sp.trace_links(home, points_m[0], points_m[1:], trace_settings=settings)
    direct = ~(links.interactions > 0).any(axis=1)
    assert np.bincount(links.path_rx[direct]).max() == 1


@pytest.mark.skipif(not BLEFLAT.is_file(), reason="the measured flat is not here")
def test_beams_at_the_corner_of_three_walls_end() -> None:
    """Two walls that touch there each let a sliver of a beam back to the other, for ever, where rounding has it so."""
    flat = sp.load_map(BLEFLAT)
    cells = np.argwhere(flat.state == 0)[:, ::-1]
    rx = np.column_stack([np.add(flat.origin_m, (cells + 0.5) * flat.resolution_m), np.full(len(cells), 1.3)])
    simulation = sp.Simulation(flat, sp.TraceSettings(2.44e9), sp.SceneSettings(material="drywall"))
    simulation.links((0.6250000000000001, 0.32500000000000007, 1.3), rx[clear_of_walls(flat, rx)][5::100])
