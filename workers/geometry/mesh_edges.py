"""Edges of a mesh: the faces that share one, those that bend, and the neighbours of each vertex. Pure."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.geometry.jit import compiled

Numbers = NDArray[np.int64]

FLAT = 1e-9
"""One minus the cosine between two faces, below which there is no edge between them."""


@compiled
def neighbours_of(faces: Numbers, count: int) -> tuple[Numbers, Numbers]:
    """(starts [count + 1], members): the neighbours of each vertex, one after the other, ascending."""
    keys, starts, found = np.empty(6 * len(faces), np.int64), np.zeros(count + 1, np.int64), 0
    for f in range(len(faces)):
        for k in range(3):
            one, other = faces[f, k], faces[f, (k + 1) % 3]
            keys[6 * f + 2 * k], keys[6 * f + 2 * k + 1] = one * count + other, other * count + one
    keys.sort()
    members = np.empty(len(keys), np.int64)
    for n in range(len(keys)):
        if n == 0 or keys[n] != keys[n - 1]:
            members[found] = keys[n] % count
            found += 1
            starts[keys[n] // count + 1] = found
    for n in range(count):
        starts[n + 1] = max(starts[n + 1], starts[n])
    return starts, members[:found].copy()


def half_edges(faces: Numbers, count: int) -> tuple[Numbers, Numbers]:
    """(keys [3 F], ascending, the same for the sides of one edge; which [3 F] sides these are, three times their face and on)."""
    keys = _edge_keys(faces, count)
    which = np.argsort(keys, kind="stable")
    return keys[which], which


@compiled
def _edge_keys(faces: Numbers, count: int) -> Numbers:
    """[3 F]: a number for the edge of each side of each face."""
    keys = np.empty(3 * len(faces), np.int64)
    for f in range(len(faces)):
        for k in range(3):
            one, other = faces[f, k], faces[f, (k + 1) % 3]
            keys[3 * f + k] = min(one, other) * count + max(one, other)
    return keys


@compiled
def bent_edges(
    vertices: Array, faces: Numbers, normals: Array, keys: Numbers, which: Numbers
) -> tuple[Numbers, Numbers]:
    """Edges [E, 2] that are not between two coplanar faces, and the vertices across them [E, 2]; the rest: `half_edges`."""
    edges, across = np.empty((len(keys), 2), np.int64), np.empty((len(keys), 2), np.int64)
    count = first = 0
    for last in range(len(keys)):
        if last + 1 < len(keys) and keys[last + 1] == keys[last]:
            continue
        one, other = which[first], which[last]
        a, b = keys[last] // len(vertices), keys[last] % len(vertices)
        p, q = faces[one // 3, (one + 2) % 3], faces[other // 3, (other + 2) % 3]
        bent = last != first + 1 or abs(_dot(normals[one // 3], normals[other // 3])) <= 1.0 - FLAT
        if not bent and p != q:
            # Two faces folded onto one another are coplanar, and their edge is bent all the same: p and q are on one side
            along, u, v = vertices[b] - vertices[a], vertices[p] - vertices[a], vertices[q] - vertices[a]
            bent = _dot(u, v) * _dot(along, along) > _dot(along, u) * _dot(along, v)
        if bent:
            edges[count, 0], edges[count, 1], across[count, 0], across[count, 1] = a, b, p, q
            count += 1
        first = last + 1
    return edges[:count].copy(), across[:count].copy()


@compiled
def _dot(one: Array, other: Array) -> float:
    """The scalar product of two vectors [3], y last, as `numpy.einsum` adds three products."""
    return float((one[0] * other[0] + one[2] * other[2]) + one[1] * other[1])
