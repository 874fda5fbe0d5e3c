"""ROS bags (format 2.0) of a RealSense: what its SDK records, and what its ROS driver publishes with registered depth.

Written by the description of the format (wiki.ros.org/Bags/Format/2.0), of the messages sensor_msgs/Image, CameraInfo,
geometry_msgs/Transform and std_msgs/Float32 (little-endian, strings and lists after their length), and by the SDK's
sources: topics /device_0/sensor_N/Depth_0/image/data, .../info/camera_info, .../tf/0 (a transform that takes coordinates of
the reference stream to the stream's), .../option/Depth Units/value.
"""

import bz2
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.capture import CaptureCamera, DepthCamera, Recorded, RecordedFrame
from schemas.errors import CaptureError
from schemas.scene.view import Intrinsics
from workers.geometry.frames import invert, pose, rotation_from_quaternion

HEAD = b"#ROSBAG V2.0\n"
MOST_BYTES = 512_000_000
"""Of one record, packed or not."""

MESSAGE, CHUNK, CONNECTION = 2, 5, 7
"""Kinds of records, `op` of their head."""


def is_bag(path: Path) -> bool:
    """Whether a file is a ROS bag, by its first bytes."""
    if not path.is_file():
        return False
    with open(path, "rb") as stream:
        return stream.read(len(HEAD)) == HEAD


class _Cut(ValueError):
    """Bytes that end before they should."""


@dataclass
class _Bytes:
    """Takes values from bytes, one after the other. Raises _Cut at the end."""

    data: bytes
    at: int = 0

    def take(self, size: int) -> bytes:
        if size < 0 or self.at + size > len(self.data):
            raise _Cut(f"{size} bytes at {self.at} of {len(self.data)}")
        self.at += size
        return self.data[self.at - size : self.at]

    def values(self, layout: str) -> tuple:
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def text(self) -> str:
        return self.block().decode("utf-8", "replace")

    def block(self) -> bytes:
        return self.take(self.values("I")[0])


def _head(data: bytes) -> dict[str, bytes]:
    """Fields `name=value` of a record's head."""
    found, source = {}, _Bytes(data)
    while source.at < len(data):
        name, _, value = source.block().partition(b"=")
        found[name.decode("ascii", "replace")] = value
    return found


def _records(read: Callable[[int], bytes]) -> Iterator[tuple[dict[str, bytes], bytes]]:
    """(head, data) of records as far as they are whole."""
    while len(size := read(4)) == 4:
        parts = []
        for part in range(2):
            if part:
                size = read(4)
            count = int.from_bytes(size, "little")
            if len(size) < 4 or count > MOST_BYTES or len(data := read(count)) < count:
                return
            parts.append(data)
        try:
            yield _head(parts[0]), parts[1]
        except _Cut:
            return


def _unpacked(head: dict[str, bytes], data: bytes) -> bytes:
    """A chunk's records. Raises _Cut for one that is altered."""
    how, size = head.get("compression", b"none"), int.from_bytes(head.get("size", b""), "little")
    if size > MOST_BYTES:
        raise _Cut(f"a chunk of {size} bytes")
    try:
        if how == b"lz4":
            return bytes(pa.decompress(data, decompressed_size=size, codec="lz4", asbytes=True))
        if how == b"bz2":
            return bz2.BZ2Decompressor().decompress(data, max_length=size)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise _Cut(str(error)) from error
    return data


@dataclass(frozen=True)
class _Message:
    topic: str
    kind: str
    stamp_us: int
    data: bytes


def _messages(path: Path) -> Iterator[_Message]:
    """The messages of a bag as far as it can be read; damaged chunks are left out."""
    topics: dict[bytes, tuple[str, str]] = {}
    with open(path, "rb") as stream:
        stream.read(len(HEAD))
        for head, data in _records(stream.read):
            try:
                inner = [(head, data)]
                if head.get("op") == bytes([CHUNK]):
                    chunk = _Bytes(_unpacked(head, data))
                    inner = list(_records(lambda count, c=chunk: c.take(min(count, len(c.data) - c.at))))  # type: ignore[misc]
                yield from _of_records(inner, topics)
            except (_Cut, struct.error):
                continue


