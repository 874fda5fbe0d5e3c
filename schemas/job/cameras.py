"""The `cameras` branch of a job: where cameras stand and what their intrinsics are."""

import math
from typing import Annotated, Literal

from pydantic import Field

from schemas.base import Frozen, Interval, Range

Focal = Annotated[float, Field(ge=1e-3, le=1e6)]
Principal = Annotated[float, Field(ge=-1e6, le=1e6)]
Reach = Annotated[float, Field(gt=0, le=1e3)]
Offset = Annotated[float, Field(ge=-1e3, le=1e3)]
"""Far beyond any camera, and what its numbers can be without overflow in float32 on the GPU."""


class Orbit(Frozen):
    """Where input cameras stand: spherical coordinates about the centre of the table top [A]."""

    inclination_rad: Interval = Range(0.7, 0.9)
    """Angle of the optical axis below the horizontal."""
    yaw_rad: Interval = Range(-math.pi, math.pi)
    """Direction from the table to the camera."""
    radius_m: Reach = 2.5
    """Distance from the centre of the table top."""


class Sensor(Frozen):
    """A pinhole camera. cx, cy count from the image's left and upper edge: pixel centres lie at +0.5 [A, D]."""

    width: Annotated[int, Field(ge=1, le=4096)] = 640
    """Pixels."""
    height: Annotated[int, Field(ge=1, le=4096)] = 480
    """Pixels."""
    fx: Focal = 525.0
    """Focal length, pixels."""
    fy: Focal = 525.0
    """Focal length, pixels."""
    cx: Principal = 320.0
    """Principal point, pixels from the left edge."""
    cy: Principal = 240.0
    """Principal point, pixels from the upper edge."""


class DepthCamera(Frozen):
    """The depth camera's place in the RGB camera's optical axes, metres; same rotation [A]."""

    enabled: bool = True
    """Whether there are aligned views."""
    offset_m: tuple[Offset, Offset, Offset] = (-0.051, 0.001, -0.001)
    """Translation in the RGB camera's optical axes."""


class Mirror(Frozen):
    """The camera on the other side [A, C]."""

    enabled: bool = True
    """Whether there are mirror views; without them camPoses.csv has one row a pair, with an even id."""
    T_z_m: Reach = 1.3
    """Distance of the mirror camera from the point that it looks at."""
    pivot_depth: Literal["percentile", "median", "nearest"] = "percentile"
    """How d_z, the distance to the object's front surface, is read from the object's stored input depth."""
    percentile: Annotated[float, Field(ge=0, le=100)] = 2.0
    """Of the object's depth pixels, for `pivot_depth: percentile`."""


class Cameras(Frozen):
    """Every camera of a pair."""

    orbit: Orbit = Orbit()
    """Where input cameras stand."""
    sensor: Sensor = Sensor()
    """The pinhole camera of every view."""
    depth: DepthCamera = DepthCamera()
    """The depth camera that is not aligned with the RGB camera."""
    mirror: Mirror = Mirror()
    """The camera on the other side."""
