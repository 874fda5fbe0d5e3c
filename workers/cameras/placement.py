"""Poses of the cameras that follow from an input camera, and d_z: the depth of the pivot that the mirror camera turns about."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.errors import ViewError
from schemas.job.cameras import DepthCamera, Mirror
from schemas.job.images import Images
from schemas.scene.camera import Camera
from schemas.scene.region import REGION_FIRST_OBJECT
from workers.geometry.frames import UP, half_turn, pose, translation
from workers.geometry.pixels import dequantise_depth


def place_aligned_camera(camera: Camera, depth_camera: DepthCamera) -> Camera:
    """The depth camera: T_world_depth = T_world_rgb Trans(t), t along the RGB camera's optical axes, same rotation [D]."""
    return Camera(camera.intrinsics, frozen_array(camera.T_world_cam @ translation(*depth_camera.offset_m)))


def place_mirror_camera(camera: Camera, d_z_m: float, mirror: Mirror) -> Camera:
    """The camera on the other side of the object."""
    return Camera(camera.intrinsics, frozen_array(mirror_pose(camera.T_world_cam, d_z_m, mirror.T_z_m)))


def mirror_pose(T_world_cam: Pose, d_z_m: float, T_z_m: float = 1.3, up: Array = UP) -> Pose:
    """Camera on the other side: half a turn about `up` through the pivot d_z_m ahead, and T_z_m away from it.

    [4, 4] float64, camera to world, optical frame, any roll. The pivot is the point of the optical axis in the plane
    of the object's front surface. Equals the product of transforms of Staszak and Belter 2024 at zero roll.
    """
    pivot = T_world_cam[:3, 3] + d_z_m * T_world_cam[:3, 2]
    R = half_turn(up) @ T_world_cam[:3, :3]
    return pose(R, pivot - T_z_m * R[:, 2])


def object_distance(depth: NDArray[np.uint16], region: NDArray[np.uint8], images: Images, mirror: Mirror) -> float:
    """`front_distance` of the object in a stored view; converts only the object's pixels to metres."""
    return front_distance(dequantise_depth(depth[region >= REGION_FIRST_OBJECT], images), np.True_, mirror)


def front_distance(depth_m: Array, object_pixels: NDArray[np.bool_] | np.bool_, mirror: Mirror) -> float:
    """d_z: distance to the object's front surface along the optical axis, metres, from its stored depth.

    A low percentile by default, because the nearest pixel is noisy. Raises ViewError where no pixel of the object has
    depth.
    """
    z = depth_m[object_pixels & (depth_m > 0.0)]
    if z.size == 0:
        raise ViewError("object_not_seen", "the input view has no depth pixel of the object: narrow start.offset_m")
    if mirror.pivot_depth == "nearest":
        return float(z.min())
    if mirror.pivot_depth == "median":
        return float(np.median(z))
    return float(np.percentile(z, mirror.percentile))
