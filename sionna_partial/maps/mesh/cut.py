"""Triangles cut at the border of an area seen from above, or by a slab: arrays in, arrays out."""

from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from sionna_partial.arrays import Bools, Floats, Indices, cross
from sionna_partial.process import njit

BORDER_M = 1e-5
"""Distance within which a surface is on a border and stays [m]: the rounding of float32 files."""

UPRIGHT_M = 1e-4
"""Triangles narrower than this, seen from above, are cut as upright walls [m]."""

MERGE_M = 1e-6

SEAM_M = 1e-4
"""Distance within which a cut point is on a vertex or edge [m]: `UPRIGHT_M` moves it that far."""

Triangles = Floats


def cut_triangles(corners_m: Triangles, area: Any) -> tuple[Bools, Triangles, Indices]:
    """Cut triangles at the border of an area (shapely, world x and y [m]) seen from above.

    Returns a mask (F,) of the triangles in the area or on its border (within `BORDER_M`), the pieces inside of
    triangles across the border (P, 3, 3) [m], with their winding, and the triangle of each piece (P,), rising.
    """
    whole = np.zeros(len(corners_m), dtype=bool)
    if not len(corners_m) or area.is_empty:
        return whole, np.zeros((0, 3, 3)), np.zeros(0, dtype=np.intp)
    shift = np.append(np.floor(area.bounds[:2]), 0.0)  # map projections leave few digits for the cut
    local = corners_m - shift
    area = shapely.simplify(shapely.transform(area, lambda points: points - shift[:2]), 0.0)
    ends, upright = _seen_from_above(local[..., :2])
    shapes = np.where(upright, shapely.linestrings(ends), shapely.polygons(local[..., :2]))
    near = shapely.buffer(area, BORDER_M, join_style="mitre")
    shapely.prepare(near)
    touched = shapely.intersects(near, shapes)
    whole[touched] = shapely.covers(near, shapes[touched])
    flat, steep = (np.nonzero(touched & ~whole & kind)[0] for kind in (~upright, upright))
    flat_pieces, flat_source = _cut_flat(local[flat], shapes[flat], area)
    steep_pieces, steep_source = _cut_upright(local[steep], ends[steep], area)
    pieces = np.concatenate([flat_pieces, steep_pieces])
    source = np.concatenate([flat[flat_source], steep[steep_source]])
    order = np.argsort(source, kind="stable")
    return whole, pieces[order] + shift, source[order]


@njit(cache=True)
def clip_slab(corners_m, values, low, high):
    """Clip triangles to the slab in which a linear function with `values` (F, 3) at the corners is within limits (F,).

    Returns polygons (F, 5, 3) [m] with the winding of the triangles, and their numbers of corners (F,), 0 for none.
    """
    polygons, sizes = np.zeros((len(corners_m), 5, 3)), np.zeros(len(corners_m), dtype=np.int64)
    for index in range(len(corners_m)):
        size = 0
        for here in range(3):
            there = (here + 1) % 3
            start, end = values[index, here], values[index, there]
            if low[index] <= start <= high[index]:
                polygons[index, size] = corners_m[index, here]
                size += 1
            first, second = (low[index], high[index]) if start < end else (high[index], low[index])
            below, above = (here, there) if start < end else (there, here)  # neighbours get the same point
            for limit in (first, second):
                if min(start, end) < limit < max(start, end):
                    fraction = (limit - values[index, below]) / (values[index, above] - values[index, below])
                    along = corners_m[index, above] - corners_m[index, below]
                    polygons[index, size] = corners_m[index, below] + fraction * along
                    size += 1
        sizes[index] = size
    return polygons, sizes


def merge_points(points_m: Floats, distance_m: float = MERGE_M) -> Indices:
    """Return for each point (V,) the first one within the distance."""
    from scipy.sparse import coo_array  # plans do without these, which take long to import
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    unique, first, inverse = np.unique(points_m, axis=0, return_index=True, return_inverse=True)
    if not len(unique):
        return np.zeros(0, np.intp)
    pairs = cKDTree(unique).query_pairs(distance_m, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(unique), len(unique)))
    count, labels = connected_components(graph, directed=False)
    lowest = np.full(count, len(points_m), dtype=np.intp)
    np.minimum.at(lowest, labels, first)
    return lowest[labels][inverse.ravel()]


