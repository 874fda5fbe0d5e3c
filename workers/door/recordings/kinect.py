"""Azure Kinect recordings: tracks and frames, read by PyAV, and the device's calibration.

The layout is that of Microsoft's description ("Azure Kinect record file format") and its SDK: tracks named COLOR and DEPTH or
marked by the tags K4A_COLOR_TRACK and K4A_DEPTH_TRACK, time stamps in microseconds of the device's clock, depth as 16-bit
big-endian millimetres (b16g), the factory calibration as an attachment. When it closes a file, the SDK writes the last time stamp
into its head (record.cpp, k4a_record_flush): what a cut file has lost.

What the calibration's numbers mean is taken from the SDK (calibration.c, mode_specific_calibration.c,
intrinsic_transformation.c): principal point and focal lengths are shares of the sensor's width and height, measured from the
upper left corner of the image; Rt takes points of the rig to points of the camera, metres; the lens is OpenCV's rational model.
"""

import functools
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray
from pydantic import AliasPath, BaseModel, ConfigDict, Field, ValidationError

from schemas.base import Pose, frozen_array
from schemas.capture import CaptureCamera, DepthCamera, Recorded, RecordedFrame
from schemas.errors import CaptureError
from schemas.scene.view import Intrinsics
from workers.door.recordings.pictures import PictureError, Size, decode_rgb, decode_small
from workers.geometry.frames import invert, pose

CONVERSIONS = {
    "NV12": (cv2.COLOR_YUV2RGB_NV12, cv2.COLOR_YUV2GRAY_NV12),
    "YUY2": (cv2.COLOR_YUV2RGB_YUY2, cv2.COLOR_YUV2GRAY_YUY2),
    "BGRA": (cv2.COLOR_BGRA2RGB, cv2.COLOR_BGRA2GRAY),
}
"""OpenCV's conversions of colour frames to RGB and to grey, by their four-character code."""

FORMATS = ("MJPG", *CONVERSIONS)
"""Of colour frames."""

DEPTH_FORMAT = "b16g"

DEPTH_UNITS_PER_M = 1000.0
"""Of a recording: depth is whole millimetres."""


