"""The mirror camera: the pose on the other side of the object (Staszak and Belter 2024; dataset.md section 1)."""

from schemas.base import Array, Pose
from workers.geometry.frames import UP, half_turn, pose


def mirror_pose(T_world_cam: Pose, d_z_m: float, T_z_m: float = 1.3, up: Array = UP) -> Pose:
    """Camera on the other side: half a turn about `up` through the pivot d_z_m ahead, and T_z_m away from it.

    [4, 4] float64, camera to world, optical frame, any roll. The pivot is the point of the optical axis in the plane
    of the object's front surface. Equals the article's product of transforms at zero roll.
    """
    pivot = T_world_cam[:3, 3] + d_z_m * T_world_cam[:3, 2]
    R = half_turn(up) @ T_world_cam[:3, :3]
    return pose(R, pivot - T_z_m * R[:, 2])