def close_seams(vertices_m: Floats, triangles: Indices, first_new: int) -> tuple[Indices, Indices]:
    """Split triangles at vertices from `first_new` on that are on their open edges, so that neighbours share edges.

    An edge that its neighbour has in two parts would look like the rim of a screen, which diffracts. Returns triangles
    (G, 3), and their source triangles (G,), rising.
    """
    source = np.arange(len(triangles))
    while True:
        triangle, corner, point, fraction = _points_on_edges(vertices_m, triangles, first_new)
        if not len(triangle):
            return triangles, source
        split, first = np.unique(triangle, return_index=True)
        edge = np.zeros(len(triangles), dtype=np.intp)
        edge[split] = corner[first]
        ours = edge[triangle] == corner  # one edge of a triangle at a time
        start, end, apex = (triangles[split, (edge[split] + step) % 3] for step in (0, 1, 2))
        node = np.concatenate([start, point[ours], end])
        owner = np.concatenate([split, triangle[ours], split])
        order = np.lexsort((np.concatenate([np.zeros(len(split)), fraction[ours], np.ones(len(split))]), owner))
        node, owner = node[order], owner[order]
        within = np.nonzero(np.diff(owner) == 0)[0]
        across = apex[np.searchsorted(split, owner[within])]
        kept = np.delete(np.arange(len(triangles)), split)
        parts = np.stack([node[within], node[within + 1], across], axis=1)
        origin = np.concatenate([kept, owner[within]])
        order = np.argsort(origin, kind="stable")
        triangles, source = np.concatenate([triangles[kept], parts])[order], source[origin[order]]


def _points_on_edges(
    vertices_m: Floats, triangles: Indices, first_new: int
) -> tuple[Indices, Indices, Indices, Floats]:
    """Return triangle, corner where its open edge starts, new vertex on it, and fraction of its length."""
    edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2).reshape(-1, 2)
    _, index, counts = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True, return_counts=True)
    open_edges = np.nonzero((counts[index.ravel()] == 1) & (edges[:, 0] != edges[:, 1]))[0]
    points = np.unique(edges[open_edges])
    points = points[points >= first_new]
    ends = vertices_m[edges[open_edges]]
    tree = shapely.STRtree(shapely.linestrings(ends[..., :2]))
    which, hit = tree.query(shapely.points(vertices_m[points, :2]), predicate="dwithin", distance=SEAM_M)
    point, along = points[which], ends[hit, 1] - ends[hit, 0]
    offset = vertices_m[point] - ends[hit, 0]
    lengths = np.linalg.norm(along, axis=1)
    fraction = (offset * along).sum(axis=1) / lengths**2
    on_edge = np.linalg.norm(offset - fraction[:, None] * along, axis=1) <= SEAM_M
    on_edge &= (fraction * lengths > SEAM_M) & ((1.0 - fraction) * lengths > SEAM_M)
    order = np.nonzero(on_edge)[0]
    order = order[np.lexsort((fraction[order], open_edges[hit[order]]))]
    edge = open_edges[hit[order]]
    return edge // 3, edge % 3, point[order], fraction[order]


def _seen_from_above(flat_m: Floats) -> tuple[Floats, Bools]:
    edges = np.stack([flat_m, np.roll(flat_m, -1, axis=1)], axis=2)
    lengths = np.linalg.norm(edges[:, :, 1] - edges[:, :, 0], axis=2)
    longest = np.argmax(lengths, axis=1)
    rows = np.arange(len(flat_m))
    return edges[rows, longest], np.abs(_doubled_area(flat_m)) <= UPRIGHT_M * lengths[rows, longest]


def _doubled_area(flat_m: Floats) -> Floats:
    return cross(flat_m[:, 1] - flat_m[:, 0], flat_m[:, 2] - flat_m[:, 0])


def _cut_flat(corners_m: Triangles, shapes: NDArray[Any], area: Any) -> tuple[Triangles, Indices]:
    """Cut triangles with a width seen from above, within their planes."""
    parts, source = shapely.get_parts(shapely.intersection(shapes, area), return_index=True)
    wide = 2 * shapely.area(parts) > MERGE_M * shapely.length(parts)
    pieces, index = shapely.get_parts(shapely.constrained_delaunay_triangles(parts[wide]), return_index=True)
    source = source[wide][index]
    flat = shapely.get_coordinates(shapely.orient_polygons(pieces)).reshape(-1, 4, 2)[:, :3]
    first, second, third = corners_m[source].transpose(1, 0, 2)
    doubled = _doubled_area(corners_m[source][..., :2])
    offset = flat - first[:, None, :2]
    along_second = cross(offset, (third - first)[:, None, :2]) / doubled[:, None]
    along_third = cross((second - first)[:, None, :2], offset) / doubled[:, None]
    height = first[:, 2:] + along_second * (second - first)[:, 2:] + along_third * (third - first)[:, 2:]
    cut = np.concatenate([flat, height[..., None]], axis=2)
    cut[doubled < 0] = cut[doubled < 0][:, ::-1]
    return cut, source


