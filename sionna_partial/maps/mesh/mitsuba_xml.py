"""Mitsuba scene files: their shapes and radio materials, read without Mitsuba."""

import math
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import defusedxml.ElementTree
import numpy as np
from numpy.typing import NDArray

from sionna_partial.errors import MapError, SettingsError
from sionna_partial.maps.mesh.files import checked_mesh, confined_path, read_triangles
from sionna_partial.maps.mesh.mesh import SceneMesh, material_records, materials_of_records
from sionna_partial.maps.ros_map import MapWarning
from sionna_partial.settings import Material

MAX_XML_BYTES = 100_000_000
"""Largest scene file that is read [bytes]."""

DEFAULT_THICKNESS_M = 0.1
"""Thickness of a radio material where none is given [m] (Sionna RT)."""

SHAPE_TYPES = ("ply", "obj", "rectangle", "cube")
"""Types of shapes that are read."""

_CORNERS = np.array([[x, y, z] for z in (-1.0, 1.0) for y in (-1.0, 1.0) for x in (-1.0, 1.0)])
_SIDES = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
_SHAPES: dict[str, tuple[NDArray[np.float64], NDArray[np.int64]]] = {
    "rectangle": (_CORNERS[[0, 1, 3, 2]] * (1.0, 1.0, 0.0), np.array([[0, 1, 2], [0, 2, 3]])),
    "cube": (_CORNERS, _SIDES[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)),
}
"""Corners and triangles of the shapes that need no file, as Mitsuba has them."""


@dataclass(frozen=True)
class _Part:
    """A shape of a scene, in the axes of the scene."""

    name: str
    vertices_m: NDArray[np.float64]
    triangles: NDArray[np.int64]
    material: Material | None


def read_mitsuba_scene(path: Path) -> SceneMesh:
    """Read the meshes of a Mitsuba scene file with their radio materials.

    Shapes of the types in `SHAPE_TYPES` are read, with their `to_world`. Materials are those that Sionna RT takes
    (`radio-material`, `itu-radio-material`, and names such as `mat-itu_concrete`); any other is None, with a warning.

    Parameters
    ----------
    path : pathlib.Path
        The .xml file. Its meshes lie in its folder or below.

    Returns
    -------
    SceneMesh
        In the axes of the scene, with z up.

    Raises
    ------
    MapError
        If the file is damaged, or asks for other files than meshes in its folder.
    """
    parts = _read_parts(path)
    materials = tuple(dict.fromkeys(part.material for part in parts))
    return _joined(path, parts, [materials.index(part.material) for part in parts], materials)


def exported_record(mesh: SceneMesh) -> dict[str, object]:
    """Say in `map.yaml` of an exported scene what `scene.xml` does not hold of its mesh.

    Parameters
    ----------
    mesh : SceneMesh

    Returns
    -------
    dict
        For `read_exported_mesh`.
    """
    return {"height_range": [*(mesh.height_range_m or ())], "materials": material_records(mesh)}


def read_exported_mesh(folder: Path, sheet: Mapping[str, Any]) -> SceneMesh:
    """Read the mesh of an exported scene.

    Parameters
    ----------
    folder : pathlib.Path
        The scene folder.
    sheet : mapping
        Its `map.yaml`.

    Returns
    -------
    SceneMesh
        That which was exported.

    Raises
    ------
    MapError
        If the scene is damaged.
    """
    path = folder / "scene.xml"
    record, offset_m = sheet["mesh"], sheet.get("scene_offset")
    try:
        materials = materials_of_records(record["materials"])
        low, high = (float(value) for value in record["height_range"])
        shift = np.array(offset_m, dtype=np.float64).reshape(3)
    except (KeyError, TypeError, ValueError) as error:
        raise MapError(
            f"path = '{folder / 'map.yaml'}' has a damaged mesh entry ({error}): export it again."
        ) from error
    parts = _read_parts(path, known={f"part{index}" for index in range(len(materials))})
    if not parts:
        nothing = np.zeros((0, 3))
        return SceneMesh(nothing, nothing.astype(int), np.zeros(0, dtype=np.uint8), materials, (low, high))
    placed = [replace(part, vertices_m=part.vertices_m + shift) for part in parts]
    index = [int(part.name.removeprefix("part")) for part in parts]
    return replace(_joined(path, placed, index, materials), height_range_m=(low, high))


