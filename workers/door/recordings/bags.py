"""ROS bags of a RealSense, by the library rosbags: its SDK's, and those of its ROS drivers with depth registered to colour.

Of ROS 1 a .bag, of ROS 2 a .db3, a .mcap, or the folder that holds them. Few kinds of messages are read, by their published
definitions; those in a bag are a stranger's, and would be compiled. What the topics mean is in the SDK's sources:
/device_0/sensor_N/Depth_0/image/data, .../info/camera_info, .../tf/0 (a transform that takes coordinates of the reference
stream to the stream's), .../option/Depth_Units/value. The SDK's .db3 has texts in place of all but images: .../camera_info
"width=...;ppx=...;model=...;coeffs=...", .../tf/ref_0 "rotation=(column by column);translation=..."; and each message may be
compressed by itself.
"""

import bz2
import heapq
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import lz4.frame
import numpy as np
from backports import zstd
from numpy.typing import NDArray
from rosbags.rosbag1 import reader as bag
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_typestore

from schemas.base import Array, Pose, frozen_array
from schemas.capture import CaptureCamera, DepthCamera, Recorded, RecordedFrame
from schemas.errors import CaptureError
from schemas.scene.view import Intrinsics
from workers.door.opening import as_refusal, open_file
from workers.door.recordings.pictures import read_intrinsics
from workers.geometry.frames import invert, pose, rotation_from_quaternion

MOST_BYTES = 512_000_000
"""Of one chunk, unpacked."""

LONGEST_SIDE = 20_000
"""Of an image, pixels."""

IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
TRANSFORM, FLOAT, TEXT = "geometry_msgs/msg/Transform", "std_msgs/msg/Float32", "std_msgs/msg/String"

ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a message of ROS 2 that is compressed."""


@dataclass(frozen=True)
class _Kind:
    """A format of bags: what opens a file, the method and the definitions that decode messages, what mends one that was cut."""

    open: Callable[[Path], Any]
    method: str
    store: Stores
    remedy: str

    def decode(self, data: bytes, kind: str) -> Any:
        """The message with its fields."""
        if data.startswith(ZSTD):
            data = _unpack(zstd.ZstdDecompressor, data)
        return getattr(_definitions(self.store), self.method)(data, kind)


_definitions = cache(get_typestore)

KINDS = {
    b"#ROSBAG V2.0\n": _Kind(
        bag.Reader, "deserialize_ros1", Stores.ROS1_NOETIC, "`rosbag reindex FILE` mends a bag that was cut"
    ),
    b"SQLite format 3\0": _Kind(  # the library puts the path into a URI
        lambda path: Sqlite3Reader(Path(quote(str(path)))),
        *("deserialize_cdr", Stores.ROS2_HUMBLE, "`ros2 bag reindex FOLDER` mends a bag that was cut"),
    ),
    b"\x89MCAP0\r\n": _Kind(
        mcap.McapReader, "deserialize_cdr", Stores.ROS2_HUMBLE, "`mcap recover FILE` mends a bag that was cut"
    ),
}
"""Formats of bags by their first bytes."""


def _unpack(open_decompressor: Callable[[], Any], data: bytes, *_: int) -> bytes:
    """What a chunk holds, up to `MOST_BYTES`."""
    decompressor = open_decompressor()
    unpacked: bytes = decompressor.decompress(data, MOST_BYTES)
    if not decompressor.eof:
        raise ValueError(f"a chunk is cut, or unpacks to more than {MOST_BYTES // 1_000_000} MB")
    return unpacked


# The library unpacks whatever a few bytes stand for.
bag.decompressors |= {
    "bz2": partial(_unpack, bz2.BZ2Decompressor),
    "lz4": partial(_unpack, lz4.frame.LZ4FrameDecompressor),
}
mcap.DECOMPRESSORS |= {
    "lz4": partial(_unpack, lz4.frame.LZ4FrameDecompressor),
    "zstd": partial(_unpack, zstd.ZstdDecompressor),
}


def _kind_of(path: Path) -> _Kind | None:
    with open_file(path, CaptureError) as stream:
        head = stream.read(16)
    return next((kind for start, kind in KINDS.items() if head.startswith(start)), None)


def _files(path: Path) -> list[Path]:
    """The files of a bag: itself, or those in its folder by name."""
    if not path.is_dir():
        return [path]
    if packed := next((file for file in path.iterdir() if file.name.endswith((".db3.zstd", ".mcap.zstd"))), None):
        raise CaptureError("format", f"{packed} is compressed: unpack it (zstd -d FILE), and import what comes out")
    return sorted(file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS bag, by the first bytes of a file, or of a folder by the file that describes it."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else _kind_of(path) is not None


@dataclass(frozen=True)
class _Message:
    """A message as stored; `content` decodes it."""

    topic: str
    kind: str
    stamp_us: int
    content: Callable[[], Any]


@contextmanager
def _opened(path: Path) -> Iterator[list[tuple[_Kind, Any]]]:
    """The files of a bag, open. Raises CaptureError, with the command that mends it, whatever the library raises meanwhile."""
    with ExitStack() as stack:
        readers = []
        for file in _files(path):
            if (kind := _kind_of(file)) is None:
                raise CaptureError("unreadable", f"{file} is no bag: copy it again")
            stack.enter_context(as_refusal(file, CaptureError, kind.remedy))
            reader = kind.open(file)
            reader.open()
            stack.callback(reader.close)
            readers.append((kind, reader))
        yield readers


def _messages(path: Path) -> Iterator[_Message]:
    """The messages of the kinds that are read, in the order of time."""
    with _opened(path) as readers:
        yield from heapq.merge(*(_of_file(*pair) for pair in readers), key=lambda message: message.stamp_us)


def _part(topic: str, kind: str) -> str:
    """What a topic of a type is about: the type of its message in ROS 1; "" for what is not needed."""
    if kind in (TEXT, INFO) and topic.endswith("/camera_info"):
        return INFO
    if kind in (TEXT, TRANSFORM) and "/tf/" in topic:
        return TRANSFORM
    if kind in (TEXT, FLOAT) and topic.replace("_", " ").endswith("/option/Depth Units/value"):
        return FLOAT
    return IMAGE if kind == IMAGE else ""


def _of_file(kind: _Kind, reader: Any) -> Iterator[_Message]:
    wanted = [connection for connection in reader.connections if _part(connection.topic, connection.msgtype)]
    for connection, stamp_ns, data in reader.messages(wanted) if wanted else ():
        content = partial(kind.decode, bytes(data), connection.msgtype)
        yield _Message(connection.topic, _part(connection.topic, connection.msgtype), stamp_ns // 1000, content)


# ---------------------------------------------------------------------------------------------- messages

COLORS = {"rgb8": None, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB}
PACKED = {
    **dict.fromkeys(("yuyv", "YUYV", "yuv422_yuy2"), cv2.COLOR_YUV2RGB_YUY2),
    **dict.fromkeys(("uyvy", "UYVY", "yuv422"), cv2.COLOR_YUV2RGB_UYVY),
}
"""OpenCV's conversions of encodings of colour, of 3 or 4 bytes a pixel and of 2; the SDK has capitals, or yuv422 for UYVY."""

DEPTHS = {"mono16": "u2", "16UC1": "u2", "32FC1": "f4"}


def _pixels(image: Any) -> NDArray:
    """[H, W] or [H, W, C] of an Image in one of the encodings above. Raises ValueError or KeyError."""
    height, width, step = image.height, image.width, image.step
    if height * step != len(image.data) or not 0 < height <= LONGEST_SIDE or not 0 < width <= LONGEST_SIDE:
        raise ValueError(f"an image of {width} x {height} in {len(image.data)} bytes")
    rows = image.data.reshape(height, step)
    if image.encoding in DEPTHS:
        kind = np.dtype((">" if image.is_bigendian else "<") + DEPTHS[image.encoding])
        return rows[:, : width * kind.itemsize].copy().view(kind).reshape(height, width)
    channels = {**dict.fromkeys(COLORS, 3), "rgba8": 4, "bgra8": 4, **dict.fromkeys(PACKED, 2)}[image.encoding]
    return np.ascontiguousarray(rows[:, : width * channels].reshape(height, width, channels))


