"""Cameras: intrinsics and a pose in the optical frame (x right, y down, z forward)."""

from dataclasses import dataclass
from typing import Literal

from schemas.base import Array, Frozen, Pose
from schemas.job.cameras import Sensor

Role = Literal["input", "aligned", "mirror", "projected"]
ROLES: tuple[Role, ...] = ("input", "aligned", "mirror", "projected")


class Intrinsics(Frozen):
    """A pinhole camera whose pixel (column i, row j) has its centre at (i + 0.5, j + 0.5).

    `cx_opencv`, `cy_opencv` are the same principal point where pixel centres lie on integers.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def cx_opencv(self) -> float:
        """Principal point, pixels, with the first pixel's centre at 0."""
        return self.cx - 0.5

    @property
    def cy_opencv(self) -> float:
        """Principal point, pixels, with the first pixel's centre at 0."""
        return self.cy - 0.5

    @staticmethod
    def of(sensor: Sensor) -> "Intrinsics":
        """The intrinsics that a job's sensor describes."""
        return Intrinsics(**sensor.model_dump())


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics and `T_world_cam` [4, 4] float64, optical frame."""

    intrinsics: Intrinsics
    T_world_cam: Pose

    @property
    def position(self) -> Array:
        """[3] float64, world, metres."""
        return self.T_world_cam[:3, 3]
