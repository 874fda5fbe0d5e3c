"""How an object stands on a level support: the final correction, and the figures that describe it. Pure geometry."""

import numpy as np
from scipy.spatial import ConvexHull

from schemas.base import Array, Pose
from schemas.shape import Hull, Mesh
from workers.geometry.frames import pose, rotation_between, transform
from workers.geometry.heights import Terrain, heights_at
from workers.scene.support import inside_margin

SAME_PLANE_M = 1e-6
"""Vertices this near the lowest plane of the hull belong to the face that lies in it."""

CONTACT_M = 5e-5
"""A vertex that is nearer to the support than this counts as touching it."""

NEAR_LOWEST_M = 0.02
"""Only vertices this near the lowest one can touch a support that is level to within a few degrees."""

DOWN = np.array([0.0, 0.0, -1.0])


def snap_to_face(T_world_obj: Pose, hull: Hull, com: Array, snap_rad: float) -> Pose:
    """Turn the object about its centre of mass, by at most `snap_rad`, onto the face of its hull that it stands on.

    A simulator stops with the lowest vertices some tenths of a millimetre apart, because its collision shapes have
    margins. On a level plane a rest pose has a face of the hull in the plane with the centre of mass above it, so the
    nearest such face is the pose that was meant. Returns the pose unchanged where no such face is near (the object
    leans on an edge of the table, say). The height is left to the caller.
    """
    R = T_world_obj[:3, :3]
    tilt = np.arccos(np.clip(hull.normals @ (R.T @ DOWN), -1.0, 1.0))
    near = np.flatnonzero(tilt <= snap_rad)
    for index in near[np.argsort(tilt[near], kind="stable")]:
        normal = hull.normals[index]
        turn = rotation_between(R @ normal, DOWN) @ R
        if _stands(hull.vertices @ turn.T, turn @ com):
            com_world = R @ com + T_world_obj[:3, 3]
            return pose(turn, com_world - turn @ com)
    return T_world_obj


def is_stable(T_world_obj: Pose, hull: Hull, com: Array) -> bool:
    """Whether the centre of mass stands over the hull's lowest face (on a level plane, at any height)."""
    return _stands(transform(T_world_obj, hull.vertices), transform(T_world_obj, com[None, :])[0])


def _stands(points: Array, com: Array) -> bool:
    face = points[points[:, 2] <= points[:, 2].min() + SAME_PLANE_M]
    return support_margin(face[:, :2], com[:2]) > 0.0


def support_margin(contacts_xy: Array, com_xy: Array) -> float:
    """Metres that the centre of mass projects inside the hull of the contact points [N, 2]; negative outside.

    With fewer than three contacts not in a line there is no area: minus the distance to the nearest contact.
    """
    if len(contacts_xy) >= 3:
        spread = np.linalg.svd(contacts_xy - contacts_xy.mean(axis=0), compute_uv=False)[-1]
        if spread > 1e-9:
            outline = contacts_xy[ConvexHull(contacts_xy).vertices]
            return float(inside_margin(com_xy[None, :], outline)[0])
    if len(contacts_xy) == 0:
        return -np.inf
    return -float(np.linalg.norm(contacts_xy - com_xy, axis=1).min())


def touching(hull: Hull, T_world_obj: Pose, support: Mesh | Terrain) -> Array:
    """[N, 2] float64: where vertices of the hull are within `CONTACT_M` of the mesh below them, world coordinates."""
    points = transform(T_world_obj, hull.vertices)
    points = points[points[:, 2] <= points[:, 2].min() + NEAR_LOWEST_M]
    gap = points[:, 2] - heights_at(points[:, :2], support)
    return points[np.isfinite(gap) & (np.abs(gap) <= CONTACT_M)][:, :2]
