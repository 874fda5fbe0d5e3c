"""Pure: cleans a mesh from outside, whatever its format.

Cuts polygons, merges points, winds faces, finds closed bodies, drops doubled and empty faces.

A mesh that cannot be used raises a MeshError that says why not.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.base import Array, Pose, frozen_array
from schemas.errors import MeshError
from schemas.scene.shape import Part, Shape
from workers.door.meshes.raw import Indices, Mask, RawMesh, check_indices
from workers.geometry.frames import transform

MERGE_RELATIVE = 1e-8
"""Vertices within this share of the bounding box's diagonal are one point, which allows for the rounding of text files."""
THIN_RELATIVE = 1e-6
"""A closed sheet whose volume is below this share of area times diagonal is a sheet with two sides, not a solid."""


@dataclass(frozen=True, eq=False)
class Bodies:
    """The connected surfaces of a mesh.

    body [F] int64: which body a face belongs to; closed [B] bool: every directed edge has its opposite;
    volume [B] float64, cubic units: signed, by the divergence theorem; it means something where `closed` is true.
    """

    body: Indices
    closed: Mask
    volume: Array


def merge_points(vertices: Array) -> Indices:
    """[V] int64: the same number for vertices at the same place (within `MERGE_RELATIVE` of the diagonal)."""
    low = vertices.min(axis=0)
    step = max(float(np.linalg.norm(vertices.max(axis=0) - low)) * MERGE_RELATIVE, np.finfo(np.float64).tiny)
    cell = np.round((vertices - low) / step).astype(np.int64)
    key = cell[:, 0]
    for axis in (1, 2):
        key = np.unique(key, return_inverse=True)[1] * (int(cell[:, axis].max()) + 1) + cell[:, axis]
    return np.asarray(np.unique(key, return_inverse=True)[1], dtype=np.int64)


def find_collapsed(corners: Indices) -> Mask:
    """[F] bool: which faces [F, 3] name a corner twice."""
    a, b, c = corners.T
    return (a == b) | (b == c) | (c == a)


def find_repeated(corners: Indices, oriented: bool) -> Mask:
    """[F] bool: which faces [F, 3] repeat the corners of an earlier one; `oriented`: in the same winding as well."""
    if oriented:
        first = corners.argmin(axis=1)
        turned = (first[:, None] + np.arange(3)) % 3
        canonical = np.take_along_axis(corners, turned, axis=1)
    else:
        canonical = np.sort(corners, axis=1)
    count = int(corners.max(initial=0)) + 1
    pair = np.unique(canonical[:, 0] * count + canonical[:, 1], return_inverse=True)[1]
    _, first_seen = np.unique(pair * count + canonical[:, 2], return_index=True)
    again = np.ones(len(corners), dtype=np.bool_)
    again[first_seen] = False
    return again


@dataclass(frozen=True, eq=False)
class _Edges:
    """Half-edges sorted by undirected edge: face and direction of each, and where each edge's run starts."""

    face: Indices
    forward: Mask
    start: Indices
    size: Indices


def _edges(corners: Indices) -> _Edges:
    tail = corners.ravel()
    head = corners[:, [1, 2, 0]].ravel()
    count = int(corners.max(initial=0)) + 1
    key = np.minimum(tail, head) * count + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    _, start, size = np.unique(key[order], return_index=True, return_counts=True)
    return _Edges(order // 3, (tail < head)[order], start, size)


def find_flips(corners: Indices) -> Mask:
    """[F] bool: which faces [F, 3] to flip so that neighbours are wound consistently; the fewest of each surface.

    Each face is in a graph twice, as it is and flipped; an edge of exactly two faces joins the copies that
    agree. A surface that can be oriented falls into two halves, one the reverse of the other. One that cannot
    (a Moebius strip) stays whole and is left as it is.
    """
    edges, count = _edges(corners), len(corners)
    at = edges.start[edges.size == 2]
    a, b = edges.face[at], edges.face[at + 1]
    disagree = (edges.forward[at] == edges.forward[at + 1]).astype(np.int64)
    if not disagree.any():
        return np.zeros(count, dtype=np.bool_)
    rows = np.concatenate([a, a + count])
    columns = np.concatenate([b + count * disagree, b + count * (1 - disagree)])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(2 * count, 2 * count))
    half = connected_components(graph, directed=False)[1].astype(np.int64)
    as_is, turned = half[:count], half[count:]
    kept = np.bincount(as_is, minlength=int(half.max()) + 1)
    return (kept[as_is] < kept[turned]) | ((kept[as_is] == kept[turned]) & (as_is > turned))


