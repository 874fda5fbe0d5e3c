"""The factory calibration that an Azure Kinect attaches to its recordings, as the cameras of one colour and depth mode.

What the numbers mean is taken from Microsoft's Azure Kinect Sensor SDK (calibration.c, mode_specific_calibration.c,
intrinsic_transformation.c): principal point and focal lengths are shares of the sensor's width and height, measured from the
upper left corner of the image; Rt takes points of the rig to points of the camera, metres; the lens is OpenCV's rational model.
"""

import json
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from schemas.base import Pose, frozen_array
from schemas.capture import CaptureCamera, DepthCamera
from schemas.errors import CaptureError
from schemas.scene.view import Intrinsics
from workers.geometry.frames import invert, pose

DEPTH_UNITS_PER_M = 1000.0
"""Of a recording: depth is whole millimetres."""

DEPTH_MODES = {
    "NFOV_2X2BINNED": (512, (96, 90), (320, 288)),
    "NFOV_UNBINNED": (1024, (192, 180), (640, 576)),
    "WFOV_2X2BINNED": (512, (0, 0), (512, 512)),
    "WFOV_UNBINNED": (1024, (0, 0), (1024, 1024)),
}
"""Width of the square sensor after binning, the cut's left and upper edge in it, and the size of the image, pixels."""

COLOR_SIZES = ((1280, 720), (1920, 1080), (2560, 1440), (2048, 1536), (3840, 2160), (4096, 3072))
"""Of the device's colour modes, pixels. Each is the whole width of a 4:3 sensor, cut to its height at top and bottom alike."""

DEPTH_SENSOR = (1024, 1024)
ROTATION_ERROR = 1e-3
"""By which a stored rotation may miss a rotation: it is in single precision."""

Numbers = Annotated[list[float], Field(max_length=64)]


class _Part(BaseModel):
    """A part of the file; what it has beyond these keys is not needed."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class _Lens(_Part):
    ModelType: str
    ModelParameters: Numbers


class _Place(_Part):
    Rotation: Annotated[list[float], Field(min_length=9, max_length=9)]
    Translation: Annotated[list[float], Field(min_length=3, max_length=3)]


class _Camera(_Part):
    Location: str
    Intrinsics: _Lens
    Rt: _Place
    SensorWidth: Annotated[int, Field(ge=1)]
    SensorHeight: Annotated[int, Field(ge=1)]


class _Cameras(_Part):
    Cameras: list[_Camera]


class _File(_Part):
    CalibrationInformation: _Cameras


@dataclass(frozen=True, eq=False)
class DeviceCalibration:
    """The colour camera and the depth camera of one recording, as their images are stored."""

    color: CaptureCamera
    depth: DepthCamera


def read_calibration(data: bytes, color_size: tuple[int, int], depth_mode: str) -> DeviceCalibration:
    """The cameras of a colour image of (width, height) and a depth mode. Raises CaptureError with what is wrong and a remedy."""
    if color_size not in COLOR_SIZES:
        known = ", ".join(f"{w} x {h}" for w, h in COLOR_SIZES)
        raise CaptureError(
            "mode", f"colour images of {color_size[0]} x {color_size[1]} are no mode of the device: {known}"
        )
    mode = DEPTH_MODES.get(depth_mode.upper())
    if mode is None:
        raise CaptureError("mode", f"the depth mode {depth_mode!r} is not known: {', '.join(DEPTH_MODES)}")
    cameras = {camera.Location: camera for camera in _parse(data)}
    color = _camera(cameras, "CALIBRATION_CameraLocationPV0")
    depth = _camera(cameras, "CALIBRATION_CameraLocationD0")
    if (depth.SensorWidth, depth.SensorHeight) != DEPTH_SENSOR:
        raise _wrong(f"the depth sensor is {depth.SensorWidth} x {depth.SensorHeight}, and the device's is 1024 x 1024")
    T_color_depth = _place(color) @ invert(_place(depth))
    binned, cut, size = mode
    return DeviceCalibration(
        CaptureCamera(_color_intrinsics(color, color_size), _lens(color), DEPTH_UNITS_PER_M),
        DepthCamera(_intrinsics(depth, (binned, binned), cut, size), _lens(depth), frozen_array(T_color_depth)),
    )


def _wrong(what: str) -> CaptureError:
    return CaptureError(
        "calibration", f"the attached calibration.json: {what}; take the recording as the device made it"
    )


def _parse(data: bytes) -> list[_Camera]:
    try:
        return _File.model_validate(json.loads(data.rstrip(b"\0"))).CalibrationInformation.Cameras
    except ValidationError as error:
        first = error.errors()[0]
        raise _wrong(f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}") from error
    except ValueError as error:
        raise _wrong(f"it is no JSON ({error})") from error


def _camera(cameras: dict[str, _Camera], location: str) -> _Camera:
    if location not in cameras:
        raise _wrong(f"it has no camera {location}")
    camera = cameras[location]
    lens = camera.Intrinsics
    if lens.ModelType != "CALIBRATION_LensDistortionModelBrownConrady":
        raise _wrong(f"{location} has the lens model {lens.ModelType}, and only BrownConrady can be read")
    values = lens.ModelParameters
    if len(values) < 14 or min(values[2:4]) <= 0.0:
        raise _wrong(f"{location} must have 14 parameters with positive focal lengths")
    if any(values[10:12]):
        raise _wrong(f"{location} has a centre of distortion {values[10:12]} beside its principal point")
    return camera


def _lens(camera: _Camera) -> np.ndarray:
    """[8] float64 in OpenCV's order, from k1 to k6, the centre of distortion, p2 and p1."""
    k1, k2, k3, k4, k5, k6, _, _, p2, p1 = camera.Intrinsics.ModelParameters[4:14]
    return frozen_array([k1, k2, p1, p2, k3, k4, k5, k6])


def _color_intrinsics(camera: _Camera, size: tuple[int, int]) -> Intrinsics:
    """Calibrations of early devices are of the 16:9 part of the sensor, later ones of the whole 4:3 sensor."""
    width, height = size
    across, down = camera.SensorWidth, camera.SensorHeight
    if across * 3 != down * 4 and across * 9 != down * 16:
        raise _wrong(f"the colour sensor is {across} x {down}, neither 4:3 nor 16:9")
    calibrated = width * down // across
    return _intrinsics(camera, (width, calibrated), (0, (calibrated - height) // 2), size)


def _intrinsics(camera: _Camera, sensor: tuple[int, int], cut: tuple[int, int], size: tuple[int, int]) -> Intrinsics:
    """Of the part of a sensor of `sensor` pixels that begins at `cut` and has `size`, pixel centres at +0.5."""
    cx, cy, fx, fy = camera.Intrinsics.ModelParameters[:4]
    return Intrinsics(
        width=size[0],
        height=size[1],
        fx=fx * sensor[0],
        fy=fy * sensor[1],
        cx=cx * sensor[0] - cut[0],
        cy=cy * sensor[1] - cut[1],
    )


def _place(camera: _Camera) -> Pose:
    """[4, 4] float64: the rig's coordinates to the camera's; the rotation is made exact."""
    R = np.reshape(camera.Rt.Rotation, (3, 3))
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_ERROR or np.linalg.det(R) < 0.0:
        raise _wrong(f"the rotation of {camera.Location} is none")
    U, _, V = np.linalg.svd(R)
    return pose(U @ V, np.array(camera.Rt.Translation))
