"""Floor plans as pictures, and corrections that are drawn on a map."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Any, TypeAlias

import shapely

from sionna_partial.apps.app.files import Project, stored_map
from sionna_partial.apps.app.jobs import logged_warnings
from sionna_partial.arrays import States
from sionna_partial.checks import require, require_choice, require_number
from sionna_partial.constants import DRAWING_SUFFIXES, IFC_SUFFIXES, PICTURE_SUFFIXES, WALL_THICKNESS_M, CellState
from sionna_partial.errors import MapError
from sionna_partial.files import decoding
from sionna_partial.maps.importers.pictures import read_picture, wall_shades
from sionna_partial.maps.map_files import load_map
from sionna_partial.maps.partial_map import PartialMap

LENGTH, WALL, FREE, BRUSH, AREA = "length", "wall", "free", "brush", "area"
STROKES = {
    LENGTH: "measures a known length",
    WALL: "adds a straight wall",
    FREE: "erases walls",
    BRUSH: "gives walls a material (brush)",
    AREA: "gives walls a material (polygon)",
}
"""Kinds of strokes on the map, and their effects."""

STRAIGHT, BRUSHES, PAINTS = (LENGTH, WALL), (FREE, BRUSH), (BRUSH, AREA)
"""Strokes that are lines from their first to their last point, have a width, and have a material."""

_MOST_POINTS = 100_000


@dataclass(frozen=True, eq=False)
class Plan:
    """A picture of a floor plan: shades (rows, columns), dark for walls, and the edge of a pixel [m], if known."""

    name: str
    content: bytes
    shade: States
    threshold: int
    pixel_m: float | None = None

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height [m], or [pixels] before the scale is known."""
        rows, columns = self.shade.shape
        return columns * (self.pixel_m or 1.0), rows * (self.pixel_m or 1.0)

    @property
    def is_scaled(self) -> bool:
        return self.pixel_m is not None

    @property
    def settings(self) -> dict[str, Any]:
        """Fields that can be changed, as in a project."""
        return {"threshold": self.threshold, "pixel_m": self.pixel_m}

    @property
    def python(self) -> list[str] | None:
        """None: the app's project has the map."""
        return None

    def read(self) -> PartialMap:
        """Return the map of a plan with a scale."""
        with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder, logged_warnings():
            path = stored_map([(self.name, self.content)], Path(folder))
            try:
                return read_picture(path, resolution_m=self.pixel_m, threshold=self.threshold)
            except MapError as error:
                reason = str(error).replace(str(path), PurePath(self.name).name)
                raise MapError(f"{reason} Move the threshold of the walls, or draw a known length again.") from error


@dataclass(frozen=True, eq=False)
class Drawing:
    """A drawing or building model, whose layers or kinds of elements can have materials."""

    name: str
    content: bytes
    materials: Mapping[str, str] = field(default_factory=dict)
    is_scaled = True

    @property
    def settings(self) -> dict[str, Any]:
        """Fields that can be changed, as in a project."""
        return {"materials": {**self.materials}}

    @property
    def python(self) -> list[str]:
        """Lines that read the map."""
        given = f", layer_materials={dict(self.materials)!r}" if self.materials else ""
        return [f"partial = sp.load_map({self.name!r}{given})"]

    def read(self) -> PartialMap:
        with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder, logged_warnings():
            path = stored_map([(self.name, self.content)], Path(folder))
            try:
                return load_map(path, layer_materials=self.materials or None)
            except MapError as error:
                raise MapError(str(error).replace(str(path), PurePath(self.name).name)) from error


Source: TypeAlias = Plan | Drawing
"""File that is read again with other settings."""


def uploaded_source(files: Sequence[tuple[str, bytes]], settings: Mapping[str, Any] | None = None) -> Source | None:
    """Read a picture or drawing from uploaded files (name, content); None for other files."""
    if len(files) != 1:
        return None
    suffix, given = PurePath(files[0][0]).suffix.lower(), dict(settings or {})
    if suffix in (*DRAWING_SUFFIXES, *IFC_SUFFIXES):
        return Drawing(*files[0], **given)
    if suffix not in PICTURE_SUFFIXES:
        return None
    with tempfile.TemporaryDirectory(prefix="sionna-partial-") as folder:
        shade, threshold, _ = wall_shades(stored_map(files, Path(folder)))
    return Plan(*files[0], shade, **{"threshold": threshold} | given)


def drawn(partial: PartialMap, strokes: Sequence["Stroke"]) -> PartialMap:
    for stroke in strokes:
        partial = stroke.on(partial)
    return partial


@dataclass(frozen=True)
class Stroke:
    """A correction of a map along, or of the area within, points [m]; `BRUSHES` have a width [m]."""

    kind: str
    points_m: tuple[tuple[float, float], ...]
    width_m: float = 0.0
    material: str = ""

    def on(self, partial: PartialMap) -> PartialMap:
        """Return the corrected map; only materials can be changed on a mesh (MapError)."""
        count = len(self.points_m)
        require(0 < count <= _MOST_POINTS, "points", count, "draw a shorter line.")
        if self.kind == AREA:
            require(count > 2, "corners of an area", count, "drag around it, or click on three or more corners.")
            area = shapely.make_valid(shapely.Polygon(self.points_m))
        else:
            width_m = WALL_THICKNESS_M if self.kind == WALL else self.width_m
            line = shapely.LineString(self.points_m if count > 1 else self.points_m * 2)
            area = line.buffer(max(width_m, 1.5 * partial.resolution_m) / 2.0)
        if self.kind in PAINTS:
            return partial.with_wall_material(self.material, area)
        if partial.mesh is not None:
            raise MapError("walls are drawn on floor plans alone, and this map has a mesh: change its file.")
        state = partial.state.copy()
        if self.kind == WALL:
            state[partial.cells_within(area)] = CellState.WALL
        else:
            state[partial.cells_within(area) & (state == CellState.WALL)] = CellState.FREE
        return replace(partial, state=state)


def read_again(project: Project) -> tuple[PartialMap, Source | None, tuple[Stroke, ...]]:
    """Return the map of a project without its strokes, its file, and the strokes; or its map alone.

    The file is not used if it gives another map with this version of the package.
    """
    if project.source is None:
        return project.partial, None, ()
    name, content, values = project.source
    with decoding(Path("project.zip"), "was not saved by the app", MapError, "save it again."):
        source, strokes = uploaded_source([(name, content)], values), tuple(map(_stroke, project.strokes))
    bare = None if source is None else source.read()
    if bare is None or drawn(bare, strokes) != project.partial:
        return project.partial, None, ()
    return bare, source, strokes


def _stroke(record: Mapping[str, Any]) -> Stroke:
    require_choice("stroke", record["kind"], STROKES)
    require_number("width_m", record["width_m"], 0.0, 1e3)
    points_m = tuple((float(x_m), float(y_m)) for x_m, y_m in record["points_m"])
    return Stroke(record["kind"], points_m, float(record["width_m"]), str(record["material"]))
