"""Meshes of known geometry, for tests of the judge."""

from collections.abc import Sequence

import manifold3d
import numpy as np
from scipy.spatial.transform import Rotation

from schemas.base import Array
from schemas.scene.shape import Mesh

ROUND = 64
"""Corners of a circle."""


def _mesh(solid: manifold3d.Manifold) -> Mesh:
    mesh = solid.to_mesh64()
    return Mesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts, dtype=np.int32))


def rotation(axis: Sequence[float], degrees: float) -> Array:
    """[3, 3]: a turn about an axis of any length."""
    return Rotation.from_rotvec(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis)).as_matrix()


def moved(mesh: Mesh, turn: Array | None = None, at: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
    """Turned about the origin, then moved, metres."""
    return Mesh(mesh.vertices @ (np.eye(3) if turn is None else turn).T + np.array(at), mesh.faces)


def joined(*meshes: Mesh) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces).astype(np.int32))


def box(size: Sequence[float], middle: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
    """A box of these sides."""
    return moved(_mesh(manifold3d.Manifold.cube(tuple(size), True)), at=middle)


def ball(radius: float, middle: Sequence[float] = (0.0, 0.0, 0.0)) -> Mesh:
    """Points on a sphere, among them its ends along each axis."""
    return moved(_mesh(manifold3d.Manifold.sphere(radius, ROUND)), at=middle)


def prism(outline: Sequence[Sequence[float]], depth: float) -> Mesh:
    """The outline (x, z), counter-clockwise, from y = -depth / 2 to depth / 2."""
    points = np.array(outline)
    ends = [np.insert(points, 1, y, axis=1) for y in (-depth / 2, depth / 2)]
    return _mesh(manifold3d.Manifold.hull_points(np.ascontiguousarray(np.concatenate(ends))))


def turned(outline: Sequence[Sequence[float]]) -> Mesh:
    """The closed outline (radius, z), counter-clockwise, about the z axis: `ROUND` flat sides, corners on the circles."""
    angle = 2.0 * np.pi * np.arange(ROUND) / ROUND
    points = np.array(outline)
    rings = np.stack([np.outer(points[:, 0], np.cos(angle)), np.outer(points[:, 0], np.sin(angle))], axis=-1)
    heights = np.broadcast_to(points[:, 1, None, None], (len(points), ROUND, 1))
    k, n = np.meshgrid(np.arange(len(points)), np.arange(ROUND), indexing="ij")
    after, beside = (k + 1) % len(points) * ROUND, (n + 1) % ROUND
    low, low_next, high, high_next = k * ROUND + n, k * ROUND + beside, after + n, after + beside
    faces = np.concatenate([np.stack(three, axis=-1) for three in ((low, low_next, high_next), (low, high_next, high))])
    return Mesh(np.concatenate([rings, heights], axis=-1).reshape(-1, 3), faces.reshape(-1, 3).astype(np.int32))


def bowl(radius: float, wall: float) -> Mesh:
    """A conical bowl on the origin: level inside up to about half its radius, at the height of its wall."""
    low, high = radius / 2, radius / 2
    return turned([(0.0, 0.0), (low, 0.0), (radius, high), (radius - wall, high), (low - wall, wall), (0.0, wall)])


def funnel(radius: float, wall: float) -> Mesh:
    """A conical ring on the origin, as high as half its radius, with walls at 45 degrees between its corners."""
    half = radius / 2
    return turned([(half, 0.0), (radius, half), (radius - wall, half), (half - wall, 0.0)])
