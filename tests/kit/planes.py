"""Views of a plane whose depth is known in closed form."""

import numpy as np

from schemas.job.views import Images
from schemas.scene.view import Camera, Intrinsics, Role, View
from workers.geometry.camera import orbit_pose, unproject
from workers.geometry.pixels import quantise_depth
from workers.scene.cameras import mirror_pose

K = Intrinsics(width=160, height=120, fx=131.0, fy=131.0, cx=80.0, cy=60.0)
IMAGES = Images()
HERE = Camera(K, orbit_pose(np.array([0, 0, 0.0]), 0.8, 0.7, 2.5))
THERE = Camera(K, mirror_pose(HERE.T_world_cam, 2.5))


def plane_view(role: Role, camera: Camera, height_m: float = 0.0, region: int = 3) -> View:
    """A view of the plane z = height, exact at pixel centres."""
    rows, columns = np.mgrid[0 : K.height, 0 : K.width]
    rays = unproject(rows.ravel(), columns.ravel(), np.ones(rows.size), K) @ camera.T_world_cam[:3, :3].T
    depth = ((height_m - camera.position[2]) / rays[:, 2]).reshape(K.height, K.width)
    depth = np.where((depth > 0) & (depth < 8), depth, 0)
    rgb = np.random.default_rng(1).integers(0, 255, (K.height, K.width, 3)).astype(np.uint8)
    ids = np.where(depth > 0, region, 0).astype(np.uint8)
    return View(role, 0, 0, camera, rgb, quantise_depth(depth, IMAGES), ids, ())
