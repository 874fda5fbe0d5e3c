"""How near the objects of a scene come to the table and to one another, between their meshes. Pure geometry."""

import itertools
from collections.abc import Sequence

import manifold3d
import numpy as np

from schemas.scene.shape import Mesh
from workers.geometry.convexity import mesh_of, solid_of, weld
from workers.geometry.elevation import Terrain, vertical_gap
from workers.geometry.hull import convex_hull
from workers.geometry.hull_offset import least_width_m
from workers.geometry.manifold import hold_to_one_thread

NEAR_M = 0.02
"""How far from an object the next one is looked for."""

NO_VOLUME = 1e-15
"""Cubic metres: what two bodies share by rounding alone."""


BESIDE_M = 1e-3
"""What seems to lie deeper in the ground than this, along z, may touch the side of a wall that rises beside it."""

SIDE_M = 5e-4
"""It does if it is not as deep any more when its sides are so much further in."""

SIDE_TO_M = 1e-7
"""To what its depth in the wall is told."""


def clearances(meshes: Sequence[Mesh], ground: Terrain) -> list[float]:
    """Of each mesh (world coordinates): metres to what is nearest, negative where they overlap most.

    To the ground see `ground_gap_m`. Between two meshes the least distance, or minus the least width of what they share; a mesh
    that encloses no body stands there as its hull.
    """
    hold_to_one_thread()
    solids = [_solid(mesh) for mesh in meshes]
    boxes = [(mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)) for mesh in meshes]
    found = [ground_gap_m(mesh, ground) for mesh in meshes]
    for i, j in itertools.combinations(range(len(meshes)), 2):
        if (boxes[i][0] > boxes[j][1] + NEAR_M).any() or (boxes[j][0] > boxes[i][1] + NEAR_M).any():
            continue
        gap = between(solids[i], solids[j])
        found[i], found[j] = min(found[i], gap), min(found[j], gap)
    return found


def above_ground(mesh: Mesh, ground: Terrain) -> tuple[float, float]:
    """(metres along z down to the ground, negative where a mesh reaches into it; metres that it reaches into a wall's side).

    Along z, what reaches into the side of a wall by a hair would be as deep as the wall is high. So where it is deep its
    sides are moved in until it is not.
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
    """The mesh drawn together about its middle, so that its sides are so much further in; heights stay."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    shares = np.append(1.0 - 2.0 * by_m / np.maximum((high - low)[:2], 2.0 * by_m), 1.0)
    middle = (low + high) / 2
    return Mesh(middle + (mesh.vertices - middle) * shares, mesh.faces)


def ground_gap_m(mesh: Mesh, ground: Terrain) -> float:
    """Metres from a mesh to the ground along z; minus how far it reaches into the ground, or into a wall's side if more."""
    below, beside = above_ground(mesh, ground)
    return min(below, -beside) if beside > 0.0 else below


def between(a: manifold3d.Manifold, b: manifold3d.Manifold) -> float:
    """Metres between two bodies, `NEAR_M` at most; minus the least width of the widest piece that both share."""
    hold_to_one_thread()
    pieces = [piece for piece in (a ^ b).decompose() if piece.volume() > NO_VOLUME]
    if not pieces:
        return float(a.min_gap(b, NEAR_M))
    return -max(least_width_m(convex_hull(mesh_of(piece).vertices)) for piece in pieces)


def overlap_m(a: Mesh, b: Mesh) -> float:
    """Metres that two meshes (world coordinates) reach into one another at most; 0 where they do not."""
    apart = (a.vertices.min(axis=0) > b.vertices.max(axis=0)) | (b.vertices.min(axis=0) > a.vertices.max(axis=0))
    return 0.0 if apart.any() else max(0.0, -between(_solid(a), _solid(b)))


def _solid(mesh: Mesh) -> manifold3d.Manifold:
    hold_to_one_thread()
    solid = solid_of(weld(mesh))
    return manifold3d.Manifold.hull_points(np.ascontiguousarray(mesh.vertices)) if solid is None else solid
