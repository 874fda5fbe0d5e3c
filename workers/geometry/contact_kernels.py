"""Compiled loops over pairs of features of two meshes: which are near, and how far apart they are along their normal."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.jit import compiled
from workers.geometry.nearest import nearest_on_triangle

SLOPE = 0.02
"""Slope, about a degree, up to which a surface that falls below the plane of contact may still lie on it."""

PARALLEL = 1e-3
"""Sine of the angle between edges below which they count as parallel: their ends lie on faces then."""

BORDER_M = 1e-7
"""Distance from a face up to which a corner above its border is above it."""

Index = NDArray[np.int64]


@compiled
def bounds_in(points: Array, features: NDArray[np.integer], low: Array, high: Array) -> tuple[Index, Array, Array]:
    """(numbers [N], lower and upper bounds [N, 3]) of the features [F, K], corners by number, whose bounds overlap a box."""
    found, count = np.empty(len(features), np.int64), 0
    least, most = np.empty((len(features), 3)), np.empty((len(features), 3))
    for f in range(len(features)):
        near = True
        for k in range(3):
            down = up = points[features[f, 0], k]
            for m in range(1, features.shape[1]):
                down, up = min(down, points[features[f, m], k]), max(up, points[features[f, m], k])
            near = near and down <= high[k] and up >= low[k]
            if not near:
                break
            least[count, k], most[count, k] = down, up
        if near:
            found[count] = f
            count += 1
    return found[:count], least[:count], most[:count]


def find_near(low: Array, high: Array, others_low: Array, others_high: Array, within: float) -> Index:
    """[N, 2]: the pairs of two lists of boxes, bounds [A, 3] and [B, 3], with at most `within` between them on each axis.

    Sorted by the first box. The second list is swept along the axis on which it extends farthest.
    """
    if len(low) == 0 or len(others_low) == 0:
        return np.empty((0, 2), np.int64)
    axis, widest, starts = _longest_axis(others_low, others_high)
    order = np.argsort(starts, kind="stable")  # numba's own takes seconds to compile
    return _sweep(low, high, others_low, others_high, within, axis, widest, order, starts[order])


@compiled
def _longest_axis(low: Array, high: Array) -> tuple[int, float, Array]:
    """(the axis on which boxes, bounds [B, 3], extend farthest; the widest box there; their lower bounds [B] there)."""
    axis, longest = 0, -1.0
    for k in range(3):
        least, most = low[0, k], high[0, k]
        for n in range(1, len(low)):
            least, most = min(least, low[n, k]), max(most, high[n, k])
        if most - least > longest:
            axis, longest = k, most - least
    widest, starts = high[0, axis] - low[0, axis], np.empty(len(low))
    for n in range(len(low)):
        widest, starts[n] = max(widest, high[n, axis] - low[n, axis]), low[n, axis]
    return axis, widest, starts


@compiled
def _sweep(
    low: Array,
    high: Array,
    others_low: Array,
    others_high: Array,
    within: float,
    axis: int,
    widest: float,
    order: Index,
    sorted_low: Array,
) -> Index:
    """The pairs of `find_near`: along `axis` the second list, of boxes at most `widest` there, begins at `sorted_low` [B]."""
    pairs, count = np.empty((64, 2), np.int64), 0
    for n in range(len(low)):
        first = np.searchsorted(sorted_low, low[n, axis] - within - widest)
        for m in range(first, len(order)):
            if sorted_low[m] > high[n, axis] + within:
                break
            f = order[m]
            near = True
            for k in range(3):
                near = near and others_low[f, k] - within <= high[n, k] and low[n, k] <= others_high[f, k] + within
            if not near:
                continue
            if count == len(pairs):
                pairs = np.concatenate((pairs, pairs))
            pairs[count, 0], pairs[count, 1] = n, f
            count += 1
    return pairs[:count]


@compiled
def corners_on_faces(
    pairs: Index,
    vertices: Array,
    starts: Index,
    members: Index,
    others: Array,
    faces: Index,
    side: Index,
    within: float,
    deepest: float,
) -> tuple[Array, Index]:
    """(point, normal and gap [N, 7], (corner, face) [N, 2]) of corners over or in faces of another surface.

    pairs [P, 2]: of a vertex and a face that are near. The normal points from the face to the corner's body, the gap, from
    -`deepest` to `within`, is negative where the corner lies below the face. A corner touches a face where all its
    neighbours lie on one side of the face's plane, to within `SLOPE`, and the face's own neighbours not on the same side.
    """
    found, which, count = np.empty((64, 7)), np.empty((64, 2), np.int64), 0
    triangle, normal, foot, nearest = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3)
    u, v = np.empty(3), np.empty(3)
    for row in range(len(pairs)):
        n, f = pairs[row, 0], pairs[row, 1]
        for k in range(3):
            for corner in range(3):
                triangle[corner, k] = others[faces[f, corner], k]
            u[k], v[k] = triangle[1, k] - triangle[0, k], triangle[2, k] - triangle[0, k]
        cross(u, v, normal)
        normal /= np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        height = 0.0
        for k in range(3):
            height += normal[k] * (vertices[n, k] - triangle[0, k])
        if abs(height) > max(within, deepest):
            continue
        for k in range(3):
            foot[k] = vertices[n, k] - height * normal[k]
        nearest_on_triangle(foot, triangle, nearest)
        beside2 = 0.0
        for k in range(3):
            beside2 += (nearest[k] - foot[k]) ** 2
        if beside2 > BORDER_M * BORDER_M:
            continue
        over, under = True, True
        for m in range(starts[n], starts[n + 1]):
            up = length2 = 0.0
            for k in range(3):
                along = vertices[members[m], k] - vertices[n, k]
                up += normal[k] * along
                length2 += along * along
            slack = SLOPE * np.sqrt(length2)
            over = over and up >= -slack
            under = under and up <= slack
        # About the deepest face of a hollow everything rises, as about the underside of a body: there the corner tells
        upright, turned = over and (side[f] >= 0 or not under), under and side[f] <= 0
        gap = height if upright else -height
        if not (upright or turned) or gap > within or gap < -deepest:
            continue
        if count == len(found):
            found, which = np.concatenate((found, found)), np.concatenate((which, which))
        sign = 1.0 if upright else -1.0
        for k in range(3):
            found[count, k] = 0.5 * (vertices[n, k] + foot[k])
            found[count, 3 + k] = sign * normal[k]
        found[count, 6] = gap
        which[count, 0], which[count, 1] = n, f
        count += 1
    return found[:count], which[:count]


@compiled
def cross(u: Array, v: Array, out: Array) -> None:
    """Writes the cross product of two vectors [3] into `out` [3]."""
    out[0], out[1], out[2] = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@compiled
def edges_across_edges(
    pairs: Index,
    vertices: Array,
    edges: Index,
    across: Index,
    others: Array,
    edges2: Index,
    across2: Index,
    within: float,
    deepest: float,
) -> Array:
    """[N, 7]: point, normal and gap, from -`deepest` to `within`, where edges of one surface cross those of another.

    Nearest points of two lines (Ericson 2005, 5.1.9), both within the edges. An edge crosses another where the faces about
    the one lie above the plane between them and those about the other below, to within `SLOPE`.
    """
    found, count = np.empty((64, 7)), 0
    n, u, v, r = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for row in range(len(pairs)):
        i, j = pairs[row, 0], pairs[row, 1]
        a, b = vertices[edges[i, 0]], others[edges2[j, 0]]
        for k in range(3):
            u[k], v[k], r[k] = vertices[edges[i, 1], k] - a[k], others[edges2[j, 1], k] - b[k], a[k] - b[k]
        cross(u, v, n)
        uu = uv = vv = ur = vr = nn = nr = 0.0
        for k in range(3):
            uu, uv, vv = uu + u[k] * u[k], uv + u[k] * v[k], vv + v[k] * v[k]
            ur, vr = ur + u[k] * r[k], vr + v[k] * r[k]
            nn, nr = nn + n[k] * n[k], nr + n[k] * r[k]
        if nn <= PARALLEL * PARALLEL * uu * vv or nr * nr > max(within, deepest) ** 2 * nn:
            continue
        s, t = (uv * vr - ur * vv) / nn, (uu * vr - uv * ur) / nn
        if s < 0.0 or s > 1.0 or t < 0.0 or t > 1.0:
            continue
        length = np.sqrt(nn)
        positive, negative = True, True
        for m in range(2):
            up = down = far_up = far_down = along_up = along_down = 0.0
            for k in range(3):
                x, y = vertices[across[i, m], k] - a[k], others[across2[j, m], k] - b[k]
                up, down = up + n[k] * x / length, down + n[k] * y / length
                far_up, far_down = far_up + x * x, far_down + y * y
                along_up, along_down = along_up + x * u[k], along_down + y * v[k]
            slack_up = SLOPE * np.sqrt(max(0.0, far_up - along_up * along_up / uu))
            slack_down = SLOPE * np.sqrt(max(0.0, far_down - along_down * along_down / vv))
            positive = positive and up >= -slack_up and down <= slack_down
            negative = negative and up <= slack_up and down >= -slack_down
        sign = 1.0 if positive else -1.0
        gap = sign * nr / length
        if not (positive or negative) or gap > within or gap < -deepest:
            continue
        if count == len(found):
            found = np.concatenate((found, found))
        for k in range(3):
            found[count, k] = 0.5 * (a[k] + s * u[k] + b[k] + t * v[k])
            found[count, 3 + k] = sign * n[k] / length
        found[count, 6] = gap
        count += 1
    return found[:count]