@dataclass(frozen=True, eq=False)
class _Info:
    """Of a CameraInfo: size (width, height), K [3, 3], D, and the model of the lens."""

    size: tuple[int, int]
    K: Array
    D: Array
    model: str


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
    K, D = (content.K, content.D) if hasattr(content, "K") else (content.k, content.d)
    return _Info((content.width, content.height), np.reshape(K, (3, 3)), np.asarray(D), content.distortion_model)


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
    """One of the two streams: the topic of its images, their encoding, and what is told of its camera."""

    topic: str = ""
    encoding: str = ""
    info: _Info | None = None
    T_stream_ref: Pose | None = None
    reference: str = ""

    @property
    def is_registered(self) -> bool:
        """Of depth, whether it is in the image of the colour camera."""
        return "aligned_depth" in self.topic or "/depth_registered/" in self.topic


@dataclass
class _Contents:
    color: _Stream = field(default_factory=_Stream)
    depth: _Stream = field(default_factory=_Stream)
    units_per_m: float = 1000.0
    stamps_us: dict[str, list[int]] = field(default_factory=dict)
    infos: dict[str, _Info] = field(default_factory=dict)
    transforms: dict[str, Pose] = field(default_factory=dict)

    def take(self, message: _Message) -> None:
        """Learns what a message says of cameras and streams; of an image no more than its time, once its stream is known."""
        topic = message.topic
        if message.kind == IMAGE:
            stream = self.depth if "depth" in topic.lower() else self.color
            better = not stream.topic or (not stream.is_registered and _Stream(topic).is_registered)
            if better and not any(word in topic.lower() for word in ("infra", "confidence", "fisheye")):
                stream.topic, stream.encoding = topic, message.content().encoding
            self.stamps_us.setdefault(topic, []).append(message.stamp_us)
        elif message.kind == INFO:
            self.infos[topic.removesuffix("/camera_info").removesuffix("/info")] = _info(message.content())
        elif message.kind == TRANSFORM:
            self.transforms[topic] = _transform(message.content())
        else:
            metres = float(message.content().data)
            if 1e-6 <= metres <= 0.01:
                self.units_per_m = round(1.0 / metres, 3)


def open_bag(path: Path) -> Recorded:
    """The recording of a bag. Raises CaptureError that says what it holds and what is missing."""
    contents = _Contents()
    for message in _messages(path):
        with suppress(CaptureError), as_refusal(message.topic, CaptureError):  # a damaged message is passed over
            contents.take(message)
    for stream in (contents.color, contents.depth):
        base = _base(stream.topic)
        stream.info = contents.infos.get(base)
        place = next((topic for topic in contents.transforms if topic.startswith(f"{base}/tf/")), None)
        if place:
            stream.T_stream_ref, stream.reference = contents.transforms[place], place.rpartition("/")[2]
    _check(path, contents)
    color, depth = _cameras(path, contents)
    stamps = contents.stamps_us[contents.color.topic]
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 33_333.0

    def frames() -> Iterator[RecordedFrame]:
        for message in _messages(path):
            if message.topic in (contents.color.topic, contents.depth.topic):
                is_depth = message.topic == contents.depth.topic
                yield RecordedFrame(is_depth, message.stamp_us, partial(_load, message, is_depth, contents))

    clock, topic = (max(period, 1.0), frames, float(stamps[-1])), contents.color.topic
    return Recorded(path, color, depth, *clock, told={"topic": topic}, missing=f"it has no camera_info for {topic}")


