"""The parts of a Mitsuba scene as files have them: shapes, meshes, and materials that Sionna RT loads."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sionna_partial.llvm import load_llvm
from sionna_partial.settings import ITU_BANDS_GHZ, Material

SIONNA_LOAD_GHZ = 3.5
"""Frequency at which Sionna RT evaluates the materials of a scene while it loads it [GHz]."""


def write_ply(path: Path, vertices_m: NDArray[np.float64], triangles: NDArray[np.integer]) -> None:
    """Write a mesh with all digits of its vertices (trimesh would round them to float32)."""
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, triangles
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices_m)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
    path.write_bytes("\n".join(lines).encode() + vertices_m.astype("<f8").tobytes() + faces.tobytes())


def add_shape(scene: ET.Element, name: str, material: str) -> None:
    """Add the shape of `meshes/NAME.ply` to a scene, of a material that it has."""
    shape = ET.SubElement(scene, "shape", type="ply", id=name)
    ET.SubElement(shape, "string", name="filename", value=f"meshes/{name}.ply")
    ET.SubElement(shape, "boolean", name="face_normals", value="true")
    ET.SubElement(shape, "ref", name="bsdf", id=material)


def write_xml(scene: ET.Element, folder: Path) -> Path:
    """Write `scene.xml` into a folder, and return its path."""
    ET.indent(scene)
    path = folder / "scene.xml"
    ET.ElementTree(scene).write(path, encoding="utf-8")
    return path


def _loads_by_name(itu: str) -> bool:
    """Whether Sionna RT loads an ITU material by its name (2.2.0 has no display colour for vacuum, and fails)."""
    return itu != "vacuum" and any(low <= SIONNA_LOAD_GHZ <= high for low, high in ITU_BANDS_GHZ[itu])


def add_material(scene: ET.Element, name: str, material: Material, frequency_hz: float) -> None:
    """Add a material to a scene: an ITU one by its name where Sionna RT can load it so, any other by its constants."""
    if material.itu is not None and _loads_by_name(material.itu):
        bsdf = ET.SubElement(scene, "bsdf", type="itu-radio-material", id=name)
        ET.SubElement(bsdf, "string", name="type", value=material.itu)
    else:
        permittivity, conductivity = material.relative_permittivity, material.conductivity_s_m
        if material.itu is not None:
            permittivity, conductivity = itu_constants(material.itu, frequency_hz)
        bsdf = ET.SubElement(scene, "bsdf", type="radio-material", id=name)
        ET.SubElement(bsdf, "float", name="relative_permittivity", value=repr(float(permittivity)))
        ET.SubElement(bsdf, "float", name="conductivity", value=repr(float(conductivity)))
    ET.SubElement(bsdf, "float", name="thickness", value=repr(float(material.thickness_m)))


def itu_constants(name: str, frequency_hz: float) -> tuple[float, float]:
    """Return relative permittivity and conductivity [S/m] of an ITU material (ITU-R P.2040-3, eq. 28 and 29)."""
    load_llvm()
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    frequency_ghz = frequency_hz / 1e9
    bands = ITU_MATERIALS_PROPERTIES[name].items()
    a, b, c, d = next(factors for (low, high), factors in bands if low <= frequency_ghz <= high)
    return a * frequency_ghz**b, c * frequency_ghz**d