def _joined(path: Path, parts: list[_Part], index: Iterable[int], materials: tuple[Material | None, ...]) -> SceneMesh:
    starts = np.cumsum([0, *(len(part.vertices_m) for part in parts)])
    triangles = np.concatenate([part.triangles + start for part, start in zip(parts, starts, strict=False)])
    material = np.repeat([*index], [len(part.triangles) for part in parts])
    return checked_mesh(path, np.concatenate([part.vertices_m for part in parts]), triangles, material, materials)


def _read_parts(path: Path, known: set[str] | None = None) -> list[_Part]:
    """Read all shapes. Those of an exported scene have the `known` names, and need no material."""
    root = _read_xml(path)
    for tag in ("include", "path"):
        if root.find(f".//{tag}") is not None:
            raise MapError(f"path = '{path}' has an <{tag}>, which is not followed: put everything into one file.")
    shapes = root.findall("./shape")
    others = sorted({str(shape.get("type")) for shape in shapes} - {*SHAPE_TYPES})
    if others:
        raise MapError(
            f"path = '{path}' has shapes of type {', '.join(others)}: give {', '.join(SHAPE_TYPES)}; "
            "Mitsuba writes other meshes as PLY (mesh.write_ply)."
        )
    if known is not None:
        wrong = [name for name in (_name(shape) for shape in shapes) if name not in known]
        if wrong:
            raise MapError(f"path = '{path}' has a shape {wrong[0]!r} that was not exported: export the scene again.")
        return [_part(path, shape, None) for shape in shapes]
    if not shapes:
        raise MapError(f"path = '{path}' holds no shape: give a Mitsuba scene with meshes.")
    materials = {bsdf.get("id"): _material(path, bsdf) for bsdf in root.findall("./bsdf")}
    return [_part(path, shape, _material_of(path, shape, materials)) for shape in shapes]


def _read_xml(path: Path) -> ET.Element:
    """Parse a scene file; a document type, which entities need, is refused."""
    try:
        with path.open("rb") as stream:
            content = stream.read(MAX_XML_BYTES + 1)
    except OSError as error:
        raise MapError(f"path = '{path}' cannot be read ({error.strerror}): check the path.") from error
    if len(content) > MAX_XML_BYTES:
        raise MapError(f"path = '{path}' has more than {MAX_XML_BYTES:,} bytes: split the scene.")
    try:
        root: ET.Element = defusedxml.ElementTree.fromstring(content, forbid_dtd=True)
    except defusedxml.DefusedXmlException as error:
        raise MapError(f"path = '{path}' has a DOCTYPE, which is not followed: remove it from the file.") from error
    except (ET.ParseError, LookupError, ValueError) as error:
        raise MapError(f"path = '{path}' is not valid XML ({error}): give a Mitsuba scene file.") from error
    if root.tag != "scene":
        raise MapError(f"path = '{path}' has the root <{root.tag}>: give a Mitsuba scene file, with <scene>.")
    return root


def _name(element: ET.Element) -> str:
    return element.get("id") or element.get("name") or element.get("type") or element.tag


def _property(element: ET.Element, name: str) -> str | None:
    for child in element:
        if child.get("name") == name and child.get("value") is not None:
            return child.get("value")
    return None


def _part(path: Path, shape: ET.Element, material: Material | None) -> _Part:
    kind = str(shape.get("type"))
    if kind in _SHAPES:
        vertices, triangles = _SHAPES[kind]
    else:
        file = _property(shape, "filename") or ""
        what = f"path = '{path}': shape {_name(shape)!r} has the filename"
        vertices, triangles = read_triangles(confined_path(path.parent, file, what), kind)
    transform = _transform(path, shape)
    return _Part(_name(shape), vertices @ transform[:3, :3].T + transform[:3, 3], triangles, material)


