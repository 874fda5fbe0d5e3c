"""Convex hulls of points, by manifold3d and by Qhull where they are thin, and convex parts of a body by cutting it in two. Pure.

Cutting ends on every mesh: a cut is a plane, one of a few, and so many parts are made at most.
"""

import heapq
import itertools
import math
from collections.abc import Iterator
from weakref import WeakKeyDictionary

import manifold3d
import numpy as np
from manifold3d import Manifold
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from schemas.base import Array, frozen_array
from schemas.scene.shape import Hull, Mesh, Shape
from workers.geometry.distance import distance_to_mesh
from workers.geometry.frames import add_up
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import (
    bounds_of,
    concavity_m,
    face_areas,
    face_normals,
    hold_to_one_thread,
    is_first,
    mesh_of,
)

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
    points = mesh.vertices
    least = NO_AREA * float((np.ptp(bounds_of(points), axis=0) ** 2).sum())
    return Hull(frozen_array(points), frozen_array(_normals(points, mesh.faces, least)))


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


@compiled_for("f8[:,::1], i4[:,::1], f8")
def _normals(points: Array, faces: NDArray[np.int32], least: float) -> Array:
    """[N, 3]: unit normals of the triangles of which twice the area is more than `least`."""
    normals, count = np.empty((len(faces), 3)), 0
    for a, b, c in faces:
        x, y, z = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        u, v, w = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        i, j, k = y * w - z * v, z * u - x * w, x * v - y * u
        doubled = math.sqrt(i * i + j * j + k * k)
        if doubled > least:
            normals[count, 0], normals[count, 1], normals[count, 2] = i / doubled, j / doubled, k / doubled
            count += 1
    return normals[:count]


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


WAYS = np.array(
    [way for way in itertools.product((1, 0, -1), repeat=3) if 0 < np.abs(way).sum() < 3 and way > (0, 0, 0)]
)
WAYS = WAYS / np.linalg.norm(WAYS, axis=1, keepdims=True)
"""[9, 3]: normals of the planes that cut: the axes, and halfway between two of them."""

SHARES = (0.25, 0.5, 0.75)
"""Where a piece may be cut, as shares of its length along a normal, beside the levels of its faces across that."""

ACROSS = 0.99
"""Cosine from which a face is across a normal."""

LEVELS = 2
"""Levels of faces, those with the largest areas, that a piece may be cut at."""

SCRAP = 1e-6
"""Share of the whole length, or of its cube, below which what a cut leaves is rounding."""

WRAPPED = 40
"""Cells along the longest side of a sheet that is wrapped. Holes of two cells are closed."""

AROUND = 0.75
"""Distance from a sheet to the surface of what wraps it, in cells."""


def wrap(mesh: Mesh) -> tuple[Manifold, float]:
    """(A solid about a mesh that encloses none: what is near its surface or shut in by it; how far it reaches beyond, metres)."""
    from scipy import ndimage  # takes 36 ms to load, and few meshes are wrapped

    hold_to_one_thread()
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    cell = float((high - low).max()) / WRAPPED
    low = low - 3.0 * cell
    counts = np.ceil((high - low) / cell).astype(int) + 4
    points = np.stack(np.meshgrid(*(low[k] + cell * np.arange(counts[k]) for k in range(3)), indexing="ij"), axis=-1)
    distance = distance_to_mesh(points.reshape(-1, 3), mesh)[0].reshape(counts) / cell
    rooms, _ = ndimage.label(distance > 1.0)
    field = np.where((rooms == rooms[0, 0, 0]) | (distance <= 1.0), AROUND - distance, AROUND)
    grid = field.tolist()

    def sample(x: float, y: float, z: float) -> float:
        """The field between grid points, linear along each axis."""
        u, v, w = (x - low[0]) / cell, (y - low[1]) / cell, (z - low[2]) / cell
        i, j, k = int(u), int(v), int(w)
        u, v, w = u - i, v - j, w - k
        near, far = grid[i], grid[i + 1]
        a = (near[j][k] * (1 - u) + far[j][k] * u) * (1 - v) + (near[j + 1][k] * (1 - u) + far[j + 1][k] * u) * v
        k += 1
        b = (near[j][k] * (1 - u) + far[j][k] * u) * (1 - v) + (near[j + 1][k] * (1 - u) + far[j + 1][k] * u) * v
        return a * (1 - w) + b * w

    bounds = *(low + cell), *(low + cell * (counts - 3))
    return Manifold.level_set(sample, bounds, cell, 0.0), AROUND * cell


