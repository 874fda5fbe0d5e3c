"""ROS bags of a RealSense or an Azure Kinect: the SDK's, and those of ROS drivers with depth registered to colour.

What the topics of the SDK mean is in its sources: /device_0/sensor_N/Depth_0/image/data, .../info/camera_info, .../tf/0 (a
transform that takes coordinates of the reference stream to the stream's), .../option/Depth_Units/value. Its .db3 has texts in
place of all but images: .../camera_info "width=...;ppx=...;model=...;coeffs=...", .../tf/ref_0 "rotation=(column by
column);translation=...". Drivers have a camera_info beside each topic of images.
"""

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose, frozen_array
from schemas.capture import CaptureCamera, DepthCamera, Recorded, RecordedFrame
from schemas.errors import CaptureError
from schemas.scene.view import Intrinsics
from workers.door.opening import as_refusal
from workers.door.recordings.bag_files import IMAGE, INFO, TRANSFORM, BagMessage, open_files, read_messages
from workers.door.recordings.bag_images import COLORS, DEPTHS, PACKED, BagImage, read_image
from workers.door.recordings.pictures import read_intrinsics
from workers.geometry.frames import invert, pose, rotation_from_quaternion


@dataclass(frozen=True, eq=False)
class _Info:
    """Of a CameraInfo: size (width, height), K [3, 3], D, and the model of the lens; P [3, 3] is of the rectified image."""

    size: tuple[int, int]
    K: Array
    D: Array
    model: str
    P: Array | None = None

    def is_like(self, other: "_Info") -> bool:
        """Whether it is of the same image, whatever the lens."""
        return self.size == other.size and bool(np.allclose(self.K, other.K, rtol=1e-6))

    @property
    def rectified(self) -> "_Info":
        """Of the images that image_proc and drivers call image_rect: REP 104 has their camera in P."""
        return self if self.P is None or not self.P[0, 0] > 0.0 else replace(self, K=self.P, D=np.zeros(0), P=None)


def _fields(text: str) -> dict[str, Any]:
    """Of "name=number,number;name=word": arrays, or words."""
    pairs = (part.partition("=")[::2] for part in text.split(";"))
    return {name: value if name == "model" else np.array(value.split(","), np.float64) for name, value in pairs}


def _info(content: Any) -> _Info:
    if hasattr(content, "data"):
        said = _fields(content.data)
        width, height, fx, fy, cx, cy = (said[name].item() for name in ("width", "height", "fx", "fy", "ppx", "ppy"))
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return _Info((int(width), int(height)), K, said["coeffs"], said["model"])
    K, D, P = (content.K, content.D, content.P) if hasattr(content, "K") else (content.k, content.d, content.p)
    size, P = (content.width, content.height), np.reshape(P, (3, 4))[:, :3]
    return _Info(size, np.reshape(K, (3, 3)), np.asarray(D), content.distortion_model, P)


def _transform(content: Any) -> Pose:
    """[4, 4]. Raises ValueError where a number is none or the rotation is none."""
    if hasattr(content, "data"):
        said = _fields(content.data)
        R, t = said["rotation"].reshape(3, 3).T, said["translation"]
        length = np.sqrt(np.abs(np.linalg.det(R)))
    else:
        shift, turn = content.translation, content.rotation
        q, t = np.array([turn.x, turn.y, turn.z, turn.w]), np.array([shift.x, shift.y, shift.z])
        R, length = rotation_from_quaternion(q), np.linalg.norm(q)
    if not np.isfinite([*R.ravel(), *t]).all() or not 0.99 < length < 1.01 or np.abs(R @ R.T - np.eye(3)).max() > 0.01:
        raise ValueError(f"the rotation {R.tolist()}")
    return pose(R, t)


# ---------------------------------------------------------------------------------------------- what a bag holds


@dataclass
class _Stream:
    """The images of a topic: their encoding, the frame of their coordinates, their times, and what is told of their camera.

    stamped_us: when each was taken; stored_us: when it came to the recorder.
    """

    topic: str
    encoding: str = ""
    frame: str = ""
    stored_us: list[int] = field(default_factory=list)
    stamped_us: list[int] = field(default_factory=list)
    info: _Info | None = None
    T_stream_ref: Pose | None = None
    reference: str = ""

    @property
    def is_rectified(self) -> bool:
        """Whether image_proc, or a driver that does the same, has taken the lens out."""
        return "rect" in self.topic.rpartition("/")[2]

    @property
    def is_color(self) -> bool:
        """Whether its encoding has colours."""
        return self.encoding in COLORS or self.encoding in PACKED

    @property
    def is_depth(self) -> bool:
        """Whether its encoding is one of depth, and not named as what else has it: infrared has mono16."""
        said = "depth" in self.topic.lower() and not self.is_color
        return said or (self.encoding in DEPTHS and self.encoding != "mono16")

    def is_registered_to(self, color: "_Stream") -> bool:
        """Of depth, whether it is in the image of this colour camera: by its name, or by the frame and the camera (REP 118)."""
        if "aligned_depth" in self.topic or "/depth_registered/" in self.topic:
            return self.topic.split("/")[1] == color.topic.split("/")[1]
        is_same = self.info is not None and color.info is not None and self.info.is_like(color.info)
        return is_same and bool(self.frame) and self.frame == color.frame and not self.topic.startswith(SDK)


