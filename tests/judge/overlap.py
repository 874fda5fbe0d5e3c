"""The depth to which two bodies are inside one another, from the boolean intersection of their meshes."""

import itertools

import manifold3d
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from schemas.base import Array
from tests.judge.nearest import distances_to_faces, winding_numbers
from tests.judge.surface import Surface

EXACT_TO = 60
"""Corners of a hull up to which its least width is exact: beyond, over its faces alone, which is never less."""

FILLED = 0.95
"""Share of its hull's volume from which a piece is convex."""

MOST_POINTS = 2000
"""Points of a piece at which its thickness is measured."""


TOGETHER = 32
"""Points whose distances are measured together."""


def overlap_m(a: Surface, b: Surface) -> float:
    """Metres: the depth of the deepest piece of the intersection, 0 where there is none."""
    if (a.bounds[0] > b.bounds[1]).any() or (b.bounds[0] > a.bounds[1]).any():
        return 0.0
    pieces = (piece for one, other in itertools.product(a.solids, b.solids) for piece in (one ^ other).decompose())
    depths = [_depth_m(piece, a, b) for piece in pieces]
    return max([*depths, _open_depth_m(a, b), _open_depth_m(b, a)])


def _open_depth_m(a: Surface, b: Surface) -> float:
    """The depth of open pieces of `a` inside the bodies of `b`, at their corners and the middles of edges and faces.

    What reaches through an open surface between these is not found: it has no inside.
    """
    faces = a.faces[a.open]
    if len(faces) == 0 or not b.solids:
        return 0.0
    where = _samples(a.vertices, faces)
    where = where[((where > b.bounds[0]) & (where < b.bounds[1])).all(axis=1)]
    closed = b.corners[~b.open]
    inside = where[winding_numbers(where, closed) > 0.5]
    return float(distances_to_faces(inside, closed).max()) if len(inside) else 0.0


def _samples(points: Array, faces: NDArray[np.int64]) -> Array:
    """[N, 3]: corners of faces, middles of their edges and of themselves."""
    p, q, r = (points[faces[:, k]] for k in range(3))
    return np.unique(np.concatenate([p, q, r, (p + q) / 2, (q + r) / 2, (r + p) / 2, (p + q + r) / 3]), axis=0)


def _depth_m(piece: manifold3d.Manifold, a: Surface, b: Surface) -> float:
    """The least distance by which one must move to leave the other here, or a little less: the larger of two lower bounds.

    The piece's thickness at a point is the point's depth in one of the bodies. And a convex piece, moved by less than its
    least width, still meets itself. The second counts where edges cross, whose piece ends in edges.
    """
    mesh = piece.to_mesh64()
    points, faces = np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts, dtype=np.int64)
    where = _samples(points, faces)
    where = where[:: -(-len(where) // MOST_POINTS)]
    thickness = max(_greatest_distance_m(where, each) for each in (a, b))
    if piece.volume() < FILLED * manifold3d.Manifold.hull_points(np.ascontiguousarray(points)).volume():
        return thickness
    return max(thickness, least_width_m(points))


def _greatest_distance_m(points: Array, of: Surface) -> float:
    """From points to the surface: some neighbours at a time, and of it what is nearer than their nearest corners."""
    order = np.argsort(points[:, np.ptp(points, axis=0).argmax()])
    greatest = 0.0
    for k in range(0, len(points), TOGETHER):
        some = points[order[k : k + TOGETHER]]
        reach = of.corner_tree.query(some)[0].max()
        near = of.faces_in(np.array([some.min(axis=0) - reach, some.max(axis=0) + reach]))
        greatest = max(greatest, float(distances_to_faces(some, of.corners[near]).max()))
    return greatest


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
