"""Convex parts of a body that is not convex: of built-in shapes by their making, of meshes from outside by halving.

See `workers.geometry.lathe_decomposition` and `workers.geometry.hull`, which ends on every mesh. Parts of meshes are kept in
memory and in files, which may be deleted.
"""

import hashlib
import io
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import manifold3d
import numpy as np
import shapely
from cachetools import LRUCache, cached
from scipy.spatial import QhullError

from schemas.base import Array, frozen_array
from schemas.environment import cache_folder
from schemas.scene.shape import Asset, Mesh
from workers.geometry import mesh as convexity
from workers.geometry.hull import convex_hull, halve, wrap
from workers.geometry.lathe_decomposition import TOLERANCE, decompose_lofts
from workers.geometry.mesh import components, concavity_m, is_convex_surface, mesh_of, solid_of, weld
from workers.pool import Answers

CAPACITY_BYTES = 64 * 1024 * 1024
"""Memory per process: a thousand mugs."""


class Parts(NamedTuple):
    """Vertices [N, 3] float64, metres, of each convex part of a body, and the deepest hollow that one of them fills, metres.

    The depth counts what was left out to make the mesh coarser, and is 0 of a built-in shape, whose parts are its own.
    """

    clouds: tuple[Array, ...]
    depth_m: float = 0.0


USUAL_FOLDER = cache_folder("parts")


def key_of(*inputs: str | bytes) -> str:
    """SHA-256 of everything that an answer depends on."""
    whole = hashlib.sha256()
    for each in inputs:
        data = each.encode() if isinstance(each, str) else each
        whole.update(len(data).to_bytes(8, "little") + data)
    return whole.hexdigest()


_MEMORY: LRUCache[str, Parts] = LRUCache(CAPACITY_BYTES, lambda parts: sum(cloud.nbytes for cloud in parts.clouds))


@cached(_MEMORY, key=lambda key, _: key)
def _kept(key: str, make: Callable[[], Parts]) -> Parts:
    """The parts of this key from memory, else made: those used last stay that fit `CAPACITY_BYTES` together."""
    return make()


def _stored(key: str, folder: Path | None, make: Callable[[], Parts]) -> Parts:
    """The parts of this key from their file in the folder, else made and written there. A file cut off is not believed."""
    answers = Answers(None if folder is None else folder / key)
    data = answers.get(key)
    if data is not None:
        with np.load(io.BytesIO(data)) as stored:
            clouds = np.split(stored["vertices"], np.cumsum(stored["counts"])[:-1])
            return Parts(tuple(map(frozen_array, clouds)), float(stored["depth_m"]))
    parts, content = make(), io.BytesIO()
    counts = [len(cloud) for cloud in parts.clouds]
    np.savez(content, depth_m=parts.depth_m, vertices=np.concatenate(parts.clouds), counts=counts)
    answers.put(key, content.getvalue())
    return parts


THRESHOLD = 0.05
"""Deepest hollow that a part may fill, of a mesh of size 2."""

SIMPLER = 2e-3
"""Tolerance, as a share of its size, to which a piece is made coarser first: halving takes longer the more faces there are."""

MOST_FACES = 4_000
"""Faces of a piece that is halved: where it has more, the tolerance is doubled until it has not."""

MOST_PIECES = 128
"""A mesh in more pieces than this is cut as one."""

MOST_PARTS = 64
"""Parts after which the pieces that are left, the smaller ones, get their hulls: a pile's time grows with them."""

LIBRARIES = ("manifold3d", "numpy", "scipy")
"""Libraries whose versions change the parts of a mesh."""

SCRAP = 1e-3
"""Thickness of a loose triangle, as a share of its distance from the middle of the mesh."""


def parts_of(asset: Asset, threshold: float = THRESHOLD, share: float = TOLERANCE) -> tuple[Array, ...]:
    """Vertices [N, 3], object frame, of each of an asset's convex parts: from its making if known, or else by halving.

    `threshold` is that of `decompose`, `share` that of `decompose_lofts`. Halved is also a built-in shape whose outlines touch
    except for the last bits, which cannot be cut by its making.
    """
    lofted = asset.lofted
    if lofted is None:
        return decompose(asset.shape.mesh, asset.sha256, threshold).clouds
    key = key_of("lofts", repr(share), asset.sha256, asset.shape.mesh.vertices.tobytes())
    try:
        return _kept(key, lambda: Parts(decompose_lofts(lofted.lofts, share))).clouds
    except (ValueError, shapely.errors.GEOSException):
        return decompose(asset.shape.mesh, asset.sha256, threshold).clouds


def decompose(mesh: Mesh, digest: str, threshold: float = THRESHOLD, folder: Path | None = USUAL_FOLDER) -> Parts:
    """Convex parts of a mesh: all within its hull, and together with the hull's vertices. Connected pieces are cut apart.

    Every mesh has some. The same arguments give the same bytes in every process, so results are kept in memory and in `folder`
    (None: nowhere).
    """
    key = key_of(version_of_parts(), repr(threshold), digest, mesh.vertices.tobytes(), mesh.faces.tobytes())
    return _kept(key, lambda: _stored(key, folder, lambda: _decompose(mesh, threshold)))


