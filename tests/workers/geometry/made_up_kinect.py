"""The cameras of a made-up Azure Kinect, and the exact depth of planes and spheres in them, by OpenCV's lens functions.

The numbers are of the size that devices have; both lenses are far from zero.
"""

import cv2
import numpy as np

from schemas.base import frozen_array
from schemas.capture import DepthCamera
from schemas.scene.view import Intrinsics
from workers.geometry.frames import pose, rotation_about

COLOR = Intrinsics(width=1920, height=1080, fx=912.37, fy=912.25, cx=961.94, cy=548.79)
COLOR_LENS = frozen_array([0.52, -2.65, 0.0007, -0.0003, 1.55, 0.40, -2.47, 1.47])
DEPTH = Intrinsics(width=640, height=576, fx=504.4, fy=504.5, cx=321.3, cy=337.9)
DEPTH_LENS = frozen_array([2.91, 1.82, 0.00006, -0.00003, 0.093, 3.25, 2.79, 0.49])
AXIS = np.array([0.9961, 0.0619, -0.0619]) / np.linalg.norm([0.9961, 0.0619, -0.0619])
T_COLOR_DEPTH = frozen_array(pose(rotation_about(AXIS, np.radians(-6.2)), np.array([-0.0320, -0.0021, 0.0039])))
CAMERA = DepthCamera(DEPTH, DEPTH_LENS, T_COLOR_DEPTH)


def smaller(k: Intrinsics, times: float) -> Intrinsics:
    """The same camera with smaller images."""
    return Intrinsics(
        width=round(k.width * times),
        height=round(k.height * times),
        fx=k.fx * times,
        fy=k.fy * times,
        cx=k.cx * times,
        cy=k.cy * times,
    )


def opencv_rays(k: Intrinsics, lens: np.ndarray) -> np.ndarray:
    """[h, w, 3] rays with z = 1 through the pixel centres, by OpenCV, iterated until it stands."""
    matrix = np.array([[k.fx, 0, k.cx_opencv], [0, k.fy, k.cy_opencv], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(k.width, dtype=np.float64), np.arange(k.height, dtype=np.float64))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 400, 1e-12)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    xy = cv2.undistortPoints(pixels, matrix, np.asarray(lens), None, None, None, criteria)
    return np.concatenate([xy[:, 0], np.ones((len(pixels), 1))], axis=1).reshape(k.height, k.width, 3)


def plane_depth(rays: np.ndarray, normal: np.ndarray, distance_m: float) -> np.ndarray:
    """[h, w] z of the plane normal . p = distance_m, 0 where it is not met."""
    along = rays @ normal
    z = np.divide(distance_m, along, out=np.zeros(along.shape), where=along != 0)
    return np.where(z > 0, z, 0.0)


def sphere_depth(rays: np.ndarray, centre: np.ndarray, radius_m: float) -> np.ndarray:
    """[h, w] z of the near side of a sphere, 0 where it is not met."""
    a, b = (rays**2).sum(axis=2), rays @ centre
    root = b * b - a * (centre @ centre - radius_m**2)
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0.0)


def plane_in_depth_camera(T_color_depth: np.ndarray, normal: np.ndarray, distance_m: float) -> tuple[np.ndarray, float]:
    """A plane of the colour camera's frame in the depth camera's."""
    R, t = T_color_depth[:3, :3], T_color_depth[:3, 3]
    return R.T @ normal, distance_m - float(normal @ t)
