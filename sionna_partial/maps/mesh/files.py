"""Scanned and modelled meshes: mesh files through trimesh, and Mitsuba scene files, read without Mitsuba.

Mitsuba would follow includes and paths out of the scene's folder, and abort on indices out of range. XML is parsed here
(defusedxml), and meshes are checked before Mitsuba reads them.
"""

import io
import json
import math
import os
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import defusedxml.ElementTree
import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.transformations import rotation_matrix, translation_matrix

from sionna_partial.arrays import Floats
from sionna_partial.errors import MapError, SettingsError
from sionna_partial.files import decoding, lies_in, read_bytes
from sionna_partial.maps.environment import ImportNotes, MapWarning
from sionna_partial.maps.mesh.scene_mesh import MAX_COORDINATE_M, MAX_MESH_BYTES, MAX_TRIANGLES, SceneMesh, merged_mesh
from sionna_partial.maps.mesh.upright import TURNS, levelling, looks_y_up, mesh_ends, surfaces_of, warn_of_axis
from sionna_partial.settings import Material

CUT = "cut or simplify the mesh."

MAX_XML_BYTES = 100_000_000

Y_UP_KINDS = ("glb", "gltf")
"""Formats whose y points up: glTF 2.0, section 3.4."""

DEFAULT_THICKNESS_M = 0.1
"""Default thickness of a radio material in Sionna RT [m]."""

SHAPE_TYPES = ("ply", "obj", "rectangle", "cube")

SHAPE_PROPERTIES = ("filename", "to_world", "face_normals", "flip_normals", "flip_tex_coords")
MATERIAL_PROPERTIES = (
    *("type", "thickness", "relative_permittivity", "conductivity", "scattering_coefficient", "xpd_coefficient"),
    *("scattering_pattern", "alpha_r", "alpha_i", "lambda_", "color"),
)
"""Properties of shapes and radio materials that are read or have no effect."""