def _base(topic: str) -> str:
    """The topic of a stream without what it says of the image: /device_0/sensor_1/Color_0, /camera/color."""
    return topic.removesuffix("/image/data").rpartition("/image_")[0] or topic.removesuffix("/image/data")


def _check(path: Path, contents: _Contents) -> None:
    """Raises CaptureError where a stream, its encoding or what is told of its camera is not what can be used."""
    for name, stream in (("colour", contents.color), ("depth", contents.depth)):
        if not stream.topic:
            with _opened(path) as readers:
                kinds = {one.topic: one.msgtype for _, reader in readers for one in reader.connections}
            packed = any("CompressedImage" in kind for kind in kinds.values())
            why = "its images are compressed: convert them (rosrun image_transport republish compressed raw)"
            topics = ", ".join(sorted(topic for topic, kind in kinds.items() if "Image" in kind))
            more = why if packed else f"it has {topics or 'no topic of images'}"
            raise CaptureError(name, f"{path} has no images of {name}; {more}")
        usable = (*COLORS, *PACKED) if name == "colour" else tuple(DEPTHS)
        if stream.encoding not in usable:
            wanted = f"not one of {', '.join(usable)}: record it as one of those"
            raise CaptureError("format", f"{path}: {name} is {stream.encoding!r:.60}, {wanted}")
        if stream.info is None and not contents.depth.is_registered:
            raise CaptureError("calibration", f"{path} has no camera_info for {stream.topic}: record it as well")


def _cameras(path: Path, contents: _Contents) -> tuple[CaptureCamera | None, DepthCamera | None]:
    color, depth = contents.color, contents.depth
    if color.info is None:
        return None, None
    units_per_m = contents.units_per_m if contents.units_per_m <= 10_000 else 1000.0
    camera = CaptureCamera(_intrinsics(path, color.info), _lens(path, color.info), units_per_m)
    if depth.is_registered or depth.info is None:
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
    return read_intrinsics(f"{path}: a camera_info", info.size, info.K[[0, 1, 0, 1], [0, 1, 2, 2]], 0.0)


FORWARD = ("plumb_bob", "rational_polynomial", "brown conrady", "none", "")
"""Models whose numbers are OpenCV's; the SDK's modified and inverse one, which a D455's colour has, differ by 0.03 pixels there:
its rs2_project_point_to_pixel uses both forwards."""


def _lens(path: Path, info: _Info) -> Array:
    """[8]; raises CaptureError for a lens of another kind whose numbers are not all 0."""
    model = info.model.lower().removeprefix("modified ").removeprefix("inverse ")
    if not np.isfinite(info.D).all() or (np.any(info.D) and (model not in FORWARD or len(info.D) > 8)):
        told = f"the lens {info.model!r:.60} with {info.D[:16].tolist()} is not read: export frames"
        raise CaptureError("calibration", f"{path}: {told}")
    return frozen_array(np.append(info.D[:8], np.zeros(8))[:8])


def _load(message: _Message, is_depth: bool, contents: _Contents, small: bool) -> NDArray | None:
    """As `RecordedFrame.load`."""
    stream = contents.depth if is_depth else contents.color
    image = pixels = None
    with suppress(CaptureError), as_refusal(message.topic, CaptureError):
        image = message.content()
        pixels = _pixels(image)
    if image is None or pixels is None or image.encoding != stream.encoding:
        return None
    if stream.info is not None and pixels.shape[1::-1] != stream.info.size:
        return None
    if is_depth:
        scale = contents.units_per_m if image.encoding != "32FC1" else 1.0
        depth = np.nan_to_num(pixels.astype(np.float64) / scale, nan=0.0, posinf=0.0, neginf=0.0)
        return depth if not small else np.zeros(0)
    conversion = {**COLORS, **PACKED}[image.encoding]
    rgb = pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))
    if not small:
        return rgb
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    half = (rgb.shape[1] // 2, rgb.shape[0] // 2)
    return np.asarray(cv2.resize(gray, half, interpolation=cv2.INTER_AREA), np.uint8)
