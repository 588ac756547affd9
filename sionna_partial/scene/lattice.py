"""PartialMap -> wall outlines that keep every cell: the staircase through the centres of the boundary wall cells."""

import numpy as np
from numpy.typing import NDArray

from sionna_partial.constants import CellState
from sionna_partial.maps.partial_map import PartialMap
from sionna_partial.scene.graph import lattice_graph
from sionna_partial.scene.outlines import Outlines, assemble
from sionna_partial.scene.polylines import Chain, WallGraph, turns, wall_chains


def lattice_outlines(partial: PartialMap) -> Outlines:
    """Outline the wall cells of a map as they are.

    Cells that touch by a side are joined from centre to centre, and so are two that touch by a corner where no other
    cell joins them. Nothing is simplified but that collinear steps become one segment. Between thick walls' faces there
    is nothing: a step with full blocks of two by two cells on either side is left out. A lone cell is a square, its own
    border.

    Parameters
    ----------
    partial : PartialMap

    Returns
    -------
    Outlines
        Segments at 0, 45 or 90 degrees, which meet only at shared vertices.
    """
    graph = lattice_graph(partial.state == CellState.WALL)
    junction = graph.degree != 2
    lines = [_corners(graph, junction, chain) / 2.0 for chain in wall_chains(graph)]
    return assemble(lines, partial.resolution_m)


def _corners(graph: WallGraph, junction: NDArray[np.bool_], chain: Chain) -> NDArray[np.int64]:
    """Places (n, 2) [half cells] where a chain begins, turns, meets others and ends."""
    places = graph.points[chain.points]
    kept = junction[chain.points]
    kept[1:-1] |= turns(places)
    kept[[0, -1]] = True
    return places[kept]
