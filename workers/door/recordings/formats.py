"""Edge: the formats of recordings, one row of `READERS` each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from schemas.capture import Recorded
from schemas.errors import CaptureError
from workers.door.recordings.bags import is_bag, open_bag
from workers.door.recordings.folders import FOLDERS
from workers.door.recordings.kinect import is_kinect, open_kinect
from workers.door.recordings.pictures import PictureError


@dataclass(frozen=True)
class Reader:
    """One format: its name, whether a path is of it by a glance, and what opens it (raises CaptureError)."""

    name: str
    sniff: Callable[[Path], bool]
    open: Callable[[Path], Recorded]


READERS = (
    Reader("an Azure Kinect recording (.mkv)", is_kinect, open_kinect),
    Reader("a ROS bag of a RealSense (.bag)", is_bag, open_bag),
    *(Reader(name, *row) for name, row in FOLDERS.items()),
)
"""Formats that are read, in the order in which they are tried."""

NOT_READ = {
    b"SQLite format 3": "a ROS 2 bag: convert it (rosbags-convert) to a ROS 1 .bag, or export its frames",
    b"\x89MCAP": "an MCAP file: convert it (rosbags-convert) to a ROS 1 .bag, or export its frames",
    b"\0\0\0": "a video alone: depth is in other files, import the folder that holds both",
}
"""First bytes of formats that are known, and not read."""


def open_any(path: Path) -> Recorded:
    """The recording at a path. Raises CaptureError that names the formats that are read."""
    if not path.exists():
        raise CaptureError("missing", f"{path}: no such file or folder")
    if path.is_file() and path.stat().st_size == 0:
        raise CaptureError("empty", f"{path} has no bytes: copy it again")
    try:
        for reader in READERS:
            if reader.sniff(path):
                return reader.open(path)
        head = b""
        if path.is_file():
            with open(path, "rb") as stream:
                head = stream.read(16)
    except PictureError as error:
        raise CaptureError("unreadable", f"{path} {error}") from error
    except OSError as error:
        raise CaptureError("unreadable", f"{path} cannot be read: {error.strerror or error}") from error
    told = next((f"{path} is {what}" for start, what in NOT_READ.items() if head.startswith(start)), "")
    known = "; ".join(reader.name for reader in READERS)
    raise CaptureError("format", told or f"{path} is none of the formats that are read: {known}")
