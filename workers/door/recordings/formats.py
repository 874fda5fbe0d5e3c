"""Edge: the formats of recordings, one row of `READERS` each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from schemas.capture import Recorded
from schemas.errors import CaptureError
from workers.door.opening import as_refusal, open_file
from workers.door.recordings.bags import is_bag, open_bag
from workers.door.recordings.folders import FOLDERS
from workers.door.recordings.kinect import is_kinect, open_kinect


@dataclass(frozen=True)
class Reader:
    """One format: its name, whether a path is of it by a glance, and what opens it (raises CaptureError)."""

    name: str
    sniff: Callable[[Path], bool]
    open: Callable[[Path], Recorded]


READERS = (
    Reader("an Azure Kinect recording (.mkv)", is_kinect, open_kinect),
    Reader("a ROS bag of a RealSense (.bag, .db3, .mcap)", is_bag, open_bag),
    *(Reader(name, *row) for name, row in FOLDERS.items()),
)
"""Formats that are read, in the order in which they are tried."""

VIDEO = b"\0\0\0"
"""First bytes of a video, which is known, and not read."""


def open_any(path: Path) -> Recorded:
    """The recording at a path. Raises CaptureError that names the formats that are read."""
    if not path.exists():
        raise CaptureError("missing", f"{path}: no such file or folder")
    head = b""
    if not path.is_dir():
        with open_file(path, CaptureError) as stream:
            head = stream.read(len(VIDEO))
        if not head:
            raise CaptureError("empty", f"{path} has no bytes: copy it again")
    with as_refusal(path, CaptureError):
        for reader in READERS:
            if reader.sniff(path):
                return reader.open(path)
    known = f"none of the formats that are read: {'; '.join(reader.name for reader in READERS)}"
    video = "a video alone: depth is in other files, import the folder that holds both"
    raise CaptureError("format", f"{path} is {video if head == VIDEO else known}")
