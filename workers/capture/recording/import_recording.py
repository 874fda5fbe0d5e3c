"""From an Azure Kinect recording to the folder of a capture."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from schemas.base import Array
from schemas.capture import CapturedView
from schemas.errors import CaptureError
from schemas.job.captures import Board
from workers.capture.folder import CaptureFile, write_description, write_view
from workers.capture.recording.calibration import DEPTH_UNITS_PER_M, DeviceCalibration, read_calibration
from workers.capture.recording.choose import (
    FrameMeasure,
    Losses,
    choose_frames,
    count_losses,
    measure_frame,
    pair_frames,
)
from workers.capture.recording.tracks import (
    DEPTH_FORMAT,
    Recording,
    TrackFrame,
    decode_color,
    decode_depth,
    decode_gray,
    is_whole,
    open_recording,
    read_frames,
)
from workers.geometry.zbuffer import register_depth

RECORDING_FILE = "recording.json"
"""Where the views come from: the recording, and the time stamp of each view."""


@dataclass(frozen=True)
class ImportedView:
    """A view and the frame it was made from."""

    number: int
    color_us: int
    depth_us: int
    sharpness: float


@dataclass(frozen=True)
class Imported:
    """What was made of a recording."""

    views: tuple[ImportedView, ...]
    frames: int
    """Colour frames with depth, of which the views were chosen."""
    losses: Losses


@dataclass(frozen=True, eq=False)
class _Frames:
    """The frames of a recording that can be used: time stamps, and measures of the colour frames."""

    color_us: np.ndarray
    measures: list[FrameMeasure]
    depth_us: np.ndarray
    damaged: int


def import_recording(path: Path, out: Path, about: CaptureFile, board: Board, views: int) -> Imported:
    """Writes a capture folder into `out`, which must exist: `views` chosen frames with depth in the colour camera.

    The images keep the lens of the colour camera, which camera.json has. What describes the folder is written last, so that a
    folder that was left half-made is not taken for a capture. Raises CaptureError for a recording that cannot be used.
    """
    recording = open_recording(path)
    device = _read_device(recording)
    found = _measure(recording)
    pairs = pair_frames(found.color_us, found.depth_us, recording.period_us, recording.depth_delay_us)
    if not pairs:
        raise CaptureError(
            "empty",
            f"{path}: none of {len(found.color_us)} colour frames that can be read has one of {len(found.depth_us)} depth "
            "frames within half a frame's time: copy the file again",
        )
    losses = count_losses(
        found.color_us, len(pairs), found.damaged, recording.period_us, recording.extent, path.stat().st_size
    )
    usable = sorted(pairs)
    chosen = [usable[i] for i in choose_frames([found.measures[i] for i in usable], views)]
    made = tuple(
        ImportedView(n, int(found.color_us[i]), int(found.depth_us[pairs[i]]), found.measures[i].sharpness)
        for n, i in enumerate(chosen)
    )
    _write_views(recording, device, made, out)
    _write_source(recording, made, losses, out)
    write_description(out, about, device.color, board)
    return Imported(made, len(pairs), losses)


def _read_device(recording: Recording) -> DeviceCalibration:
    """The recording's cameras. Raises CaptureError that names the file."""
    path = recording.path
    try:
        device = read_calibration(recording.calibration, recording.color_size, recording.depth_mode)
    except CaptureError as error:
        raise CaptureError(error.reason, f"{path}: {error.detail}") from error
    size = (device.depth.intrinsics.width, device.depth.intrinsics.height)
    if recording.depth_size != size:
        raise CaptureError(
            "mode", f"{path}: depth is {recording.depth_size}, and the mode {recording.depth_mode} has {size}"
        )
    return device


def _measure(recording: Recording) -> _Frames:
    """Reads the whole recording once."""
    color: dict[int, FrameMeasure] = {}
    depth: set[int] = set()
    damaged = 0
    for frame in read_frames(recording):
        if frame.is_depth:
            if is_whole(frame.data, DEPTH_FORMAT, recording.depth_size):
                depth.add(frame.stamp_us)
            continue
        measure = _measure_color(recording, frame)
        if measure is None:
            damaged += 1
        else:
            color[frame.stamp_us] = measure
    stamps = sorted(color)
    return _Frames(np.array(stamps, np.int64), [color[t] for t in stamps], np.array(sorted(depth), np.int64), damaged)


def _measure_color(recording: Recording, frame: TrackFrame) -> FrameMeasure | None:
    if not is_whole(frame.data, recording.color_format, recording.color_size):
        return None
    gray = decode_gray(frame.data, recording.color_format, recording.color_size)
    return None if gray is None else measure_frame(gray)


def _write_views(recording: Recording, device: DeviceCalibration, views: tuple[ImportedView, ...], out: Path) -> None:
    """Reads the recording again and writes the chosen frames; a view is written as soon as both its frames are there."""
    color = {view.color_us: [view] for view in views}
    depth: dict[int, list[ImportedView]] = {}
    for view in views:
        depth.setdefault(view.depth_us, []).append(view)
    half: dict[int, bytes] = {}
    for frame in read_frames(recording):
        waiting = (depth if frame.is_depth else color).get(frame.stamp_us, [])
        for view in waiting:
            if view.number not in half:
                half[view.number] = frame.data
                continue
            other = half.pop(view.number)
            pair = (other, frame.data) if frame.is_depth else (frame.data, other)
            write_view(out, _view(recording, device, view.number, *pair))


def _view(recording: Recording, device: DeviceCalibration, number: int, color: bytes, depth: bytes) -> CapturedView:
    rgb = decode_color(color, recording.color_format, recording.color_size)
    if rgb is None:
        raise CaptureError("unreadable", f"{recording.path}: the colour frame of view {number} cannot be decoded")
    depth_m = decode_depth(depth, recording.depth_size) / DEPTH_UNITS_PER_M
    seen = register_depth(depth_m, device.depth, device.color.intrinsics, device.color.lens)
    return CapturedView(number, rgb, _stored(seen), None)


def _stored(depth_m: Array) -> np.ndarray:
    """[H, W] uint16 in units of the folder; depth beyond what 16 bits hold is none."""
    units = np.rint(depth_m * DEPTH_UNITS_PER_M)
    return np.where(units < 65536.0, units, 0.0).astype(np.uint16)


def _write_source(recording: Recording, views: tuple[ImportedView, ...], losses: Losses, out: Path) -> None:
    told = {
        "recording": recording.path.name,
        "serial_number": recording.serial_number,
        "depth_mode": recording.depth_mode,
        "losses": asdict(losses),
        "views": [asdict(view) for view in views],
    }
    (out / RECORDING_FILE).write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
