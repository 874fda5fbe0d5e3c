"""What all views of a capture share: how depth is wrong, and how large the print is; with what is known of it beforehand."""

import math
from dataclasses import dataclass, field

import numpy as np

from schemas.base import Array, Pose, frozen_array
from schemas.capture.estimate import DepthCorrection
from schemas.job.captures import Estimation
from workers.capture.poses.motion import cross_matrix, exponential, logarithm
from workers.capture.poses.observation import Patches
from workers.geometry.frames import pose

NAMES = (
    "offset_m",
    "scale",
    "shift_x_m",
    "shift_y_m",
    "shift_z_m",
    "turn_x_rad",
    "turn_y_rad",
    "turn_z_rad",
    "print_scale",
)
"""The shared parameters in the order in which they stand in every array of nine."""
DEPTH_SCALE = NAMES.index("scale")
PRINT_SCALE = NAMES.index("print_scale")

OFFSET_M = 0.011
SCALE = 0.001
"""The Azure Kinect's systematic error is below 11 mm + 0.1 % of the distance (Microsoft, Azure Kinect DK hardware
specifications); taken as one sigma, because it is a bound for good conditions."""
SCALE_BY_PRINT = 0.5
"""Nothing is known of the print's size where depth is metric truth."""
"""Sigma of the scale of depth where the print is metric truth: the scale then takes up the error of the print as well."""
SHIFT_M = 0.010
TURN_RAD = math.radians(0.5)
"""Registration: users report up to 1 to 2 cm between markers and depth."""
PRINT = 0.5
"""Nothing is known of the print's size where depth is metric truth."""
IDENTIFIED = 0.5
"""A parameter is identified by a capture that leaves it less than this share of its prior sigma."""


@dataclass(frozen=True, eq=False)
class Shared:
    """Values of the shared parameters; those of a capture that knows nothing are the defaults."""

    offset_m: float = 0.0
    scale: float = 1.0
    T_cam_depth: Pose = field(default_factory=lambda: frozen_array(np.eye(4)))
    print_scale: float = 1.0

    def corrected(self, patches: Patches) -> Array:
        """[P, 3] metres, camera axes: the middles of patches after the correction."""
        raw = self.scale * patches.ray_z + self.offset_m * patches.ray
        return raw @ self.T_cam_depth[:3, :3].T + self.T_cam_depth[:3, 3]

    def derivative(self, patches: Patches) -> Array:
        """[P, 3, 9]: of `corrected` by the parameters; those of registration are a shift and a turn of what is corrected."""
        R = self.T_cam_depth[:3, :3]
        turned = (self.scale * patches.ray_z + self.offset_m * patches.ray) @ R.T
        by = np.zeros((len(patches), 3, len(NAMES)))
        by[:, :, 0] = patches.ray @ R.T
        by[:, :, 1] = patches.ray_z @ R.T
        by[:, :, 2:5] = np.eye(3)
        by[:, :, 5:8] = -cross_matrix(turned)
        return by

    def moved(self, step: Array) -> "Shared":
        """The parameters after a step [9]."""
        R = exponential(step[5:8]) @ self.T_cam_depth[:3, :3]
        U, _, V = np.linalg.svd(R)
        T = frozen_array(pose(U @ V, self.T_cam_depth[:3, 3] + step[2:5]))
        return Shared(self.offset_m + float(step[0]), self.scale + float(step[1]), T, self.print_scale + float(step[8]))

    def deviation(self) -> Array:
        """[9]: how far each parameter is from its expected value."""
        turn = logarithm(self.T_cam_depth[:3, :3])
        parts = [self.offset_m, self.scale - 1, *self.T_cam_depth[:3, 3], *turn, self.print_scale - 1]
        return np.array(parts, dtype=np.float64)

    def correction(self, identified: tuple[str, ...]) -> DepthCorrection:
        """What the other stages are told."""
        return DepthCorrection(self.offset_m, self.scale, self.T_cam_depth, identified)


def prior_sigma(spec: Estimation, has_depth: bool) -> Array:
    """[9]: how far each parameter may be from its expected value, one sigma; 0 for those that are not estimated."""
    if not has_depth:
        return np.zeros(len(NAMES))
    trusts_print = spec.trust == "print"
    scale, print_ = (SCALE_BY_PRINT, 0.0) if trusts_print else (SCALE, PRINT)
    return np.array([OFFSET_M, scale, *[SHIFT_M] * 3, *[TURN_RAD] * 3, print_])


def identified(sigma: Array, prior: Array) -> tuple[str, ...]:
    """Names of the parameters that the capture determines, by their sigma [9] after and before."""
    return tuple(name for name, after, before in zip(NAMES, sigma, prior, strict=True) if after < IDENTIFIED * before)
