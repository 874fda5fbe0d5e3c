"""The mirror camera: the pose on the other side of the object (Staszak and Belter 2024; dataset.md section 1)."""

import numpy as np

from schemas.base import Array, Pose
from workers.geometry.camera import inclination
from workers.geometry.frames import UP, half_turn, pose, rotation_about, translation

X_AXIS = np.array([1.0, 0.0, 0.0])
Y_AXIS = np.array([0.0, 1.0, 0.0])


def mirror_pose(T_world_cam: Pose, d_z_m: float, T_z_m: float = 1.3, up: Array = UP) -> Pose:
    """Camera on the other side: half a turn about `up` through the pivot d_z_m ahead, and T_z_m away from it.

    [4, 4] float64, camera to world, optical frame, any roll. The pivot is the point of the optical axis in the plane
    of the object's front surface. Equals `article_product` at zero roll.
    """
    pivot = T_world_cam[:3, 3] + d_z_m * T_world_cam[:3, 2]
    R = half_turn(up) @ T_world_cam[:3, :3]
    return pose(R, pivot - T_z_m * R[:, 2])


def article_product(T_world_cam: Pose, d_z_m: float, T_z_m: float = 1.3) -> Pose:
    """The article's product of transforms, [4, 4] float64, for a zero-roll camera.

    T_in Trans_z(d_z) Rot_x(phi) Rot_y(pi) Rot_x(-phi) Trans_z(-T_z), with phi the angle of the axis below the
    horizontal. It stands here as the reference that `mirror_pose` is held against.
    """
    phi = inclination(T_world_cam)
    turn = rotation_about(X_AXIS, phi) @ half_turn(Y_AXIS) @ rotation_about(X_AXIS, -phi)
    return T_world_cam @ translation(0, 0, d_z_m) @ pose(turn, np.zeros(3)) @ translation(0, 0, -T_z_m)