Kind = TypeVar("Kind")

SDK = "/device_"
"""First part of the topics of the SDK, where `frame_id` says nothing."""

VIDEO = re.compile("Packet|CompressedVideo")
"""Types of messages of topics that are compressed as video: theora's, ffmpeg's, Foxglove's."""

OTHERS = ("infra", "confidence", "fisheye", "/ir/", "body_index")
"""Of topics of images that are neither colour nor depth."""


@dataclass
class _Contents:
    streams: dict[str, _Stream] = field(default_factory=dict)
    units_per_m: float = 1000.0
    infos: dict[str, _Info] = field(default_factory=dict)
    transforms: dict[str, Pose] = field(default_factory=dict)

    def take(self, message: BagMessage) -> None:
        """Learns what a message says of cameras and streams; of an image no more than its times, once its stream is known."""
        topic = message.topic
        if message.kind == IMAGE:
            if not any(word in topic.lower() for word in OTHERS):
                image = read_image(message)
                stream = self.streams.setdefault(topic, _Stream(topic, image.encoding, image.frame))
                stream.stored_us.append(message.stamp_us)
                stream.stamped_us.append(image.stamp_us)
        elif message.kind == INFO:
            self.infos[topic.removesuffix("/camera_info").removesuffix("/info")] = _info(message.content())
        elif message.kind == TRANSFORM:
            self.transforms[topic] = _transform(message.content())
        else:
            metres = float(message.content().data)
            if 1e-6 <= metres <= 0.01:
                self.units_per_m = round(1.0 / metres, 3)

    def describe(self) -> None:
        """Gives each stream what is told of its camera."""
        for topic, stream in self.streams.items():
            base = topic.removesuffix("/image/data") if topic.startswith(SDK) else topic.rpartition("/")[0]
            info = self.infos.get(base)
            stream.info = info.rectified if info and stream.is_rectified else info
            place = next((name for name in self.transforms if name.startswith(f"{base}/tf/")), None)
            if place:
                stream.T_stream_ref, stream.reference = self.transforms[place], place.rpartition("/")[2]


def open_bag(path: Path) -> Recorded:
    """The recording of a bag. Raises CaptureError that says what it holds and what is missing."""
    contents = _Contents()
    for message in read_messages(path):
        _or_none(contents.take, message.topic, message)
    contents.describe()
    color, depth, others = _pair(path, contents)
    color_camera, depth_camera = _cameras(path, color, depth, contents.units_per_m)
    is_stamped = _are_stamped(color, depth)
    stamps = sorted(color.stamped_us if is_stamped else color.stored_us)
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 33_333.0

    def frames() -> Iterator[RecordedFrame]:
        for message in read_messages(path):
            if message.topic in (color.topic, depth.topic):
                stream = depth if message.topic == depth.topic else color
                image = _or_none(read_image, message.topic, message)
                stamp_us = image.stamp_us if is_stamped and image else message.stamp_us
                yield RecordedFrame(stream is depth, stamp_us, partial(_load, image, stream, contents.units_per_m))

    clock = max(period, 1.0), frames, float(stamps[-1])
    notes = (f"{color.topic} is taken with {depth.topic}, and {', '.join(others)} left out",) if others else ()
    told, missing = {"topic": color.topic}, f"it has no camera_info for {color.topic}"
    return Recorded(path, color_camera, depth_camera, *clock, told=told, missing=missing, notes=notes)


def _are_stamped(color: _Stream, depth: _Stream) -> bool:
    """Whether both streams say when their images were taken, by one clock: depth is then near most of colour.

    A recorder stores what comes when it comes: registered depth some tens of milliseconds after its colour image.
    """
    c, d = (np.array(sorted(stream.stamped_us), np.int64) for stream in (color, depth))
    if len(np.unique(c)) < max(2, 0.9 * len(c)):
        return False
    at = np.searchsorted(d, c).clip(1, len(d) - 1) if len(d) > 1 else np.zeros(len(c), int)
    gaps = np.minimum(np.abs(d[at] - c), np.abs(d[at - 1] - c))
    return bool(np.median(gaps) < 0.5 * np.median(np.diff(c)))


