"""Convex hulls."""

import manifold3d
import numpy as np
from scipy.spatial import ConvexHull

from schemas.base import Array, frozen_array
from schemas.scene.shape import Hull
from workers.geometry.manifold import hold_to_one_thread

THIN = 1e-4
"""A cloud whose spread across its plane is below this share of its spread along it is left to Qhull: manifold3d's hull
leaves out points that stand out by less than 1e-7 of the cloud's size, which means something there."""

FLAT_M = 1e-9
"""A cloud whose least singular value is below this lies in a plane."""

MOST_VERTICES = 30_000
"""Of a hull: PyBullet takes 131,072 at most, and looks at each of them in every step."""

COARSER = 1e-5
"""By how much of its size a hull with too many vertices is made coarser first; then by four times as much, and so on."""

NO_AREA = 1e-12
"""A triangle whose area is below this share of the hull's size squared has no direction that can be trusted."""


def convex_hull(vertices: Array) -> Hull:
    """The hull of a vertex cloud [N, 3], metres; a flat cloud is thickened by joggling it (Qhull's QJ).

    Exact to 1e-7 of the cloud's size, unless it has more than `MOST_VERTICES`: then as many as that are kept, and those
    left out stand out by some 1e-4 of the size at most. Points may come more than once. Normals are those of triangles,
    so that a face of the hull may have many, and are those of the triangles that have an area.
    """
    centred = vertices - vertices.mean(axis=0)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(centred.T @ centred), 0.0))
    if spread[0] < THIN * spread[2]:
        return _thin_hull(vertices)
    hold_to_one_thread()
    solid = manifold3d.Manifold.hull_points(np.ascontiguousarray(vertices))
    step = COARSER * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    while solid.num_vert() > MOST_VERTICES:
        solid, step = solid.simplify(step), 4.0 * step
        if solid.num_vert() <= MOST_VERTICES:
            solid = solid.hull()
    mesh = solid.to_mesh64()
    points = np.array(mesh.vert_properties, dtype=np.float64)
    a, b, c = points[np.asarray(mesh.tri_verts, dtype=np.int64).T]
    ab, ac = b - a, c - a
    across = np.stack(
        [ab[:, (k + 1) % 3] * ac[:, (k + 2) % 3] - ab[:, (k + 2) % 3] * ac[:, (k + 1) % 3] for k in range(3)], 1
    )
    doubled = np.sqrt((across * across).sum(axis=1))
    kept = doubled > NO_AREA * float(((points.max(axis=0) - points.min(axis=0)) ** 2).sum())
    return Hull(frozen_array(points), frozen_array(across[kept] / doubled[kept, None]))


def _thin_hull(vertices: Array) -> Hull:
    """The hull by Qhull, which is three times slower and knows no least thickness."""
    unique = np.unique(vertices, axis=0)
    flat = float(np.linalg.svd(unique - unique.mean(axis=0), compute_uv=False)[-1]) < FLAT_M
    hull = ConvexHull(unique, qhull_options="QJ" if flat else "Qt")
    return Hull(frozen_array(unique[hull.vertices]), frozen_array(hull.equations[:, :3]))
