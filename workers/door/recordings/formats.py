"""Edge: the formats of recordings, a row of `READERS` each; and those that are folders of images, by their published layouts.

TUM RGB-D (rgb.txt, depth.txt, 5000 units a metre, registered; the calibrations of its three cameras), BOP scenes
(scene_camera.json; depth_scale in millimetres), Open3D's recorder (intrinsic.json, column by column) and folders like it,
Record3D (.r3d: a zip of JPEG and of depth in metres compressed by LZFSE), Polycam's raw data (keyframes/), ARKitScenes
(lowres_wide/). Depth to which a phone gives the lowest confidence, 0, is none.

Principal points count from the first pixel's centre in the first three, and from the image's corner in Apple's.
"""

import json
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from schemas.base import frozen_array
from schemas.capture import CaptureCamera, Recorded, RecordedFrame
from schemas.errors import CaptureError
from schemas.scene.view import Intrinsics
from workers.door.opening import as_refusal, open_file, read_bytes
from workers.door.recordings.bag_files import is_bag
from workers.door.recordings.bags import open_bag
from workers.door.recordings.kinect import is_kinect, open_kinect
from workers.door.recordings.pictures import (
    Size,
    decode_confidence,
    decode_depth,
    decode_rgb,
    decode_small,
    read_head,
    read_intrinsics,
    scaled_camera,
)

MOST_BYTES = 256_000_000
"""Of one file or one member of an archive."""

UNITS_PER_M = 1000.0
"""Of depth that is written: whole millimetres, and finer where a recording's is finer."""

NO_TIME_US = 33_333
"""Between two frames of a recording without time stamps."""

Read = Callable[[], bytes]


def _wrong(path: Path, what: str) -> CaptureError:
    return CaptureError("unreadable", f"{path}: {what}")


_bytes_of = partial(read_bytes, most_bytes=MOST_BYTES, refuse=CaptureError)


def _tree_of(path: Path, read: Read | None = None) -> Any:
    """Of JSON without NaN, in a file or in what `read` reads. Raises CaptureError."""

    def refuse(name: str) -> float:
        raise ValueError(f"{name} is no number of JSON")

    data = _bytes_of(path) if read is None else read()
    with as_refusal(path, CaptureError):
        return json.loads(data, parse_constant=refuse)


def _size_of(path: Path) -> Size:
    """Width and height in the head of an image. Raises CaptureError."""
    with as_refusal(path, CaptureError):
        return read_head(_bytes_of(path))[0]


Seen = Intrinsics | Size
"""A colour camera, or the size of its images where nothing else is known of it."""


def _of_size(k: Seen) -> Size:
    return (k.width, k.height) if isinstance(k, Intrinsics) else k


def _color(stamp_us: int, read: Read, k: Seen) -> RecordedFrame:
    def load(small: bool) -> np.ndarray:
        return (decode_small if small else decode_rgb)(read(), _of_size(k))

    return RecordedFrame(False, stamp_us, load, k if isinstance(k, Intrinsics) else None)


def _depth(
    stamp_us: int, read: Read, k: Seen, units_per_m: float, size: Size | None = None, sure: Read | None = None
) -> RecordedFrame:
    """Of the colour camera `k`, registered to it or, with a `size`, seen by it in an image of that size.

    sure: how sure a phone is of each pixel: depth of the lowest confidence, 0, is none.
    """
    size, camera = size or _of_size(k), k if isinstance(k, Intrinsics) else None

    def load(small: bool) -> np.ndarray | None:
        depth = np.zeros(0) if small else decode_depth(read(), size, units_per_m)
        return depth if small or sure is None else np.where(decode_confidence(sure(), size) > 0, depth, 0.0)

    seen = scaled_camera(camera, size) if camera and size != _of_size(k) else camera
    return RecordedFrame(True, stamp_us, load, seen)


