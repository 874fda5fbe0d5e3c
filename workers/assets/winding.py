"""Generalised winding numbers: how often a mesh, closed or open, goes round a point."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.distance import Tree, build_tree
from workers.geometry.jit import compiled

WIDE = 4.0
"""How many radii a branch of the tree must be away to count as one dipole; on an opened sphere errors stay below 0.01."""


def winding_of_closed(points: Array, mesh: Mesh) -> NDArray[np.int64]:
    """[N]: how often closed bodies, which share vertices where they share edges, go round points [N, 3].

    Faces above a point count 1 where they face up and -1 where they face down. Exact but for a point within rounding of a
    face: which side of an edge a point lies on, seen from above, is computed once for both of its faces.
    """
    number = np.zeros(len(points), np.int64)
    if len(mesh.faces) and len(points):
        corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float64)
        _count_above(np.ascontiguousarray(points, dtype=np.float64), corners, build_tree(corners), number)
    return number


@compiled
def _count_above(points: Array, corners: Array, tree: Tree, number: NDArray[np.int64]) -> None:
    order, low, high, first, count = tree
    stack = np.empty(128, np.int64)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        stack[0], height = 0, 1
        while height > 0:
            height -= 1
            node = stack[height]
            across = low[node, 0] <= x <= high[node, 0] and low[node, 1] <= y <= high[node, 1]
            if count[node] == 0 or not across or high[node, 2] < z:
                continue
            if 2 * node + 1 < len(first):
                stack[height], stack[height + 1] = 2 * node + 2, 2 * node + 1
                height += 2
                continue
            for i in range(first[node], first[node] + count[node]):
                number[n] += _is_above(corners, order[i], x, y, z)


@compiled
def _is_above(corners: Array, face: int, x: float, y: float, z: float) -> int:
    """1 or -1 for a face above the point that faces up or down, else 0."""
    turn = _side(corners, face, 0, 1, x, y)
    if turn == 0 or _side(corners, face, 1, 2, x, y) != turn or _side(corners, face, 2, 0, x, y) != turn:
        return 0
    ax, ay, az = corners[face, 0, 0], corners[face, 0, 1], corners[face, 0, 2]
    ux, uy, uz = corners[face, 1, 0] - ax, corners[face, 1, 1] - ay, corners[face, 1, 2] - az
    vx, vy, vz = corners[face, 2, 0] - ax, corners[face, 2, 1] - ay, corners[face, 2, 2] - az
    out = (uy * vz - uz * vy) * (x - ax) + (uz * vx - ux * vz) * (y - ay) + (ux * vy - uy * vx) * (z - az)
    return turn if turn * out < 0.0 else 0


@compiled
def _side(corners: Array, face: int, start: int, end: int, x: float, y: float) -> int:
    """1 where (x, y) lies left of an edge seen from above, -1 right; on it, as if moved a little along x, and less along y."""
    ax, ay, bx, by = corners[face, start, 0], corners[face, start, 1], corners[face, end, 0], corners[face, end, 1]
    swapped = ax > bx or (ax == bx and ay > by)
    if swapped:
        ax, ay, bx, by = bx, by, ax, ay
    side = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
    if side == 0.0:
        side = ay - by if ay != by else bx - ax
    return 0 if side == 0.0 else 1 if (side > 0.0) != swapped else -1


def winding_numbers(points: Array, mesh: Mesh) -> Array:
    """[N]: how often the faces of a mesh go round points [N, 3] (Jacobson et al., Robust inside-outside segmentation, 2013).

    1 inside a closed body that is wound outwards, the sum where bodies overlap, 0 outside; of an open mesh, what it hides of all
    directions. Faces near by count by their solid angles. A branch of the tree, of area A and with all points within r of its
    middle, counts as one dipole from a distance R of `WIDE` r on (Barill et al., Fast winding numbers, 2018). That is wrong by at
    most A r / (2 pi (R - r)^3), as the second derivatives of 1 / (4 pi R) are at most 2 / (4 pi R^3).
    """
    number = np.zeros(len(points))
    if len(mesh.faces) and len(points):
        corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float64)
        tree = build_tree(corners)
        terms = _expand(corners, tree)
        _add_up(np.ascontiguousarray(points, dtype=np.float64), corners, tree, terms, number)
    return number


@compiled
def _expand(corners: Array, tree: Tree) -> Array:
    """[nodes, 7]: each node's mean point, the square of the largest distance from it, the sum of areas times normals."""
    order, _, _, first, count = tree
    faces = len(corners)
    normal, mean, area = np.empty((faces, 3)), np.empty((faces, 3)), np.empty(faces)
    for face in range(faces):
        a, b, c = corners[face, 0], corners[face, 1], corners[face, 2]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            normal[face, k] = ((b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])) / 2.0
            mean[face, k] = (a[k] + b[k] + c[k]) / 3.0
        area[face] = np.sqrt(normal[face, 0] ** 2 + normal[face, 1] ** 2 + normal[face, 2] ** 2)
    terms = np.zeros((len(first), 7))
    for node in range(len(first)):
        mine, term, whole = order[first[node] : first[node] + count[node]], terms[node], 0.0
        for face in mine:
            whole += area[face]
            for k in range(3):
                term[k] += area[face] * mean[face, k]
        for k in range(3):
            term[k] = term[k] / whole if whole > 0.0 else mean[mine[0], k] if len(mine) else 0.0
        for face in mine:
            for corner in range(3):
                away = 0.0
                for k in range(3):
                    away += (corners[face, corner, k] - term[k]) ** 2
                term[3] = max(term[3], away)
            for k in range(3):
                term[4 + k] += normal[face, k]
    return terms


