"""Where the cameras of a pair stand, and what depth becomes when it is stored."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, frozen_array
from schemas.camera import Camera
from schemas.errors import ViewError
from schemas.job import DepthCamera, Images, Mirror
from schemas.scene import REGION_FIRST_OBJECT, REGION_FLOOR, REGION_TABLE, Placed, PosedScene, ScenePlan, Settled
from workers.geometry.frames import UP, translation
from workers.geometry.mirror import mirror_pose
from workers.geometry.pixels import round_depth


def pose_scene(plan: ScenePlan, settled: tuple[Settled, ...]) -> PosedScene:
    """Floor, table and objects where they rest, in order of region id."""
    objects = tuple(
        Placed(start.region_id, start.asset.shape, rest.T_world_obj)
        for start, rest in zip(plan.objects, settled, strict=True)
    )
    table = Placed(REGION_TABLE, plan.table.asset.shape, plan.table.T_world_table)
    floor = Placed(REGION_FLOOR, plan.floor, frozen_array(np.eye(4)))
    return PosedScene((floor, table, *objects), plan.appearance)


def quantise_depth(depth_m: NDArray[np.floating], images: Images) -> NDArray[np.uint16]:
    """[H, W] uint16: z in units, to the nearest; 0 where nothing was hit or z is outside the stored range (open)."""
    low, high = images.depth_range_m
    return round_depth(depth_m, low, high, images.depth_units_per_m)


def stored_depth_m(depth: NDArray[np.uint16], images: Images) -> Array:
    """[H, W] float64 metres, 0 where there is none: what a reader of the stored image gets."""
    return depth / images.depth_units_per_m


def place_aligned_camera(camera: Camera, depth_camera: DepthCamera) -> Camera:
    """The depth camera: T_world_depth = T_world_rgb Trans(t), t in the RGB camera's optical axes, same rotation [D]."""
    return Camera(camera.intrinsics, frozen_array(camera.T_world_cam @ translation(*depth_camera.offset_m)))


def object_distance(depth: NDArray[np.uint16], region: NDArray[np.uint8], images: Images, mirror: Mirror) -> float:
    """`front_distance` of the object in a stored view; of its depth only the object's pixels are turned to metres."""
    return front_distance(stored_depth_m(depth[region >= REGION_FIRST_OBJECT], images), np.True_, mirror)


def front_distance(depth_m: Array, object_pixels: NDArray[np.bool_] | np.bool_, mirror: Mirror) -> float:
    """d_z: distance to the object's front surface along the optical axis, metres, from its stored depth.

    A low percentile by default, because the single nearest pixel is noisy. Raises ViewError where the object has no
    pixel with depth.
    """
    z = depth_m[object_pixels & (depth_m > 0.0)]
    if z.size == 0:
        raise ViewError("object_not_seen", "the input view has no depth pixel of the object: narrow start.offset_m")
    if mirror.front == "nearest":
        return float(z.min())
    if mirror.front == "median":
        return float(np.median(z))
    return float(np.percentile(z, mirror.percentile))


def place_mirror_camera(camera: Camera, d_z_m: float, mirror: Mirror) -> Camera:
    """The camera on the other side of the object."""
    return Camera(camera.intrinsics, frozen_array(mirror_pose(camera.T_world_cam, d_z_m, mirror.T_z_m, UP)))