def _recorded(
    path: Path, frames: list[RecordedFrame], lens: tuple[float, ...] = (), units_per_m: float = UNITS_PER_M, **more: Any
) -> Recorded:
    """A recording of these frames, its camera that of the middle focal length, if any. Raises CaptureError without frames."""
    frames = sorted(frames, key=lambda frame: (frame.stamp_us, frame.is_depth))
    colors = [frame for frame in frames if not frame.is_depth]
    if not colors or len(colors) == len(frames):
        raise CaptureError("empty", f"{path} has {len(colors)} colour images and {len(frames) - len(colors)} of depth")
    cameras = [frame.camera for frame in colors if isinstance(frame.camera, Intrinsics)]
    sizes = {(k.width, k.height) for k in cameras}
    if len(sizes) > 1:
        raise _wrong(path, f"has colour images of {len(sizes)} sizes: import each by itself")
    stamps = np.array([frame.stamp_us for frame in colors])
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else float(NO_TIME_US)
    camera = None
    if cameras:
        k = sorted(cameras, key=lambda each: each.fx)[len(cameras) // 2]
        camera = CaptureCamera(k, frozen_array(np.append(lens, np.zeros(8))[:8]), units_per_m)
    clock = max(period, 1.0), lambda: iter(frames), float(stamps[-1])
    return Recorded(path, camera, None, *clock, units_per_m=units_per_m, **more)


# ---------------------------------------------------------------------------------------------- TUM RGB-D

TUM_UNITS_PER_M = 5000.0

TUM_CAMERAS = {
    "freiburg1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": ((535.4, 539.2, 320.1, 247.6), ()),
}
"""fx, fy, cx, cy and lens of the colour cameras, by a word in the folder's name, as the data set's page has them."""

TUM_SIZE = (640, 480)


def _open_tum(path: Path, units_per_m: float = TUM_UNITS_PER_M) -> Recorded:
    color, depth = (list(_tum_list(path, name)) for name in ("rgb.txt", "depth.txt"))
    if not color:
        raise CaptureError("empty", f"{path}/rgb.txt names no image")
    word = next((word for word in TUM_CAMERAS if word in path.resolve().name.lower()), None)
    numbers, lens = TUM_CAMERAS.get(word or "", ((), ()))
    size, missing = _size_of(color[0][1]), "no file in it has its camera"
    k: Seen = read_intrinsics(path, size, numbers, 0.0) if word and size == TUM_SIZE else size
    if word and size != TUM_SIZE:
        missing += f", and the camera of TUM's {word} has images of 640 x 480, not of {size[0]} x {size[1]}"
    frames = [_color(stamp, partial(_bytes_of, file), k) for stamp, file in color]
    frames += [_depth(stamp, partial(_bytes_of, file), k, units_per_m) for stamp, file in depth]
    told = {"calibration": f"that of TUM's {word}"} if isinstance(k, Intrinsics) else {}
    more = {"told": told, "missing": missing, "with_units": partial(_open_tum, path)}
    return _recorded(path, frames, lens, units_per_m, **more)


def _tum_list(folder: Path, name: str) -> Iterator[tuple[int, Path]]:
    """(microseconds, file) of each line `seconds file`."""
    for line in _bytes_of(folder / name).decode("utf-8", "replace").splitlines():
        parts = line.split()
        if parts and not line.lstrip().startswith("#"):
            if len(parts) != 2 or not re.fullmatch(r"[0-9]{1,12}(\.[0-9]{1,12})?", parts[0]):
                raise _wrong(folder / name, f"the line {line[:60]!r} is not a time in seconds and a file")
            file = folder / parts[1]
            if not file.resolve().is_relative_to(folder.resolve()):
                raise _wrong(folder, f"names the file {parts[1]!r}, which is not in it")
            yield round(float(parts[0]) * 1e6), file


# ---------------------------------------------------------------------------------------------- BOP, Open3D


BOP_FILE = "scene_camera.json"


def _open_bop(path: Path) -> Recorded:
    described = path / BOP_FILE
    tree, frames = _tree_of(described), []
    if not isinstance(tree, dict) or not all(
        isinstance(each, dict) and name.isdecimal() for name, each in tree.items()
    ):
        raise _wrong(described, "is no list of cameras by the number of an image")
    for name, entry in sorted(tree.items(), key=lambda item: int(item[0])):
        stamp = int(name) * NO_TIME_US
        color, z = _bop_file(path, ("rgb", "gray"), int(name)), _bop_file(path, ("depth",), int(name))
        K, scale = entry.get("cam_K"), entry.get("depth_scale")
        if not isinstance(K, list) or len(K) != 9:
            raise _wrong(described, f"{name}: cam_K must be nine numbers")
        if not isinstance(scale, int | float) or not 0 < scale < 1e6:
            raise _wrong(described, f"{name}: depth_scale is {scale!r}, and must be millimetres a unit")
        k = read_intrinsics(described, _size_of(color), (K[0], K[4], K[2], K[5]), 0.0)
        frames.append(_color(stamp, partial(_bytes_of, color), k))
        frames.append(_depth(stamp, partial(_bytes_of, z), k, 1000.0 / scale))
    finest = max((1000.0 / entry["depth_scale"] for entry in tree.values()), default=UNITS_PER_M)
    return _recorded(path, frames, (), min(max(finest, UNITS_PER_M), 10_000.0))


def _bop_file(path: Path, folders: tuple[str, ...], number: int) -> Path:
    names = [f"{folder}/{number:06d}.{end}" for folder in folders for end in ("png", "jpg", "tif", "tiff")]
    file = next((path / name for name in names if (path / name).is_file()), None)
    if file is None:
        raise CaptureError("missing", f"{path} has no {names[0]}, nor another of {', '.join(names[1:])}")
    return file


CAMERA_JSON = "camera.json"
OPEN3D_FILES = ("intrinsic.json", "camera_intrinsic.json", CAMERA_JSON)


def _open3d_folder(path: Path) -> Path | None:
    """The folder of colour images, of which depth/ has one each by the same name."""
    color = next((path / name for name in ("color", "rgb") if (path / name).is_dir()), None)
    return color if (path / "depth").is_dir() else None


def _images_in(folder: Path) -> list[Path]:
    """Its files in the order of the numbers in their names, 9 before 10, without those that systems leave in every folder."""
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith((".", "Thumbs.db"))]
    return sorted(files, key=lambda file: re.sub(r"[0-9]+", lambda number: number[0].zfill(20), file.name))


