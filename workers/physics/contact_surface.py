"""What of a mesh may touch another: its corners, edges and faces, each with its neighbours, and its outermost layer. Pure."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.distance import dot, nearest_on_segments, nearest_on_triangle
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import bounds_of, edge_keys, face_normals, has_rim, numbers_in, weld

SLOPE = 0.02
"""Slope, about a degree, up to which a surface that falls below the plane of contact may still lie on it."""


Index = NDArray[np.int64]


@compiled_for(
    "f8[:,::1], const(i4[:,::1]), f8[::1], f8[::1]",
    "f8[:,::1], i8[:,::1], f8[::1], f8[::1]",
    "const(f8[:,::1]), const(i4[:,::1]), f8[::1], f8[::1]",
)
def bounds_in(points: Array, features: NDArray[np.integer], low: Array, high: Array) -> tuple[Index, Array, Array]:
    """(numbers [N], lower and upper bounds [N, 3]) of the features [F, K], corners by number, whose bounds overlap a box."""
    numbers, count = np.empty(len(features), np.int64), 0
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
            numbers[count] = f
            count += 1
    return numbers[:count], least[:count], most[:count]


def find_near(low: Array, high: Array, others_low: Array, others_high: Array, within: float) -> Index:
    """[N, 2]: the pairs of two lists of boxes, bounds [A, 3] and [B, 3], with at most `within` between them on each axis.

    Sorted by the first box. The second list is swept along the axis on which it extends farthest, cut to where the first is:
    a box as wide as a floor would have every other one looked at.
    """
    if len(low) == 0 or len(others_low) == 0:
        return np.empty((0, 2), np.int64)
    axis = int((others_high.max(axis=0) - others_low.min(axis=0)).argmax())
    starts = np.maximum(others_low[:, axis], low[:, axis].min() - within)
    ends = np.minimum(others_high[:, axis], high[:, axis].max() + within)
    widest, order = float((ends - starts).max()), np.argsort(starts, kind="stable")
    return _sweep(low, high, others_low, others_high, within, axis, widest, order, starts[order])


@compiled_for("f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8, i8, f8, i8[::1], f8[::1]")
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


FLAT = 1e-9
"""One minus the cosine between two faces, below which there is no edge between them."""

WHOLE = 1e-6
"""Share of its area by which a patch of faces in one plane may miss its hull and still count as convex."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A welded mesh with the neighbours of its features.

    vertices [V, 3] metres; faces [F, 3]; side [F]: 1 where all about a face lies below its plane as it is wound, -1 where
    all lies above, 0 where neither or both, and on a surface that is not closed, which has no inside; 1 where it is known to be
    wound outwards: nothing meets a face from behind. corners [C]:
    vertices that are not within a plane; edges [E, 2] that bend or bound, across [E, 2]: the vertices beside them (twice the
    same at one triangle); starts [V + 1] and members: the neighbours of each vertex. welded: the mesh with its faces of no area.
    """

    vertices: Array
    faces: Index
    side: Index
    corners: Index
    edges: Index
    across: Index
    starts: Index
    members: Index
    welded: Mesh


def surface_of(mesh: Mesh, closed: bool, outward: bool = False) -> Surface:
    """The features of a mesh, or of a part of one that is `closed`, whichever way its faces are wound, if not `outward`."""
    mesh = weld(mesh)
    vertices, faces = np.ascontiguousarray(mesh.vertices, dtype=np.float64), mesh.faces.astype(np.int64)
    normals = face_normals(vertices, faces)
    solid = normals.any(axis=1)
    faces, normals = faces[solid], normals[solid]
    edges, across, bent = _edges(vertices, faces, normals, *_half_edges(faces, len(vertices)), outward)
    # The neighbours of each vertex, one after the other, ascending as edges are
    ends, others = edges[:, ::-1].T.ravel(), edges.T.ravel()
    starts = np.append(0, np.cumsum(np.bincount(ends, minlength=len(vertices))))
    members = others[np.argsort(ends, kind="stable")]
    if outward:
        side = np.ones(len(faces), dtype=np.int64)
    else:
        side = _sides(vertices, faces, normals, starts, members) if closed else np.zeros(len(faces), dtype=np.int64)
    edges, across = edges[bent], across[bent]
    return Surface(vertices, faces, side, numbers_in(edges, len(vertices)), edges, across, starts, members, mesh)


def is_closed(mesh: Mesh) -> bool:
    """Whether every edge of a mesh has two faces or more, once its vertices at one place are one."""
    mesh = weld(mesh)
    return not has_rim(mesh.faces, len(mesh.vertices))


def crop(mesh: Mesh, low: Array, high: Array) -> Mesh:
    """The triangles that overlap a box, bounds [3] and [3], with all that may share a corner with one of them."""
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    near, least, most = bounds_in(vertices, mesh.faces, low, high)
    if len(near):
        near, _, _ = bounds_in(vertices, mesh.faces, bounds_of(least)[0], bounds_of(most)[1])
    return Mesh(mesh.vertices, mesh.faces[near])


def _half_edges(faces: Index, count: int) -> tuple[Index, Index]:
    """(keys [3 F], ascending, the same for the sides of one edge; which [3 F] sides these are, three times their face and on)."""
    keys = edge_keys(faces, count)
    which = np.argsort(keys, kind="stable")
    return keys[which], which


@compiled_for("f8[:,::1], i8[:,::1], f8[:,::1], i8[::1], i8[::1]")
def _sides(vertices: Array, faces: Index, normals: Array, starts: Index, members: Index) -> Index:
    """[F]: on which side of a face's plane everything about its corners lies, to within `SLOPE`."""
    side = np.empty(len(faces), np.int64)
    for f in range(len(faces)):
        below, above = True, True
        for c in range(3):
            corner = faces[f, c]
            for m in range(starts[corner], starts[corner + 1]):
                up = length2 = 0.0
                for k in range(3):
                    line = vertices[members[m], k] - vertices[corner, k]
                    up += line * normals[f, k]
                    length2 += line * line
                slack = SLOPE * np.sqrt(length2)
                below = below and up <= slack
                above = above and up >= -slack
        side[f] = np.int64(below) - np.int64(above)
    return side


