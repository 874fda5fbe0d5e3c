"""Signed contacts between the true meshes of bodies and their ground, found anew as bodies move. Pure."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from workers.geometry.distance import nearest_on_triangle
from workers.geometry.frames import transform
from workers.geometry.jit import compiled, compiled_for
from workers.geometry.mesh import bounds_of
from workers.physics.contact_surface import SLOPE, Index, Surface, bounds_in, find_near

DEEPEST_M = 3e-3
"""Overlap from which bodies are moved apart, metres: coarse parts may be smaller than a quarter of a metre's shape by half of
that, and the walls of mugs are as thick."""

DEEP_M = 1e-3
"""Overlap from which only a corner below a single face is believed: seams of bodies that abut have edges below one another."""


PARALLEL = 1e-3
"""Sine of the angle between edges below which they count as parallel: their ends lie on faces then."""

BORDER_M = 1e-7
"""Distance from a face up to which a corner above its border is above it, and from the end of an edge of what is beside that."""

SLIGHT_M = 1e-5
"""Overlap that a step leaves at most, and up to which edges count as crossing beyond their ends by as much: in the inner corner
of a hole what is a little too deep is beyond the ends of both edges."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts of body `upper` [N] with body `lower` [N], in world coordinates; the last body is the ground.

    points [N, 3] metres; normals [N, 3], unit, from lower to upper; gaps [N] metres, negative where the two overlap.
    """

    upper: Index
    lower: Index
    points: Array
    normals: Array
    gaps: Array

    def of(self, body: int) -> NDArray[np.bool_]:
        """[N]: which contacts a body has."""
        return (self.upper == body) | (self.lower == body)


@dataclass(frozen=True, eq=False)
class Near:
    """The features of two surfaces, `upper` and `lower`, that are near one another, by their numbers."""

    upper: int
    lower: int
    corners: Index
    """[P, 2]: corner of upper, face of lower."""
    faces: Index
    """[P, 2]: corner of lower, face of upper."""
    edges: Index
    """[P, 2]: edge of upper, edge of lower."""


def find_near_features(surfaces: Sequence[Surface], points: Sequence[Array], within_m: float) -> list[Near]:
    """The pairs of features with at most `within_m` between their boxes; the last surface is the ground.

    points: the vertices [V, 3] of each surface, world.
    """
    near = []
    bounds = [bounds_of(each) for each in points]
    for i, j in itertools.combinations(range(len(surfaces)), 2):
        low, high = np.maximum(bounds[i][0], bounds[j][0]) - within_m, np.minimum(bounds[i][1], bounds[j][1]) + within_m
        if (low > high).any():
            continue
        here, there = (_boxes(surfaces[k], points[k], low, high) for k in (i, j))
        pairs = ((here[0], there[1]), (there[0], here[1]), (here[2], there[2]))
        near.append(Near(i, j, *(_pairs(*each, within_m) for each in pairs)))
    return near


_Boxes = tuple[Index, Array, Array]


def _boxes(surface: Surface, points: Array, low: Array, high: Array) -> tuple[_Boxes, _Boxes, _Boxes]:
    """(numbers, bounds) of the corners, faces and edges of a surface whose boxes overlap a box."""
    corners, least, most = bounds_in(points, surface.corners[:, None], low, high)
    return (
        (surface.corners[corners], least, most),
        bounds_in(points, surface.faces, low, high),
        bounds_in(points, surface.edges, low, high),
    )


def _pairs(here: _Boxes, there: _Boxes, within_m: float) -> Index:
    pairs = find_near(here[1], here[2], there[1], there[2], within_m)
    return np.stack([here[0][pairs[:, 0]], there[0][pairs[:, 1]]], axis=1)


def contacts_within(surfaces: Sequence[Surface], poses: Sequence[Pose], within_m: float) -> Contacts:
    """The contacts of surfaces at these poses [4, 4] with gaps and overlaps of at most `within_m`; the last is the ground."""
    points = [transform(T, each.vertices) for T, each in zip(poses, surfaces, strict=True)]
    return find_contacts(surfaces, points, find_near_features(surfaces, points, within_m), within_m, within_m)


def find_contacts(
    surfaces: Sequence[Surface], points: Sequence[Array], near: Sequence[Near], within_m: float, deepest_m: float
) -> Contacts:
    """The contacts with gaps from -`deepest_m` to `within_m` among features that are near."""
    rows, upper, lower = [np.empty((0, 7))], [], []
    for pair in near:
        for contacts in _between(surfaces, points, pair, (within_m, deepest_m)):
            rows.append(contacts)
            upper += [pair.upper] * len(contacts)
            lower += [pair.lower] * len(contacts)
    every = np.concatenate(rows)
    above, below = (np.array(numbers, dtype=np.int64) for numbers in (upper, lower))
    return Contacts(above, below, every[:, :3], every[:, 3:6], every[:, 6])


def _between(
    surfaces: Sequence[Surface], points: Sequence[Array], pair: Near, reach: tuple[float, float]
) -> tuple[Array, ...]:
    """Point, normal and gap [N, 7] of the contacts of two surfaces: corners on faces, faces on corners, edges."""
    a, b = surfaces[pair.upper], surfaces[pair.lower]
    p, q = points[pair.upper], points[pair.lower]
    on_lower = corners_on_faces(pair.corners, p, a.starts, a.members, q, b.faces, b.side, *reach)
    on_upper = corners_on_faces(pair.faces, q, b.starts, b.members, p, a.faces, a.side, *reach)
    crossed = edges_across_edges(pair.edges, p, a.edges, a.across, q, b.edges, b.across, *reach)
    turned = _shallowest(*on_upper)
    turned[:, 3:6] *= -1.0
    return _shallowest(*on_lower), turned, crossed[crossed[:, 6] >= -DEEP_M]


def _shallowest(rows: Array, which: Index) -> Array:
    """The contacts without those by which a corner would leave the other body the longer way.

    A corner that is on one face, or above it, is not deep below another.
    """
    inside, deep = rows[:, 6] < 0.0, rows[:, 6] < -DEEP_M
    if not inside.any():
        return rows
    best, best_inside = (np.full(int(which[:, 0].max()) + 1, -np.inf) for _ in range(2))
    np.maximum.at(best, which[:, 0], rows[:, 6])
    np.maximum.at(best_inside, which[inside, 0], rows[inside, 6])
    return rows[(~inside | (rows[:, 6] >= best_inside[which[:, 0]])) & (~deep | (rows[:, 6] >= best[which[:, 0]]))]


@compiled_for("i8[:,::1], f8[:,::1], i8[::1], i8[::1], f8[:,::1], i8[:,::1], i8[::1], f8, f8")
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
    contacts, which, count = np.empty((64, 7)), np.empty((64, 2), np.int64), 0
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
        if count == len(contacts):
            contacts, which = np.concatenate((contacts, contacts)), np.concatenate((which, which))
        sign = 1.0 if upright else -1.0
        for k in range(3):
            contacts[count, k] = 0.5 * (vertices[n, k] + foot[k])
            contacts[count, 3 + k] = sign * normal[k]
        contacts[count, 6] = gap
        which[count, 0], which[count, 1] = n, f
        count += 1
    return contacts[:count], which[:count]


@compiled
def cross(u: Array, v: Array, out: Array) -> None:
    """Writes the cross product of two vectors [3] into `out` [3]."""
    out[0], out[1], out[2] = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@compiled_for("i8[:,::1], f8[:,::1], i8[:,::1], i8[:,::1], f8[:,::1], i8[:,::1], i8[:,::1], f8, f8")
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

    Nearest points of two lines (Ericson 2005, 5.1.9), both within the edges, but for `SLIGHT_M`. An edge crosses another where
    the faces about the one lie above the plane between them and those about the other below, to within `SLOPE`.
    """
    contacts, count = np.empty((64, 7)), 0
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
        length = np.sqrt(nn)
        beyond = max(max(-s, s - 1.0) * np.sqrt(uu), max(-t, t - 1.0) * np.sqrt(vv))
        if beyond > BORDER_M + SLIGHT_M:
            continue
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
        if beyond > BORDER_M + (-gap if -SLIGHT_M <= gap < 0.0 else 0.0):
            continue
        if count == len(contacts):
            contacts = np.concatenate((contacts, contacts))
        for k in range(3):
            contacts[count, k] = 0.5 * (a[k] + s * u[k] + b[k] + t * v[k])
            contacts[count, 3 + k] = sign * n[k] / length
        contacts[count, 6] = gap
        count += 1
    return contacts[:count]
