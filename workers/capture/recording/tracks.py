"""The tracks of an Azure Kinect recording, read by PyAV.

The layout is that of Microsoft's description ("Azure Kinect record file format") and its SDK: tracks named COLOR and DEPTH or
marked by the tags K4A_COLOR_TRACK and K4A_DEPTH_TRACK, time stamps in microseconds of the device's clock, depth as 16-bit
big-endian millimetres (b16g), the factory calibration as an attachment.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import av
from av.container import InputContainer
from av.video.stream import VideoStream

from schemas.errors import CaptureError
from workers.capture.recording.extent import HEAD_BYTES, Extent, read_extent
from workers.capture.recording.images import DEPTH_FORMAT, FORMATS

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
    extent: Extent
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
    if not path.is_file():
        raise CaptureError("missing", f"{path} is no file")
    if path.stat().st_size == 0:
        raise CaptureError("empty", f"{path} has no bytes: copy it again")
    with path.open("rb") as file:
        extent = read_extent(file.read(HEAD_BYTES))
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
        return _describe(path, container, color, depth, extent)


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


def _describe(
    path: Path, container: InputContainer, color: VideoStream, depth: VideoStream, extent: Extent
) -> Recording:
    tags = {**container.metadata, **color.metadata, **depth.metadata}
    color_format, depth_format = (_fourcc(stream) for stream in (color, depth))
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
    return Recording(
        path,
        color_format,
        (color.width, color.height),
        (depth.width, depth.height),
        tags["K4A_DEPTH_MODE"],
        _calibration(path, container),
        1e6 / float(rate),
        _whole_number(path, tags, "K4A_DEPTH_DELAY_NS") / 1000.0,
        tags.get("K4A_DEVICE_SERIAL_NUMBER", ""),
        extent,
        color.index,
        depth.index,
    )


def _fourcc(stream: VideoStream) -> str:
    return stream.codec_context.codec_tag.strip("\0 ") or stream.codec_context.name


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


def _whole_number(path: Path, tags: dict[str, str], name: str) -> int:
    try:
        return int(tags.get(name, "0"))
    except ValueError:
        raise CaptureError("format", f"{path}: the tag {name} is {tags[name]!r}, no number: {AS_RECORDED}") from None