_CORNERS = np.array([[x, y, z] for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
_SIDES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
_SHAPES = {
    "rectangle": (_CORNERS[[0, 1, 3, 2]] * (1.0, 1.0, 0.0), np.array([[0, 1, 2], [0, 2, 3]])),
    "cube": (_CORNERS, _SIDES[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)),
}
"""Corners and triangles of the shapes without a file, as in Mitsuba."""

Triangles = tuple[Floats, NDArray[np.int64]]
"""Vertices (V, 3) [m], and indices (F, 3) into them."""


class _Neighbours(trimesh.resolvers.FilePathResolver):  # type: ignore[misc]
    """Resolver that returns only buffers of a .gltf in its folder."""

    def get(self, name: str) -> bytes:
        path = confined_path(Path(self.parent), name, f"'{self.file_path}' asks for the file")
        return read_bytes(path, "path", MapError, MAX_MESH_BYTES, CUT)


def read_mesh(path: Path, up: str | None = None, notes: ImportNotes | None = None) -> SceneMesh:
    """Read a mesh file, without colours and textures; `up` as in `load_map`."""
    notes = notes or ImportNotes(path)
    kind = path.suffix.lower().removeprefix(".")
    vertices, triangles = _read_triangles(path, kind, notes)
    usual = "y" if kind in Y_UP_KINDS else "z"
    axis, what = up or usual, f"path = '{path}'"
    is_valid = bool((np.abs(vertices[triangles]) <= MAX_COORDINATE_M).all())  # others are refused below
    if up is None and is_valid:
        why = ", against the specification of glTF" if usual == "y" else ""
        warn_of_axis(what, _axis_up(vertices * notes.unit_m, triangles, usual), axis, why)
    vertices = vertices @ TURNS[axis].T
    if is_valid:
        corners = vertices[triangles]
        turn = levelling(what, surfaces_of(corners * notes.unit_m), notes)
        middle = (corners.min(axis=(0, 1), initial=np.inf) + corners.max(axis=(0, 1), initial=-np.inf)) / 2
        vertices = (vertices - middle) @ turn.T + middle if turn[2, 2] < 1.0 else vertices
    reason = "up" if up else "the specification of glTF" if axis == "y" else "the default"
    notes.notes.append(f"{axis} of the file points up ({reason})")
    return _joined(path, [(vertices, triangles)], [0], (None,), notes)


def confined_path(folder: Path, name: str, what: str) -> Path:
    """Return the path of a file named by another; a MapError (`what` ...) if it is not in the folder."""
    if not lies_in(folder, name):
        raise MapError(f"{what} {name!r}, which is not allowed: put it into '{folder}' and give its relative path.")
    if not (folder / name).is_file():
        raise MapError(f"{what} {name!r}, which is not there: put it into '{folder}', or correct the name.")
    return folder / name


def _read_triangles(path: Path, kind: str, notes: ImportNotes) -> Triangles:
    content = read_bytes(path, "path", MapError, MAX_MESH_BYTES, CUT)
    with decoding(path, f"no {kind.upper()} mesh", MapError):
        if kind == "gltf":
            json.loads(content)  # trimesh would look for another file
        stream, resolver = io.BytesIO(content), _Neighbours(os.fspath(path))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # damage ends in the error below
            scene = trimesh.load_scene(stream, file_type=kind, resolver=resolver, process=False, skip_materials=True)
            parts = [*_placed_parts(path, scene, notes)]
        _require_whole(kind, content, sum(len(triangles) for _, triangles in parts))
    if not any(len(triangles) for _, triangles in parts):
        raise MapError(f"path = '{path}' holds 0 triangles: give a mesh with surfaces, not points or lines alone.")
    vertices, triangles = _concatenated(parts)
    if len(triangles) > MAX_TRIANGLES:
        count = f"{len(triangles):,} triangles, more than {MAX_TRIANGLES:,}"
        raise MapError(f"path = '{path}' holds {count}: cut or simplify it.")
    return vertices, triangles


def _require_whole(kind: str, content: bytes, triangles: int) -> None:
    """Raise a ValueError if a file has another length than announced: trimesh would read a part."""
    is_text = kind == "stl" and content[:5].lower() == b"solid" and b"facet" in content[:1000]
    if is_text and not content.rstrip().splitlines()[-1].strip().startswith(b"endsolid"):
        raise ValueError("it ends before its endsolid")
    if kind != "ply":
        return
    header, _, body = content.partition(b"end_header")
    counts = {name: int(count) for name, count in re.findall(rb"^element\s+(\w+)\s+(\d+)", header, re.MULTILINE)}
    lines = sum(map(bool, map(bytes.strip, body.splitlines()))) if b"format ascii" in header else None
    if lines not in (None, sum(counts.values())):
        raise ValueError(f"it announces {sum(counts.values())} vertices, faces and others, and has {lines}")
    if triangles < counts.get(b"face", 0):
        raise ValueError(f"it announces {counts[b'face']} faces, and has {triangles}")


def _placed_parts(path: Path, scene: Any, notes: ImportNotes) -> Iterator[Triangles]:
    for node in scene.graph.nodes_geometry:
        transform, name = scene.graph[node]
        part = scene.geometry[name]
        if not isinstance(part, trimesh.Trimesh):
            notes.skip(type(part).__name__, 1, "no surface")
            continue
        vertices, triangles = np.asarray(part.vertices, dtype=np.float64), np.asarray(part.faces, dtype=np.int64)
        wrong = (triangles < 0) | (triangles >= len(vertices))
        if wrong.any():
            count = f"vertex {triangles[wrong][0]}, but {len(vertices)} vertices"
            raise MapError(f"path = '{path}' has a triangle with {count}: export the mesh again.")
        yield vertices @ _affine(transform)[:3, :3].T + transform[:3, 3], triangles


def _concatenated(parts: list[Triangles]) -> Triangles:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    triangles = [triangles + start for (_, triangles), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(triangles)


def _joined(
    path: Path, parts: list[Triangles], index: list[int], materials: tuple[Material | None, ...], notes: ImportNotes
) -> SceneMesh:
    material = np.repeat(index, [len(triangles) for _, triangles in parts])
    try:
        mesh = merged_mesh(*_concatenated(parts), material, materials)
    except MapError as error:
        raise MapError(f"path = '{path}': {error}") from error
    if not len(mesh.triangles):
        raise MapError(f"path = '{path}' holds degenerate triangles alone: give a mesh with surfaces, in metres.")
    notes.use("triangles", len(mesh.triangles))
    notes.skip("triangles", sum(len(triangles) for _, triangles in parts) - len(mesh.triangles), "degenerate")
    return mesh


def _axis_up(vertices_m: Floats, triangles: NDArray[np.int64], usual: str) -> str:
    corners = vertices_m[triangles]
    extent = corners.max(axis=(0, 1)) - corners.min(axis=(0, 1))
    area = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    facing = np.bincount(np.argmax(area, axis=1), weights=np.linalg.norm(area, axis=1), minlength=3)
    other = "z" if usual == "y" else "y"
    order = [0, 1, 2] if other == "y" else [0, 2, 1]
    axis = other if looks_y_up(extent[order], *facing[order[1:]]) else usual
    return f"-{axis}" if mesh_ends(corners @ TURNS[axis].T).upside_down else axis


def read_mitsuba_scene(path: Path, notes: ImportNotes | None = None) -> SceneMesh:
    """Read the meshes of a Mitsuba scene file, in its folder or below, with their radio materials.

    Materials are read as in Sionna RT (`radio-material`, `itu-radio-material`, and names such as `mat-itu_concrete`);
    any other is None, with a warning.
    """
    notes = notes or ImportNotes(path)
    root, shapes = _read_shapes(path, notes)
    if not shapes:
        raise MapError(f"path = '{path}' holds no shape: give a Mitsuba scene with meshes.")
    named = {bsdf.get("id"): _material(path, bsdf) for bsdf in root.findall("./bsdf")}
    used = [_material_of(path, element, named) for element, _ in shapes]
    materials = tuple(dict.fromkeys(used))
    return _joined(path, [triangles for _, triangles in shapes], [*map(materials.index, used)], materials, notes)


def read_exported_mesh(folder: Path, record: Mapping[str, Any], offset_m: object) -> SceneMesh:
    """Read the mesh of an exported scene from "mesh" (`record`) and "scene_offset" of its map.yaml.

    The shape `part0` has the triangles of the first material of the record, and so on.
    """
    path = folder / "scene.xml"
    try:
        materials = tuple(None if fields is None else Material(**fields) for fields in record["materials"])
        low, high = (float(value) for value in record["height_range"])
        shift = np.array(offset_m, dtype=np.float64).reshape(3)
    except (KeyError, TypeError, ValueError) as error:
        sheet = folder / "map.yaml"
        raise MapError(f"path = '{sheet}' has a damaged mesh entry ({error}): export it again.") from error
    notes = ImportNotes(path)
    _, shapes = _read_shapes(path, notes)
    names = [_name(element) for element, _ in shapes]
    index = {f"part{number}": number for number in range(len(materials))}
    for name in names:
        if name not in index:
            raise MapError(f"path = '{path}' has a shape {name!r} that was not exported: export the scene again.")
    if not shapes:
        return SceneMesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros(0, np.uint8), materials, (low, high))
    parts = [(vertices + shift, triangles) for _, (vertices, triangles) in shapes]
    mesh = _joined(path, parts, [index[name] for name in names], materials, notes)
    return replace(mesh, height_range_m=(low, high))


def _read_shapes(path: Path, notes: ImportNotes) -> tuple[ET.Element, list[tuple[ET.Element, Triangles]]]:
    """Read a scene file and its shapes, without DOCTYPE (entities) and references to other files."""
    content = read_bytes(path, "path", MapError, MAX_XML_BYTES, "split the scene.")
    try:
        root: ET.Element = defusedxml.ElementTree.fromstring(content, forbid_dtd=True)
    except defusedxml.DefusedXmlException as error:
        raise MapError(f"path = '{path}' has a DOCTYPE, which is not followed: remove it from the file.") from error
    except (ET.ParseError, LookupError, ValueError) as error:
        raise MapError(f"path = '{path}' is not valid XML ({error}): give a Mitsuba scene file.") from error
    if root.tag != "scene":
        raise MapError(f"path = '{path}' has the root <{root.tag}>: give a Mitsuba scene file, with <scene>.")
    for tag in ("include", "path"):
        if root.find(f".//{tag}") is not None:
            raise MapError(f"path = '{path}' has an <{tag}>, which is not followed: put everything into one file.")
    elements = root.findall("./shape")
    others = sorted({str(element.get("type")) for element in elements} - {*SHAPE_TYPES})
    if others:
        remedy = f"give {', '.join(SHAPE_TYPES)}; Mitsuba writes other meshes as PLY (mesh.write_ply)."
        raise MapError(f"path = '{path}' has shapes of type {', '.join(others)}: {remedy}")
    return root, [(element, _shape_triangles(path, element, notes)) for element in elements]


def _shape_triangles(path: Path, shape: ET.Element, notes: ImportNotes) -> Triangles:
    kind, matrix = str(shape.get("type")), np.eye(4)
    _require_known(path, shape, SHAPE_PROPERTIES)
    if kind in _SHAPES:
        vertices, triangles = _SHAPES[kind]
    else:
        what = f"path = '{path}': shape {_name(shape)!r} has the filename"
        file = confined_path(path.parent, _property(shape, "filename") or "", what)
        vertices, triangles = _read_triangles(file, kind, notes)
    for step in (step for node in shape.findall("transform[@name='to_world']") for step in node):
        try:
            one = _affine(_step(step))
            if np.linalg.matrix_rank(one[:3, :3]) < 3:
                raise ValueError("it flattens the shape")
        except (KeyError, ValueError) as error:
            what = f"shape {_name(shape)!r} has a to_world with <{step.tag} {step.attrib}>"
            remedy = "give matrix, translate, scale or rotate, finite, not 0 in scale, and with 0 0 0 1 as last row."
            raise MapError(f"path = '{path}': {what}, which cannot be read ({error}): {remedy}") from error
        matrix = one @ matrix
    return vertices @ matrix[:3, :3].T + matrix[:3, 3], triangles


def _affine(matrix: Floats) -> Floats:
    """Return a matrix (4, 4), or raise a ValueError if it is projective or not finite."""
    if not np.isfinite(matrix).all():
        raise ValueError("a transform is not finite")
    if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), rtol=0, atol=1e-9):
        raise ValueError(f"a transform is projective, with the last row {matrix[3].tolist()}")
    return matrix