@compiled
def _add_up(points: Array, corners: Array, tree: Tree, terms: Array, number: Array) -> None:
    """Depth first, so that the order of sums is the tree's."""
    order, _, _, first, count = tree
    stack = np.empty(128, np.int64)
    for n in range(len(points)):
        p, total = points[n], 0.0
        stack[0], height = 0, 1
        while height > 0:
            height -= 1
            node = stack[height]
            if count[node] == 0:
                continue
            x, y, z = terms[node, 0] - p[0], terms[node, 1] - p[1], terms[node, 2] - p[2]
            d2 = x * x + y * y + z * z
            if d2 > WIDE * WIDE * terms[node, 3]:
                dipole = terms[node, 4] * x + terms[node, 5] * y + terms[node, 6] * z
                total += dipole / (2.0 * d2 * np.sqrt(d2))
            elif 2 * node + 1 < len(first):
                stack[height], stack[height + 1] = 2 * node + 2, 2 * node + 1
                height += 2
            else:
                for i in range(first[node], first[node] + count[node]):
                    total += _half_solid_angle(p, corners[order[i]])
        number[n] = total / (2.0 * np.pi)


@compiled
def _half_solid_angle(p: Array, corners: Array) -> float:
    """Half the solid angle of a triangle [3, 3] seen from p, positive from its back (Van Oosterom and Strackee 1983)."""
    ax, ay, az = corners[0, 0] - p[0], corners[0, 1] - p[1], corners[0, 2] - p[2]
    bx, by, bz = corners[1, 0] - p[0], corners[1, 1] - p[1], corners[1, 2] - p[2]
    cx, cy, cz = corners[2, 0] - p[0], corners[2, 1] - p[1], corners[2, 2] - p[2]
    a, b, c = (
        np.sqrt(ax * ax + ay * ay + az * az),
        np.sqrt(bx * bx + by * by + bz * bz),
        np.sqrt(cx * cx + cy * cy + cz * cz),
    )
    volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    below = (
        a * b * c
        + (ax * bx + ay * by + az * bz) * c
        + (bx * cx + by * cy + bz * cz) * a
        + (cx * ax + cy * ay + cz * az) * b
    )
    return np.arctan2(volume, below)
