"""Meshes read through trimesh: every format, and files that are damaged, empty or hostile."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from meshes import room, surface_m2

from sionna_partial.errors import MapError
from sionna_partial.maps.environment import MapWarning
from sionna_partial.maps.mesh.files import confined_path, read_mesh

FORMATS = ("ply", "glb", "gltf", "obj", "stl")
PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0
1 0 {z}
1 1 0
0 1 0
3 0 1 2
3 0 2 {last}
"""


TO_Y_UP = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]


def written(folder: Path, suffix: str, scene: trimesh.Scene | None = None) -> Path:
    scene = scene or room()
    if suffix in ("glb", "gltf"):
        scene.apply_transform(TO_Y_UP)
    path = folder / f"room.{suffix}"
    if suffix == "gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(scene).items():
            (folder / name).write_bytes(content)
        return (folder / "model.gltf").rename(path)
    (scene if suffix in ("glb", "obj") else scene.to_mesh()).export(path)
    return path


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_gives_the_room(tmp_path: Path, suffix: str) -> None:
    mesh = read_mesh(written(tmp_path, suffix))
    assert (len(mesh.triangles), len(mesh.vertices_m)) == (24, 16)
    np.testing.assert_allclose(mesh.bounds_m, [[0, 0, 0], [5, 4, 3]], atol=1e-6)
    assert surface_m2(mesh) == pytest.approx(2 * (20 + 15 + 12) + 2 * (9 + 0.3 + 0.3), rel=1e-6)
    assert mesh.materials == (None,)


def test_nodes_are_placed_by_their_transforms(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1))
    for shift in (0.0, 10.0):
        moved = trimesh.transformations.translation_matrix((shift, 0, 0)) @ turn
        scene.add_geometry(trimesh.creation.box((2, 6, 3)), geom_name="box", transform=moved)
    scene.export(tmp_path / "boxes.glb")
    mesh = read_mesh(tmp_path / "boxes.glb", "z")
    assert len(mesh.triangles) == 24
    np.testing.assert_allclose(mesh.bounds_m, [[-3, -1, -1.5], [13, 1, 1.5]], atol=1e-6)


