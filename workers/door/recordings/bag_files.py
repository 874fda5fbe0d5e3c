"""Edge: the files of ROS bags, by the library rosbags: of ROS 1 a .bag, of ROS 2 a .db3, a .mcap, or the folder that holds them.

Few kinds of messages are read, by their published definitions; those in a bag are a stranger's, and would be compiled. Each
message may be compressed by itself.
"""

import bz2
import heapq
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import lz4.frame
from backports import zstd
from rosbags.rosbag1 import reader as bag
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.typesys import Stores, get_typestore

from schemas.errors import CaptureError
from workers.door.opening import as_refusal, open_file

MOST_BYTES = 512_000_000
"""Of one chunk, unpacked."""

IMAGE, COMPRESSED, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo"
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
class BagMessage:
    """A message as stored; `content` decodes it. A compressed image has the topic and the kind of the image itself."""

    topic: str
    kind: str
    stamp_us: int
    content: Callable[[], Any]


@contextmanager
def open_files(path: Path) -> Iterator[list[tuple[_Kind, Any]]]:
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


TRANSPORTS = ("/compressed", "/compressedDepth", "")
"""What image_transport adds to the topic of an image that it compresses; the best of what a recorder may have of one last."""


def read_messages(path: Path) -> Iterator[BagMessage]:
    """The messages of the kinds that are read, in the order of time, and of an image that is there more than once the best."""
    with open_files(path) as readers:
        best: dict[str, tuple[bool, int]] = {}
        for connection in (each for _, reader in readers for each in reader.connections):
            if connection.msgtype in (IMAGE, COMPRESSED):
                name, rank = _image_of(connection)
                best[name] = max(best.get(name, rank), rank)
        yield from heapq.merge(*(_of_file(*pair, best) for pair in readers), key=lambda message: message.stamp_us)


def _image_of(connection: Any) -> tuple[str, tuple[bool, int]]:
    """(topic of the image itself, how good this way of having it is: whether there is any, then the place in `TRANSPORTS`)."""
    is_raw, has_any = connection.msgtype == IMAGE, connection.msgcount > 0
    transport = "" if is_raw else next(end for end in TRANSPORTS if connection.topic.endswith(end))
    place = len(TRANSPORTS) if is_raw else TRANSPORTS.index(transport)
    return connection.topic.removesuffix(transport), (has_any, place)


def _part(topic: str, kind: str) -> str:
    """What a topic of a type is about: the type of its message in ROS 1, not compressed; "" for what is not needed."""
    if kind in (TEXT, INFO) and topic.endswith("/camera_info"):
        return INFO
    if kind in (TEXT, TRANSFORM) and "/tf/" in topic:
        return TRANSFORM
    if kind in (TEXT, FLOAT) and topic.replace("_", " ").endswith("/option/Depth Units/value"):
        return FLOAT
    return IMAGE if kind in (IMAGE, COMPRESSED) else ""


def _of_file(kind: _Kind, reader: Any, best: dict[str, tuple[bool, int]]) -> Iterator[BagMessage]:
    said: dict[int, tuple[str, str]] = {}
    for each in reader.connections:
        part, (name, rank) = _part(each.topic, each.msgtype), _image_of(each)
        if part and (part != IMAGE or rank == best[name]):
            said[each.id] = name if part == IMAGE else each.topic, part
    wanted = [each for each in reader.connections if each.id in said]
    for connection, stamp_ns, data in reader.messages(wanted) if wanted else ():
        content = partial(kind.decode, bytes(data), connection.msgtype)
        yield BagMessage(*said[connection.id], stamp_ns // 1000, content)