def _open3d_camera(path: Path, size: Size) -> tuple[Seen, str]:
    """The camera of images of a size by Open3D's file, or what is missing. A camera.json may be one of ours."""
    for described in (path / name for name in OPEN3D_FILES if (path / name).is_file()):
        tree = _tree_of(described)
        matrix = tree.get("intrinsic_matrix") if isinstance(tree, dict) else None
        if isinstance(matrix, list) and len(matrix) == 9:
            stated = tuple(tree.get(name, side) for name, side in zip(("width", "height"), size, strict=True))
            if stated != size:
                return size, f"{described.name} is of {stated[0]} x {stated[1]}, its images are {size[0]} x {size[1]}"
            return read_intrinsics(described, size, (matrix[i] for i in (0, 4, 6, 7)), 0.0), ""
        if described.name != CAMERA_JSON:
            raise _wrong(described, "has no intrinsic_matrix of nine numbers, column by column")
    return size, f"it has no {OPEN3D_FILES[0]}"


def _open_open3d(path: Path, units_per_m: float = UNITS_PER_M) -> Recorded:
    folder = _open3d_folder(path) or path
    color, depth = _images_in(folder), _images_in(path / "depth")
    if not color or [file.stem for file in color] != [file.stem for file in depth]:
        counts = f"{len(color)} images in {folder.name}/ and {len(depth)} in depth/"
        raise CaptureError("counts", f"{path} has {counts}, or of other names")
    (k, missing), frames = _open3d_camera(path, _size_of(color[0])), []
    for number, (rgb, z) in enumerate(zip(color, depth, strict=True)):
        frames.append(_color(number * NO_TIME_US, partial(_bytes_of, rgb), k))
        frames.append(_depth(number * NO_TIME_US, partial(_bytes_of, z), k, units_per_m))
    return _recorded(path, frames, (), units_per_m, missing=missing, with_units=partial(_open_open3d, path))


# ---------------------------------------------------------------------------------------------- Apple's


def _is_record3d(path: Path) -> bool:
    if not path.is_file() or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return "metadata" in archive.namelist()


def _open_record3d(path: Path) -> Recorded:
    tree = _tree_of(path, _member(path, "metadata"))
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
    numbers = sorted(int(match[1]) for name in names if (match := re.fullmatch(r"rgbd/([0-9]{1,9})\.jpg", name)))
    with as_refusal(f"{path}: its metadata", CaptureError):
        size, depth_size = ((int(tree[w]), int(tree[h])) for w, h in (("w", "h"), ("dw", "dh")))
        K = tree.get("K") or [0] * 9
        of_frames = tree.get("perFrameIntrinsicCoeffs") or []
        times = tree.get("frameTimestamps") or [n / float(tree.get("fps", 30)) for n in range(len(numbers))]
        stamps = [round(float(times[n]) * 1e6) for n in numbers]
        cameras = [of_frames[n] if n < len(of_frames) else (K[0], K[4], K[6], K[7]) for n in numbers]
    if not all(0 < side <= 20_000 for side in (*size, *depth_size)):
        raise _wrong(path, f"images of {size} and depth of {depth_size} cannot be")
    frames = []
    for number, stamp, camera in zip(numbers, stamps, cameras, strict=True):
        k = read_intrinsics(path, size, camera, 0.5)
        frames.append(_color(stamp, _member(path, f"rgbd/{number}.jpg"), k))
        if f"rgbd/{number}.depth" in names:
            sure = _member(path, name) if (name := f"rgbd/{number}.conf") in names else None
            frames.append(_depth(stamp, _member(path, f"rgbd/{number}.depth"), k, 1000.0, depth_size, sure))
    return _recorded(path, frames)