def test_projective_nodes(tmp_path: Path) -> None:
    path = written(tmp_path, "gltf")
    sheet = json.loads(path.read_text())
    node = next(node for node in sheet["nodes"] if "mesh" in node)
    node["matrix"] = [1, 0, 0, 0.1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    path.write_text(json.dumps(sheet))
    with pytest.raises(MapError, match=r"is damaged or no GLTF mesh \(a transform is projective, with the last row"):
        read_mesh(path)


def test_far_meshes_keep_their_digits(tmp_path: Path) -> None:
    shift = (500_000.123456789, 4_500_000.7, 0.0)
    scene = room()
    scene.apply_translation(shift)
    mesh = read_mesh(written(tmp_path, "obj", scene))
    np.testing.assert_allclose(mesh.bounds_m[0], shift, atol=1e-7, rtol=0)


@pytest.mark.parametrize(
    ("suffix", "up", "message"),
    [
        ("ply", "y", 'looks as if y pointed up: give up="y" to turn it, or up="z" to read it'),
        ("glb", "z", 'looks as if z pointed up, against the specification of glTF: give up="z" to turn it'),
    ],
)
def test_other_axis_up(tmp_path: Path, suffix: str, up: str, message: str) -> None:
    lying = room()
    lying.apply_transform(TO_Y_UP if up == "y" else np.linalg.inv(TO_Y_UP))
    path = written(tmp_path, suffix, lying)
    with pytest.warns(MapWarning, match=message):
        read_mesh(path)
    np.testing.assert_allclose(read_mesh(path, up).bounds_m, [[0, 0, 0], [5, 4, 3]], atol=1e-6)


ROOMS = {"corridor": (20, 2, 2.6), "cellar": (8, 6, 2.1), "flat": (9, 6, 2.7), "hall": (12, 8, 9)}


@pytest.mark.parametrize("name", ROOMS)
def test_rooms_of_both_axes(name: str) -> None:
    """By its specification, y of glTF points up; a hall may be higher than wide."""
    for file in (f"{name}.glb", f"{name}_zup.ply"):
        mesh = read_mesh(Path(__file__).parent / "reports" / "gltf_up" / file)
        np.testing.assert_allclose(np.ptp(mesh.bounds_m, axis=0), ROOMS[name], atol=1e-6)


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("content", [b"", b"rubbish" * 50])
def test_no_mesh(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"room.{suffix}"
    path.write_bytes(content)
    message = rf"room.{suffix}' (is damaged or no {suffix.upper()} mesh|holds 0 triangles|holds deg)"
    with pytest.raises(MapError, match=message):
        read_mesh(path)


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_every_truncation(tmp_path: Path, suffix: str) -> None:
    content = written(tmp_path, suffix).read_bytes()
    for size in range(0, len(content) - 1, 293):
        path = tmp_path / f"short.{suffix}"
        path.write_bytes(content[:size])
        with pytest.raises(MapError, match="short"):
            read_mesh(path)


@pytest.mark.parametrize(
    ("z", "last", "message"),
    [
        ("nan", 3, r"vertices_m\[1\] = \(nan, nan, nan\) is not allowed: give finite numbers of metres"),
        ("0", 4, r"has a triangle with vertex 4, but 4 vertices: export the mesh again"),
    ],
)
def test_wrong_vertices(tmp_path: Path, z: str, last: int, message: str) -> None:
    path = tmp_path / "room.ply"
    path.write_text(PLY.format(z=z, last=last))
    with pytest.raises(MapError, match=rf"path = '{re.escape(str(path))}'.*{message}"):
        read_mesh(path)


@pytest.mark.parametrize(
    ("suffix", "old", "new", "message"),
    [
        ("ply", "3 0 2 3\n", "", "it announces 6 vertices, faces and others, and has 5"),
        ("ply", "3 0 2 3\n", "2 0 2\n", "it announces 2 faces, and has 1"),
        ("stl", "endsolid", "", "it ends before its endsolid"),
    ],
)
def test_cut_text(tmp_path: Path, suffix: str, old: str, new: str, message: str) -> None:
    path = tmp_path / f"room.{suffix}"
    path.write_text(PLY.format(z=0, last=3))
    if suffix == "stl":
        path.write_text(trimesh.exchange.stl.export_stl_ascii(room().to_mesh()))
        read_mesh(path)
    path.write_text(path.read_text()[::-1].replace(old[::-1], new[::-1], 1)[::-1])
    with pytest.raises(MapError, match=rf"room\.{suffix}' is damaged or no .* mesh \({message}\): export it again"):
        read_mesh(path)


def test_no_surface_and_too_many(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "points.ply")
    with pytest.raises(MapError, match="holds 0 triangles: give a mesh with surfaces, not points or lines alone"):
        read_mesh(tmp_path / "points.ply")
    (tmp_path / "room.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    with pytest.raises(MapError, match=r"room.obj' holds degenerate triangles alone: give a mesh with surfaces, in"):
        read_mesh(tmp_path / "room.obj")
    monkeypatch.setattr("sionna_partial.maps.mesh.files.MAX_TRIANGLES", 23)
    with pytest.raises(MapError, match="holds 24 triangles, more than 23: cut or simplify it"):
        read_mesh(written(tmp_path, "ply"))


@pytest.mark.parametrize("outside", ["../secret.bin", "/etc/passwd", "https://host/a.bin"])
def test_gltf_reads_nothing_outside_its_folder(tmp_path: Path, outside: str) -> None:
    folder = tmp_path / "mesh"
    folder.mkdir()
    path = written(folder, "gltf")
    sheet = json.loads(path.read_text())
    (tmp_path / "secret.bin").write_bytes((folder / sheet["buffers"][0]["uri"]).read_bytes())
    sheet["buffers"][0]["uri"] = outside
    path.write_text(json.dumps(sheet))
    with pytest.raises(MapError, match=rf"room.gltf' asks for the file '{outside}', which is not (allowed|there)"):
        read_mesh(path)


def test_confined_path(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text("")
    (tmp_path / "sub").mkdir()
    assert confined_path(tmp_path, "a.ply", "it has") == tmp_path / "a.ply"
    with pytest.raises(MapError, match=r"it has 'b.ply', which is not there: put it into '.*', or correct the name"):
        confined_path(tmp_path, "b.ply", "it has")
    (tmp_path / "sub" / "link.ply").symlink_to(tmp_path / "a.ply")
    for name in ("../a.ply", str(tmp_path / "a.ply"), "", "a\0b", "link.ply"):
        with pytest.raises(MapError, match=r"it has .*, which is not allowed: put it into '.*' and give its relative"):
            confined_path(tmp_path / "sub", name, "it has")