def decode_color(data: bytes, fourcc: str, size: Size, small: bool) -> NDArray[np.uint8] | None:
    """A frame as `RecordedFrame.load` gives it; None for bytes that are cut, cannot be read or have another size."""
    width, height = size
    if fourcc == "MJPG":
        if data[:2] != b"\xff\xd8" or data.rstrip(b"\0")[-2:] != b"\xff\xd9":
            return None
        try:
            return (decode_small if small else decode_rgb)(data, size)
        except PictureError:
            return None
    shape = {"NV12": (height * 3 // 2, width), "YUY2": (height, width, 2), "BGRA": (height, width, 4)}[fourcc]
    if len(data) != np.prod(shape):
        return None
    image = cv2.cvtColor(np.frombuffer(data, np.uint8).reshape(shape), CONVERSIONS[fourcc][small])
    if small:
        image = cv2.resize(image, (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(image, np.uint8)


def decode_depth(data: bytes, size: Size) -> NDArray[np.float64] | None:
    """[h, w] metres of 16-bit big-endian millimetres; None for bytes that are cut."""
    if len(data) != 2 * size[0] * size[1]:
        return None
    return np.frombuffer(data, ">u2").reshape(size[1], size[0]) / DEPTH_UNITS_PER_M


AS_RECORDED = "take the file as k4arecorder or the SDK wrote it"
PLACES = "or export its frames as rgb_00000.png and depth_00000.png (registered to colour) with a camera.json"


def is_kinect(path: Path) -> bool:
    """Whether a file is Matroska, by its first bytes or its name."""
    if not path.is_file() or path.suffix.lower() == ".mkv":
        return path.is_file()
    with open(path, "rb") as stream:
        return stream.read(4) == b"\x1a\x45\xdf\xa3"


def open_kinect(path: Path) -> Recorded:
    """A recording with its calibration. Raises CaptureError that names the file, what is missing and what to do."""
    with _open(path) as container:
        color, depth = _track(container, "COLOR"), _track(container, "DEPTH")
        if color is None:
            why = "has no colour track: record with the colour camera on (k4arecorder -c 1080p)"
            raise CaptureError("color", f"{path} {why}")
        if depth is None:
            why = "has no depth track: record with a depth mode other than OFF and PASSIVE_IR"
            raise CaptureError("depth", f"{path} {why}")
        codec = _check_formats(path, color, depth)
        tags = {**container.metadata, **color.metadata, **depth.metadata}
        mode, delay, rate = _clock(path, tags, color, depth)
        calibration = _calibration(path, container)
        duration_us = None if container.duration is None else float(container.duration)
        streams, size = {color.index: False, depth.index: True}, (color.width, color.height)
        depth_size = (depth.width, depth.height)
    try:
        color_camera, depth_camera = read_calibration(calibration, size, mode)
    except CaptureError as error:
        raise CaptureError(error.reason, f"{path}: {error.detail}") from error
    of_mode = (depth_camera.intrinsics.width, depth_camera.intrinsics.height)
    if depth_size != of_mode:
        raise CaptureError("mode", f"{path}: depth is {depth_size}, and the mode {mode} has {of_mode}")

    def load(data: bytes, is_depth: bool, small: bool) -> NDArray | None:
        return decode_depth(data, depth_size) if is_depth else decode_color(data, codec, size, small)

    def frames() -> Iterator[RecordedFrame]:
        for is_depth, stamp_us, data in _read_frames(path, streams):
            yield RecordedFrame(is_depth, stamp_us, functools.partial(load, data, is_depth))

    told = {"serial_number": tags.get("K4A_DEVICE_SERIAL_NUMBER", ""), "depth_mode": mode}
    return Recorded(path, color_camera, depth_camera, 1e6 / rate, frames, duration_us, delay / 1000.0, told)


def _read_frames(path: Path, streams: dict[int, bool]) -> Iterator[tuple[bool, int, bytes]]:
    """(is depth, microseconds, bytes) in the order of the file, as far as it can be read; damaged blocks are left out."""
    with _open(path) as container:
        try:
            for packet in container.demux([container.streams[i] for i in streams]):
                if packet.size and packet.pts is not None and not packet.is_corrupt and packet.time_base is not None:
                    stamp = round(packet.pts * packet.time_base * 1_000_000)
                    yield streams[packet.stream.index], stamp, bytes(packet)
        except (av.FFmpegError, OSError):
            return  # the file ends within a block; what is missing is counted by the reader


def _open(path: Path) -> InputContainer:
    try:
        return av.open(str(path), format="matroska", metadata_errors="replace")
    except (av.FFmpegError, OSError) as error:
        raise CaptureError(
            "unreadable", f"{path} cannot be read as a Matroska file ({error}): copy it again"
        ) from error


def _track(container: InputContainer, name: str) -> VideoStream | None:
    """The track with the device's tag, or else the one with the name."""
    streams = container.streams.video
    tagged = [stream for stream in streams if f"K4A_{name}_TRACK" in stream.metadata]
    named = [stream for stream in streams if stream.metadata.get("title") == name]
    return next(iter(tagged + named), None)


def _check_formats(path: Path, color: VideoStream, depth: VideoStream) -> str:
    """The four-character code of colour frames; CaptureError `format` where these or those of depth are not read."""
    codecs = (stream.codec_context for stream in (color, depth))
    of_color, of_depth = (codec.codec_tag.strip("\0 ") or codec.name for codec in codecs)
    if of_color not in FORMATS:
        wanted = f"not one of {', '.join(FORMATS)}"
        raise CaptureError("format", f"{path}: colour frames are {of_color}, {wanted}: {AS_RECORDED}")
    if of_depth != DEPTH_FORMAT:
        raise CaptureError("format", f"{path}: depth frames are {of_depth}, and {DEPTH_FORMAT} is read: {AS_RECORDED}")
    return of_color


def _clock(path: Path, tags: dict[str, str], color: VideoStream, depth: VideoStream) -> tuple[str, int, float]:
    """Depth mode, by how many nanoseconds depth frames are later than colour frames, and frames a second."""
    if "K4A_DEPTH_MODE" not in tags:
        raise CaptureError("mode", f"{path} has no tag K4A_DEPTH_MODE: {AS_RECORDED}")
    rate = color.average_rate or depth.average_rate
    if not rate:
        raise CaptureError("format", f"{path} does not say how many frames it has a second: {AS_RECORDED}")
    delay = tags.get("K4A_DEPTH_DELAY_NS", "0")
    if not re.fullmatch(r"\s*[+-]?[0-9]+\s*", delay):
        raise CaptureError("format", f"{path}: the tag K4A_DEPTH_DELAY_NS is {delay!r}, no number: {AS_RECORDED}")
    return tags["K4A_DEPTH_MODE"], int(delay), float(rate)


def _calibration(path: Path, container: InputContainer) -> bytes:
    """The attachment with the device's tag, or else the one with the name."""
    files = container.streams.attachments
    tagged = [file for file in files if "K4A_CALIBRATION_FILE" in file.metadata]
    named = [file for file in files if file.metadata.get("filename") == "calibration.json"]
    for file in tagged + named:
        if file.data:
            return bytes(file.data)
    raise CaptureError(
        "calibration",
        f"{path} has no attachment calibration.json, without which depth cannot be brought into the colour camera "
        f"(tools that cut or convert files drop it): {AS_RECORDED}, {PLACES}",
    )


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


class _Camera(BaseModel):
    """A camera of the file; what it has beyond these keys is not needed."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    location: str = Field(validation_alias="Location")
    model: str = Field(validation_alias=AliasPath("Intrinsics", "ModelType"))
    parameters: Numbers = Field(validation_alias=AliasPath("Intrinsics", "ModelParameters"))
    rotation: Numbers = Field(validation_alias=AliasPath("Rt", "Rotation"), min_length=9, max_length=9)
    translation: Numbers = Field(validation_alias=AliasPath("Rt", "Translation"), min_length=3, max_length=3)
    width: int = Field(validation_alias="SensorWidth", ge=1)
    height: int = Field(validation_alias="SensorHeight", ge=1)


class _File(BaseModel):
    """The attached file."""

    cameras: list[_Camera] = Field(validation_alias=AliasPath("CalibrationInformation", "Cameras"))


def read_calibration(data: bytes, color_size: Size, depth_mode: str) -> tuple[CaptureCamera, DepthCamera]:
    """The cameras of a colour image of (width, height) and a depth mode. Raises CaptureError with what is wrong and a remedy."""
    if color_size not in COLOR_SIZES:
        known = ", ".join(f"{w} x {h}" for w, h in COLOR_SIZES)
        raise CaptureError(
            "mode", f"colour images of {color_size[0]} x {color_size[1]} are no mode of the device: {known}"
        )
    mode = DEPTH_MODES.get(depth_mode.upper())
    if mode is None:
        raise CaptureError("mode", f"the depth mode {depth_mode!r} is not known: {', '.join(DEPTH_MODES)}")
    cameras = {camera.location: camera for camera in _parse(data)}
    color = _camera(cameras, "CALIBRATION_CameraLocationPV0")
    depth = _camera(cameras, "CALIBRATION_CameraLocationD0")
    if (depth.width, depth.height) != DEPTH_SENSOR:
        raise _wrong(f"the depth sensor is {depth.width} x {depth.height}, and the device's is 1024 x 1024")
    T_color_depth = _place(color) @ invert(_place(depth))
    binned, cut, size = mode
    k_depth = _intrinsics(depth, (binned, binned), cut, size)
    return (
        CaptureCamera(_color_intrinsics(color, color_size), _lens(color), DEPTH_UNITS_PER_M),
        DepthCamera(k_depth, _lens(depth), frozen_array(T_color_depth)),
    )


def _wrong(what: str) -> CaptureError:
    return CaptureError(
        "calibration", f"the attached calibration.json: {what}; take the recording as the device made it"
    )


def _parse(data: bytes) -> list[_Camera]:
    try:
        return _File.model_validate(json.loads(data.rstrip(b"\0"))).cameras
    except ValidationError as error:
        first = error.errors()[0]
        raise _wrong(f"{'.'.join(str(part) for part in first['loc'])}: {first['msg']}") from error
    except ValueError as error:
        raise _wrong(f"it is no JSON ({error})") from error


def _camera(cameras: dict[str, _Camera], location: str) -> _Camera:
    if location not in cameras:
        raise _wrong(f"it has no camera {location}")
    camera = cameras[location]
    if camera.model != "CALIBRATION_LensDistortionModelBrownConrady":
        raise _wrong(f"{location} has the lens model {camera.model}, and only BrownConrady can be read")
    values = camera.parameters
    if len(values) < 14 or min(values[2:4]) <= 0.0:
        raise _wrong(f"{location} must have 14 parameters with positive focal lengths")
    if any(values[10:12]):
        raise _wrong(f"{location} has a centre of distortion {values[10:12]} beside its principal point")
    return camera


def _lens(camera: _Camera) -> np.ndarray:
    """[8] float64 in OpenCV's order, from k1 to k6, the centre of distortion, p2 and p1."""
    k1, k2, k3, k4, k5, k6, _, _, p2, p1 = camera.parameters[4:14]
    return frozen_array([k1, k2, p1, p2, k3, k4, k5, k6])


def _color_intrinsics(camera: _Camera, size: tuple[int, int]) -> Intrinsics:
    """Calibrations of early devices are of the 16:9 part of the sensor, later ones of the whole 4:3 sensor."""
    width, height = size
    across, down = camera.width, camera.height
    if across * 3 != down * 4 and across * 9 != down * 16:
        raise _wrong(f"the colour sensor is {across} x {down}, neither 4:3 nor 16:9")
    calibrated = width * down // across
    return _intrinsics(camera, (width, calibrated), (0, (calibrated - height) // 2), size)


def _intrinsics(camera: _Camera, sensor: tuple[int, int], cut: tuple[int, int], size: tuple[int, int]) -> Intrinsics:
    """Of the part of a sensor of `sensor` pixels that begins at `cut` and has `size`, pixel centres at +0.5."""
    cx, cy, fx, fy = camera.parameters[:4]
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
    R = np.reshape(camera.rotation, (3, 3))
    if np.abs(R @ R.T - np.eye(3)).max() > ROTATION_ERROR or np.linalg.det(R) < 0.0:
        raise _wrong(f"the rotation of {camera.location} is none")
    U, _, V = np.linalg.svd(R)
    return pose(U @ V, np.array(camera.translation))