@cache
def version_of_parts() -> str:
    """Digest of the code that parts depend on: this file and the geometry's, and the versions of libraries."""
    files = [Path(__file__), *sorted(Path(convexity.__file__).parent.glob("*.py"))]
    return key_of(*(file.read_bytes() for file in files), *(version(name) for name in LIBRARIES))


def _decompose(mesh: Mesh, threshold: float) -> Parts:
    welded = weld(mesh)
    pieces = components(welded)
    if len(pieces) > MOST_PIECES:
        pieces = [welded]
    low, high = welded.vertices.min(axis=0), welded.vertices.max(axis=0)
    most_m, clouds, depth_m = threshold * float((high - low).max()) / 2, list[Array](), 0.0
    pieces.sort(key=lambda piece: -float(np.ptp(piece.vertices, axis=0).max()))
    for piece in pieces:
        if _has_hull(piece.vertices):
            parts = _parts_of(piece, most_m, MOST_PARTS - len(clouds))
            clouds += [cloud for cloud in parts.clouds if _has_hull(cloud)]
            depth_m = max(depth_m, parts.depth_m)
        else:
            # And a point a little nearer to the middle of the mesh, hence within its hull
            inner = piece.vertices.mean(axis=0) * (1.0 - SCRAP) + SCRAP * (low + high) / 2
            clouds.append(np.concatenate([piece.vertices, [inner]]))
    kept = [cloud for cloud in clouds if _has_hull(cloud)] or [convex_hull(mesh.vertices).vertices]
    return Parts(tuple(frozen_array(cloud) for cloud in kept), depth_m)


def _has_hull(points: Array) -> bool:
    """Whether points [N, 3] have a convex hull: a single triangle has none, nor have points in a line but for rounding."""
    try:
        convex_hull(points)
    except (QhullError, ValueError):
        return False
    return True


def _parts_of(piece: Mesh, most_m: float, most_parts: int) -> Parts:
    """The parts of a connected piece of a mesh, of which none fills a hollow deeper than `most_m` if that may be."""
    hull, solid = convex_hull(piece.vertices), solid_of(piece)
    if is_convex_surface(piece, solid):
        return Parts((hull.vertices,))
    if (depth_m := concavity_m(piece)) <= most_m or most_parts < 2:
        return Parts((hull.vertices,), depth_m)
    coarse, moved_m = wrap(_fewer(piece)) if solid is None else (solid, 0.0)
    simpler, step_m = _simplified(coarse, SIMPLER * float(np.linalg.norm(np.ptp(piece.vertices, axis=0))))
    if simpler.is_empty():
        return Parts((hull.vertices,), depth_m)
    parts, depth_m = halve(simpler, most_m, most_parts)
    fitted = _fit(parts, hull.vertices, hull.normals)
    return Parts(tuple(fitted) or (hull.vertices,), depth_m + step_m + moved_m)


def _simplified(solid: manifold3d.Manifold, step_m: float) -> tuple[manifold3d.Manifold, float]:
    """(A solid with at most `MOST_FACES`, or with as few as it can be made of; how far its surface has moved, metres).

    By tolerances that double from `step_m` on. At once fewer faces go by a large one than by a smaller one before it: where
    there is no gain, the next starts from the last. It ends, because the faces become fewer each time.
    """
    simpler, moved_m, start_m = solid.simplify(step_m), step_m, 0.0
    if simpler.is_empty():  # it is thinner than the tolerance
        simpler, moved_m = solid, 0.0
    while simpler.num_tri() > MOST_FACES:
        step_m *= 2.0
        further = solid.simplify(step_m)
        if not 0 < further.num_tri() < simpler.num_tri():
            solid, start_m = simpler, moved_m
            further = solid.simplify(step_m)
            if not 0 < further.num_tri() < simpler.num_tri():
                break
        simpler, moved_m = further, start_m + step_m
    return simpler, moved_m


def _fewer(sheet: Mesh) -> Mesh:
    """A sheet with at most `MOST_FACES`, by welding what is near."""
    fewer, step_m = sheet, SIMPLER * float(np.linalg.norm(np.ptp(sheet.vertices, axis=0)))
    while len(fewer.faces) > MOST_FACES:
        fewer, step_m = weld(Mesh(np.round(sheet.vertices / step_m) * step_m, sheet.faces)), 2.0 * step_m
    return fewer


def _fit(clouds: list[Array], vertices: Array, normals: Array) -> list[Array]:
    """The parts clipped to the hull, with the vertices of the hull that they lost."""
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    reach = (vertices @ normals.T).max(axis=0)
    whole = manifold3d.Manifold.hull_points(np.ascontiguousarray(vertices))
    fitted = []
    for cloud in clouds:
        if (cloud @ normals.T - reach).max() > 1e-9 * size:
            cloud = mesh_of(manifold3d.Manifold.hull_points(np.ascontiguousarray(cloud)) ^ whole).vertices
        if len(cloud) >= 4:
            fitted.append(cloud)
    if not fitted:  # the hull is flat and clips all away
        return []
    owner = np.concatenate([np.full(len(cloud), k) for k, cloud in enumerate(fitted)])
    points = np.concatenate(fitted)
    nearest = np.array([((points - vertex) ** 2).sum(axis=1).argmin() for vertex in vertices])
    lost = (points[nearest] != vertices).any(axis=1)
    return [np.concatenate([cloud, vertices[lost & (owner[nearest] == k)]]) for k, cloud in enumerate(fitted)]
