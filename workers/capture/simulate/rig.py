"""The simulated Azure Kinect: its colour camera and, beside it, its depth camera."""

import math
from dataclasses import dataclass, replace

import numpy as np

from schemas.base import frozen_array
from schemas.capture.depth_camera import DepthCamera
from schemas.job.captures import RegistrationError
from schemas.scene.view import Intrinsics
from workers.geometry.frames import pose, rotation_about

COLOR = Intrinsics(width=1920, height=1080, fx=912.37, fy=912.25, cx=961.44 + 0.5, cy=548.29 + 0.5)
"""The article's camera. Its principal point (961.44, 548.29) counts from the first pixel's centre."""

DEPTH = Intrinsics(width=640, height=576, fx=503.85, fy=503.74, cx=321.5 + 0.5, cy=329.0 + 0.5)
"""Mode NFOV unbinned: the size is Microsoft's. The rest is one published calibration of a device (MicrosoftDocs/azure-docs
#76396: 0.49204, 0.49193, 0.50148 and 0.49705 of 1024 pixels), of whose 1024 x 1024 pixels this mode is assumed to be the part
from (192, 180) on. Its lens is left out."""

DEPTH_POSITION_M = (-0.032, -0.002, 0.004)
"""Of the depth camera in the colour camera's optical frame: assumed, near published calibrations."""

DEPTH_TILT_DEG = 6.0
"""The depth camera looks down from the colour camera's axis by so much (Microsoft's specification)."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Both cameras of one device: pinholes with pixel centres at +0.5."""

    color: Intrinsics
    depth: DepthCamera


def make_rig(image_scale: float) -> Rig:
    """The device with all images `image_scale` times as large."""
    rotation = rotation_about(np.array([1.0, 0.0, 0.0]), -math.radians(DEPTH_TILT_DEG))
    T_color_depth = frozen_array(pose(rotation, np.array(DEPTH_POSITION_M)))
    return Rig(
        scale_intrinsics(COLOR, image_scale),
        DepthCamera(scale_intrinsics(DEPTH, image_scale), frozen_array(np.zeros(8)), T_color_depth),
    )


def scale_intrinsics(k: Intrinsics, scale: float) -> Intrinsics:
    """The same field of view on an image `scale` times as large, at least 1 pixel wide and high."""
    width, height = (max(round(side * scale), 1) for side in (k.width, k.height))
    return Intrinsics(width=width, height=height, fx=k.fx * scale, fy=k.fy * scale, cx=k.cx * scale, cy=k.cy * scale)


def assumed_device(device: DepthCamera, error: RegistrationError | None) -> DepthCamera:
    """The depth camera as its calibration has it: the true one without an error.

    With one, it is taken to stand `shift_m` elsewhere and to be turned by `turn_deg` about the vertical of the image, both in
    the colour camera's axes: T_error T_color_depth.
    """
    if error is None:
        return device
    turn = rotation_about(np.array([0.0, 1.0, 0.0]), math.radians(error.turn_deg))
    T_error = pose(turn, np.array(error.shift_m))
    return replace(device, T_color_depth=frozen_array(T_error @ device.T_color_depth))
