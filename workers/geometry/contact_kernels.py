"""Compiled loops over pairs of features of two meshes, for `workers.geometry.contact_points`."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.jit import compiled
from workers.geometry.nearest import nearest_on_triangle

SLOPE = 0.02
"""Slope, about a degree, up to which a surface that falls below the plane of contact may still lie on it."""

PARALLEL = 1e-3
"""Sine of the angle between edges below which they count as parallel: their ends lie on faces then."""

Index = NDArray[np.int64]


@compiled
def find_near_faces(points: Array, corners: Array, low: Array, high: Array, within: float) -> Index:
    """[N, 2]: the pairs of a point [P, 3] and a face, with its corners and bounds [F, ...], within a distance."""
    pairs, count = np.empty((64, 2), np.int64), 0
    here = np.empty(3)
    for n in range(len(points)):
        for f in range(len(corners)):
            near = True
            for k in range(3):
                near = near and low[f, k] - within <= points[n, k] <= high[f, k] + within
            if not near:
                continue
            nearest_on_triangle(points[n], corners[f], here)
            d2 = (here[0] - points[n, 0]) ** 2 + (here[1] - points[n, 1]) ** 2 + (here[2] - points[n, 2]) ** 2
            if d2 <= within * within:
                if count == len(pairs):
                    pairs = np.concatenate((pairs, pairs))
                pairs[count, 0], pairs[count, 1] = n, f
                count += 1
    return pairs[:count]


@compiled
def clear_opposite_sides(
    vertices: Array,
    chosen: Index,
    starts: Index,
    members: Index,
    normals: Array,
    within: float,
    over: NDArray[np.bool_],
    under: NDArray[np.bool_],
) -> None:
    """Clears `over` [N] where a neighbour of a vertex lies below the plane through it, and `under` [N] where one lies above.

    chosen [N]: the vertices; normals [N, 3]: of the planes; starts, members: the neighbours of every vertex.
    """
    for n in range(len(chosen)):
        v = vertices[chosen[n]]
        for m in range(starts[chosen[n]], starts[chosen[n] + 1]):
            w = vertices[members[m]]
            up = length2 = 0.0
            for k in range(3):
                up += normals[n, k] * (w[k] - v[k])
                length2 += (w[k] - v[k]) ** 2
            slack = max(2.0 * within, SLOPE * np.sqrt(length2))
            over[n] = over[n] and up >= -slack
            under[n] = under[n] and up <= slack


@compiled
def find_edge_crossings(a: Array, over: Array, b: Array, under: Array, within: float) -> Array:
    """[K, 2, 3]: middle and normal of the places where edges a [N, 2, 3] cross edges b [M, 2, 3] within a distance.

    Nearest points of two lines (Ericson 2005, 5.1.9), both within the edges. over, under: the vertices across the edges.
    """
    found, count = np.empty((64, 2, 3)), 0
    n = np.empty(3)
    for i in range(len(a)):
        for j in range(len(b)):
            near = True
            for k in range(3):
                near = near and min(a[i, 0, k], a[i, 1, k]) - within <= max(b[j, 0, k], b[j, 1, k])
                near = near and max(a[i, 0, k], a[i, 1, k]) + within >= min(b[j, 0, k], b[j, 1, k])
            if not near:
                continue
            u, v, r = a[i, 1] - a[i, 0], b[j, 1] - b[j, 0], a[i, 0] - b[j, 0]
            n[0], n[1], n[2] = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
            uu = uv = vv = ur = vr = nn = nr = 0.0
            for k in range(3):
                uu, uv, vv = uu + u[k] * u[k], uv + u[k] * v[k], vv + v[k] * v[k]
                ur, vr = ur + u[k] * r[k], vr + v[k] * r[k]
                nn, nr = nn + n[k] * n[k], nr + n[k] * r[k]
            if nn <= PARALLEL * PARALLEL * uu * vv or nr * nr > within * within * nn:
                continue
            s, t = (uv * vr - ur * vv) / nn, (uu * vr - uv * ur) / nn
            if s < 0.0 or s > 1.0 or t < 0.0 or t > 1.0:
                continue
            length = np.sqrt(nn)
            positive, negative = True, True  # the first edge's faces above the plane through it, the second's below
            for m in range(2):
                up = down = far_up = far_down = 0.0
                for k in range(3):
                    x, y = over[i, m, k] - a[i, 0, k], under[j, m, k] - b[j, 0, k]
                    up, down = up + n[k] * x / length, down + n[k] * y / length
                    far_up, far_down = far_up + x * x, far_down + y * y
                slack_up = max(2.0 * within, SLOPE * np.sqrt(far_up))
                slack_down = max(2.0 * within, SLOPE * np.sqrt(far_down))
                positive = positive and up >= -slack_up and down <= slack_down
                negative = negative and up <= slack_up and down >= -slack_down
            if not (positive or negative):
                continue
            if count == len(found):
                found = np.concatenate((found, found))
            for k in range(3):
                found[count, 0, k] = 0.5 * (a[i, 0, k] + s * u[k] + b[j, 0, k] + t * v[k])
                found[count, 1, k] = n[k] / length if positive else -n[k] / length
            count += 1
    return found[:count]
