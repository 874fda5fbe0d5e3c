"""Nearest points of triangles, of segments, and of meshes by a tree of boxes."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.jit import compiled, compiled_for


@compiled
def dot(one: Array, other: Array) -> float:
    """The scalar product of two vectors [3]; x and z are added first, as einsum adds three products."""
    return (one[0] * other[0] + one[2] * other[2]) + one[1] * other[1]


@compiled
def nearest_on_triangle(p: Array, corners: Array, nearest: Array) -> None:
    """Writes into `nearest` [3] the point of the triangle `corners` [3, 3] that is nearest to p [3].

    Uses the Voronoi regions of corners and edges (Ericson, Real-Time Collision Detection 2005, 5.1.5).
    """
    a, b, c = corners[0], corners[1], corners[2]
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for k in range(3):
        ab, ac = b[k] - a[k], c[k] - a[k]
        d1 += ab * (p[k] - a[k])
        d2 += ac * (p[k] - a[k])
        d3 += ab * (p[k] - b[k])
        d4 += ac * (p[k] - b[k])
        d5 += ab * (p[k] - c[k])
        d6 += ac * (p[k] - c[k])
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    v = w = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        pass
    elif d3 >= 0.0 and d4 <= d3:
        v = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 > d3:  # an edge without length is left to the others
        v = d1 / (d1 - d3)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 > d6:
        w = d2 / (d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6 and (d4 - d3) + (d5 - d6) > 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    elif va + vb + vc > 0.0:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    for k in range(3):
        nearest[k] = a[k] + v * (b[k] - a[k]) + w * (c[k] - a[k])


@compiled
def nearest_on_segments(a: Array, b: Array, c: Array, d: Array, here: Array, there: Array) -> None:
    """Writes the nearest points [3] of the segments from a to b and from c to d into `here` and `there`.

    Ericson, Real-Time Collision Detection 2005, 5.1.9.
    """
    aa = cc = ac = ar = cr = 0.0
    for k in range(3):
        u, v, r = b[k] - a[k], d[k] - c[k], a[k] - c[k]
        aa += u * u
        cc += v * v
        ac += u * v
        ar += u * r
        cr += v * r
    along = aa * cc - ac * ac
    s = min(1.0, max(0.0, (ac * cr - ar * cc) / along)) if along > 0.0 else 0.0
    t = (ac * s + cr) / cc if cc > 0.0 else 0.0
    if t < 0.0 or t > 1.0 or cc == 0.0:
        t = min(1.0, max(0.0, t))
        s = min(1.0, max(0.0, (ac * t - ar) / aa)) if aa > 0.0 else 0.0
    for k in range(3):
        here[k], there[k] = a[k] + s * (b[k] - a[k]), c[k] + t * (d[k] - c[k])


LEAF = 4
"""Faces of a leaf."""


def distance_to_mesh(points: Array, mesh: Mesh) -> tuple[Array, NDArray[np.int64]]:
    """(distance [N], metres, to the nearest point of the surface; its face [N]) of points [N, 3]; inf and -1 for no faces."""
    distance, face = np.full(len(points), np.inf), np.full(len(points), -1, np.int64)
    if len(mesh.faces) and len(points):
        corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float64)
        order, low, high, first, count = build_tree(corners)
        _search(np.ascontiguousarray(points, np.float64), corners, order, low, high, first, count, distance, face)
    return distance, face


Tree = tuple[NDArray[np.int64], Array, Array, NDArray[np.int64], NDArray[np.int64]]
"""Faces in order of the leaves; of each node low and high corner [nodes, 3], and first and count [nodes] of its faces."""


@compiled_for("f8[:,:,::1]")
def build_tree(corners: Array) -> Tree:
    """A balanced tree of boxes as a heap: node n has the children 2 n + 1 and 2 n + 2.

    Every node is halved at the median centre along its longest side.
    """
    faces, depth = len(corners), 0
    while LEAF << depth < faces:
        depth += 1
    nodes = 2 ** (depth + 1) - 1
    order = np.arange(faces)
    first, count = np.zeros(nodes, np.int64), np.zeros(nodes, np.int64)
    low, high = np.full((nodes, 3), np.inf), np.full((nodes, 3), -np.inf)
    centre, least, most = np.empty((faces, 3)), np.empty((faces, 3)), np.empty((faces, 3))
    for face in range(faces):
        for k in range(3):
            x, y, z = corners[face, 0, k], corners[face, 1, k], corners[face, 2, k]
            centre[face, k], least[face, k], most[face, k] = (x + y + z) / 3.0, min(x, y, z), max(x, y, z)
    count[0] = faces
    for node in range(nodes):
        start, stop = first[node], first[node] + count[node]
        if start == stop:
            continue
        mine = order[start:stop].copy()
        axis, longest = 0, -1.0
        for k in range(3):
            near, far = np.inf, -np.inf
            for face in mine:
                low[node, k], high[node, k] = min(low[node, k], least[face, k]), max(high[node, k], most[face, k])
                near, far = min(near, centre[face, k]), max(far, centre[face, k])
            if far - near > longest:
                axis, longest = k, far - near
        if 2 * node + 2 < nodes:
            half = (stop - start) // 2
            order[start:stop] = mine[np.argsort(centre[mine, axis], kind="mergesort")]
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
        best, nearest = np.inf, -1
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
                    best, nearest = d2, order[i]
        distance[n], face[n] = np.sqrt(best), nearest
