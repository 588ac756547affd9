"""Every chain of planes that rays have met, and what the rays say of where its paths can go."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sionna_partial.scene.floor_plan import grow
from sionna_partial.tracing.mesh.planes import MeshPlanes, mix
from sionna_partial.tracing.mesh.rays import Rays

MARGIN = 8.0
"""Distance in direction from a chain's rays up to which its receivers are looked for, in spacings of the rays."""


class Chains(NamedTuple):
    """Every chain of planes that rays met, as a tree; the first `size` rows of the arrays are used.

    Parameters
    ----------
    parent, plane : (M,) int32 arrays
        The chain without its last plane (-1 for none), and that plane.
    low, high : (M, 3) float32 arrays
        Boxes that hold the unit directions in which rays left the last plane.
    reach_m : (M,) float32 array
        Unfolded length of the longest of these rays, to where it met the next face [m].
    table : (T,) int32 array
        Hash table of the chains; -1 where it is empty.
    size : int
        Number of chains.
    rays : int
        Number of rays.
    """

    parent: NDArray[np.int32]
    plane: NDArray[np.int32]
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    reach_m: NDArray[np.float32]
    table: NDArray[np.int32]
    size: int
    rays: int


class Views(NamedTuple):
    """Where receivers of each chain are looked for.

    Parameters
    ----------
    order : (M,) int32 array
        The chains, each after its parent and with all that begin like it behind it.
    depth : (M,) int32 array
        Number of planes.
    source_m : (M, 3) float64 array
        Images of the transmitter [m].
    margin : (M,) float64 array
        Width by which the box of directions is enlarged.
    """

    order: NDArray[np.int32]
    depth: NDArray[np.int32]
    source_m: NDArray[np.float64]
    margin: NDArray[np.float64]


def collect_chains(rays: Iterable[Rays], planes: MeshPlanes) -> Chains:
    """Make the tree of all chains of planes that rays have met."""
    chains = Chains(
        parent=np.empty(1024, np.int32),
        plane=np.empty(1024, np.int32),
        low=np.empty((1024, 3), np.float32),
        high=np.empty((1024, 3), np.float32),
        reach_m=np.empty(1024, np.float32),
        table=np.full(4096, -1, np.int32),
        size=0,
        rays=0,
    )
    for part in rays:
        chains = _add_rays(chains, part.face, part.leg_m, part.direction, planes.plane)
    return chains


@njit(cache=True)
def _add_rays(chains, face, leg, direction, plane_of):  # type: ignore[no-untyped-def]
    """Add the chains of some rays to the tree."""
    parent, plane, low, high, reach, table, count, rays = chains
    for i in range(face.shape[0]):
        room = count + face.shape[1]
        if room > len(parent):
            parent, plane, reach = grow(parent, room), grow(plane, room), grow(reach, room)
            low, high = grow(low, room), grow(high, room)
        if 2 * room > len(table):
            table = _rehash(parent, plane, count, 2 * len(table))
        above, length = -1, leg[i, 0]
        for k in range(face.shape[1]):
            if face[i, k] < 0:
                break
            length += leg[i, k + 1]
            place = _find(table, parent, plane, above, plane_of[face[i, k]])
            node = table[place]
            if node < 0:
                parent[count], plane[count], reach[count] = above, plane_of[face[i, k]], length
                low[count], high[count] = direction[i, k + 1], direction[i, k + 1]
                table[place] = node = count
                count += 1
            reach[node] = max(reach[node], length)
            for axis in range(3):
                low[node, axis] = min(low[node, axis], direction[i, k + 1, axis])
                high[node, axis] = max(high[node, axis], direction[i, k + 1, axis])
            above = node
    return Chains(parent, plane, low, high, reach, table, count, rays + len(face))


@njit(cache=True)
def _find(table, parent, plane, node, last):  # type: ignore[no-untyped-def]
    """Place in the hash table of the chain that adds the plane `last` to the chain `node`, or where it belongs."""
    mask = np.uint64(len(table) - 1)
    place = mix(node + 1, last) & mask
    while table[place] >= 0 and (parent[table[place]] != node or plane[table[place]] != last):
        place = (place + np.uint64(1)) & mask
    return place


@njit(cache=True)
def _rehash(parent, plane, count, size):  # type: ignore[no-untyped-def]
    """Hash table of a larger size."""
    table = np.full(size, -1, np.int32)
    for node in range(count):
        table[_find(table, parent, plane, parent[node], plane[node])] = node
    return table


def view_chains(chains: Chains, planes: MeshPlanes, tx_m: NDArray[np.float64]) -> Views:
    """Find the image, the margin and the place in the order of every chain."""
    parent, plane = chains.parent[: chains.size], chains.plane[: chains.size]
    margin = MARGIN * np.sqrt(4.0 * np.pi / max(1, chains.rays))
    return Views(_depth_first(parent), *_images(parent, plane, planes, tx_m, margin))


@njit(cache=True)
def _images(parent, plane, planes, tx, margin):  # type: ignore[no-untyped-def]
    """Depth, image of the transmitter and margin of every chain: a small plane bounds the directions."""
    depth, source, margins = np.empty(len(parent), np.int32), np.empty((len(parent), 3)), np.empty(len(parent))
    for node in range(len(parent)):
        p, above = plane[node], parent[node]
        depth[node] = 1 if above < 0 else depth[above] + 1
        source[node] = tx if above < 0 else source[above]
        margins[node] = margin if above < 0 else margins[above]
        away = -planes.offset_m[p]
        distance = 0.0
        for axis in range(3):
            away += planes.normal[p, axis] * source[node, axis]
            distance += (planes.centre_m[p, axis] - source[node, axis]) ** 2
        gap = np.sqrt(distance) - planes.radius_m[p]
        if gap > 0.0:
            margins[node] = min(margins[node], 2.0 * planes.radius_m[p] / gap)
        for axis in range(3):
            source[node, axis] -= 2.0 * away * planes.normal[p, axis]
    return depth, source, margins


@njit(cache=True)
def _depth_first(parent):  # type: ignore[no-untyped-def]
    """Order of the chains in which those that begin alike are together."""
    child, beside = np.full(len(parent) + 1, -1, np.int32), np.empty(len(parent), np.int32)
    for node in range(len(parent) - 1, -1, -1):
        beside[node], child[parent[node] + 1] = child[parent[node] + 1], node
    order, stack = np.empty(len(parent), np.int32), np.empty(len(parent) + 1, np.int32)
    stack[0], top, count = child[0], 1, 0
    while top > 0:
        node = stack[top - 1]
        if node < 0:
            top -= 1
            continue
        order[count] = node
        count += 1
        stack[top - 1] = beside[node]
        stack[top] = child[node + 1]
        top += 1
    return order
