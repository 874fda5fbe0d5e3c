"""Distance or overlap of objects with the table and with one another, between their meshes. Pure."""

import itertools
from collections.abc import Iterator, Sequence
from functools import cache

import manifold3d
import numpy as np

from schemas.scene.shape import Mesh
from workers.geometry.convexity import mesh_of, solid_of, weld
from workers.geometry.elevation import Terrain, vertical_gap
from workers.geometry.hull import convex_hull
from workers.geometry.hull_offset import least_width_m
from workers.geometry.manifold import hold_to_one_thread

NEAR_M = 0.02
"""Farthest distance between two objects that is measured."""

NO_VOLUME = 1e-15
"""Cubic metres of overlap that are rounding alone."""

BESIDE_M = 1e-3
"""Depth in the ground, along z, beyond which an object may be touching the side of a wall instead."""

SIDE_M = 5e-4
"""It touches a wall if it is less deep once its sides are moved in by this much."""

SIDE_TO_M = 1e-7
"""Resolution of its depth in the wall."""


def clearances(meshes: Sequence[Mesh], ground: Terrain) -> list[float]:
    """For each mesh (world coordinates) the metres to the nearest other or to the ground; negative where they overlap most.

    To the ground as `ground_gap_m`. Between two meshes as `between`, where a mesh that encloses no body counts as its hull.
    """
    found = [ground_gap_m(mesh, ground) for mesh in meshes]
    for i, j, gap in find_gaps_m(meshes):
        found[i], found[j] = min(found[i], gap), min(found[j], gap)
    return found


def find_gaps_m(meshes: Sequence[Mesh], near_m: float = NEAR_M) -> Iterator[tuple[int, int, float]]:
    """(i, j, `between` them) of every two meshes, in one frame, whose boxes are within `near_m` of one another."""
    solids = cache(lambda k: _solid(meshes[k]))
    for i, j in find_near(meshes, near_m):
        yield i, j, between(solids(i), solids(j))


def find_near(meshes: Sequence[Mesh], near_m: float) -> Iterator[tuple[int, int]]:
    """The numbers i < j of every two meshes, in one frame, whose bounding boxes are within `near_m` of one another."""
    boxes = [(mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) for mesh in meshes]
    for i, j in itertools.combinations(range(len(meshes)), 2):
        if (boxes[i][0] <= boxes[j][1] + near_m).all() and (boxes[j][0] <= boxes[i][1] + near_m).all():
            yield i, j


def above_ground(mesh: Mesh, ground: Terrain) -> tuple[float, float]:
    """(metres along z down to the ground, negative for a mesh that reaches into it; metres of overlap with a wall's side).

    Along z a hair of overlap with a wall's side is as deep as the wall is high. So where the overlap is deep, the mesh is
    narrowed until it is not.
    """
    gap = vertical_gap(mesh, ground)
    if gap >= -BESIDE_M or vertical_gap(_narrower(mesh, SIDE_M), ground) < -BESIDE_M:
        return gap, 0.0
    low, high = 0.0, SIDE_M
    while high - low > SIDE_TO_M:
        middle = (low + high) / 2
        low, high = (middle, high) if vertical_gap(_narrower(mesh, middle), ground) < -BESIDE_M else (low, middle)
    return vertical_gap(_narrower(mesh, high), ground), high


def _narrower(mesh: Mesh, by_m: float) -> Mesh:
    """The mesh scaled about its middle in x and y, so that each side moves in by `by_m`."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    shares = np.append(1.0 - 2.0 * by_m / np.maximum((high - low)[:2], 2.0 * by_m), 1.0)
    middle = (low + high) / 2
    return Mesh(middle + (mesh.vertices - middle) * shares, mesh.faces)


def ground_gap_m(mesh: Mesh, ground: Terrain) -> float:
    """Metres from a mesh to the ground along z; minus the depth of overlap with the ground, or with a wall's side if more."""
    below, beside = above_ground(mesh, ground)
    return min(below, -beside) if beside > 0.0 else below


def between(a: manifold3d.Manifold, b: manifold3d.Manifold) -> float:
    """Metres between two bodies, `NEAR_M` at most; minus the least width of the widest piece of their intersection."""
    hold_to_one_thread()
    pieces = [piece for piece in (a ^ b).decompose() if piece.volume() > NO_VOLUME]
    if not pieces:
        return float(a.min_gap(b, NEAR_M))
    return -max(least_width_m(convex_hull(mesh_of(piece).vertices)) for piece in pieces)


def _solid(mesh: Mesh) -> manifold3d.Manifold:
    hold_to_one_thread()
    solid = solid_of(weld(mesh))
    return manifold3d.Manifold.hull_points(np.ascontiguousarray(mesh.vertices)) if solid is None else solid
