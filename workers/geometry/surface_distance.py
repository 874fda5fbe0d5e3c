"""Exact distances from many points to the nearest triangle of a large mesh, by a tree of boxes.

`nearest_on_mesh` compares each point with every face's box; here a point looks at some dozens of them.
"""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.jit import compiled
from workers.geometry.nearest import nearest_on_triangle

LEAF = 4
"""Faces of a leaf."""


def distance_to_mesh(points: Array, mesh: Mesh) -> tuple[Array, NDArray[np.int64]]:
    """(distance [N], metres, to the nearest point of the surface; its face [N]) of points [N, 3]; inf and -1 for no faces."""
    distance, face = np.full(len(points), np.inf), np.full(len(points), -1, np.int64)
    if len(mesh.faces) and len(points):
        corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float64)
        order, low, high, first, count = _build(corners)
        _search(np.ascontiguousarray(points, np.float64), corners, order, low, high, first, count, distance, face)
    return distance, face


def _build(corners: Array) -> tuple[NDArray[np.int64], Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """A balanced tree as a heap: (faces in order of the leaves; low, high [nodes, 3]; first, count [nodes] of each node's faces).

    Every node is halved at the median centre along its longest side.
    """
    faces = len(corners)
    depth = max(int(np.ceil(np.log2(faces / LEAF))), 0)
    nodes = 2 ** (depth + 1) - 1
    order = np.arange(faces)
    first, count = np.zeros(nodes, np.int64), np.zeros(nodes, np.int64)
    low, high = np.full((nodes, 3), np.inf), np.full((nodes, 3), -np.inf)
    centre, least, most = corners.mean(axis=1), corners.min(axis=1), corners.max(axis=1)
    count[0] = faces
    for node in range(nodes):
        start, stop = first[node], first[node] + count[node]
        if start == stop:
            continue
        mine = order[start:stop]
        low[node], high[node] = least[mine].min(axis=0), most[mine].max(axis=0)
        if 2 * node + 2 < nodes:
            middles = centre[mine]
            axis = int(np.argmax(middles.max(axis=0) - middles.min(axis=0)))
            half = (stop - start) // 2
            order[start:stop] = mine[np.argsort(middles[:, axis], kind="stable")]
            first[2 * node + 1], count[2 * node + 1] = start, half
            first[2 * node + 2], count[2 * node + 2] = start + half, stop - start - half
    return order, low, high, first, count


@compiled
def _box_distance2(point: Array, low: Array, high: Array) -> float:
    total = 0.0
    for axis in range(3):
        out = max(low[axis] - point[axis], point[axis] - high[axis], 0.0)
        total += out * out
    return total


@compiled
def _search(
    points: Array,
    corners: Array,
    order: NDArray[np.int64],
    low: Array,
    high: Array,
    first: NDArray[np.int64],
    count: NDArray[np.int64],
    distance: Array,
    face: NDArray[np.int64],
) -> None:
    """Nearer child first; a node farther than the best face so far is left out."""
    here = np.empty(3)
    stack = np.empty(128, np.int64)
    for n in range(len(points)):
        best, found = np.inf, -1
        stack[0], height = 0, 1
        while height > 0:
            height -= 1
            node = stack[height]
            if count[node] == 0 or _box_distance2(points[n], low[node], high[node]) >= best:
                continue
            left = 2 * node + 1
            if left < len(first):
                a = _box_distance2(points[n], low[left], high[left])
                b = _box_distance2(points[n], low[left + 1], high[left + 1])
                stack[height], stack[height + 1] = (left + 1, left) if a <= b else (left, left + 1)
                height += 2
                continue
            for i in range(first[node], first[node] + count[node]):
                nearest_on_triangle(points[n], corners[order[i]], here)
                d2 = (here[0] - points[n, 0]) ** 2 + (here[1] - points[n, 1]) ** 2 + (here[2] - points[n, 2]) ** 2
                if d2 < best:
                    best, found = d2, order[i]
        distance[n], face[n] = np.sqrt(best), found