def _of_records(
    records: list[tuple[dict[str, bytes], bytes]], topics: dict[bytes, tuple[str, str]]
) -> Iterator[_Message]:
    for head, data in records:
        number = head.get("conn", b"")
        if head.get("op") == bytes([CONNECTION]):
            kind = _head(data).get("type", b"").decode("ascii", "replace")
            topics[number] = head.get("topic", b"").decode("utf-8", "replace"), kind
        elif head.get("op") == bytes([MESSAGE]) and number in topics:
            seconds, nanoseconds = struct.unpack("<II", head.get("time", b"")[:8].ljust(8, b"\0"))
            yield _Message(*topics[number], seconds * 1_000_000 + nanoseconds // 1000, data)


# ---------------------------------------------------------------------------------------------- messages


def _skip_header(source: _Bytes) -> int:
    """Of std_msgs/Header: its time, microseconds."""
    _, seconds, nanoseconds = source.values("III")
    source.block()
    return int(seconds) * 1_000_000 + int(nanoseconds) // 1000


COLORS = {"rgb8": None, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB}
PACKED = {"yuyv": cv2.COLOR_YUV2RGB_YUY2, "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2, "uyvy": cv2.COLOR_YUV2RGB_UYVY}
"""OpenCV's conversions of encodings of colour, of 3 or 4 bytes a pixel and of 2."""

DEPTHS = {"mono16": "u2", "16UC1": "u2", "32FC1": "f4"}


def _image(data: bytes) -> tuple[str, NDArray]:
    """(encoding, pixels [H, W] or [H, W, C]) of sensor_msgs/Image. Raises _Cut."""
    source = _Bytes(data)
    _skip_header(source)
    height, width = source.values("II")
    encoding = source.text()
    big, step = source.values("BI")
    rows = np.frombuffer(source.block(), np.uint8)
    if height * step != len(rows) or not 0 < height <= 20_000 or not 0 < width <= 20_000:
        raise _Cut(f"an image of {width} x {height} in {len(rows)} bytes")
    rows = rows.reshape(height, step)
    bytes_of = {**dict.fromkeys(COLORS, 3), "rgba8": 4, "bgra8": 4, **dict.fromkeys(PACKED, 2)}
    if encoding in DEPTHS:
        kind = np.dtype((">" if big else "<") + DEPTHS[encoding])
        return encoding, rows[:, : width * kind.itemsize].copy().view(kind).reshape(height, width)
    channels = bytes_of.get(encoding, 1)
    if width * channels > step:
        raise _Cut(f"rows of {step} bytes for {width} pixels of {encoding}")
    return encoding, rows[:, : width * channels].reshape(height, width, channels)


@dataclass(frozen=True, eq=False)
class _Info:
    """sensor_msgs/CameraInfo: size (width, height), K [3, 3], D, and its model."""

    size: tuple[int, int]
    K: Array
    D: Array
    model: str


def _info(data: bytes) -> _Info:
    source = _Bytes(data)
    _skip_header(source)
    height, width = source.values("II")
    model = source.text()
    (count,) = source.values("I")
    D = np.array(source.values(f"{min(count, 64)}d"))
    return _Info((int(width), int(height)), np.array(source.values("9d")).reshape(3, 3), D, model)


# ---------------------------------------------------------------------------------------------- what a bag holds


@dataclass
class _Stream:
    """One of the two streams: the topic of its images and what is told of its camera."""

    topic: str = ""
    info: _Info | None = None
    encoding: str = ""
    T_stream_ref: Pose | None = None
    reference: str = ""


@dataclass
class _Contents:
    color: _Stream = field(default_factory=_Stream)
    depth: _Stream = field(default_factory=_Stream)
    units_per_m: float = 1000.0
    seen: set[tuple[str, str]] = field(default_factory=set)
    stamps_us: dict[str, list[int]] = field(default_factory=dict)


def open_bag(path: Path) -> Recorded:
    """The recording of a bag. Raises CaptureError that says what it holds and what is missing."""
    found = _Contents()
    infos: dict[str, _Info] = {}
    transforms: dict[str, Pose] = {}
    for message in _messages(path):
        found.seen.add((message.topic, message.kind))
        try:
            _look_at(message, found, infos, transforms)
        except (_Cut, struct.error):
            continue
    for stream in (found.color, found.depth):
        stream.info = infos.get(_base(stream.topic))
        place = next((t for t in transforms if t.startswith(f"{_base(stream.topic)}/tf/")), None)
        if place:
            stream.T_stream_ref, stream.reference = transforms[place], place.rpartition("/")[2]
    _check(path, found)
    color, depth = _cameras(path, found)
    stamps = sorted(found.stamps_us[found.color.topic])
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 33_333.0

    def frames() -> Iterator[RecordedFrame]:
        for message in _messages(path):
            if message.topic in (found.color.topic, found.depth.topic):
                yield _frame(message, found)

    return Recorded(path, color, depth, max(period, 1.0), frames, float(stamps[-1]), told={"topic": found.color.topic})


def _base(topic: str) -> str:
    """The topic of a stream without what it says of the image: /device_0/sensor_1/Color_0, /camera/color."""
    return topic.removesuffix("/image/data").rpartition("/image_")[0] or topic.removesuffix("/image/data")


def _look_at(message: _Message, found: _Contents, infos: dict[str, _Info], transforms: dict[str, Pose]) -> None:
    topic, kind = message.topic, message.kind
    if kind == "sensor_msgs/Image":
        stream = found.depth if "depth" in topic.lower() else found.color
        aligned = "aligned_depth" in topic or "/depth_registered/" in topic
        if (not stream.topic or (aligned and "aligned_depth" not in stream.topic)) and "infra" not in topic.lower():
            stream.topic, stream.encoding = topic, _image(message.data)[0]
        found.stamps_us.setdefault(topic, []).append(message.stamp_us)
    elif kind == "sensor_msgs/CameraInfo":
        infos[topic.removesuffix("/camera_info").removesuffix("/info")] = _info(message.data)
    elif kind == "geometry_msgs/Transform" and "/tf/" in topic:
        x, y, z, qx, qy, qz, qw = _Bytes(message.data).values("7d")
        q = np.array([qx, qy, qz, qw])
        if not np.isfinite([x, y, z, *q]).all() or not 0.99 < np.linalg.norm(q) < 1.01:
            raise _Cut("a transform that is none")
        transforms[topic] = pose(rotation_from_quaternion(q), np.array([x, y, z]))
    elif topic.replace("_", " ").endswith("/option/Depth Units/value") and kind == "std_msgs/Float32":
        (metres,) = _Bytes(message.data).values("f")
        if 1e-6 <= metres <= 0.01:
            found.units_per_m = round(1.0 / metres, 3)


def _check(path: Path, found: _Contents) -> None:
    kinds = {kind for _, kind in found.seen}
    for name, stream in (("colour", found.color), ("depth", found.depth)):
        if not stream.topic:
            packed = "sensor_msgs/CompressedImage" in kinds
            why = "its images are compressed: convert them (rosrun image_transport republish compressed raw)"
            topics = ", ".join(sorted(topic for topic, kind in found.seen if "Image" in kind)) or "no topic of images"
            raise CaptureError(name, f"{path} has no images of {name}; {why if packed else f'it has {topics}'}")
        usable = (*COLORS, *PACKED) if name == "colour" else tuple(DEPTHS)
        if stream.encoding not in usable:
            raise CaptureError(
                "format",
                f"{path}: {name} is {stream.encoding!r}, not one of {', '.join(usable)}: record it as one of those",
            )
        if stream.info is None:
            raise CaptureError("calibration", f"{path} has no camera_info for {stream.topic}: record it as well")


def _cameras(path: Path, found: _Contents) -> tuple[CaptureCamera, DepthCamera | None]:
    color, depth = found.color, found.depth
    assert color.info is not None and depth.info is not None
    camera = CaptureCamera(
        _intrinsics(path, color.info),
        _lens(path, color.info),
        found.units_per_m if found.units_per_m <= 10_000 else 1000.0,
    )
    if "aligned_depth" in depth.topic or "/depth_registered/" in depth.topic:
        return camera, None
    if color.T_stream_ref is None or depth.T_stream_ref is None or color.reference != depth.reference:
        raise CaptureError(
            "calibration",
            f"{path} does not say where the depth camera is beside the colour camera: record the topic "
            "aligned_depth_to_color, or with the RealSense Viewer",
        )
    T_color_depth = color.T_stream_ref @ invert(depth.T_stream_ref)
    return camera, DepthCamera(_intrinsics(path, depth.info), _lens(path, depth.info), frozen_array(T_color_depth))


def _intrinsics(path: Path, info: _Info) -> Intrinsics:
    K = info.K
    if not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0 or np.abs(K).max() > 1e6 or min(info.size) < 1:
        raise CaptureError("calibration", f"{path}: a camera_info has no usable intrinsics: {K.ravel().tolist()}")
    size = {"width": info.size[0], "height": info.size[1]}
    return Intrinsics(**size, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2] + 0.5, cy=K[1, 2] + 0.5)


FORWARD = ("plumb_bob", "rational_polynomial", "brown conrady", "modified brown conrady", "none", "")


def _lens(path: Path, info: _Info) -> Array:
    """[8]; raises CaptureError for a lens of another kind whose numbers are not all 0."""
    if not np.isfinite(info.D).all() or (np.any(info.D) and (info.model.lower() not in FORWARD or len(info.D) > 8)):
        raise CaptureError(
            "calibration", f"{path}: the lens {info.model!r} with {info.D.tolist()} is not read: export frames"
        )
    lens = np.zeros(8)
    lens[: min(len(info.D), 8)] = info.D[:8]
    return frozen_array(lens)


def _frame(message: _Message, found: _Contents) -> RecordedFrame:
    is_depth = message.topic == found.depth.topic
    stream = found.depth if is_depth else found.color

    def load(small: bool) -> NDArray | None:
        try:
            encoding, pixels = _image(message.data)
        except (_Cut, struct.error):
            return None
        if encoding != stream.encoding or stream.info is None or pixels.shape[1::-1] != stream.info.size:
            return None
        if is_depth:
            scale = found.units_per_m if encoding != "32FC1" else 1.0
            depth = np.nan_to_num(pixels.astype(np.float64) / scale, nan=0.0, posinf=0.0, neginf=0.0)
            return depth if not small else np.zeros(0)
        how = {**COLORS, **PACKED}[encoding]
        rgb = (
            np.ascontiguousarray(pixels) if how is None else np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), how))
        )
        if not small:
            return rgb
        gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        return np.asarray(
            cv2.resize(gray, (rgb.shape[1] // 2, rgb.shape[0] // 2), interpolation=cv2.INTER_AREA), np.uint8
        )

    return RecordedFrame(is_depth, message.stamp_us, load)
