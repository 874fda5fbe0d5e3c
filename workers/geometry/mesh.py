"""Meshes: bounds, equal rows, welding, connected pieces, planes of faces, convexity, and conversion from and to manifold3d."""

import functools
import os
from collections.abc import Sequence

import manifold3d
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.distance import distance_to_mesh
from workers.geometry.jit import compiled, compiled_for


def bounds_of(points: Array) -> Array:
    """[2, D] float64: lower and upper corner of the axis-aligned bounding box of points [N, D], N > 0.

    numpy's minimum along the first axis takes ten times as long. Points must not hold nan.
    """
    return _bounds_of(np.ascontiguousarray(points))


@compiled_for("f8[:,::1]", "const(f8[:,::1])")
def _bounds_of(points: Array) -> Array:
    bounds = np.empty((2, points.shape[1]))
    bounds[0], bounds[1] = np.inf, -np.inf
    for n in range(len(points)):
        for axis in range(points.shape[1]):
            bounds[0, axis] = min(bounds[0, axis], points[n, axis])
            bounds[1, axis] = max(bounds[1, axis], points[n, axis])
    return bounds


FRACTION_OF_2_64 = -0x61C8864680B583EB
"""2^64 over the golden ratio, as a signed number: its multiples are spread evenly (Knuth, The Art of Computer Programming
vol. 3, 6.4)."""