def _label(one: Indices, other: Indices, count: int) -> Indices:
    """[count] int64: the same number for what pairs [N], [N] join."""
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _apart(edges: _Edges, number: Indices, count: int) -> Indices:
    """[count] int64: the body of each face, where surfaces that touch stay apart; number: of the edge of each side."""
    pairs = edges.start[edges.size == 2]
    surface = _label(edges.face[pairs], edges.face[pairs + 1], count)
    met = edges.size[number] > 2
    meeting, where = np.unique(np.stack([number[met], surface[edges.face[met]]]), axis=1, return_inverse=True)
    ends = meeting[:, np.bincount(where.ravel(), np.where(edges.forward[met], 1, -1)) != 0]
    same = np.flatnonzero(ends[0, 1:] == ends[0, :-1])
    return _label(ends[1, same], ends[1, same + 1], count)[surface]


def find_bodies(vertices: Array, faces: Indices, corners: Indices, apart: bool = False) -> Bodies:
    """The bodies of a mesh: faces [F, 3] into vertices [V, 3], with `corners` the same faces into merged points.

    Faces that share an edge are of one body. apart: where more than two do, surfaces that are closed there by themselves touch,
    and stay apart; the others are joined.
    """
    edges, count = _edges(corners), len(corners)
    number = np.repeat(np.arange(len(edges.size)), edges.size)
    body = _apart(edges, number, count) if apart else _label(edges.face[edges.start][number], edges.face, count)
    bodies = int(body.max(initial=-1)) + 1
    balance = np.add.reduceat(np.where(edges.forward, 1, -1), edges.start) if count else np.zeros(0, dtype=np.int64)
    open_edges = np.bincount(body[edges.face[edges.start]], weights=balance != 0, minlength=bodies)
    centred = vertices - 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    a, b, c = (centred[faces[:, k]] for k in range(3))
    volume = np.bincount(body, weights=(a * np.cross(b, c)).sum(axis=1) / 6.0, minlength=bodies)
    return Bodies(body, open_edges == 0, volume.astype(np.float64))


def is_solid(vertices: Array, faces: Indices) -> bool:
    """Whether the faces [F, 3] are closed, consistently wound bodies that enclose a volume."""
    corners = merge_points(vertices)[faces]
    bodies = find_bodies(vertices, faces, corners)
    return bool(bodies.closed.all()) and float(bodies.volume.sum()) > thin_volume(vertices, faces)


def thin_volume(vertices: Array, faces: Indices) -> float:
    """The volume below which a closed surface counts as a sheet: `THIN_RELATIVE` times area times diagonal."""
    diagonal = float(np.linalg.norm(vertices.max(axis=0) - vertices.min(axis=0)))
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return THIN_RELATIVE * area * diagonal


LARGEST_COORDINATE = 1e7
"""Largest coordinate, in units of the file; products of larger ones lose precision."""


@dataclass(frozen=True, eq=False)
class LoadedMesh:
    """A cleaned shape in the file's own frame and units, and what of it was mended or left out."""

    shape: Shape
    notes: tuple[str, ...]


def transform_shape(shape: Shape, matrix: Pose) -> Shape:
    """The shape taken through an affine transform [4, 4]; a mirroring turns the faces over as well."""
    mirrored = float(np.linalg.det(matrix[:3, :3])) < 0
    inverse = np.linalg.inv(matrix[:3, :3])
    parts = []
    for part in shape.parts:
        normals = None if part.normals is None else frozen_array(_unit(part.normals @ inverse))
        faces = frozen_array(part.faces[:, ::-1], np.int32) if mirrored else part.faces
        vertices = frozen_array(transform(matrix, part.vertices))
        parts.append(replace(part, vertices=vertices, faces=faces, normals=normals))
    return Shape(tuple(parts), shape.closed)


