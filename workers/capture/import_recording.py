"""From a recording of any format to the folder of a capture: frames paired, chosen and registered."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

from schemas.base import Array
from schemas.capture import CapturedView, DepthCamera, Recorded, RecordedFrame
from schemas.errors import CaptureError
from schemas.job.captures import Board
from schemas.scene.view import Intrinsics
from workers.capture.folder import (
    CAMERA_FILE,
    CameraFile,
    CaptureFile,
    camera_of,
    describe_camera,
    is_taken_out,
    read_json,
    stored_depth,
    write_description,
    write_view,
)
from workers.door.opening import as_refusal
from workers.door.recordings.formats import open_any
from workers.door.recordings.pictures import change_camera, scaled_camera
from workers.geometry.zbuffer import register_depth

Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class Losses:
    """What is missing of a recording.

    dropped: colour frames missing between the first and the last that were read; without_depth: colour frames without a depth
    frame; damaged: frames that were cut short; cut: frames missing at the end, None where nobody knows.
    """

    dropped: int
    without_depth: int
    damaged: int
    cut: int | None


def pair_frames(color_us: Stamps, depth_us: Stamps, period_us: float, delay_us: float = 0.0) -> dict[int, int]:
    """Index of the depth frame for colour frames that have one: nearest in time, less than half a period away.

    Depth stamps are `delay_us` later than the colour stamps they belong to. Both ascending.
    """
    if not len(depth_us):
        return {}
    shifted = depth_us - delay_us
    after = np.searchsorted(shifted, color_us)
    near = np.clip(np.stack([after - 1, after]), 0, len(shifted) - 1)
    gaps = np.abs(shifted[near] - color_us)
    best, gap = np.take_along_axis(near, gaps.argmin(axis=0)[None], axis=0)[0], gaps.min(axis=0)
    return {int(i): int(best[i]) for i in np.flatnonzero(gap < 0.5 * period_us)}


def count_losses(color_us: Stamps, pairs: int, damaged: int, period_us: float, duration_us: float | None) -> Losses:
    """`pairs` colour frames have depth; `duration_us` is what the file says of its length. At least one colour frame."""
    frames = round(float(color_us[-1] - color_us[0]) / period_us) + 1
    dropped = max(frames - len(color_us) - damaged, 0)
    cut = None if duration_us is None else max(round((duration_us - float(color_us[-1])) / period_us), 0)
    return Losses(dropped, len(color_us) - pairs, damaged, cut)


def describe_losses(losses: Losses) -> list[str]:
    """Sentences for the user, none where nothing is missing."""
    sentences = {
        "the recorder was interrupted and wrote no length: nobody knows how many frames are lost at the end": losses.cut
        is None,
        f"the recording is cut: about {losses.cut} frames are lost at its end": losses.cut,
        f"{losses.dropped} frames are missing between the first and the last": losses.dropped,
        f"{losses.damaged} frames are damaged": losses.damaged,
        f"{losses.without_depth} colour frames have no depth": losses.without_depth,
    }
    return [sentence for sentence, count in sentences.items() if count]


LOOK = (32, 18)
"""Width and height of the small picture by which frames are compared."""
BLURRED = 0.5
"""A frame with less than this share of the usual sharpness is taken only where there are too few others."""
NEAR = 0.5
"""Two frames whose looks, of length 1, differ by less show much the same: a correlation of 0.875."""


@dataclass(frozen=True, eq=False)
class FrameMeasure:
    """What a frame is chosen by: sharpness, and a small picture [LOOK pixels] without its brightness and contrast."""

    sharpness: float
    look: Array


def measure_frame(gray: NDArray[np.uint8]) -> FrameMeasure:
    """Sharpness is the variance of the Laplacian, which motion blur lowers; grey levels squared."""
    look = cv2.resize(gray, LOOK, interpolation=cv2.INTER_AREA).astype(np.float64).ravel()
    look -= look.mean()
    norm = float(np.sqrt((look * look).sum()))
    return FrameMeasure(float(cv2.Laplacian(gray, cv2.CV_64F).var()), look / norm if norm > 0.0 else look)


def choose_frames(measures: list[FrameMeasure], count: int) -> list[int]:
    """Ascending indices of `count` frames, or of all where there are fewer.

    First each frame must be the sharpest among its neighbours in time, whose content is the same, so that their sharpness can
    be compared. Of those the sharpest is taken, then again and again the one that is the farthest way from all that were
    taken: a camera that stands still or comes back adds no frame while others are left.
    """
    if len(measures) <= count:
        return list(range(len(measures)))
    sharpness = np.array([measure.sharpness for measure in measures])
    reach = max(len(measures) // (8 * count), 1)
    candidates = _sharpest(sharpness, reach)
    while len(candidates) < count and reach > 0:
        reach //= 2
        candidates = _sharpest(sharpness, reach)
    ways = _ways(np.stack([measures[i].look for i in candidates]))
    return sorted(candidates[_spread(ways, int(np.argmax(sharpness[candidates])), count)].tolist())


def _sharpest(sharpness: Array, reach: int) -> NDArray[np.int64]:
    """Frames that are the sharpest of those at most `reach` frames away, and not blurred where enough others are sharp."""
    padded = np.pad(sharpness, reach, constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    best = np.flatnonzero(windows.argmax(axis=1) == reach)
    sharp = best[sharpness[best] >= BLURRED * np.median(sharpness[best])]
    return sharp if reach > 0 else best


def _ways(looks: Array) -> Array:
    """[N, N] float64: how far the camera goes from one frame to another, as a sum of small changes of the look.

    The change between two frames says how far apart they are only while they show much the same; farther on it does not grow.
    So frames are joined to their neighbours in time and to all that look nearly the same, and the shortest way is taken.
    """
    change = np.stack([np.sqrt(((looks - look) ** 2).sum(axis=1)) for look in looks])
    joined = change < NEAR
    after = np.arange(len(looks) - 1)
    joined[after, after + 1] = True
    return np.asarray(shortest_path(np.where(joined, np.maximum(change, 1e-9), 0.0), directed=False), np.float64)


def _spread(ways: Array, first: int, count: int) -> NDArray[np.int64]:
    """Indices of `count` frames: `first`, then each the farthest from those before it; ties go to the earliest."""
    chosen = [first]
    nearest = ways[first].copy()
    nearest[first] = -1.0
    while len(chosen) < count:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ways[chosen[-1]])
        nearest[chosen] = -1.0
    return np.array(chosen)


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
    calibration: str
    """Whose the camera is, in words."""
    notes: tuple[str, ...]
    """What is missing or was taken for granted, sentences."""


def _open(path: Path, file: Path | None) -> tuple[Recorded, CameraFile, list[str]]:
    """(recording, its camera.json, notes): with the camera of a file, or of such a file beside pictures that have no other.

    Raises CaptureError where there is none, or one of pictures of another size.
    """
    opened = open_any(path)
    if file is None and opened.color is not None:
        return opened, describe_camera(opened.color), []
    file = file or path / CAMERA_FILE
    if opened.color is None and not file.is_file():
        how = f"describe it in a {CAMERA_FILE} (docs/captures.md has its keys) and name that by --camera"
        raise CaptureError("calibration", f"{path}: {opened.missing}: {how}, or put it into the folder")
    spec, notes = read_json(file, CameraFile), []
    if "depth_units_per_m" not in spec.model_fields_set:
        units = opened.color.depth_units_per_m if opened.color else opened.units_per_m
        spec = spec.model_copy(update={"depth_units_per_m": units})
        if opened.with_units:
            notes = [f"depth is taken for {units:g} units a metre: {file} can say depth_units_per_m"]
    elif opened.with_units:
        opened = opened.with_units(spec.depth_units_per_m)
    colors = (frame for frame in opened.frames() if not frame.is_depth)
    image = next((image for frame in colors if (image := _load(opened, frame, False)) is not None), None)
    if image is not None and image.shape[1::-1] != (spec.width, spec.height):
        size = f"{image.shape[1]} x {image.shape[0]}"
        raise CaptureError("size", f"{path}: its pictures are {size}, and {file} says {spec.width} x {spec.height}")
    told = {**opened.told, "calibration": str(file)}
    return replace(_with_camera(opened, spec, file), told=told), spec, notes


def _with_camera(opened: Recorded, spec: CameraFile, file: Path) -> Recorded:
    """The recording as a camera.json has it: depth stays where its camera is described, and else is registered as it was."""
    camera, depth = camera_of(spec), None if spec.depth_camera else opened.depth

    def seen_by(frame: RecordedFrame) -> RecordedFrame:
        if spec.depth_camera is not None or not isinstance(frame.camera, DepthCamera):
            return replace(frame, camera=None)
        k = frame.camera.intrinsics
        scaled = scaled_camera(camera.intrinsics, (k.width, k.height))
        return replace(frame, camera=replace(scaled, lens=camera.lens))

    first = next((each for frame in opened.frames() if (each := seen_by(frame)).is_depth), None)
    registers = depth is not None or (first is not None and first.camera is not None)
    if registers and (spec.depth == "ray" or is_taken_out(spec)):
        how = "depth of another camera is registered as z, and with a lens of at most eight numbers: describe depth_camera"
        raise CaptureError("calibration", f"{file}: {how}")
    return replace(opened, color=camera, depth=depth, frames=lambda: map(seen_by, opened.frames()))


def import_recording(
    path: Path, out: Path, about: CaptureFile, board: Board, views: int, camera: Path | None = None
) -> Imported:
    """Writes a capture folder into `out`, which must exist: `views` chosen frames with depth in the colour camera.

    The images keep the lens of the colour camera, which camera.json has: the recording's, or that of the file `camera` in its
    place. What describes the folder is written last, so that a folder that was left half-made is not taken for a capture.
    Raises CaptureError for a recording that cannot be used.
    """
    recording, stored, notes = _open(path, camera)
    color_us, measures, depth_us, damaged = _measure(recording)
    pairs = pair_frames(color_us, depth_us, recording.period_us, recording.depth_delay_us)
    if not pairs:
        raise CaptureError(
            "empty",
            f"{path}: none of {len(color_us)} colour frames that can be read has one of {len(depth_us)} depth "
            "frames within half a frame's time: copy the file again",
        )
    losses = count_losses(color_us, len(pairs), damaged, recording.period_us, recording.duration_us)
    usable = sorted(pairs)
    chosen = [usable[i] for i in choose_frames([measures[i] for i in usable], views)]
    made = tuple(
        ImportedView(n, int(color_us[i]), int(depth_us[pairs[i]]), measures[i].sharpness) for n, i in enumerate(chosen)
    )
    _write_views(recording, made, out)
    origin: dict[str, Any] = {"recording": path.name, "calibration": "the recording's own calibration"}
    origin |= recording.told
    origin |= {"losses": asdict(losses), "views": [asdict(view) for view in made]}
    (out / RECORDING_FILE).write_text(json.dumps(origin, indent=1) + "\n", encoding="utf-8")
    write_description(out, about, stored, board)
    notes = [*describe_losses(losses), *recording.notes, *notes]
    return Imported(made, len(pairs), losses, origin["calibration"], tuple(notes))


def _measure(recording: Recorded) -> tuple[Stamps, list[FrameMeasure], Stamps, int]:
    """(stamps and measures of the colour frames that can be used, stamps of depth frames, damaged frames), read once."""
    color: dict[int, FrameMeasure] = {}
    depth: set[int] = set()
    damaged = 0
    for frame in recording.frames():
        image = _load(recording, frame, True)
        if frame.is_depth and image is not None:
            depth.add(frame.stamp_us)
        elif image is not None:
            color[frame.stamp_us] = measure_frame(image)
        elif not frame.is_depth:
            damaged += 1
    stamps = sorted(color)
    return np.array(stamps, np.int64), [color[t] for t in stamps], np.array(sorted(depth), np.int64), damaged


def _load(recording: Recorded, frame: RecordedFrame, small: bool) -> NDArray | None:
    what = "depth" if frame.is_depth else "colour"
    with as_refusal(f"{recording.path}: {what} at {frame.stamp_us / 1e6:.3f} s", CaptureError):
        return frame.load(small)


def _write_views(recording: Recorded, views: tuple[ImportedView, ...], out: Path) -> None:
    """Reads the recording again and writes the chosen frames; a view is written as soon as both its frames are there."""
    color = {view.color_us: [view] for view in views}
    depth: dict[int, list[ImportedView]] = {}
    for view in views:
        depth.setdefault(view.depth_us, []).append(view)
    half: dict[int, RecordedFrame] = {}
    for frame in recording.frames():
        for view in (depth if frame.is_depth else color).get(frame.stamp_us, []):
            other = half.setdefault(view.number, frame)
            if other.is_depth != frame.is_depth:
                pair = (other, frame) if frame.is_depth else (frame, other)
                write_view(out, _view(recording, view.number, *pair))
                del half[view.number]


def _view(recording: Recorded, number: int, color: RecordedFrame, depth: RecordedFrame) -> CapturedView:
    """Both images in the recording's colour camera."""
    rgb, depth_m = _load(recording, color, False), _load(recording, depth, False)
    if rgb is None or depth_m is None:
        raise CaptureError("unreadable", f"{recording.path}: the colour frame of view {number} cannot be decoded")
    common = recording.color
    assert common is not None
    k = color.camera if isinstance(color.camera, Intrinsics) else common.intrinsics
    camera = depth.camera if isinstance(depth.camera, DepthCamera) else recording.depth
    if camera is None:
        depth_m = change_camera(depth_m, k, common.intrinsics, between=False)
    else:
        depth_m = register_depth(depth_m, camera, common.intrinsics, common.lens)
    rgb = change_camera(rgb, k, common.intrinsics, between=True)
    return CapturedView(number, rgb, stored_depth(depth_m, common.depth_units_per_m), None)