def _cut_upright(corners_m: Triangles, ends_m: Floats, area: Any) -> tuple[Triangles, Indices]:
    """Cut triangles that are lines seen from above."""
    source, low, high = _spans_inside(ends_m, area)
    start, along = ends_m[source, 0], ends_m[source, 1] - ends_m[source, 0]
    offset = corners_m[source][..., :2] - start[:, None]
    fraction = (offset * along[:, None]).sum(axis=2) / (along**2).sum(axis=1)[:, None]
    polygons, sizes = clip_slab(corners_m[source], fraction, low, high)
    fans = [(np.nonzero(sizes > last)[0], last) for last in (2, 3, 4)]
    pieces = np.concatenate([polygons[rows][:, [0, last - 1, last]] for rows, last in fans])
    return pieces, np.concatenate([source[rows] for rows, _ in fans])


def _spans_inside(ends_m: Floats, area: Any) -> tuple[Indices, Floats, Floats]:
    """Return line, start and end (fractions) of parts of lines (L, 2, 2) in an area or on its border."""
    lengths = np.linalg.norm(ends_m[:, 1] - ends_m[:, 0], axis=1)
    line, fraction = _border_stops(ends_m, area)
    line = np.concatenate([np.repeat(np.arange(len(ends_m)), 2), line])
    fraction = np.concatenate([np.tile([0.0, 1.0], len(ends_m)), fraction])
    order = np.lexsort((fraction, line))
    line, fraction = line[order], fraction[order]
    apart = (np.diff(line, prepend=-1) != 0) | (np.diff(fraction, prepend=0.0) * lengths[line] > MERGE_M)
    line, fraction = line[apart], fraction[apart]
    spans = np.nonzero(np.diff(line) == 0)[0]
    line, low, high = line[spans], fraction[spans], fraction[spans + 1]
    middle = ends_m[line, 0] + ((low + high) / 2)[:, None] * (ends_m[line, 1] - ends_m[line, 0])
    shapely.prepare(area)
    inside = shapely.dwithin(area, shapely.points(middle), BORDER_M)
    line, low, high = line[inside], low[inside], high[inside]
    new = (np.diff(line, prepend=-1) != 0) | (low != np.roll(high, 1))
    first = np.nonzero(new)[0]
    last = np.append(first[1:], len(line)) - 1 if len(line) else first
    return line[first], low[first], high[last]


def _border_stops(ends_m: Floats, area: Any) -> tuple[Indices, Floats]:
    """Return line and fraction where lines (L, 2, 2) cross the border of an area or touch corners."""
    rings, ring = shapely.get_coordinates(shapely.get_parts(shapely.boundary(area)), return_index=True)
    edges = np.stack([rings[:-1], rings[1:]], axis=1)[ring[:-1] == ring[1:]]
    tree = shapely.STRtree(shapely.linestrings(edges))
    line, edge = tree.query(shapely.linestrings(ends_m), predicate="dwithin", distance=BORDER_M)
    start, along = ends_m[line, 0], ends_m[line, 1] - ends_m[line, 0]
    border = edges[edge, 1] - edges[edge, 0]
    offset = edges[edge, 0] - start
    doubled = cross(along, border)
    lengths = np.linalg.norm(along, axis=1)
    slanted = np.abs(doubled) > 1e-9 * lengths * np.linalg.norm(border, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing, on_border = cross(offset, border) / doubled, cross(offset, along) / doubled
    crossed = slanted & (on_border >= 0) & (on_border <= 1)
    lines, fractions = [line[crossed]], [crossing[crossed]]
    for corner in (offset, offset + border):
        close = np.abs(cross(along, corner)) <= BORDER_M * lengths
        lines.append(line[close])
        fractions.append((along * corner).sum(axis=1)[close] / lengths[close] ** 2)
    line, fraction = np.concatenate(lines), np.concatenate(fractions)
    between = (fraction > 0) & (fraction < 1)
    return line[between], fraction[between]
