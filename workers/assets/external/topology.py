"""Pure: merges the points of a triangle soup, winds its faces consistently, and finds its closed bodies."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.base import Array

MERGE_RELATIVE = 1e-8
"""Vertices within this share of the bounding box's diagonal are one point, which allows for the rounding of text files."""
THIN_RELATIVE = 1e-6
"""A closed sheet whose volume is below this share of area times diagonal is a sheet with two sides, not a solid."""

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


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


def find_bodies(vertices: Array, faces: Indices, corners: Indices) -> Bodies:
    """The bodies of a mesh: faces [F, 3] into vertices [V, 3], with `corners` the same faces into merged points."""
    edges, count = _edges(corners), len(corners)
    first = np.repeat(edges.face[edges.start], edges.size)
    graph = coo_array((np.ones(len(first), dtype=np.int8), (first, edges.face)), shape=(count, count))
    bodies, label = connected_components(graph, directed=False)
    body = label.astype(np.int64)
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
