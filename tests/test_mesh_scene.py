"""Mitsuba scene files: Sionna's own, ours, those of others, and hostile ones."""

import re
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from meshes import box, surface_m2

from sionna_partial.errors import MapError
from sionna_partial.maps.environment import MapWarning
from sionna_partial.maps.mesh.files import read_exported_mesh, read_mitsuba_scene
from sionna_partial.settings import Material

SCENES = Path(sysconfig.get_paths()["purelib"]) / "sionna" / "rt" / "scenes"
RADIO = '<bsdf type="itu-radio-material" id="wall"><string name="type" value="concrete"/></bsdf>'
CONCRETE = Material(itu="concrete")


def scene(folder: Path, content: str) -> Path:
    (folder / "meshes").mkdir(exist_ok=True)
    box((0, 0, 0), (5, 4, 3)).export(folder / "meshes" / "box.ply")
    path = folder / "any.xml"
    path.write_text(f"<scene version='2.1.0'>{content}</scene>")
    return path


def shape(kind: str, inside: str = "", bsdf: str = '<ref id="wall"/>') -> str:
    file = '<string name="filename" value="meshes/box.ply"/>' if kind == "ply" else ""
    return f'<shape type="{kind}" id="it">{file}{inside}{bsdf}</shape>'


def moved(*steps: str) -> str:
    return f'<transform name="to_world">{"".join(steps)}</transform>'


@pytest.mark.parametrize(
    ("name", "triangles", "materials"),
    [
        ("box", 12, {"metal"}),
        ("simple_street_canyon", 74, {"glass", "wood", "marble", "brick", "concrete"}),
    ],
)
def test_scenes_of_sionna(name: str, triangles: int, materials: set[str]) -> None:
    mesh = read_mitsuba_scene(SCENES / name / f"{name}.xml")
    assert len(mesh.triangles) == triangles
    assert {material.itu for material in mesh.materials if material} == materials


def test_shapes_share_vertices_and_keep_their_materials(tmp_path: Path) -> None:
    other = '<bsdf type="radio-material" id="door"><float name="conductivity" value="0.5"/></bsdf>'
    beside = shape("ply", moved('<translate x="5"/>'), '<ref id="door" name="bsdf"/>')
    mesh = read_mitsuba_scene(scene(tmp_path, RADIO + other + shape("ply") + beside))
    assert mesh.materials == (CONCRETE, Material(1.0, 0.5, 0.1))
    np.testing.assert_array_equal(mesh.material, np.repeat([0, 1], 12))
    assert len(mesh.vertices_m) == 12


@pytest.mark.parametrize(
    ("bsdf", "material"),
    [
        ('<bsdf type="diffuse" id="mat-itu_concrete"/>', CONCRETE),
        ('<bsdf type="twosided" id="itu_wood"><bsdf type="diffuse"/></bsdf>', Material(itu="wood")),
        (
            '<bsdf type="diffuse" id="itu-any"><string name="type" value="glass"/>'
            '<float name="thickness" value="0.02"/></bsdf>',
            Material(itu="glass", thickness_m=0.02),
        ),
        (
            '<bsdf type="radio-material" id="x"><float name="relative_permittivity" value="3"/>'
            '<float name="conductivity" value="0.1"/><float name="thickness" value="0.3"/></bsdf>',
            Material(3.0, 0.1, 0.3),
        ),
    ],
)
def test_materials(tmp_path: Path, bsdf: str, material: Material) -> None:
    nested = read_mitsuba_scene(scene(tmp_path, shape("ply", "", bsdf)))
    assert nested.materials == (material,)
    name = re.search('id="(.*?)"', bsdf)
    assert name
    referred = read_mitsuba_scene(scene(tmp_path, bsdf + shape("ply", "", f'<ref id="{name[1]}"/>')))
    assert referred == nested


def test_other_materials_are_those_of_the_settings(tmp_path: Path) -> None:
    paint = '<bsdf type="diffuse" id="paint"/>'
    with pytest.warns(MapWarning, match=r"bsdf 'paint' of type 'diffuse' is no radio material; the material of SceneS"):
        mesh = read_mitsuba_scene(scene(tmp_path, paint + shape("ply", "", '<ref id="paint"/>')))
    assert mesh.materials == (None,)
    with pytest.warns(MapWarning, match=r"shape 'it' has no bsdf; the material of SceneSettings takes its place"):
        read_mitsuba_scene(scene(tmp_path, shape("ply", "", "")))


