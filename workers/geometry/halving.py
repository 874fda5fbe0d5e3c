"""Convex parts of a body by cutting it in two until no part fills a hollow deeper than is allowed; and the body of a sheet. Pure.

It ends on every mesh: a cut is a plane, one of a few, and so many parts are made at most.
"""

import heapq
import itertools
from collections.abc import Iterator

import numpy as np
from manifold3d import Manifold

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.distance import distance_to_mesh
from workers.geometry.frames import add_up
from workers.geometry.mesh import concavity_m, face_areas, face_normals, hold_to_one_thread, mesh_of

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
