"""Poses of the cameras that follow from an input camera: the depth camera and the mirror camera."""

from schemas.base import frozen_array
from schemas.job.cameras import DepthCamera, Mirror
from schemas.scene.camera import Camera
from workers.cameras.mirror import mirror_pose
from workers.geometry.frames import UP, translation


def place_aligned_camera(camera: Camera, depth_camera: DepthCamera) -> Camera:
    """The depth camera: T_world_depth = T_world_rgb Trans(t), t along the RGB camera's optical axes, same rotation [D]."""
    return Camera(camera.intrinsics, frozen_array(camera.T_world_cam @ translation(*depth_camera.offset_m)))


def place_mirror_camera(camera: Camera, d_z_m: float, mirror: Mirror) -> Camera:
    """The camera on the other side of the object."""
    return Camera(camera.intrinsics, frozen_array(mirror_pose(camera.T_world_cam, d_z_m, mirror.T_z_m, UP)))
