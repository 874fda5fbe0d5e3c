"""Where two meshes touch: corners on faces and edges across edges, each with the normal that parts the two there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from schemas.base import Array
from tests.judge.surface import Surface

ROWS_AT_ONCE = 4_000_000
"""Pairs of boxes compared at once."""

PARALLEL = 1e-4
"""Sine of the angle between two edges below which they cross nowhere in particular."""

SLACK_M = 1e-6
"""Depth to which a body may be beyond the plane of its contact: a tenth of the band."""

LOOKING = 1e-6
"""Cosine from which a face looks at another: of two flush faces that look the same way, neither holds the other."""

SAME_NORMAL = 1e-7
"""Difference of unit normals that are one."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """Points [N, 3], metres, and unit normals [N, 3] from the second body towards the first."""

    points: Array
    normals: Array


@dataclass(frozen=True)
class _Near:
    """Tolerances, metres: of the distance at a contact, and of the side that a body is on."""

    band_m: float
    slack_m: float


def find_contacts(a: Surface, b: Surface, band_m: float, overlap_m: float = 0.0) -> Contacts:
    """Contacts of two surfaces up to `band_m` apart or inside one another, where they overlap by this much at most.

    A corner touches a face if it is over it and the faces at the corner are on the outer side of the face's plane. Two edges
    touch where they are nearest if the plane along both has the faces of one on one side and those of the other on the
    other, to within `SLACK_M` and the overlap.
    """
    i, j = _near_faces(a, b, band_m)
    near = _Near(band_m, min(SLACK_M + overlap_m, band_m))
    found = [_corners_on_faces(a, b, i, j, near), _flipped(_corners_on_faces(b, a, j, i, near))]
    found.append(_edges_across_edges(a, b, i, j, near))
    joined = Contacts(*(np.concatenate([getattr(one, name) for one in found]) for name in ("points", "normals")))
    return _without_inner(joined)


def _flipped(one: Contacts) -> Contacts:
    return Contacts(one.points, -one.normals)


def _near_faces(a: Surface, b: Surface, band_m: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The numbers of every two faces whose boxes are within the band."""
    box = np.array([np.maximum(a.bounds[0], b.bounds[0]), np.minimum(a.bounds[1], b.bounds[1])])
    own, other = (each.faces_in(box + np.array([[-2.0 * band_m], [2.0 * band_m]])) for each in (a, b))
    found = [np.empty((0, 2), dtype=np.intp)]
    step = max(1, ROWS_AT_ONCE // max(1, len(other)))
    for k in range(0, len(own), step):
        some = own[k : k + step]
        near = np.ones((len(some), len(other)), dtype=bool)
        for axis in range(3):
            near &= a.boxes[0][some, axis, None] <= b.boxes[1][None, other, axis] + band_m
            near &= b.boxes[0][None, other, axis] <= a.boxes[1][some, axis, None] + band_m
        rows, columns = np.nonzero(near)
        found.append(np.column_stack([some[rows], other[columns]]))
    pairs = np.concatenate(found)
    return pairs[:, 0], pairs[:, 1]


def _corners_on_faces(a: Surface, b: Surface, i: NDArray[np.intp], j: NDArray[np.intp], near: _Near) -> Contacts:
    """Corners of `a` on faces of `b`, with the normals of the faces."""
    pairs = np.unique(np.column_stack([a.faces[i].reshape(-1), np.repeat(j, 3)]), axis=0)
    corner, face = pairs[:, 0], pairs[:, 1]
    points, normals = a.vertices[corner], b.normals[face]
    over = np.abs(_dot(points - b.corners[face, 0], normals)) <= near.band_m
    for k in range(3):
        start, end = b.corners[face, k], b.corners[face, (k + 1) % 3]
        inward = np.cross(normals, end - start)
        over &= _dot(points - start, inward) >= -near.band_m * np.linalg.norm(inward, axis=1)
    corner, points, normals = corner[over], points[over], normals[over]
    face = face[over]
    both = b.open[face]  # either side of an open surface may be the outer one
    corner, points, face = (np.concatenate([every, every[both]]) for every in (corner, points, face))
    normals = np.concatenate([normals, -normals[both]])
    each = zip(corner, b.corners[face, 0], normals, strict=True)
    kept = np.array([_is_beyond(a, a.faces_at(one), at, normal, near) for one, at, normal in each], dtype=bool)
    return Contacts(points[kept], normals[kept])


def _is_beyond(a: Surface, faces: NDArray[np.int64], at: Array, normal: Array, near: _Near) -> bool:
    """Whether faces are on the outer side of the plane through a point, and one of them looks at it."""
    beyond = ((a.corners[faces] - at) @ normal >= -near.slack_m).all()
    looks = a.normals[faces] @ normal
    return bool(beyond and np.where(a.open[faces], -np.abs(looks), looks).min() < -LOOKING)


def _edges_across_edges(a: Surface, b: Surface, i: NDArray[np.intp], j: NDArray[np.intp], near: _Near) -> Contacts:
    """Points where edges pass one another, with the normal across both."""
    pairs = np.column_stack(
        [np.repeat(a.face_edges[i], 3, axis=1).reshape(-1), np.tile(b.face_edges[j], 3).reshape(-1)]
    )
    one, two = np.unique(pairs, axis=0).T
    p, u = a.vertices[a.edges[one, 0]], a.vertices[a.edges[one, 1]] - a.vertices[a.edges[one, 0]]
    q, v = b.vertices[b.edges[two, 0]], b.vertices[b.edges[two, 1]] - b.vertices[b.edges[two, 0]]
    across = np.cross(u, v)
    uu, uv, vv, area = _dot(u, u), _dot(u, v), _dot(v, v), np.linalg.norm(across, axis=1)
    crossing = area > PARALLEL * np.sqrt(uu * vv)
    one, two, p, u, q, v, across, uu, uv, vv, area = (
        each[crossing] for each in (one, two, p, u, q, v, across, uu, uv, vv, area)
    )
    d = q - p
    s = (_dot(d, u) * vv - _dot(d, v) * uv) / area**2
    t = (_dot(d, u) * uv - _dot(d, v) * uu) / area**2
    normals = across / area[:, None]
    hit = (np.abs(_dot(d, normals)) <= near.band_m) & _within(s, uu, near.band_m) & _within(t, vv, near.band_m)
    points = (p + s[:, None] * u + q + t[:, None] * v) / 2
    one, two, normals, points = one[hit], two[hit], normals[hit], points[hit]
    found = [
        (at, side)
        for own, other, at, normal in zip(a.edge_faces[one], b.edge_faces[two], points, normals, strict=True)
        for side in (normal, -normal)
        if _is_beyond(a, own, at, side, near) and _is_beyond(b, other, at, -side, near)
    ]
    return Contacts(*np.array(found).reshape(-1, 2, 3).transpose(1, 0, 2))


def _within(share: Array, length_squared: Array, band_m: float) -> NDArray[np.bool_]:
    """Whether shares of an edge's length lie on it, to within the band."""
    slack = band_m / np.sqrt(length_squared)
    return (share >= -slack) & (share <= 1.0 + slack)


def _without_inner(all_of: Contacts) -> Contacts:
    """The same cone of forces from fewer points: of those in one plane with one normal, the corners of their outline."""
    if len(all_of.points) == 0:
        return all_of
    keys = np.column_stack([all_of.normals, _dot(all_of.points, all_of.normals) * 1e2])
    _, label = np.unique(np.round(keys / SAME_NORMAL), axis=0, return_inverse=True)
    label = label.reshape(-1)
    kept = np.concatenate([_outline(all_of, np.flatnonzero(label == k)) for k in range(label.max() + 1)])
    return Contacts(all_of.points[kept], all_of.normals[kept])


def _outline(all_of: Contacts, members: NDArray[np.intp]) -> NDArray[np.intp]:
    if len(members) <= 3:
        return members
    points = all_of.points[members] - all_of.points[members].mean(axis=0)
    _, spread, axes = np.linalg.svd(points, full_matrices=False)
    along = points @ axes[0]
    if spread[1] <= 1e-9 * spread[0]:
        return members[[along.argmin(), along.argmax()]]
    try:
        return members[ConvexHull(points @ axes[:2].T).vertices]
    except QhullError:
        return members


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("ij,ij->i", a, b)
