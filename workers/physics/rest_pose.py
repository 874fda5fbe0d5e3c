"""Rest poses on a level support: the correction onto a face, and the margin of support. Pure."""

import numpy as np
from scipy.spatial import ConvexHull

from schemas.base import Array, Pose
from schemas.scene.shape import Hull, Mesh
from workers.geometry.elevation import Terrain, sample_elevation
from workers.geometry.frames import pose, rotation_about, rotation_between, transform
from workers.physics.table_top import inside_margin

SAME_PLANE_M = 1e-6
"""Vertices within this height of the lowest one lie in one level face with it."""

CONTACT_M = 5e-5
"""Distance below which a vertex touches the support."""

STEADY_M = 2e-4
"""Margin of support below which a simulator may tip the object: its edges are rounded by a margin of half as much."""

NEAR_LOWEST_M = 0.02
"""Only vertices within this height of the lowest one can touch a support that is level to within a few degrees."""

TIPPED_RAD = 0.2
"""Lean at which an object on a face is tipping over: up to here it is tipped by geometry, beyond it is simulated."""

MOST_TIPS = 16
"""Bound on the tips in a row: corner, edge and face, and once more at the end of a rod. With more the shape is round."""

DOWN = np.array([0.0, 0.0, -1.0])


def snap_to_face(T_world_obj: Pose, hull: Hull, com: Array, snap_rad: float) -> Pose:
    """Turn the object about its centre of mass, by at most `snap_rad`, onto the face of its hull that it stands on.

    A simulator stops with the lowest vertices some tenths of a millimetre apart, because its collision shapes have
    margins. At rest on a level plane the centre of mass is above a face of the hull. Takes the nearest such face that is
    steady, or else the steadiest. Returns the pose unchanged where no such face is near, as for an object that leans on an
    edge of the table. The caller sets the height.
    """
    R = T_world_obj[:3, :3]
    tilt = np.arccos(np.clip(hull.normals @ (R.T @ DOWN), -1.0, 1.0))
    near = np.flatnonzero(tilt <= snap_rad)
    best, most = None, 0.0
    for index in near[np.argsort(tilt[near], kind="stable")]:
        turn = rotation_between(R @ hull.normals[index], DOWN) @ R
        points = hull.vertices @ turn.T
        face = points[points[:, 2] <= points[:, 2].min() + SAME_PLANE_M]
        margin = support_margin(face[:, :2], (turn @ com)[:2])
        if margin > most:
            best, most = turn, margin
        if most > STEADY_M:
            break
    return T_world_obj if best is None else pose(best, R @ com + T_world_obj[:3, 3] - best @ com)


def tip_onto_face(T_world_obj: Pose, hull: Hull, com: Array) -> Pose | None:
    """Turn the object over its lowest edges and corners, as it would tip on a level plane, until it stands on a face.

    For an object that rolling friction held between two faces. Each tip turns it about the contact nearest to its centre of
    mass, until the next vertex touches; the centre of mass only sinks. A face that is not steady is tipped over its nearest
    edge, which lifts the centre of mass by less than a micrometre. Returns the first steady pose, else the steadiest; None
    without any within `TIPPED_RAD` in all: there the object falls instead. The caller sets the height.
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
        pivot, away = _tipping_axis(low, centre, margin)
        ahead, height = (points[:, :2] - pivot[:2]) @ away, points[:, 2] - pivot[2]
        angle = np.arctan2(height, ahead)[(ahead > SAME_PLANE_M) & (height > SAME_PLANE_M)]
        turned += float(angle.min(initial=np.pi))
        if turned > TIPPED_RAD:
            break
        R = rotation_about(np.array([-away[1], away[0], 0.0]), float(angle.min()))
        T = pose(R @ T[:3, :3], R @ (T[:3, 3] - pivot) + pivot)
    return best


def _tipping_axis(low: Array, centre: Array, margin: float) -> tuple[Array, Array]:
    """(pivot [3], level unit direction [2] to tip towards) of a body with the lowest vertices `low` [N, 3]."""
    if margin > 0.0:  # over the nearest edge of its face
        corners = low[ConvexHull(low[:, :2]).vertices]
        along = np.roll(corners, -1, axis=0) - corners
        normal = np.stack([along[:, 1], -along[:, 0]], axis=1)  # outwards: corners are counter-clockwise
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        distance = ((corners - centre)[:, :2] * normal).sum(axis=1)
        nearest = int(np.argmin(distance))
        pivot = np.array([*(centre[:2] + distance[nearest] * normal[nearest]), low[:, 2].min()])
        return pivot, normal[nearest]
    pivot = _nearest_of_hull(low, centre)
    away = centre[:2] - pivot[:2]
    if float(np.linalg.norm(away)) < SAME_PLANE_M:  # balanced on a ridge or a corner: any side will do
        far = low[np.argmax(np.linalg.norm(low - low[0], axis=1))] - low[0]
        away = np.array([-far[1], far[0]]) if len(low) > 1 else np.array([1.0, 0.0])
    return pivot, away / np.linalg.norm(away)


def _nearest_of_hull(low: Array, centre: Array) -> Array:
    """[3]: the point of the segment or polygon of level points [N, 3] that is nearest to `centre`, seen from above."""
    best = low[np.argmin(np.linalg.norm(low[:, :2] - centre[:2], axis=1))]
    for k, a in enumerate(low):
        along = low[k + 1 :] - a
        length2 = np.maximum((along[:, :2] ** 2).sum(axis=1), 1e-300)
        share = np.clip(((centre - a)[:2] * along[:, :2]).sum(axis=1) / length2, 0.0, 1.0)
        for foot in a + share[:, None] * along:
            if np.linalg.norm(foot[:2] - centre[:2]) < np.linalg.norm(best[:2] - centre[:2]):
                best = foot
    return best


def stands_on_face(vertices: Array, down: Array) -> bool:
    """Whether at least three vertices [N, 3] are lowest in the unit direction `down` [3]."""
    depth = vertices @ down
    return bool(np.count_nonzero(depth >= depth.max() - SAME_PLANE_M) >= 3)


def support_margin(contacts_xy: Array, com_xy: Array) -> float:
    """Metres from the projected centre of mass to the edge of the hull of contact points [N, 2]; negative outside.

    Without three contacts that span an area: minus the distance to the nearest contact.
    """
    if len(contacts_xy) >= 3:
        spread = np.linalg.svd(contacts_xy - contacts_xy.mean(axis=0), compute_uv=False)[-1]
        if spread > 1e-9:
            outline = contacts_xy[ConvexHull(contacts_xy).vertices]
            return float(inside_margin(com_xy[None, :], outline)[0])
    if len(contacts_xy) == 0:
        return -np.inf
    return -float(np.linalg.norm(contacts_xy - com_xy, axis=1).min())


def find_contacts_xy(hull: Hull, T_world_obj: Pose, support: Mesh | Terrain) -> Array:
    """[N, 2] float64, world: the vertices of the hull within `CONTACT_M` of the mesh below them."""
    points = transform(T_world_obj, hull.vertices)
    points = points[points[:, 2] <= points[:, 2].min() + NEAR_LOWEST_M]
    gap = points[:, 2] - sample_elevation(points[:, :2], support)
    return points[np.isfinite(gap) & (np.abs(gap) <= CONTACT_M)][:, :2]