def _pair(path: Path, contents: _Contents) -> tuple[_Stream, _Stream, list[str]]:
    """The streams of colour and depth that belong together, and the topics of other cameras' colour.

    Raises CaptureError where there is none, its encoding is none that can be used, or nothing is told of its camera.
    """
    depths = [stream for stream in contents.streams.values() if stream.is_depth]
    colors = [stream for stream in contents.streams.values() if stream.is_color]
    colors = colors or [stream for stream in contents.streams.values() if not stream.is_depth]
    for name, streams in (("colour", colors), ("depth", depths)):
        if not streams:
            with open_files(path) as readers:
                kinds = sorted((each.topic, each.msgtype) for _, reader in readers for each in reader.connections)
            video = next((f"{topic} is video ({kind})" for topic, kind in kinds if VIDEO.search(kind)), "")
            images = ", ".join(topic for topic, kind in kinds if "Image" in kind) or "no topic of images"
            more = f"{video}: convert it to raw (image_transport republish)" if video else f"it has {images}"
            raise CaptureError(name, f"{path} has no images of {name}; {more}")

    def rank(pair: tuple[_Stream, _Stream]) -> tuple[bool, bool, int]:
        color, depth = pair
        is_other = "depth" in color.topic or color.is_rectified != depth.is_rectified
        shared = [a == b for a, b in zip(color.topic.split("/"), depth.topic.split("/"), strict=False)]
        return not depth.is_registered_to(color), is_other, -[*shared, False].index(False)

    color, depth = min(((color, depth) for color in colors for depth in depths), key=rank)
    is_registered = depth.is_registered_to(color)
    for name, stream in (("colour", color), ("depth", depth)):
        usable = (*COLORS, *PACKED) if name == "colour" else tuple(DEPTHS)
        if stream.encoding not in usable:
            wanted = f"not one of {', '.join(usable)}: record it as one of those, raw or compressed without loss"
            raise CaptureError("format", f"{path}: {name} is {stream.encoding!r:.60}, {wanted}")
        if stream.info is None and not is_registered:
            raise CaptureError("calibration", f"{path} has no camera_info for {stream.topic}: record it as well")
    return color, depth, sorted({stream.topic for stream in colors if stream.frame != color.frame} - {color.topic})


def _cameras(
    path: Path, color: _Stream, depth: _Stream, units_per_m: float
) -> tuple[CaptureCamera | None, DepthCamera | None]:
    if color.info is None:
        return None, None
    units_per_m = units_per_m if units_per_m <= 10_000 else 1000.0
    camera = CaptureCamera(_intrinsics(path, color.info), _lens(path, color.info), units_per_m)
    T_color_depth = np.eye(4)
    if depth.is_registered_to(color):
        if depth.info is None or (depth.info.is_like(color.info) and depth.is_rectified == color.is_rectified):
            return camera, None
    elif color.T_stream_ref is None or depth.T_stream_ref is None or color.reference != depth.reference:
        raise CaptureError(
            "calibration",
            f"{path} does not say where the depth camera is beside the colour camera: record depth registered to colour, "
            "the topic aligned_depth_to_color of a RealSense or depth_to_rgb of an Azure Kinect, or with the RealSense Viewer",
        )
    else:
        T_color_depth = color.T_stream_ref @ invert(depth.T_stream_ref)
    assert depth.info is not None  # _pair refuses it
    return camera, DepthCamera(_intrinsics(path, depth.info), _lens(path, depth.info), frozen_array(T_color_depth))


def _intrinsics(path: Path, info: _Info) -> Intrinsics:
    return read_intrinsics(f"{path}: a camera_info", info.size, info.K[[0, 1, 0, 1], [0, 1, 2, 2]], 0.0)


FORWARD = ("plumb_bob", "rational_polynomial", "brown conrady", "none", "")
"""Models whose numbers are OpenCV's; the SDK's modified and inverse one, which a D455's colour has, differ by 0.03 pixels there:
its rs2_project_point_to_pixel uses both forwards."""


def _lens(path: Path, info: _Info) -> Array:
    """[8]; raises CaptureError for a lens of another kind whose numbers are not all 0."""
    model = info.model.lower().removeprefix("modified ").removeprefix("inverse ")
    if not np.isfinite(info.D).all() or (np.any(info.D) and (model not in FORWARD or len(info.D) > 8)):
        message = f"the lens {info.model!r:.60} with {info.D[:16].tolist()} is not read: export frames"
        raise CaptureError("calibration", f"{path}: {message}")
    return frozen_array(np.append(info.D[:8], np.zeros(8))[:8])


def _load(image: BagImage | None, stream: _Stream, units_per_m: float, small: bool) -> NDArray | None:
    """As `RecordedFrame.load`."""
    if (
        image is None
        or image.encoding != stream.encoding
        or (stream.info is not None and image.size != stream.info.size)
    ):
        return None
    pixels = _or_none(image.load, stream.topic, small)
    if pixels is None or stream.is_color:
        return pixels
    scale = units_per_m if image.encoding != "32FC1" else 1.0
    depth = np.nan_to_num(pixels.astype(np.float64) / scale, nan=0.0, posinf=0.0, neginf=0.0)
    return depth if not small else np.zeros(0)


def _or_none(read: Callable[..., Kind], topic: str, *given: Any) -> Kind | None:
    """What is read of a message; None where it is damaged."""
    with suppress(CaptureError), as_refusal(topic, CaptureError):
        return read(*given)
    return None