def _step(step: ET.Element) -> Floats:
    if not {*step.attrib} <= {"value", "x", "y", "z", "angle"}:
        raise ValueError(step.attrib)
    value = np.array([float(word) for word in step.get("value", "").replace(",", " ").split()])
    if step.tag == "matrix":
        return value.reshape(4, 4)
    missing = 1.0 if step.tag == "scale" else 0.0
    vector = np.broadcast_to(value, 3) if "value" in step.attrib else [float(step.get(axis, missing)) for axis in "xyz"]
    if step.tag == "translate":
        return np.asarray(translation_matrix(vector))
    if step.tag == "scale":
        return np.diag([*vector, 1.0])
    if step.tag == "rotate" and np.any(vector):
        return np.asarray(rotation_matrix(math.radians(float(step.attrib["angle"])), vector))
    raise ValueError(step.tag)


def _name(element: ET.Element) -> str:
    return element.get("id") or element.get("name") or element.get("type") or element.tag


def _property(element: ET.Element, name: str) -> str | None:
    found = element.find(f"*[@name='{name}'][@value]")
    return None if found is None else found.get("value")


def _require_known(path: Path, element: ET.Element, names: Collection[str]) -> None:
    """Raise a MapError for a property that Mitsuba 3 and Sionna RT do not have, such as toWorld."""
    for part in element:
        if part.tag not in ("bsdf", "ref", "emitter") and part.get("name") not in names:
            what = f"<{element.tag}> {_name(element)!r} has the property {part.get('name')!r}, which is not read"
            raise MapError(f"path = '{path}': {what}: give the names of Mitsuba 3 ({', '.join(names)}).")