@pytest.mark.parametrize(
    ("steps", "low", "high"),
    [
        ([], (0, 0, 0), (5, 4, 3)),
        (['<rotate z="2" angle="90"/>'], (-4, 0, 0), (0, 5, 3)),
        (['<rotate value="1 0 0" angle="90"/>'], (0, -3, 0), (5, 0, 4)),
        (['<translate x="1"/>', '<scale value="2"/>'], (2, 0, 0), (12, 8, 6)),
        (['<matrix value="0 -1 0 7  1 0 0 0  0 0 1 0  0 0 0 1"/>'], (3, 0, 0), (7, 5, 3)),
    ],
)
def test_to_world(tmp_path: Path, steps: list[str], low: tuple[float, ...], high: tuple[float, ...]) -> None:
    mesh = read_mitsuba_scene(scene(tmp_path, RADIO + shape("ply", moved(*steps))))
    np.testing.assert_allclose(mesh.bounds_m, [low, high], atol=1e-12)


def test_rectangle_and_cube(tmp_path: Path) -> None:
    cube = read_mitsuba_scene(scene(tmp_path, RADIO + shape("cube")))
    np.testing.assert_array_equal(cube.bounds_m, [[-1, -1, -1], [1, 1, 1]])
    assert (len(cube.triangles), surface_m2(cube)) == (12, 24.0)
    a, b, c = cube.corners_m.transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a) > 0).all()
    flat = read_mitsuba_scene(scene(tmp_path, RADIO + shape("rectangle")))
    np.testing.assert_array_equal(flat.bounds_m, [[-1, -1, 0], [1, 1, 0]])
    assert (len(flat.triangles), surface_m2(flat)) == (2, 4.0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "holds no shape: give a Mitsuba scene with meshes"),
        ('<include filename="/etc/passwd"/>' + shape("cube"), "has an <include>, which is not followed: put"),
        (shape("sphere") + shape("disk"), "has shapes of type disk, sphere: give ply, obj, rectangle, cube; Mitsuba"),
        (shape("cube"), "shape 'it' refers to 'wall', which is no bsdf of the scene: add it, or correct the id"),
        (RADIO.replace("concrete", "cheese") + shape("cube"), "bsdf 'wall' is no radio material (itu = 'cheese' is"),
        (RADIO + shape("cube", moved("<lookat/>")), "shape 'it' has a to_world with <lookat {}>, which cannot be read"),
        (RADIO + shape("cube", moved('<scale value="nan"/>')), "cannot be read (a transform is not finite): "),
        (RADIO + shape("cube", moved('<scale value="0"/>')), "which cannot be read (it flattens the shape): "),
        (
            RADIO + shape("cube", moved('<matrix value="1 0 0 0  0 1 0 0  0 0 1 0  0.1 0 0 1"/>')),
            "which cannot be read (a transform is projective, with the last row [0.1, 0.0, 0.0, 1.0]): give matrix",
        ),
    ],
)
def test_refused(tmp_path: Path, content: str, message: str) -> None:
    path = scene(tmp_path, content)
    with pytest.raises(MapError, match=rf"path = '{re.escape(str(path))}'.*{re.escape(message)}"):
        read_mitsuba_scene(path)


@pytest.mark.parametrize("file", ["/etc/passwd", "../box.ply", "gone.ply"])
def test_meshes_lie_in_the_folder(tmp_path: Path, file: str) -> None:
    folder = tmp_path / "scene"
    folder.mkdir()
    path = scene(folder, RADIO + shape("ply").replace("meshes/box.ply", file))
    (folder / "meshes" / "box.ply").rename(tmp_path / "box.ply")
    with pytest.raises(MapError, match=rf"shape 'it' has the filename '{file}', which is not (allowed|there): put it"):
        read_mitsuba_scene(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<scene>&boom;</scene>", "is not valid XML (undefined entity"),
        ("<svg/>", "has the root <svg>: give a Mitsuba scene file, with <scene>"),
        ('<!DOCTYPE scene [<!ENTITY a "aa">]><scene>&a;</scene>', "has a DOCTYPE, which is not followed: remove it"),
    ],
)
def test_no_scene(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(MapError, match=rf"a.xml' {re.escape(message)}"):
        read_mitsuba_scene(tmp_path / "a.xml")


def test_damaged_exported_meshes(tmp_path: Path) -> None:
    for record in (None, {"height_range": [0, 1], "materials": [{"itu": "cheese"}]}):
        with pytest.raises(MapError, match=r"map.yaml' has a damaged mesh entry \(.*\): export it again"):
            read_exported_mesh(tmp_path, record, [0, 0, 0])  # type: ignore[arg-type]
    scene(tmp_path, shape("cube")).rename(tmp_path / "scene.xml")
    with pytest.raises(MapError, match="has a shape 'it' that was not exported: export the scene again"):
        read_exported_mesh(tmp_path, {"height_range": [0, 1], "materials": [None]}, [0, 0, 0])