def place_mesh(path: Path, mesh: RawMesh) -> RawMesh:
    """A mesh in the frame of its scene: float64, unit normals, and corners of their own where faces have colours.

    Raises MeshError `index_out_of_range` or `not_finite`.
    """
    vertices, faces, visual = mesh.vertices.astype(np.float64), mesh.faces, mesh.visual
    check_indices(path, faces, len(vertices))
    # Only vertices that a face names are checked: others may hold anything.
    if not (np.isfinite(vertices[faces]).all() and np.isfinite(mesh.matrix).all()):
        raise MeshError("not_finite", f"{path} has a coordinate that is not a finite number")
    used = np.zeros(len(vertices), dtype=np.bool_)
    used[faces] = True
    vertices = transform(mesh.matrix, np.where(used[:, None], vertices, 0.0))
    check_coordinates(path, vertices[used])
    if np.linalg.det(mesh.matrix[:3, :3]) < 0:
        faces = faces[:, ::-1]
    normals = _placed_normals(mesh)
    if visual.face_colors is not None:
        vertices, normals = vertices[faces.ravel()], None if normals is None else normals[faces.ravel()]
        visual = replace(visual, colors=np.repeat(visual.face_colors, 3, axis=0), face_colors=None)
        faces = np.arange(3 * len(faces)).reshape(-1, 3)
    return RawMesh(vertices, faces, normals, visual, np.eye(4))


def check_coordinates(path: Path, vertices: Array) -> None:
    """MeshError `not_finite` where a coordinate of vertices [V, 3] is none, or over `LARGEST_COORDINATE`."""
    largest = float(np.abs(vertices).max())
    if not largest <= LARGEST_COORDINATE:
        raise MeshError("not_finite", f"{path} has a coordinate of {largest:g}, over {LARGEST_COORDINATE:g}")


def _placed_normals(mesh: RawMesh) -> Array | None:
    """The file's own unit shading normals [V, 3], turned with the node; None where it has no usable ones."""
    if mesh.normals is None or mesh.normals.shape != mesh.vertices.shape or not np.isfinite(mesh.normals).all():
        return None
    if np.linalg.det(mesh.matrix[:3, :3]) == 0:
        return None
    turned = mesh.normals @ np.linalg.inv(mesh.matrix[:3, :3])
    return None if (np.linalg.norm(turned, axis=1) < 1e-9).any() else _unit(turned)


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length == 0, 1.0, length)


def clean_shape(path: Path, pieces: list[RawMesh]) -> tuple[Shape, list[str]]:
    """Placed meshes as one clean shape, a part each, and what was mended.

    Drops collapsed and doubled faces, but keeps two faces back to back where two solids touch. Winds neighbours alike
    and closed bodies outwards, but keeps a closed body that faces inwards inside another: it is a void. Drops slivers
    without area unless they close a gap.
    """
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    vertices = np.concatenate([piece.vertices for piece in pieces])
    faces = np.concatenate([piece.faces + start for piece, start in zip(pieces, starts[:-1], strict=True)])
    owner = np.repeat(np.arange(len(pieces)), [len(piece.faces) for piece in pieces])
    point = merge_points(vertices)
    kept = ~find_collapsed(point[faces])
    kept[kept] = ~find_repeated(point[faces[kept]], oriented=True)
    faces, owner = faces[kept], owner[kept]
    if not len(faces):
        raise MeshError("no_faces", f"{path} has only empty faces")
    faces, owner, bodies = _unify_winding(vertices, faces, owner, point)
    watertight = bool(bodies.closed.all()) and float(bodies.volume.sum()) > thin_volume(vertices, faces)
    if not watertight:
        solid = ~_slivers(vertices, faces) | bodies.closed[bodies.body]  # one may close a gap of its body
        faces, owner = faces[solid], owner[solid]
        if not len(faces):
            raise MeshError("no_faces", f"{path} has only faces without area")
    notes = [f"{len(kept) - len(faces)} doubled or empty faces dropped"] if len(faces) < len(kept) else []
    mine = ((k, piece, faces[owner == k] - starts[k]) for k, piece in enumerate(pieces))
    parts = [_part(f"part{k}", piece, left) for k, piece, left in mine if len(left)]
    closed = watertight and bool((bodies.volume > 0.0).all())
    return Shape(tuple(parts), closed), notes


