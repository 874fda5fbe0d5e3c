"""Rest poses on a level support: the correction onto a face, and the margin of support. Pure."""

from dataclasses import dataclass

import numpy as np
import shapely

from schemas.base import Array, Pose
from schemas.scene.shape import Hull
from workers.geometry.frames import DOWN, pose, rotation_between

SAME_PLANE_M = 1e-6
"""Vertices within this height of the lowest one lie in one level face with it."""

STEADY_M = 2e-4
"""Margin of support below which a simulator may tip the object: its edges are rounded by a margin of a tenth of it."""

SNAP_RAD = 0.02
"""Angle to a face up to which an object stands on it: the simulation leaves small ones 0.2 mm out of level."""


@dataclass(frozen=True, eq=False)
class Face:
    """A steady face of a hull, turned to be level below it by `turn` [3, 3], object to world.

    margin_m: from the projected centre of mass to the face's edge; height_m: of the centre of mass over the face.
    """

    turn: Array
    margin_m: float
    height_m: float


def find_face(T_world_obj: Pose, hull: Hull, com: Array) -> Face | None:
    """The nearest steady face of an object's hull, at most `SNAP_RAD` from level; None where none is near."""
    R = T_world_obj[:3, :3]
    tilt = np.arccos(np.clip(hull.normals @ (R.T @ DOWN), -1.0, 1.0))
    near = np.flatnonzero(tilt <= SNAP_RAD)
    for index in near[np.argsort(tilt[near], kind="stable")]:
        turn = rotation_between(R @ hull.normals[index], DOWN) @ R
        points = hull.vertices @ turn.T
        lowest_m = points[:, 2].min()
        face = points[points[:, 2] <= lowest_m + SAME_PLANE_M]
        margin_m = support_margin(face[:, :2], (turn @ com)[:2])
        if margin_m > STEADY_M:
            return Face(turn, margin_m, float((turn @ com)[2] - lowest_m))
    return None


def snap_to_face(T_world_obj: Pose, hull: Hull, com: Array, known: Face | None = None) -> Pose | None:
    """Turn the object about its centre of mass, by at most `SNAP_RAD`, onto the nearest steady face of its hull.

    A simulator stops with the lowest vertices some tenths of a millimetre apart, because its collision shapes have margins.
    None where no steady face is near. The caller sets the height. known: the face, if it is already found.
    """
    face = known or find_face(T_world_obj, hull, com)
    if face is None:
        return None
    return pose(face.turn, T_world_obj[:3, :3] @ com + T_world_obj[:3, 3] - face.turn @ com)


def stands_on_face(vertices: Array, down: Array) -> bool:
    """Whether at least three vertices [N, 3] are lowest in the unit direction `down` [3]."""
    depth = vertices @ down
    return bool(np.count_nonzero(depth >= depth.max() - SAME_PLANE_M) >= 3)


def support_margin(contacts_xy: Array, com_xy: Array) -> float:
    """Metres from the projected centre of mass [2] to the edge of the hull of contact points [N, 2]; negative outside.

    For contacts on a line or a point: minus the distance to it. -inf without contacts.
    """
    if len(contacts_xy) == 0:
        return -np.inf
    outline, at = shapely.convex_hull(shapely.multipoints(contacts_xy)), shapely.points(com_xy)
    if outline.geom_type == "Polygon" and outline.contains(at):
        return float(outline.exterior.distance(at))
    return -float(outline.distance(at))
