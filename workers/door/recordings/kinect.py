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
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from schemas.base import Pose, frozen_array
from schemas.capture import CaptureCamera, DepthCamera, Recorded, RecordedFrame
from schemas.errors import CaptureError
from schemas.scene.view import Intrinsics
from workers.geometry.frames import invert, pose

FORMATS = ("MJPG", "NV12", "YUY2", "BGRA")
"""Of colour frames, by their four-character code."""

DEPTH_FORMAT = "b16g"


def is_whole(data: bytes, fourcc: str, size: tuple[int, int]) -> bool:
    """Whether a frame has all its bytes; `size` is (width, height)."""
    if fourcc == "MJPG":
        return data[:2] == b"\xff\xd8" and data.rstrip(b"\0")[-2:] == b"\xff\xd9"
    pixels = size[0] * size[1]
    return (
        len(data) == {"NV12": pixels * 3 // 2, "YUY2": pixels * 2, "BGRA": pixels * 4, DEPTH_FORMAT: pixels * 2}[fourcc]
    )


def decode_depth(data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    """[h, w] uint16 of 16-bit big-endian pixels."""
    return np.frombuffer(data, ">u2").reshape(size[1], size[0]).astype(np.uint16)


def decode_color(data: bytes, fourcc: str, size: tuple[int, int]) -> NDArray[np.uint8] | None:
    """[H, W, 3] uint8 sRGB, or None for bytes that cannot be read or have another size."""
    if fourcc == "MJPG":
        rgb = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    elif fourcc == "NV12":
        rgb = cv2.cvtColor(_pixels(data, (size[1] * 3 // 2, size[0])), cv2.COLOR_YUV2RGB_NV12)
    elif fourcc == "YUY2":
        rgb = cv2.cvtColor(_pixels(data, (size[1], size[0], 2)), cv2.COLOR_YUV2RGB_YUY2)
    else:
        rgb = cv2.cvtColor(_pixels(data, (size[1], size[0], 4)), cv2.COLOR_BGRA2RGB)
    return None if rgb is None or rgb.shape != (size[1], size[0], 3) else np.asarray(rgb, np.uint8)


def decode_gray(data: bytes, fourcc: str, size: tuple[int, int]) -> NDArray[np.uint8] | None:
    """[H / 2, W / 2] uint8, fast: what sharpness and movement are measured on. None for bytes that cannot be read."""
    if fourcc == "MJPG":
        gray = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_2)
        return None if gray is None else np.asarray(gray, np.uint8)
    if fourcc == "NV12":
        whole = _pixels(data, (size[1] * 3 // 2, size[0]))[: size[1]]
    elif fourcc == "YUY2":
        whole = np.ascontiguousarray(_pixels(data, (size[1], size[0], 2))[:, :, 0])
    else:
        whole = np.asarray(cv2.cvtColor(_pixels(data, (size[1], size[0], 4)), cv2.COLOR_BGRA2GRAY), np.uint8)
    return np.asarray(cv2.resize(whole, (size[0] // 2, size[1] // 2), interpolation=cv2.INTER_AREA), np.uint8)


def _pixels(data: bytes, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8).reshape(shape)


AS_RECORDED = "take the file as k4arecorder or the SDK wrote it"
PLACES = "or export its frames as rgb_00000.png and depth_00000.png (registered to colour) with a camera.json"


@dataclass(frozen=True)
class Recording:
    """What a recording says about itself. Sizes are (width, height), times microseconds."""

    path: Path
    color_format: str
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_mode: str
    calibration: bytes
    period_us: float
    depth_delay_us: float
    """By how much depth frames are later than colour frames."""
    serial_number: str
    duration_us: float | None
    """The last time stamp; None where the recorder was interrupted before it closed the file."""
    color_stream: int
    depth_stream: int


@dataclass(frozen=True)
class TrackFrame:
    """One frame as stored."""

    is_depth: bool
    stamp_us: int
    data: bytes


def open_recording(path: Path) -> Recording:
    """Reads the head of a recording. Raises CaptureError that names what is missing and what to do."""
    with _open(path) as container:
        color = _track(container, "COLOR")
        depth = _track(container, "DEPTH")
        if color is None:
            raise CaptureError(
                "color", f"{path} has no colour track: record with the colour camera on (k4arecorder -c 1080p)"
            )
        if depth is None:
            raise CaptureError(
                "depth", f"{path} has no depth track: record with a depth mode other than OFF and PASSIVE_IR"
            )
        return _describe(path, container, color, depth)


def read_frames(recording: Recording) -> Iterator[TrackFrame]:
    """The frames of both tracks in the order of the file, as far as it can be read; damaged blocks are left out."""
    streams = {recording.color_stream: False, recording.depth_stream: True}
    with _open(recording.path) as container:
        try:
            for packet in container.demux([container.streams[i] for i in streams]):
                if packet.size and packet.pts is not None and not packet.is_corrupt and packet.time_base is not None:
                    stamp = round(packet.pts * packet.time_base * 1_000_000)
                    yield TrackFrame(streams[packet.stream.index], stamp, bytes(packet))
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


def _describe(path: Path, container: InputContainer, color: VideoStream, depth: VideoStream) -> Recording:
    tags = {**container.metadata, **color.metadata, **depth.metadata}
    codecs = (stream.codec_context for stream in (color, depth))
    color_format, depth_format = (codec.codec_tag.strip("\0 ") or codec.name for codec in codecs)
    if color_format not in FORMATS:
        raise CaptureError(
            "format", f"{path}: colour frames are {color_format}, not one of {', '.join(FORMATS)}: {AS_RECORDED}"
        )
    if depth_format != DEPTH_FORMAT:
        raise CaptureError(
            "format", f"{path}: depth frames are {depth_format}, and {DEPTH_FORMAT} is read: {AS_RECORDED}"
        )
    if "K4A_DEPTH_MODE" not in tags:
        raise CaptureError("mode", f"{path} has no tag K4A_DEPTH_MODE: {AS_RECORDED}")
    rate = color.average_rate or depth.average_rate
    if not rate:
        raise CaptureError("format", f"{path} does not say how many frames it has a second: {AS_RECORDED}")
    delay = tags.get("K4A_DEPTH_DELAY_NS", "0")
    if not re.fullmatch(r"\s*[+-]?[0-9]+\s*", delay):
        raise CaptureError("format", f"{path}: the tag K4A_DEPTH_DELAY_NS is {delay!r}, no number: {AS_RECORDED}")
    return Recording(
        path,
        color_format,
        (color.width, color.height),
        (depth.width, depth.height),
        tags["K4A_DEPTH_MODE"],
        _calibration(path, container),
        1e6 / float(rate),
        int(delay) / 1000.0,
        tags.get("K4A_DEVICE_SERIAL_NUMBER", ""),
        None if container.duration is None else float(container.duration),
        color.index,
        depth.index,
    )


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


def is_kinect(path: Path) -> bool:
    """Whether a file is Matroska, by its first bytes or its name."""
    if not path.is_file() or path.suffix.lower() == ".mkv":
        return path.is_file()
    with open(path, "rb") as stream:
        return stream.read(4) == b"\x1a\x45\xdf\xa3"


def open_kinect(path: Path) -> Recorded:
    """A recording with its calibration. Raises CaptureError that names the file."""
    recording = open_recording(path)
    try:
        device = read_calibration(recording.calibration, recording.color_size, recording.depth_mode)
    except CaptureError as error:
        raise CaptureError(error.reason, f"{path}: {error.detail}") from error
    size = (device.depth.intrinsics.width, device.depth.intrinsics.height)
    if recording.depth_size != size:
        raise CaptureError(
            "mode", f"{path}: depth is {recording.depth_size}, and the mode {recording.depth_mode} has {size}"
        )

    def frames() -> Iterator[RecordedFrame]:
        for frame in read_frames(recording):
            yield RecordedFrame(frame.is_depth, frame.stamp_us, functools.partial(_load, recording, frame))

    told = {"serial_number": recording.serial_number, "depth_mode": recording.depth_mode}
    clock = (recording.period_us, frames, recording.duration_us, recording.depth_delay_us)
    return Recorded(path, device.color, device.depth, *clock, told)


def _load(recording: Recording, frame: TrackFrame, small: bool) -> NDArray | None:
    """As `RecordedFrame.load`."""
    if frame.is_depth:
        whole = is_whole(frame.data, DEPTH_FORMAT, recording.depth_size)
        return decode_depth(frame.data, recording.depth_size) / DEPTH_UNITS_PER_M if whole else None
    decode = decode_gray if small else decode_color
    whole = is_whole(frame.data, recording.color_format, recording.color_size)
    return decode(frame.data, recording.color_format, recording.color_size) if whole else None


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