def _material_of(path: Path, shape: ET.Element, named: Mapping[str | None, Material | None]) -> Material | None:
    for bsdf in shape.findall("bsdf"):
        return _material(path, bsdf)
    for ref in shape.findall("ref"):
        if ref.get("id") not in named:
            what = f"shape {_name(shape)!r} refers to {ref.get('id')!r}, which is no bsdf of the scene"
            raise MapError(f"path = '{path}': {what}: add it, or correct the id.")
        return named[ref.get("id")]
    _warn(path, f"shape {_name(shape)!r} has no bsdf")
    return None


def _material(path: Path, bsdf: ET.Element) -> Material | None:
    """Return the radio material of a bsdf as Sionna RT reads it (scene_utils.process_xml)."""
    name = str(bsdf.get("id", "")).removeprefix("mat-")
    kind, itu = bsdf.get("type"), _property(bsdf, "type")
    if name.startswith(("itu_", "itu-")):
        kind, itu = "itu-radio-material", itu or name[4:]
    try:
        thickness_m = float(_property(bsdf, "thickness") or DEFAULT_THICKNESS_M)
        if kind == "itu-radio-material":
            _require_known(path, bsdf, MATERIAL_PROPERTIES)
            return Material(itu=itu or "", thickness_m=thickness_m)
        if kind == "radio-material":
            _require_known(path, bsdf, MATERIAL_PROPERTIES)
            permittivity = float(_property(bsdf, "relative_permittivity") or 1.0)
            return Material(permittivity, float(_property(bsdf, "conductivity") or 0.0), thickness_m)
    except (SettingsError, ValueError) as error:
        raise MapError(f"path = '{path}': bsdf {_name(bsdf)!r} is no radio material ({error}): correct it.") from error
    _warn(path, f"bsdf {_name(bsdf)!r} of type {bsdf.get('type')!r} is no radio material")
    return None


def _warn(path: Path, what: str) -> None:
    message = f"path = '{path}': {what}; the material of SceneSettings takes its place."
    warnings.warn(message, MapWarning, stacklevel=2)
