"""Convex hulls of points, by manifold3d, and by Qhull where they are thin."""

from weakref import WeakKeyDictionary

import manifold3d
import numpy as np
from scipy.spatial import ConvexHull

from schemas.base import Array, frozen_array
from schemas.scene.shape import Hull, Shape
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import bounds_of, face_areas, face_normals, hold_to_one_thread, is_first, mesh_of

THIN = 1e-4
"""Ratio of a cloud's least to its largest spread below which Qhull is used: manifold3d's hull leaves out points that stand
out by less than 1e-7 of the cloud's size, which is a part of a thin cloud's thickness."""

FLAT_M = 1e-9
"""A cloud whose least singular value is below this lies in a plane."""

MOST_VERTICES = 30_000
"""Upper limit for a hull: PyBullet takes 131,072 at most, and visits each of them in every step."""

COARSER = 1e-5
"""Tolerance, as a share of the size, of the first simplification of a hull with too many vertices; then four times that."""

NO_AREA = 1e-12
"""Area, as a share of the hull's size squared, below which a triangle's normal is rounding noise."""


def convex_hull(vertices: Array) -> Hull:
    """The hull of points [N, 3], metres; a flat cloud is thickened by joggling it (Qhull's QJ).

    Exact to 1e-7 of the cloud's size, unless it has more than `MOST_VERTICES`: then at most that many are kept, and those
    left out stand out by some 1e-4 of the size at most. Points may repeat. Normals are those of the triangles with an
    area: a face of several triangles has as many normals.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float64)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(_scatter(vertices)), 0.0))
    if spread[0] < THIN * spread[2]:
        return _thin_hull(vertices)
    hold_to_one_thread()
    # Faces that are shaded apart repeat their corners, and a hull takes as long over a point that it has already.
    distinct = is_first(vertices.view(np.int64))
    solid = manifold3d.Manifold.hull_points(vertices[distinct])
    step = COARSER * float(np.linalg.norm(np.ptp(bounds_of(vertices), axis=0)))
    while solid.num_vert() > MOST_VERTICES:
        solid, step = solid.simplify(step), 4.0 * step
        if solid.num_vert() <= MOST_VERTICES:
            solid = solid.hull()
    mesh = mesh_of(solid)
    points = np.ascontiguousarray(mesh.vertices)
    least = NO_AREA * float((np.ptp(bounds_of(points), axis=0) ** 2).sum())
    sized = 2.0 * face_areas(points, mesh.faces) > least
    return Hull(frozen_array(points), frozen_array(face_normals(points, mesh.faces)[sized]))


def hull_of(shape: Shape) -> Hull:
    """The hull of a shape, computed once and kept as long as the shape."""
    if (hull := _hulls.get(shape)) is None:
        hull = _hulls[shape] = convex_hull(shape.vertices)
    return hull


_hulls: WeakKeyDictionary[Shape, Hull] = WeakKeyDictionary()


@compiled_for("f8[:,::1]", "const(f8[:,::1])")
def _scatter(points: Array) -> Array:
    """[3, 3]: the sum over points [N, 3] of the outer products of what they are from their mean."""
    mean, scatter = np.zeros(3), np.zeros((3, 3))
    for point in points:
        for j in range(3):
            mean[j] += point[j] / len(points)
    for point in points:
        for j in range(3):
            for k in range(3):
                scatter[j, k] += (point[j] - mean[j]) * (point[k] - mean[k])
    return scatter


def _thin_hull(vertices: Array) -> Hull:
    """The hull by Qhull, which is three times slower and has no least thickness."""
    unique = np.unique(vertices, axis=0)
    flat = float(np.linalg.svd(unique - unique.mean(axis=0), compute_uv=False)[-1]) < FLAT_M
    hull = ConvexHull(unique, qhull_options="QJ" if flat else "Qt")
    return Hull(frozen_array(unique[hull.vertices]), frozen_array(hull.equations[:, :3]))


def least_width_m(hull: Hull) -> float:
    """The least distance, metres, between the plane of a face and the vertex farthest from it.

    Two crossing edges may be nearer: a regular tetrahedron's are by 13 %.
    """
    return float(_least_width(hull.vertices, hull.normals))


@compiled_for("const(f8[:,::1]), const(f8[:,::1])")
def _least_width(points: Array, normals: Array) -> float:
    """The least, over unit normals [F, 3], of the length of points [N, 3] along one."""
    least, top, bottom = np.inf, 0, 0
    for f in range(len(normals)):
        x, y, z = normals[f]
        # Begins with what is farthest along the normal before: most normals are passed over at these two points
        high = x * points[top, 0] + y * points[top, 1] + z * points[top, 2]
        low = x * points[bottom, 0] + y * points[bottom, 1] + z * points[bottom, 2]
        for n in range(len(points)):
            if high - low >= least:
                break
            along = x * points[n, 0] + y * points[n, 1] + z * points[n, 2]
            if along > high:
                high, top = along, n
            if along < low:
                low, bottom = along, n
        least = min(least, high - low)
    return least


@compiled_for("f8[:,::1], const(f8[:,::1])")
def depth_m(points: Array, normals: Array) -> float:
    """The least, over unit normals [F, 3], of how far points [N, 3] reach along one from the origin, metres.

    Of a hull's vertices and normals: the depth of the origin in it.
    """
    least, start = np.inf, 0
    for f in range(len(normals)):
        most, farthest = -np.inf, start
        for n in range(len(points)):
            # Begins with what is farthest along the normal before: most normals are passed over at the first point
            at = (start + n) % len(points)
            along = points[at, 0] * normals[f, 0] + points[at, 1] * normals[f, 1] + points[at, 2] * normals[f, 2]
            if along > most:
                most, farthest = along, at
                if most >= least:
                    break
        least, start = min(least, most), farthest
    return float(least)