@compiled_for("f8[:,::1], i8[:,::1], f8[:,::1], i8[::1], i8[::1], b1")
def _edges(
    vertices: Array, faces: Index, normals: Array, keys: Index, which: Index, outward: bool
) -> tuple[Index, Index, Index]:
    """The edges [E, 2] of half edges, the vertices across them [E, 2], and those [B] that may meet another.

    These are not between coplanar faces, nor, of faces that are wound outwards, the bottom of a groove.
    """
    edges, across, bent = np.empty((len(keys), 2), np.int64), np.empty((len(keys), 2), np.int64), np.empty_like(keys)
    count = first = bends = 0
    for last in range(len(keys)):
        if last + 1 < len(keys) and keys[last + 1] == keys[last]:
            continue
        (f, m), (g, n), (i, j) = divmod(which[first], 3), divmod(which[last], 3), divmod(keys[last], len(vertices))
        v, w = faces[f, (m + 2) % 3], faces[g, (n + 2) % 3]
        edges[count, 0], edges[count, 1], across[count, 0], across[count, 1] = i, j, v, w
        bent[bends] = count
        even = last == first + 1 and abs(dot(normals[f], normals[g])) > 1.0 - FLAT
        # Two faces folded onto one another are coplanar, and their edge is bent all the same: p and q are on one side of it
        if even and v != w:
            along, p, q = vertices[j] - vertices[i], vertices[v] - vertices[i], vertices[w] - vertices[i]
            even = not dot(p, q) * dot(along, along) > dot(along, p) * dot(along, q)
        groove = outward and last == first + 1 and dot(normals[f], vertices[w] - vertices[i]) > 0.0
        bends += not (even or groove)
        count, first = count + 1, last + 1
    return edges[:count], across[:count], bent[:bends]


def faces_within(one: tuple[Array, Index], other: tuple[Array, Index], within_m: float) -> tuple[Index, Index]:
    """The faces of each of two meshes, vertices [V, 3] and faces [F, 3], that are at most `within_m` from the other's."""
    low = np.maximum(one[0].min(axis=0), other[0].min(axis=0)) - within_m
    high = np.minimum(one[0].max(axis=0), other[0].max(axis=0)) + within_m
    (m, a, b), (n, c, d) = (bounds_in(points, faces, low, high) for points, faces in (one, other))
    pairs = find_near(a, b, c, d, within_m)
    pairs = np.stack([m[pairs[:, 0]], n[pairs[:, 1]]], axis=1)
    near = _near(one[0], one[1], other[0], other[1], pairs, within_m)
    return np.unique(pairs[near, 0]), np.unique(pairs[near, 1])


