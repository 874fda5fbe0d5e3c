"""Signed contacts between the true meshes of bodies and their ground, found anew as bodies move. Pure."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from workers.geometry.bounds import bounds_of
from workers.geometry.contact_kernels import Index, bounds_in, corners_on_faces, edges_across_edges, find_near
from workers.geometry.contact_surface import Surface
from workers.geometry.frames import transform

DEEPEST_M = 3e-3
"""Overlap from which bodies are moved apart, metres: coarse parts may be smaller than a quarter of a metre's shape by half of
that, and the walls of mugs are as thick."""

DEEP_M = 1e-3
"""Overlap from which only a corner below a single face is believed: seams of bodies that abut have edges below one another."""


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
    found = []
    bounds = [bounds_of(each) for each in points]
    for i, j in itertools.combinations(range(len(surfaces)), 2):
        low, high = np.maximum(bounds[i][0], bounds[j][0]) - within_m, np.minimum(bounds[i][1], bounds[j][1]) + within_m
        if (low > high).any():
            continue
        here, there = (_boxes(surfaces[k], points[k], low, high) for k in (i, j))
        pairs = ((here[0], there[1]), (there[0], here[1]), (here[2], there[2]))
        found.append(Near(i, j, *(_pairs(*each, within_m) for each in pairs)))
    return found


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
        for found in _between(surfaces, points, pair, (within_m, deepest_m)):
            rows.append(found)
            upper += [pair.upper] * len(found)
            lower += [pair.lower] * len(found)
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
