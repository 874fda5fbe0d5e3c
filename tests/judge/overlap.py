"""The depth to which two bodies are inside one another, from the boolean intersection of their meshes."""

import itertools

import manifold3d
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from schemas.base import Array
from tests.judge.nearest import distances_to_faces
from tests.judge.surface import Surface

EXACT_TO = 60
"""Corners of a hull up to which its least width is exact: beyond, over its faces alone, which is never less."""

FILLED = 0.5
"""Share of its hull's volume from which a piece is as deep as its hull is narrow. Others are bent sheets."""

MOST_POINTS = 2000
"""Points of a bent sheet at which its thickness is measured."""


def overlap_m(a: Surface, b: Surface) -> float:
    """Metres: the depth of the deepest piece of the intersection, 0 where there is none."""
    if (a.bounds[0] > b.bounds[1]).any() or (b.bounds[0] > a.bounds[1]).any():
        return 0.0
    pieces = (piece for one, other in itertools.product(a.solids, b.solids) for piece in (one ^ other).decompose())
    return max((_depth_m(piece, a, b) for piece in pieces), default=0.0)


def _depth_m(piece: manifold3d.Manifold, a: Surface, b: Surface) -> float:
    """The least width of the piece; of a bent sheet, which is far thinner than its hull, its greatest thickness."""
    mesh = piece.to_mesh64()
    points, faces = np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts, dtype=np.int64)
    width = least_width_m(points)
    if piece.volume() >= FILLED * manifold3d.Manifold.hull_points(np.ascontiguousarray(points)).volume():
        return width
    p, q, r = (points[faces[:, k]] for k in range(3))
    where = np.concatenate([points, (p + q) / 2, (q + r) / 2, (r + p) / 2, (p + q + r) / 3])
    where = where[:: -(-len(where) // MOST_POINTS)]
    box = np.array([points.min(axis=0) - width, points.max(axis=0) + width])
    thickness = np.maximum(*(distances_to_faces(where, each.corners[each.faces_in(box)]) for each in (a, b)))
    return min(width, float(thickness.max()))


def least_width_m(points: Array) -> float:
    """The least distance of two parallel planes with all points [N, 3] between them.

    Attained across a face of the hull or across two of its edges. The hull is taken of the points stretched to like size
    along their principal axes, because that of a sliver is lost in rounding.
    """
    centred = points - points.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred, full_matrices=False)
    if spread[-1] <= 1e-12 * spread[0]:
        return 0.0
    stretched = centred @ axes.T / spread
    try:
        hull = ConvexHull(stretched)
    except QhullError:
        return 0.0
    corners = centred[hull.vertices] @ axes.T
    directions = hull.equations[:, :3] / spread
    if len(corners) <= EXACT_TO:
        ends = np.unique(np.sort(hull.simplices[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
        edges = stretched[ends[:, 1]] - stretched[ends[:, 0]]
        i, j = np.triu_indices(len(edges), 1)
        across = np.cross(edges[i], edges[j])
        directions = np.concatenate([directions, across[np.linalg.norm(across, axis=1) > 1e-9] / spread])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    along = corners @ directions.T
    return float(np.ptp(along, axis=0).min())