def is_first(rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[N]: whether no row before is equal to a row, of rows [N, 3]."""
    return first_equal(rows) == np.arange(len(rows))


@compiled_for("i8[:,::1]", "const(i8[:,::1])")
def first_equal(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """[N]: the first place of a row equal to each of the rows [N, 3]; a row's own where none before it is equal.

    By a hash table: `np.unique` takes forty times as long. Coordinates are given by their bits (`array.view`), among which
    0.0 and -0.0 differ.
    """
    size, shift = 4, 62
    while size < 2 * len(rows):
        size, shift = 2 * size, shift - 1
    slots, first = np.full(size, -1), np.empty(len(rows), np.int64)
    for n in range(len(rows)):
        x, y, z = rows[n, 0], rows[n, 1], rows[n, 2]
        slot = ((x ^ (y >> 21) ^ (y << 43) ^ (z >> 42) ^ (z << 22)) * FRACTION_OF_2_64 >> shift) & (size - 1)
        while slots[slot] >= 0:
            known = slots[slot]
            if rows[known, 0] == x and rows[known, 1] == y and rows[known, 2] == z:
                break
            slot = (slot + 1) & (size - 1)
        if slots[slot] < 0:
            slots[slot] = n
        first[n] = slots[slot]
    return first


@functools.cache
def hold_to_one_thread() -> None:
    """Limits manifold3d's thread pool to one core; to be called before manifold3d is used.

    The pool counts the cores that the calling thread may use at the first boolean, and never again: so the first boolean
    is made while only one core is allowed.
    """
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        cube = manifold3d.Manifold.cube()
        (cube + cube.translate((0.5, 0.3, 0.2))).num_tri()
    finally:
        os.sched_setaffinity(0, allowed)


CONVEX_SHARE = 0.9999
"""Share of its hull's volume from which a body is convex."""

SHALLOW_M = 5e-5
"""Concavity up to which a surface is convex: the distance at which surfaces count as touching."""


def fills_hull(volume_m3: float, points: Array) -> bool:
    """Whether a body of this volume is convex: it fills the hull of its points [N, 3], metres."""
    hold_to_one_thread()
    return bool(volume_m3 >= CONVEX_SHARE * manifold3d.Manifold.hull_points(np.ascontiguousarray(points)).volume())


def is_convex_surface(mesh: Mesh, solid: manifold3d.Manifold | None) -> bool:
    """Whether a welded mesh is convex, by the volume of the `solid` that it encloses or by its concavity."""
    return (solid is not None and fills_hull(solid.volume(), mesh.vertices)) or concavity_m(mesh) <= SHALLOW_M


def weld(mesh: Mesh) -> Mesh:
    """The mesh with one vertex at each place, without loose vertices, repeated triangles and triangles of two corners."""
    used = numbers_in(mesh.faces, len(mesh.vertices))
    points = np.ascontiguousarray(mesh.vertices[used])
    places, faces = _welded(points, np.lexsort(points.T[::-1]), used, mesh.faces, len(mesh.vertices))
    return Mesh(points[places], faces[is_first(np.sort(faces, axis=1).astype(np.int64))])


@compiled_for("f8[:,::1], i8[::1], i8[::1], i4[:,::1], i8", "f8[:,::1], i8[::1], i8[::1], const(i4[:,::1]), i8")
def _welded(
    points: Array, order: NDArray[np.int64], used: NDArray[np.int64], faces: NDArray[np.integer], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """(the first point [V] at each place, faces [F, 3] of places), without triangles of two corners.

    points [N, 3], with the numbers `used` [N] of `count` vertices that faces [F, 3] are into; order: the points' ascending order.
    """
    place, firsts, found = np.empty(count, np.int32), np.empty(len(points), np.int64), 0
    for n in range(len(order)):
        a, b = order[n], order[n - 1]
        if n == 0 or points[a, 0] != points[b, 0] or points[a, 1] != points[b, 1] or points[a, 2] != points[b, 2]:
            firsts[found] = a
            found += 1
        place[used[a]] = found - 1
    kept, rows = np.empty((len(faces), 3), np.int32), 0
    for f in range(len(faces)):
        a, b, c = place[faces[f, 0]], place[faces[f, 1]], place[faces[f, 2]]
        if a != b and b != c and c != a:
            kept[rows, 0], kept[rows, 1], kept[rows, 2] = a, b, c
            rows += 1
    return firsts[:found].copy(), kept[:rows].copy()


def unique_rows(rows: Array) -> Array:
    """The rows [N, 3] without repetitions, in ascending order.

    By one column after the other: `np.unique` compares rows as records, which takes four times as long.
    """
    ranked, new = rows[np.lexsort(rows.T[::-1])], np.ones(len(rows), dtype=np.bool_)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    return ranked[new]


def numbers_in(numbers: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """[N] ascending: which of the numbers below `count` occur."""
    occurs = np.zeros(count, dtype=np.bool_)
    occurs[numbers] = True
    return np.flatnonzero(occurs)


def components(mesh: Mesh) -> list[Mesh]:
    """The pieces of a welded mesh that share no vertex, in the order of their first vertex, without loose vertices."""
    ends = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    count = len(mesh.vertices)
    links = coo_matrix((np.ones(len(ends), dtype=np.int8), (ends[:, 0], ends[:, 1])), shape=(count, count))
    label = connected_components(links, directed=False)[1]
    used, first = np.unique(label[mesh.faces[:, 0]], return_index=True)
    return [
        piece_of(mesh, mesh.faces[label[mesh.faces[:, 0]] == one]) for one in used[np.argsort(first, kind="stable")]
    ]


def piece_of(mesh: Mesh, faces: NDArray[np.integer]) -> Mesh:
    """These faces [F, 3] of a mesh, with the vertices that they have."""
    kept, inverse = np.unique(faces, return_inverse=True)
    return Mesh(mesh.vertices[kept], inverse.reshape(-1, 3).astype(np.int32))


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Meshes of one frame as one."""
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + np.int32(begin) for mesh, begin in zip(meshes, first, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def concavity_m(mesh: Mesh) -> float:
    """The depth of the surface below its hull, metres: the largest distance from the hull to the mesh.

    Measured at the middle of each triangle of the hull and of each of its edges; a dent deeper than wide may be deeper
    than that. From the mesh to the hull a thin wall would count by its thickness only.
    """
    hull = manifold3d.Manifold.hull_points(np.ascontiguousarray(mesh.vertices))
    if hull.is_empty():  # flat
        return 0.0
    surface = mesh_of(hull)
    corners = surface.vertices[surface.faces]
    points = np.concatenate([corners.mean(axis=1), ((corners + np.roll(corners, 1, axis=1)) / 2).reshape(-1, 3)])
    return float(distance_to_mesh(points, mesh)[0].max())


def face_planes(mesh: Mesh) -> tuple[Array, Array]:
    """(normals [F, 3], offsets [F]): unit normal n of each face, 0 where it has no area, and n . p of its points p."""
    vertices, faces = np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.faces)
    normals = face_normals(vertices, faces)
    corners = vertices[faces[:, 0]]
    x, y, z = (corners[:, axis] * normals[:, axis] for axis in range(3))
    return normals, x + z + y  # as `frames.dot` adds


@compiled_for("f8[:,::1], const(i4[:,::1])", "f8[:,::1], i8[:,::1]", "const(f8[:,::1]), const(i4[:,::1])")
def face_normals(vertices: Array, faces: NDArray[np.integer]) -> Array:
    """[F, 3]: unit normals of faces [F, 3] with contiguous vertices [V, 3]; zeros of a face without an area."""
    normals = np.zeros((len(faces), 3))
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0.0:
            normals[face, 0], normals[face, 1], normals[face, 2] = x / length, y / length, z / length
    return normals


def face_areas(vertices: Array, faces: NDArray[np.integer]) -> Array:
    """[F]: areas of faces [F, 3] with vertices [V, 3]."""
    a, b, c = (vertices[faces[:, corner]].T for corner in range(3))
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    areas: Array = np.sqrt(x * x + y * y + z * z) / 2.0
    return areas


def has_rim(faces: NDArray[np.integer], count: int) -> bool:
    """Whether some edge of faces [F, 3] into `count` vertices has one face alone."""
    keys = np.sort(edge_keys(faces, count))
    starts = np.ones(len(keys) + 1, np.bool_)  # of an edge, and the end
    starts[1:-1] = keys[1:] != keys[:-1]
    return bool((starts[:-1] & starts[1:]).any())


def edge_keys(faces: NDArray[np.integer], count: int) -> NDArray[np.int64]:
    """[3 F]: a number for each edge of each face [F, 3], the same for two faces' common edge."""
    one = faces.astype(np.int64)
    other = one[:, [1, 2, 0]]
    return (np.minimum(one, other) * count + np.maximum(one, other)).ravel()


def solid_of(mesh: Mesh) -> manifold3d.Manifold | None:
    """The solid that a welded mesh encloses, wound either way; None where the mesh is not closed, or not a manifold."""
    if has_rim(mesh.faces, len(mesh.vertices)):
        return None
    hold_to_one_thread()
    for faces in (mesh.faces, mesh.faces[:, ::-1]):
        solid = manifold3d.Manifold(
            manifold3d.Mesh64(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(faces.astype(np.uint64)))
        )
        if solid.status() != manifold3d.Error.NoError:
            return None
        if solid.volume() > 0.0:
            return solid
    return None


def mesh_of(solid: manifold3d.Manifold) -> Mesh:
    """The surface of a solid."""
    mesh = solid.to_mesh64()
    return Mesh(np.array(mesh.vert_properties, dtype=np.float64)[:, :3], np.array(mesh.tri_verts, dtype=np.int32))


def corner_weights(points: Array, mesh: Mesh, face: NDArray[np.int64]) -> tuple[NDArray[np.int32], Array]:
    """(corners [N, 3] of the faces [N], weights [N, 3]) with which vertices of a mesh add up to points [N, 3] on these faces."""
    corners = np.ascontiguousarray(mesh.faces[face])
    return corners, _weights(np.ascontiguousarray(points), np.ascontiguousarray(mesh.vertices), corners)


@compiled_for("f8[:,::1], f8[:,::1], i4[:,::1]", "f8[:,::1], const(f8[:,::1]), i4[:,::1]")
def _weights(points: Array, vertices: Array, corners: NDArray[np.int32]) -> Array:
    """Barycentric coordinates (Ericson, Real-Time Collision Detection 2005, 3.4); beyond a face, of its edges' nearest point."""
    weights = np.zeros((len(points), 3))
    for n in range(len(points)):
        a, b, c = corners[n, 0], corners[n, 1], corners[n, 2]
        d00 = d01 = d11 = d20 = d21 = 0.0
        for axis in range(3):
            u, v = vertices[b, axis] - vertices[a, axis], vertices[c, axis] - vertices[a, axis]
            w = points[n, axis] - vertices[a, axis]
            d00 += u * u
            d01 += u * v
            d11 += v * v
            d20 += w * u
            d21 += w * v
        area, second, third = d00 * d11 - d01 * d01, d11 * d20 - d01 * d21, d00 * d21 - d01 * d20
        if area > 0.0 and second >= 0.0 and third >= 0.0 and second + third <= area:
            weights[n, 1], weights[n, 2] = second / area, third / area
            weights[n, 0] = 1.0 - weights[n, 1] - weights[n, 2]
        else:
            weigh_edges(points[n], vertices, corners[n], weights[n])
    return weights


@compiled
def weigh_edges(point: Array, vertices: Array, corners: NDArray[np.int32], weights: Array) -> None:
    """Sets the weights [3] of the point of a face's edges that is nearest to `point`."""
    nearest = np.inf
    for side in range(3):
        start, end, along, square, away = corners[side], corners[(side + 1) % 3], 0.0, 0.0, 0.0
        for axis in range(3):
            edge = vertices[end, axis] - vertices[start, axis]
            along += edge * (point[axis] - vertices[start, axis])
            square += edge * edge
        share = min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0
        for axis in range(3):
            edge = vertices[end, axis] - vertices[start, axis]
            away += (point[axis] - vertices[start, axis] - share * edge) ** 2
        if away < nearest:
            nearest = away
            weights[side], weights[(side + 1) % 3], weights[(side + 2) % 3] = 1.0 - share, share, 0.0


def mix(values: Array, corners: NDArray[np.int32], weights: Array) -> Array:
    """[N, C]: values [V, C] of vertices, interpolated with weights [N, 3] of corners [N, 3]."""
    return _mix(np.ascontiguousarray(values, dtype=np.float64), corners, weights)


@compiled_for("f8[:,::1], i4[:,::1], f8[:,::1]", "const(f8[:,::1]), i4[:,::1], f8[:,::1]")
def _mix(values: Array, corners: NDArray[np.int32], weights: Array) -> Array:
    mixed = np.zeros((len(corners), values.shape[1]))
    for n in range(len(corners)):
        for corner in range(3):
            for channel in range(values.shape[1]):
                mixed[n, channel] += weights[n, corner] * values[corners[n, corner], channel]
    return mixed


@compiled_for("const(u1[:,:,::1]), f8[:,::1], f8[::1]", "u1[:,:,::1], f8[:,::1], f8[::1]")
def sample_texture(texture: NDArray[np.uint8], uv: Array, light: Array) -> Array:
    """[N, 3]: linear light of a texture [h, w, 3 or 4] at uv [N, 2], bilinear among four texels, repeated beyond its edges.

    uv (0, 0) is the lower left corner; light [256]: of each code.
    """
    height, width = texture.shape[:2]
    sampled = np.zeros((len(uv), 3))
    for n in range(len(uv)):
        x, y = uv[n, 0] * width - 0.5, (1.0 - uv[n, 1]) * height - 0.5
        left, top = np.floor(x), np.floor(y)
        for corner in range(4):
            right, down = corner % 2, corner // 2
            share = (x - left if right else 1.0 - x + left) * (y - top if down else 1.0 - y + top)
            texel = texture[(int(top) + down) % height, (int(left) + right) % width]
            for channel in range(3):
                sampled[n, channel] += share * light[texel[channel]]
    return sampled
