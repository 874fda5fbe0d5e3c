"""How an object stands on a level support: the final correction, and the figures that describe it. Pure geometry."""

import numpy as np
from scipy.spatial import ConvexHull

from schemas.base import Array, Pose
from schemas.scene.shape import Hull, Mesh
from workers.geometry.elevation import Terrain, sample_elevation
from workers.geometry.frames import pose, rotation_about, rotation_between, transform
from workers.physics.table_top import inside_margin

SAME_PLANE_M = 1e-6
"""Vertices this near the lowest plane of the hull belong to the face that lies in it."""

CONTACT_M = 5e-5
"""A vertex that is nearer to the support than this counts as touching it."""

STEADY_M = 2e-4
"""An object whose centre of mass is nearer than this to the edge of the face that it stands on may rock to the next one in a
simulator, whose edges are rounded by its margin of half as much."""

NEAR_LOWEST_M = 0.02
"""Only vertices this near the lowest one can touch a support that is level to within a few degrees."""

FARTHEST_TIP_RAD = 0.2
"""As `watch.TIPPED_RAD`: so far a thing may tip by geometry alone, without a simulation."""

MOST_TIPS = 16
"""Corner, edge, face, and at the end of a rod once more: beyond that the shape is round."""

DOWN = np.array([0.0, 0.0, -1.0])


def snap_to_face(T_world_obj: Pose, hull: Hull, com: Array, snap_rad: float) -> Pose:
    """Turn the object about its centre of mass, by at most `snap_rad`, onto the face of its hull that it stands on.

    A simulator stops with the lowest vertices some tenths of a millimetre apart, because its collision shapes have
    margins. On a level plane a rest pose has a face of the hull in the plane with the centre of mass above it, so the
    nearest such face is the pose that was meant: the nearest that is steady, or the steadiest. Returns the pose unchanged
    where no such face is near (the object leans on an edge of the table, say). The height is left to the caller.
    """
    R = T_world_obj[:3, :3]
    tilt = np.arccos(np.clip(hull.normals @ (R.T @ DOWN), -1.0, 1.0))
    near = np.flatnonzero(tilt <= snap_rad)
    best, most = None, 0.0
    for index in near[np.argsort(tilt[near], kind="stable")]:
        turn = rotation_between(R @ hull.normals[index], DOWN) @ R
        margin = face_margin(hull.vertices @ turn.T, turn @ com)
        if margin > most:
            best, most = turn, margin
        if most > STEADY_M:
            break
    return T_world_obj if best is None else pose(best, R @ com + T_world_obj[:3, 3] - best @ com)


def tip_onto_face(T_world_obj: Pose, hull: Hull, com: Array) -> Pose | None:
    """Turn the object over its lowest edges and corners, as it would tip on a level plane, until it stands on a face.

    For what friction holds between two faces, as no face can: it is turned about the nearest point of its contacts,
    away from them, until the next vertex touches; its centre of mass only sinks. A face that is not steady is tipped
    over too, by its nearest edge: the centre of mass rises by less than a micrometre. Returns the first steady pose, else
    the steadiest; None where there is none within `FARTHEST_TIP_RAD` in all, because further it falls and does not tip.
    The height is left to the caller.
    """
    T, turned = T_world_obj, 0.0
    best, most = None, 0.0
    for _ in range(MOST_TIPS):
        points, centre = transform(T, hull.vertices), transform(T, com[None, :])[0]
        low = points[points[:, 2] <= points[:, 2].min() + SAME_PLANE_M]
        margin = support_margin(low[:, :2], centre[:2])
        if margin > most:
            best, most = T, margin
        if margin > STEADY_M:
            break
        pivot, away = _way_to_tip(low, centre, margin)
        ahead, height = (points[:, :2] - pivot[:2]) @ away, points[:, 2] - pivot[2]
        angle = np.arctan2(height, ahead)[(ahead > SAME_PLANE_M) & (height > SAME_PLANE_M)]
        turned += float(angle.min(initial=np.pi))
        if turned > FARTHEST_TIP_RAD:
            break
        R = rotation_about(np.array([-away[1], away[0], 0.0]), float(angle.min()))
        T = pose(R @ T[:3, :3], R @ (T[:3, 3] - pivot) + pivot)
    return best


def _way_to_tip(low: Array, centre: Array, margin: float) -> tuple[Array, Array]:
    """(point [3] to turn about, level unit direction [2] to turn to) of a body whose lowest vertices are `low` [N, 3]."""
    if margin > 0.0:  # over the nearest edge of the face that it stands on
        corners = low[ConvexHull(low[:, :2]).vertices]
        along = np.roll(corners, -1, axis=0) - corners
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)  # outwards: the corners go round counter-clockwise
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        distance = ((corners - centre)[:, :2] * normal).sum(axis=1)
        nearest = int(np.argmin(distance))
        pivot = np.array([*(centre[:2] + distance[nearest] * normal[nearest]), low[:, 2].min()])
        return pivot, normal[nearest]
    pivot = _nearest_of_hull(low, centre)
    away = centre[:2] - pivot[:2]
    if float(np.linalg.norm(away)) < SAME_PLANE_M:  # on a ridge, in balance: it may go either way
        away = _across(low)
    return pivot, away / np.linalg.norm(away)


def _nearest_of_hull(low: Array, centre: Array) -> Array:
    """[3]: the point nearest below `centre` of the segment or polygon that the points [N, 3] of one level span."""
    best = low[np.argmin(np.linalg.norm(low[:, :2] - centre[:2], axis=1))]
    for k, a in enumerate(low):
        along = low[k + 1 :] - a
        length2 = np.maximum((along[:, :2] ** 2).sum(axis=1), 1e-300)
        share = np.clip(((centre - a)[:2] * along[:, :2]).sum(axis=1) / length2, 0.0, 1.0)
        for foot in a + share[:, None] * along:
            if np.linalg.norm(foot[:2] - centre[:2]) < np.linalg.norm(best[:2] - centre[:2]):
                best = foot
    return best


def _across(low: Array) -> Array:
    """[2]: level, at right angles to the longest line between points [N, 3]; along x where there is one point."""
    far = low[np.argmax(np.linalg.norm(low - low[0], axis=1))] - low[0]
    return np.array([-far[1], far[0]]) if len(low) > 1 else np.array([1.0, 0.0])


def face_margin(points: Array, com: Array) -> float:
    """Metres that the centre of mass [3] lies inside the lowest face of a hull's vertices [N, 3]; negative outside."""
    face = points[points[:, 2] <= points[:, 2].min() + SAME_PLANE_M]
    return support_margin(face[:, :2], com[:2])


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
    gap = points[:, 2] - sample_elevation(points[:, :2], support)
    return points[np.isfinite(gap) & (np.abs(gap) <= CONTACT_M)][:, :2]