@compiled_for("f8[:,::1], i8[:,::1], f8[:,::1], i8[:,::1], i8[:,::1], f8")
def _near(p: Array, p_faces: Index, q: Array, q_faces: Index, pairs: Index, within: float) -> NDArray[np.bool_]:
    """[N]: whether two triangles that do not pierce one another are within a distance."""
    near, limit, here, there = np.zeros(len(pairs), np.bool_), within * within, np.empty(3), np.empty(3)
    for n in range(len(pairs)):
        a, b = p[p_faces[pairs[n, 0]]], q[q_faces[pairs[n, 1]]]
        for k in range(3):
            if near[n]:
                break
            nearest_on_triangle(a[k], b, here)
            near[n] = ((a[k] - here) ** 2).sum() <= limit
            nearest_on_triangle(b[k], a, here)
            near[n] = near[n] or ((b[k] - here) ** 2).sum() <= limit
        for k in range(9):
            if near[n]:
                break
            nearest_on_segments(a[k // 3], a[(k // 3 + 1) % 3], b[k % 3], b[(k % 3 + 1) % 3], here, there)
            near[n] = ((there - here) ** 2).sum() <= limit
    return near


def skin_of(surface: Surface, which: Index, deepest_m: float, inset_m: float) -> tuple[Array, ...]:
    """Pyramids [N, 3] below these faces: their corners, and a point at most `deepest_m` below their middle.

    Faces in one plane that fill a convex outline are one piece, else each is its own. No pyramid reaches out of a wedge between
    faces: its sides lean by at most half of the wedge's angle, and by 45 degrees at most. On a surface without an inside, and
    where a wedge is sharp, it is flat. All of it is `inset_m` further inside.
    """
    vertices, faces = surface.vertices, surface.faces
    normals = face_normals(vertices, faces)
    patch, lean = _patches(vertices, faces, normals)
    pieces, outward = [], _outward(surface)
    members = np.argsort(patch, kind="stable")
    first = np.searchsorted(patch[members], np.arange(patch.max(initial=-1) + 2))
    for number in np.unique(patch[which]).tolist():
        group = members[first[number] : first[number + 1]]
        whole = _outline(vertices, faces[group], normals[group[0]])
        if whole is not None:
            pieces.append(_pyramid(whole, outward * normals[group[0]], lean[group].min(), deepest_m, inset_m))
        else:
            for face in group[np.isin(group, which)]:
                pieces.append(_pyramid(vertices[faces[face]], outward * normals[face], lean[face], deepest_m, inset_m))
    return tuple(pieces)


def _pyramid(outline: Array, outward: Array, lean: float, deepest_m: float, inset_m: float) -> Array:
    """The corners [N, 3] of a convex outline, in order, with a point below its middle; all `inset_m` below its plane."""
    middle, ahead = outline.mean(axis=0), np.roll(outline, -1, axis=0) - outline
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    inside_m = float(np.linalg.norm(np.cross(ahead, middle - outline), axis=1).min())
    apex = middle - min(deepest_m, lean * inside_m) * outward
    return np.concatenate([outline, apex[None]]) - inset_m * outward


def _outline(vertices: Array, faces: Index, normal: Array) -> Array | None:
    """The corners [N, 3] of coplanar faces, in order, where they fill a convex outline."""
    if len(faces) == 1:
        return vertices[faces[0]]
    corners = vertices[np.unique(faces)]
    x = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    x /= np.linalg.norm(x)
    flat = (corners - corners.mean(axis=0)) @ np.stack([x, np.cross(normal, x)]).T
    hull = ConvexHull(flat)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area2 = float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return corners[hull.vertices] if abs(2.0 * hull.volume - area2) <= WHOLE * area2 else None


def _patches(vertices: Array, faces: Index, normals: Array) -> tuple[NDArray[np.int32], Array]:
    """(patch [F] of each face, those that follow one another in a plane are one; lean [F]).

    lean: tangent of half the sharpest angle between a face and a neighbour that is not of its patch, as if all edges were
    convex; at most 1.
    """
    keys, which = _half_edges(faces, len(vertices))
    same = keys[1:] == keys[:-1]
    one, other = which[:-1][same] // 3, which[1:][same] // 3
    cosine = np.einsum("ij,ij->i", normals[one], normals[other])
    even = cosine > 1.0 - FLAT
    links = coo_array((np.ones(even.sum()), (one[even], other[even])), shape=(len(faces), len(faces)))
    patch = connected_components(links, directed=False)[1]
    tangent = np.sqrt(np.maximum(0.0, 1.0 + cosine) / np.maximum(1e-12, 1.0 - cosine))
    lean = np.ones(len(faces))
    np.minimum.at(lean, one[~even], tangent[~even])
    np.minimum.at(lean, other[~even], tangent[~even])
    return patch, lean


def _outward(surface: Surface) -> float:
    """1 where normals point out of the body, -1 where they point into it, 0 where there is none."""
    if not surface.side.any():
        return 0.0
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    return float(np.sign(np.einsum("ij,ij->", a, np.cross(b, c))))