def _transform(path: Path, shape: ET.Element) -> NDArray[np.float64]:
    """Matrix (4, 4) of a shape's to_world: each step acts on the outcome of those before it."""
    matrix = np.eye(4)
    for step in (step for node in shape.findall("transform") if node.get("name") == "to_world" for step in node):
        try:
            matrix = _step(step) @ matrix
        except (KeyError, ValueError) as error:
            raise MapError(
                f"path = '{path}': shape {_name(shape)!r} has a to_world with <{step.tag} {step.attrib}>, which cannot "
                "be read: give matrix, translate, scale or rotate."
            ) from error
    return matrix


def _step(step: ET.Element) -> NDArray[np.float64]:
    matrix = np.eye(4)
    if step.tag == "matrix":
        values = _numbers(step.attrib["value"])
        return values.reshape(4, 4)
    if step.tag == "translate":
        matrix[:3, 3] = _vector(step, 0.0)
    elif step.tag == "scale":
        matrix[:3, :3] = np.diag(_vector(step, 1.0))
    elif step.tag == "rotate":
        matrix[:3, :3] = _rotation(_vector(step, 0.0), math.radians(float(step.attrib["angle"])))
    else:
        raise ValueError(step.tag)
    return matrix


def _numbers(text: str) -> NDArray[np.float64]:
    return np.array([float(word) for word in text.replace(",", " ").split()])


def _vector(step: ET.Element, missing: float) -> NDArray[np.float64]:
    if "value" in step.attrib:
        return np.array(np.broadcast_to(_numbers(step.attrib["value"]), 3))
    return np.array([float(step.get(axis, missing)) for axis in "xyz"])


def _rotation(axis: NDArray[np.float64], angle_rad: float) -> NDArray[np.float64]:
    """Rotation (3, 3) about an axis (Rodrigues)."""
    length = float(np.linalg.norm(axis))
    if not length > 0.0:
        raise ValueError("no axis")
    x, y, z = axis / length
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: NDArray[np.float64] = np.eye(3) + math.sin(angle_rad) * across + (1 - math.cos(angle_rad)) * across @ across
    return turned


def _material_of(path: Path, shape: ET.Element, materials: Mapping[str | None, Material | None]) -> Material | None:
    for bsdf in shape.findall("bsdf"):
        return _material(path, bsdf)
    for ref in shape.findall("ref"):
        if ref.get("id") not in materials:
            raise MapError(
                f"path = '{path}': shape {_name(shape)!r} refers to {ref.get('id')!r}, which is no bsdf of the scene: "
                "add it, or correct the id."
            )
        return materials[ref.get("id")]
    _warn(path, f"shape {_name(shape)!r} has no bsdf")
    return None


def _material(path: Path, bsdf: ET.Element) -> Material | None:
    """Radio material of a bsdf, as Sionna RT understands it (scene_utils.process_xml)."""
    name = str(bsdf.get("id", "")).removeprefix("mat-")
    kind, itu = bsdf.get("type"), _property(bsdf, "type")
    if name.startswith(("itu_", "itu-")):
        kind, itu = "itu-radio-material", itu or name[4:]
    try:
        thickness_m = float(_property(bsdf, "thickness") or DEFAULT_THICKNESS_M)
        if kind == "itu-radio-material":
            return Material(itu=itu or "", thickness_m=thickness_m)
        if kind == "radio-material":
            permittivity = float(_property(bsdf, "relative_permittivity") or 1.0)
            return Material(permittivity, float(_property(bsdf, "conductivity") or 0.0), thickness_m)
    except (SettingsError, ValueError) as error:
        raise MapError(f"path = '{path}': bsdf {_name(bsdf)!r} is no radio material ({error}): correct it.") from error
    _warn(path, f"bsdf {_name(bsdf)!r} of type {bsdf.get('type')!r} is no radio material")
    return None


def _warn(path: Path, what: str) -> None:
    message = f"path = '{path}': {what}; the material of SceneSettings takes its place."
    warnings.warn(message, MapWarning, stacklevel=2)
