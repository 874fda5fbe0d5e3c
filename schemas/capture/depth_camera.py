"""The depth camera of an RGB-D sensor, with its place in the colour camera's frame."""

from dataclasses import dataclass

from schemas.base import Array, Pose
from schemas.scene.view import Intrinsics


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """Intrinsics with pixel centres at +0.5, the lens of its images, and its pose beside the colour camera.

    `lens` holds OpenCV's rational model in OpenCV's order (k1, k2, p1, p2, k3, k4, k5, k6), [8] float64, all 0 for a
    pinhole. T_color_depth [4, 4] takes coordinates of the depth camera to the colour camera's, optical frames, metres.
    """

    intrinsics: Intrinsics
    lens: Array
    T_color_depth: Pose
