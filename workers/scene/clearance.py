"""How near the objects of a scene come to the table and to one another, between their meshes. Pure geometry."""

import itertools
from collections.abc import Sequence

import manifold3d
import numpy as np

from schemas.shape import Mesh
from workers.geometry.convexity import solid_of, triangles_of, weld
from workers.geometry.heights import Terrain, vertical_gap
from workers.geometry.hull import convex_hull
from workers.geometry.inset import least_width_m
from workers.geometry.manifold import hold_to_one_thread

NEAR_M = 0.02
"""How far from an object the next one is looked for."""

NO_VOLUME = 1e-15
"""Cubic metres: what two bodies share by rounding alone."""


def clearances(meshes: Sequence[Mesh], ground: Terrain) -> list[float]:
    """Of each mesh (world coordinates): metres to what is nearest, negative where they overlap most.

    To the ground along z. Between two meshes the least distance, or minus the least width of what they share; a mesh
    that encloses no body stands there as its hull.
    """
    hold_to_one_thread()
    solids = [_solid(mesh) for mesh in meshes]
    boxes = [(mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) for mesh in meshes]
    found = [vertical_gap(mesh, ground) for mesh in meshes]
    for i, j in itertools.combinations(range(len(meshes)), 2):
        if (boxes[i][0] > boxes[j][1] + NEAR_M).any() or (boxes[j][0] > boxes[i][1] + NEAR_M).any():
            continue
        gap = between(solids[i], solids[j])
        found[i], found[j] = min(found[i], gap), min(found[j], gap)
    return found


def between(a: manifold3d.Manifold, b: manifold3d.Manifold) -> float:
    """Metres between two bodies, `NEAR_M` at most; minus the least width of the widest piece that both share."""
    hold_to_one_thread()
    pieces = [piece for piece in (a ^ b).decompose() if piece.volume() > NO_VOLUME]
    if not pieces:
        return float(a.min_gap(b, NEAR_M))
    return -max(least_width_m(convex_hull(triangles_of(piece).vertices)) for piece in pieces)


def overlap_m(a: Mesh, b: Mesh) -> float:
    """Metres that two meshes (world coordinates) reach into one another at most; 0 where they do not."""
    apart = (a.vertices.min(axis=0) > b.vertices.max(axis=0)) | (b.vertices.min(axis=0) > a.vertices.max(axis=0))
    return 0.0 if apart.any() else max(0.0, -between(_solid(a), _solid(b)))


def _solid(mesh: Mesh) -> manifold3d.Manifold:
    hold_to_one_thread()
    solid = solid_of(weld(mesh))
    return manifold3d.Manifold.hull_points(np.ascontiguousarray(mesh.vertices)) if solid is None else solid