def halve(solid: Manifold, most_m: float, most_parts: int) -> tuple[list[Array], float]:
    """(vertices [N, 3] of convex parts, metres; the deepest hollow that one of them fills, metres).

    The piece with the deepest hollow is cut first, until none is deeper than `most_m` or there are `most_parts`.
    """
    hold_to_one_thread()
    size_m = float(np.ptp(_surface(solid).vertices, axis=0).max())
    order = itertools.count()  # pieces are not compared

    def rank(piece: Manifold) -> tuple[float, int, Manifold]:
        return -concavity_m(_surface(piece)), next(order), piece

    pieces, done = [rank(solid)], list[tuple[float, int, Manifold]]()
    while pieces and -pieces[0][0] > most_m and len(pieces) + len(done) < most_parts:
        worst = heapq.heappop(pieces)
        parts = _cut(worst[2], size_m)
        done += [] if parts else [worst]
        for part in parts:
            heapq.heappush(pieces, rank(part))
    kept = _join(
        {number: (piece, -depth) for depth, number, piece in sorted(pieces + done, key=lambda one: one[1])}, most_m
    )
    return [_surface(piece).vertices for piece, _ in kept], max(depth for _, depth in kept)


def _join(pieces: dict[int, tuple[Manifold, float]], most_m: float) -> list[tuple[Manifold, float]]:
    """Manifolds and their depths by number, with those joined that fill no deeper hollow together, the shallowest pair first."""
    pairs = list[tuple[float, int, int, Manifold]]()
    points = {number: _surface(piece).vertices for number, (piece, _) in pieces.items()}

    def consider(one: int, other: int) -> None:
        a, b = points[one], points[other]
        if (a.min(axis=0) > b.max(axis=0)).any() or (b.min(axis=0) > a.max(axis=0)).any():
            return
        hull = Manifold.hull_points(np.concatenate([a, b]))
        filled = hull.volume() - pieces[one][0].volume() - pieces[other][0].volume()
        if filled > most_m * hull.surface_area():  # then some of it is deeper
            return
        both = pieces[one][0] + pieces[other][0]
        if (depth := concavity_m(_surface(both))) <= most_m:
            heapq.heappush(pairs, (depth, one, other, both))

    for one, other in itertools.combinations(pieces, 2):
        consider(one, other)
    while pairs:
        depth, one, other, both = heapq.heappop(pairs)
        if one in pieces and other in pieces:
            del pieces[one], pieces[other]
            number, others = max(points) + 1, list(pieces)
            pieces[number], points[number] = (both, depth), _surface(both).vertices
            for each in others:
                consider(number, each)
    return list(pieces.values())


def _cut(piece: Manifold, size_m: float) -> list[Manifold]:
    """The parts of a piece, cut where least is left of what their hulls fill, times their lengths; none where no cut leaves two.

    By volume alone a ring would be cut into ever thinner rings.
    """
    cuts = [parts for way, at in _planes(_surface(piece), size_m) if len(parts := _split(piece, way, at, size_m)) > 1]
    return min(cuts, key=lambda parts: add_up(map(_filled, parts)), default=[])


def _filled(piece: Manifold) -> float:
    """What the hull of a piece fills beside it, times its diagonal, m^4."""
    points = _surface(piece).vertices
    filled = Manifold.hull_points(points).volume() - piece.volume()
    return float(filled * np.linalg.norm(np.ptp(points, axis=0)))


def _planes(surface: Mesh, size_m: float) -> Iterator[tuple[Array, float]]:
    """(unit normal [3], place along it, metres) of the planes that a piece may be cut at, by its length along them."""
    normals, areas = face_normals(surface.vertices, surface.faces), face_areas(surface.vertices, surface.faces)
    along = surface.vertices @ WAYS.T
    low, high, step = along.min(axis=0), along.max(axis=0), SCRAP * size_m
    for way in np.argsort(low - high, kind="stable").tolist():
        across = np.abs(normals @ WAYS[way]) >= ACROSS
        levels, inverse = np.unique(np.round(along[surface.faces[across, 0], way] / step), return_inverse=True)
        largest = np.argsort(-np.bincount(inverse, weights=areas[across], minlength=len(levels)), kind="stable")
        inner = [at for at in (levels[largest] * step).tolist() if low[way] + step < at < high[way] - step]
        for at in (*(low[way] + share * (high[way] - low[way]) for share in SHARES), *inner[:LEVELS]):
            yield WAYS[way], float(at)


def _split(piece: Manifold, way: Array, at: float, size_m: float) -> list[Manifold]:
    """The connected solids that a plane leaves of a piece."""
    halves = piece.split_by_plane(way.tolist(), at)
    return [part for half in halves for part in half.decompose() if part.volume() > (SCRAP * size_m) ** 3]


def _surface(piece: Manifold) -> Mesh:
    mesh = mesh_of(piece)
    return Mesh(np.ascontiguousarray(mesh.vertices), mesh.faces)
