"""Least distances: between two meshes by FCL, of points to a mesh by the closed form for a triangle."""

import fcl
import numpy as np

from schemas.base import Array
from tests.judge.surface import Surface

PAIRS_AT_ONCE = 1_000_000


def distance_m(a: Surface, b: Surface) -> float:
    """Metres between two surfaces; 0 where they meet."""
    return max(0.0, float(fcl.distance(a.tree, b.tree, fcl.DistanceRequest(), fcl.DistanceResult())))


def boxes_apart_m(a: Surface, b: Surface) -> float:
    """Metres between the bounding boxes: a bound from below of the distance."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(a.bounds[0] - b.bounds[1], b.bounds[0] - a.bounds[1]))))


def distances_to_faces(points: Array, corners: Array) -> Array:
    """[N]: metres from each point [N, 3] to the nearest of the triangles [F, 3, 3]; inf without any."""
    if len(corners) == 0:
        return np.full(len(points), np.inf)
    step = max(1, PAIRS_AT_ONCE // len(corners))
    parts = [points[k : k + step] for k in range(0, len(points), step)]
    return np.concatenate([_to_faces(part[:, None], corners[None]).min(axis=1) for part in parts])


def winding_numbers(points: Array, corners: Array) -> Array:
    """[N]: how often the triangles [F, 3, 3] go round each point [N, 3]: 1 inside a body, 0 outside.

    By the sum of their solid angles (Van Oosterom and Strackee 1983).
    """
    step = max(1, PAIRS_AT_ONCE // len(corners))
    found = [np.zeros(0)]
    for k in range(0, len(points), step):
        a, b, c = (corners[None, :, m] - points[k : k + step, None] for m in range(3))
        la, lb, lc = (np.linalg.norm(each, axis=-1) for each in (a, b, c))
        below = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
        found.append(2.0 * np.arctan2(_dot(a, np.cross(b, c)), below).sum(axis=1) / (4.0 * np.pi))
    return np.concatenate(found)


def _to_faces(points: Array, corners: Array) -> Array:
    """[N, F]: distances of points [N, 1, 3] to triangles [1, F, 3, 3]: to the plane over the face, else to the edges."""
    a, b, c = corners[:, :, 0], corners[:, :, 1], corners[:, :, 2]
    normal = np.cross(b - a, c - a)
    normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
    height = _dot(points - a, normal)
    inside = np.ones(height.shape, dtype=bool)
    nearest = np.full(height.shape, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, to = end - start, points - start
        inside &= _dot(np.cross(edge, to), normal) >= 0.0
        share = np.clip(_dot(to, edge) / _dot(edge, edge), 0.0, 1.0)[..., None]
        nearest = np.minimum(nearest, np.linalg.norm(to - share * edge, axis=-1))
    return np.where(inside, np.abs(height), nearest)


def _dot(a: Array, b: Array) -> Array:
    return (a * b).sum(axis=-1)
