"""The camera's movement while the shutter is open."""

import math
from dataclasses import dataclass

import numpy as np

from schemas.base import Array, Pose
from schemas.job.captures import MotionBlur
from workers.geometry.frames import pose, rotation_about


@dataclass(frozen=True, eq=False)
class Motion:
    """Even motion in the camera's own axes: `way` [3] metres and a rotation by `turn_rad` about `axis` [3] in one exposure."""

    way: Array
    axis: Array
    turn_rad: float


AT_REST = Motion(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0)


def draw_motion(blur: MotionBlur, rng: np.random.Generator) -> Motion:
    """A motion with the speeds of `blur`, in a uniform direction and about a uniform axis."""
    direction, axis = (v / np.linalg.norm(v) for v in rng.standard_normal((2, 3)))
    turn_rad = math.radians(blur.turn_deg_s) * blur.exposure_s
    return Motion(blur.speed_m_s * blur.exposure_s * direction, axis, turn_rad)


def pose_at(T_world_cam: Pose, motion: Motion, moment: float) -> Pose:
    """[4, 4]: the camera's pose at a moment, -0.5 to 0.5, of the exposure; T_world_cam is that of its middle."""
    return T_world_cam @ pose(rotation_about(motion.axis, moment * motion.turn_rad), moment * motion.way)