def _unify_winding(vertices: Array, faces: Indices, owner: Indices, point: Indices) -> tuple[Indices, Indices, Bodies]:
    """Faces wound consistently and outwards, without the second side of sheets; their owners; and their bodies."""
    twins = find_repeated(point[faces], oriented=False)
    if twins.any():
        bodies = find_bodies(vertices, faces, point[faces])
        sheet = ~bodies.closed | (np.abs(bodies.volume) < thin_volume(vertices, faces))
        drop = twins & sheet[bodies.body]
        faces, owner = faces[~drop], owner[~drop]
    faces = _flipped(faces, find_flips(point[faces]))
    bodies = find_bodies(vertices, faces, point[faces])
    inwards = bodies.closed & (bodies.volume < 0) & ~_voids(vertices, faces, bodies)
    if inwards.any():
        faces = _flipped(faces, inwards[bodies.body])
        bodies = Bodies(bodies.body, bodies.closed, np.where(inwards, -bodies.volume, bodies.volume))
    return faces, owner, bodies


def _voids(vertices: Array, faces: Indices, bodies: Bodies) -> Mask:
    """[B] bool: bodies whose bounding box lies inside that of a closed body that faces outwards."""
    count = len(bodies.closed)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, bodies.body, vertices[faces].min(axis=1))
    np.maximum.at(high, bodies.body, vertices[faces].max(axis=1))
    voids = np.zeros(count, dtype=np.bool_)
    for outer in np.flatnonzero(bodies.closed & (bodies.volume > 0)):
        voids |= (low > low[outer]).all(axis=1) & (high < high[outer]).all(axis=1)
    return voids


def _flipped(faces: Indices, flip: Mask) -> Indices:
    return np.where(flip[:, None], faces[:, ::-1], faces)


def _slivers(vertices: Array, faces: Indices) -> Mask:
    """[F] bool: faces whose area is negligible compared with the square of their longest side."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    longest = np.maximum.reduce([((b - a) ** 2).sum(1), ((c - b) ** 2).sum(1), ((a - c) ** 2).sum(1)])
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) <= 1e-12 * longest


def _part(name: str, piece: RawMesh, faces: Indices) -> Part:
    """A part with the remaining faces and the vertices that they name."""
    used, index = np.unique(faces, return_inverse=True)
    vertices, corners = piece.vertices[used], index.reshape(-1, 3)
    normals = None if piece.normals is None else _facing(vertices, corners, piece.normals[used])
    return Part(
        name=name,
        vertices=frozen_array(vertices),
        faces=frozen_array(corners, np.int32),
        material=piece.visual.material,
        normals=None if normals is None else frozen_array(normals),
        uv=None if piece.visual.uv is None else frozen_array(piece.visual.uv[used]),
        colors=None if piece.visual.colors is None else frozen_array(piece.visual.colors[used], np.uint8),
    )


def _facing(vertices: Array, corners: Indices, normals: NDArray) -> Array:
    """Shading normals [V, 3], turned over where they point into the surface."""
    a, b, c = (vertices[corners[:, k]] for k in range(3))
    across = np.repeat(np.cross(b - a, c - a), 3, axis=0)
    agreement = np.bincount(corners.ravel(), (across * normals[corners.ravel()]).sum(axis=1), len(vertices))
    return np.where(agreement[:, None] < 0, -normals, normals)