def _member(path: Path, name: str) -> Read:
    """Of an archive, read when it is asked for; a bomb is refused by what comes out."""

    def read() -> bytes:
        with as_refusal(f"{path}: {name}", CaptureError):
            with zipfile.ZipFile(path) as archive, archive.open(name) as stream:
                data = stream.read(MOST_BYTES + 1)
            if len(data) > MOST_BYTES:
                raise ValueError(f"unpacks to more than {MOST_BYTES // 1_000_000} MB")
            return data

    return read


def _of_phone(
    stamp_us: int, described: Path, numbers: Iterable[Any], color: Path, depth: Path, sure: Path
) -> Iterator[RecordedFrame]:
    """The frames of a moment, of files: colour, with the camera's numbers, and depth and its confidence where they are there."""
    k = read_intrinsics(described, _size_of(color), numbers, 0.5)
    yield _color(stamp_us, partial(_bytes_of, color), k)
    if depth.is_file():
        confidence = partial(_bytes_of, sure) if sure.is_file() else None
        yield _depth(stamp_us, partial(_bytes_of, depth), k, 1000.0, _size_of(depth), confidence)


def _keyframes(path: Path) -> Path:
    return path / "keyframes" if (path / "keyframes").is_dir() else path


def _open_polycam(path: Path) -> Recorded:
    root, frames = _keyframes(path), list[RecordedFrame]()
    for described in sorted((root / "cameras").glob("*.json")):
        tree, name = _tree_of(described), described.stem
        if not name.isdecimal() or not isinstance(tree, dict) or not {"fx", "fy", "cx", "cy"} <= set(tree):
            raise _wrong(described, "must be named by its time and have fx, fy, cx and cy")
        files = (root / "images" / f"{name}.jpg", root / "depth" / f"{name}.png", root / "confidence" / f"{name}.png")
        frames += _of_phone(int(name), described, (tree[key] for key in ("fx", "fy", "cx", "cy")), *files)
    return _recorded(path, frames)


ARKIT_FOLDERS = ("lowres_wide", "lowres_depth", "lowres_wide_intrinsics")


def _open_arkit(path: Path) -> Recorded:
    color, depth, described = (path / name for name in ARKIT_FOLDERS)
    cameras = {_milliseconds(file): file for file in described.glob("*.pincam")}
    frames = list[RecordedFrame]()
    for file in sorted(color.glob("*.png")):
        at = _milliseconds(file)
        camera = next((cameras[at + off] for off in (0, 1, -1) if at + off in cameras), None)  # their times are rounded
        if camera is None:
            raise CaptureError("missing", f"{described} has no camera for {file.name}")
        numbers = _bytes_of(camera).decode("utf-8", "replace").split()[2:]
        frames += _of_phone(1000 * at, camera, numbers, file, depth / file.name, path / "confidence" / file.name)
    return _recorded(path, frames)


def _milliseconds(path: Path) -> int:
    """Of the name VIDEO_SECONDS. Raises CaptureError."""
    match = re.fullmatch(r"[0-9]+_([0-9]{1,9}(?:\.[0-9]{1,6})?)", path.stem)
    if not match:
        raise _wrong(path, "must be named VIDEO_SECONDS, such as 41069021_305.377.png")
    return round(float(match[1]) * 1000)


# ---------------------------------------------------------------------------------------------- all formats


@dataclass(frozen=True)
class Reader:
    """One format: its name, whether a path is of it by a glance, and what opens it (raises CaptureError)."""

    name: str
    sniff: Callable[[Path], bool]
    open: Callable[[Path], Recorded]


def _has(path: Path, *names: str) -> bool:
    return all((path / name).exists() for name in names)


READERS = (
    Reader("an Azure Kinect recording (.mkv)", is_kinect, open_kinect),
    Reader("a ROS bag of a RealSense or an Azure Kinect (.bag, .db3, .mcap)", is_bag, open_bag),
    Reader("a TUM RGB-D folder (rgb.txt, depth.txt)", lambda path: _has(path, "rgb.txt", "depth.txt"), _open_tum),
    Reader("a BOP scene (scene_camera.json, rgb/ or gray/, depth/)", lambda path: _has(path, BOP_FILE), _open_bop),
    Reader("an Open3D folder (color/ or rgb/, depth/)", lambda path: bool(_open3d_folder(path)), _open_open3d),
    Reader("a Record3D file (.r3d)", _is_record3d, _open_record3d),
    Reader(
        "Polycam's raw data (keyframes/)",
        lambda path: _has(_keyframes(path), "images", "depth", "cameras"),
        _open_polycam,
    ),
    Reader("an ARKitScenes folder (lowres_wide/, lowres_depth/)", lambda path: _has(path, *ARKIT_FOLDERS), _open_arkit),
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
