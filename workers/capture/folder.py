"""A capture's folder: its photographs, cameras and board. Read and written here alone.

    camera.json  board.json  capture.json (name and category; may be missing)
    rgb_00000.png  depth_00000.png  mask_00000.png  board_00000.txt  correction_00000.txt  camera_00000.json
    truth/       what a simulation knows (truth.py)

Depth and masks may be missing, in some views or in all. camera.json has width, height, fx, fy, cx, cy, `pixel_centre`
("0" as in OpenCV and the Azure Kinect's calibration, or "0.5" from the image's edge), `distortion` (OpenCV's order, up
to 14 numbers, or 4 with `lens_model` "fisheye"), `depth_units_per_m`, `depth` ("z", or "ray" for distances
along the ray), and `depth_camera` where depth is not registered.
camera_00000.json has fx, fy, cx and cy of one view, where they change. board.json is the job file's branch `captures.board`.

What is read has one camera: pictures of other intrinsics are resampled, lenses beyond eight numbers are taken out, and depth
of another camera is registered.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from schemas.base import Array, Frozen, Pose, Positive, PositiveInt, Text, frozen_array
from schemas.capture import CaptureCamera, CapturedView, DepthCamera
from schemas.errors import CaptureError
from schemas.job.captures import Board, BoardFrame
from schemas.scene.view import Intrinsics
from workers.door.recordings.pictures import PictureError, change_camera, decode_depth, pinhole_maps, remap
from workers.geometry.pixels import pixel_rays
from workers.geometry.zbuffer import register_depth
from workers.store.images import encode_mask, encode_png

CAMERA_FILE, BOARD_FILE, CAPTURE_FILE = "camera.json", "board.json", "capture.json"
Matrix = Annotated[list[Annotated[list[float], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)]
Model = TypeVar("Model", bound=Frozen)
ENDINGS = {
    "rgb": ("png", "jpg", "jpeg"),
    "depth": ("png", "npy", "tif", "tiff", "exr", "depth"),
    "mask": ("png",),
    "board": ("txt",),
    "correction": ("txt",),
    "camera": ("json",),
}
"""Of the files of a view, by their first word; one file a kind and view."""
FILE_OF_VIEW = re.compile("|".join(rf"{kind}_[0-9]{{1,9}}\.(?:{'|'.join(ends)})" for kind, ends in ENDINGS.items()))


class ViewFile(Frozen):
    """camera_00000.json: intrinsics of one view."""

    fx: Positive
    fy: Positive
    cx: float
    cy: float


class DepthFile(ViewFile):
    """`depth_camera` of camera.json."""

    width: PositiveInt
    height: PositiveInt
    distortion: Annotated[list[float], Field(max_length=8)] = Field(default_factory=list)
    T_color_depth: Matrix
    """Takes coordinates of the depth camera to the colour camera's, metres."""

    @model_validator(mode="after")
    def _has_a_rigid_transform(self) -> "DepthFile":
        if not _is_rigid(np.array(self.T_color_depth)):
            raise ValueError("T_color_depth is no rigid transform: 4 rows of 4, the last 0 0 0 1")
        return self


class CameraFile(Frozen):
    """camera.json."""

    width: PositiveInt
    height: PositiveInt
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    pixel_centre: Literal["0", "0.5"]
    """Coordinate of the first pixel's centre."""
    distortion: Annotated[list[float], Field(max_length=14)] = Field(default_factory=list)
    lens_model: Literal["opencv", "fisheye"] = "opencv"
    depth_units_per_m: Positive = 1000.0
    depth: Literal["z", "ray"] = "z"
    """What a pixel of depth measures: z along the optical axis, or the distance along its ray."""
    depth_camera: DepthFile | None = None
    """The camera of depth that is not registered to colour; its principal point counts as the colour camera's."""

    @model_validator(mode="after")
    def _has_a_lens(self) -> "CameraFile":
        count, fisheye = len(self.distortion), self.lens_model == "fisheye"
        if (count != 4) if fisheye else count in (9, 10, 11, 13):
            known = "4 of fisheye" if fisheye else "4, 5, 8, 12 or 14"
            raise ValueError(f"distortion has {count} numbers: OpenCV's lenses have {known}")
        return self


class CaptureFile(Frozen):
    """capture.json."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    category: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")] = "object"
    licence: Text = "unknown"
    frame: BoardFrame = "centre"
    """Frame of the files board_ and correction_ that others made."""


@dataclass(frozen=True)
class CaptureFolder:
    """An opened capture: its camera, its board, and the numbers of its views in ascending order.

    `camera` is that of what `read_view` gives, and `stored` what camera.json says of the files.
    """

    path: Path
    about: CaptureFile
    camera: CaptureCamera
    board: Board
    numbers: tuple[int, ...]
    stored: CameraFile

    def file(self, kind: str, number: int) -> Path | None:
        """The file of a kind (a key of ENDINGS) and view, None where there is none."""
        names = (self.path / f"{kind}_{number:05d}.{ending}" for ending in ENDINGS[kind])
        return next((name for name in names if name.exists()), None)


def open_folder(path: Path, board: Board | None = None) -> CaptureFolder:
    """Reads what describes a capture; images are read one view at a time. Raises CaptureError that names file and remedy.

    With a `board` there need be no board.json.
    """
    if not path.is_dir():
        raise CaptureError("missing", f"{path}: there is no such folder")
    numbers, spec, about = _view_numbers(path), read_json(path / CAMERA_FILE, CameraFile), path / CAPTURE_FILE
    described = read_json(about, CaptureFile) if about.exists() else CaptureFile(name=derive_name(path.resolve().name))
    board = board or read_json(path / BOARD_FILE, Board)
    return CaptureFolder(path, described, camera_of(spec), board, tuple(numbers), spec)


def derive_name(words: str) -> str:
    """A name for capture.json from any words: what a name cannot have becomes `_`."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", words).lstrip("._-")[:64] or "capture"


def _view_numbers(path: Path) -> list[int]:
    """Numbers of the views, ascending. Raises CaptureError for a file of a view whose rgb_ is missing, and for odd names."""
    numbers: dict[str, set[int]] = {"rgb": set()}
    for file in sorted(path.iterdir()):
        if FILE_OF_VIEW.fullmatch(file.name):
            kind, digits, ending = re.split("[_.]", file.name)
            number = int(digits)
            if digits != f"{number:05d}":
                raise CaptureError("name", f"{file} must be named {kind}_{number:05d}.{ending}")
            if number in numbers.setdefault(kind, set()):
                raise CaptureError("name", f"{path} has two files {kind}_{digits}: keep one of them")
            numbers[kind].add(number)
    rgb = numbers["rgb"]
    if not rgb:
        raise CaptureError(
            "missing", f"{path} has no rgb_00000.png: images are named rgb_, depth_ and mask_ with a number"
        )
    for kind, of_kind in numbers.items():
        if alone := sorted(of_kind - rgb):
            name, counts = f"{kind}_{alone[0]:05d}", f"{len(rgb)} rgb_ and {len(of_kind)} {kind}_"
            raise CaptureError("counts", f"{path}: {name} has no rgb_{alone[0]:05d}.png ({counts}): copy it again")
    return sorted(rgb)


def read_board(path: Path) -> Board:
    """The board of a board.json, wherever it is. Raises CaptureError that names the file."""
    if not path.exists():
        raise CaptureError("missing", f"{path} is not there: `verso capture board` writes one beside the print")
    return read_json(path, Board)


def read_view(folder: CaptureFolder, number: int, masked: bool = True) -> CapturedView:
    """One view's images, with its mask if wanted. Raises CaptureError where one cannot be read or has the wrong size."""
    common, path = folder.camera.intrinsics, folder.file("camera", number)
    k = common if path is None else _intrinsics(folder.stored, read_json(path, ViewFile))
    images = {}
    for kind, flags, ndim in (("rgb", cv2.IMREAD_COLOR_RGB, 3), ("mask", cv2.IMREAD_GRAYSCALE, 2)):
        if (path := folder.file(kind, number)) and (masked or kind != "mask"):
            image = _decoded(folder, path, flags | cv2.IMREAD_IGNORE_ORIENTATION, np.uint8, ndim)
            images[kind] = _as_read(folder, image, k, between=kind == "rgb")
    if "rgb" not in images:
        raise CaptureError("missing", f"{folder.path} has no rgb_{number:05d}.png")
    mask = images["mask"] > 0 if "mask" in images else None
    return CapturedView(number, images["rgb"], _read_depth(folder, number, k), mask)


def _as_read(folder: CaptureFolder, image: NDArray, k: Intrinsics, between: bool) -> NDArray:
    """An image of a view's intrinsics and of any lens as the folder's camera has it."""
    stored = folder.stored
    common = _intrinsics(stored, stored)  # the markers' camera may be in place of it
    if k != folder.camera.intrinsics:
        image = change_camera(image, k, common, between)
    if not is_taken_out(stored):
        return image
    return remap(image, pinhole_maps(common, tuple(stored.distortion), stored.lens_model == "fisheye"), between)


def _read_depth(folder: CaptureFolder, number: int, k: Intrinsics) -> NDArray[np.uint16] | None:
    """[H, W] in the folder's camera and units, None where the view has none."""
    path, spec, to = folder.file("depth", number), folder.stored.depth_camera, folder.camera
    if path is None:
        return None
    size = (folder.stored.width, folder.stored.height) if spec is None else (spec.width, spec.height)
    if path.suffix == ".png" and spec is None:
        units, per_m = _decoded(folder, path, cv2.IMREAD_UNCHANGED, np.uint16, 2), folder.stored.depth_units_per_m
        if to.depth == "z" and to.depth_units_per_m == per_m:  # as it is: all others make metres of millions of pixels
            return _as_read(folder, units, k, between=False)
        depth_m = units / per_m
    else:
        try:
            depth_m = decode_depth(path.read_bytes(), size, folder.stored.depth_units_per_m)
        except PictureError as error:
            raise CaptureError("unreadable", f"{path} {error}") from error
    if spec is None:
        camera = DepthCamera(to.intrinsics, to.lens, np.eye(4))
        depth_m = _as_read(folder, depth_m, k, between=False)
    else:
        T_color_depth = frozen_array(np.array(spec.T_color_depth))
        camera = DepthCamera(_intrinsics(folder.stored, spec), _eight(spec.distortion), T_color_depth)
    if to.depth == "ray":  # 0 where the lens has no ray
        rays = pixel_rays(camera.intrinsics, camera.lens)
        depth_m = np.nan_to_num(depth_m / np.sqrt(1.0 + (rays**2).sum(axis=2)))
    if spec is not None:
        depth_m = register_depth(depth_m, camera, to.intrinsics, to.lens)
    return stored_depth(depth_m, to.depth_units_per_m)


def stored_depth(depth_m: Array, units_per_m: float) -> NDArray[np.uint16]:
    """[H, W]: depth [H, W], metres, in units; what is beyond 16 bits is none."""
    units = np.rint(depth_m * units_per_m)
    return np.where(units < 65536.0, units, 0.0).astype(np.uint16)


def write_view(path: Path, view: CapturedView) -> None:
    """Writes one view's images below a folder that exists."""
    (path / f"rgb_{view.number:05d}.png").write_bytes(encode_png(view.rgb))
    if view.depth is not None:
        (path / f"depth_{view.number:05d}.png").write_bytes(encode_png(view.depth))
    if view.mask is not None:
        (path / f"mask_{view.number:05d}.png").write_bytes(encode_mask(view.mask))


def write_description(path: Path, about: CaptureFile, camera: CaptureCamera | CameraFile, board: Board) -> None:
    """Writes camera.json, board.json and capture.json."""
    spec = camera if isinstance(camera, CameraFile) else describe_camera(camera)
    for name, model in ((CAMERA_FILE, spec), (BOARD_FILE, board), (CAPTURE_FILE, about)):
        (path / name).write_text(model.model_dump_json(indent=1, exclude=board.unwritten) + "\n", encoding="utf-8")


def describe_camera(camera: CaptureCamera) -> CameraFile:
    """What camera.json says of a camera; the principal point with pixel centres at 0, as the Kinect has it."""
    k = camera.intrinsics
    return CameraFile(
        **k.model_dump(include={"width", "height", "fx", "fy"}),
        cx=k.cx_opencv,
        cy=k.cy_opencv,
        pixel_centre="0",
        distortion=camera.lens.tolist() if camera.has_lens else [],
        depth_units_per_m=camera.depth_units_per_m,
        depth=camera.depth,
    )


def read_pose(path: Path) -> Pose | None:
    """[4, 4] float64 of a file of four lines of four numbers, None where there is none. Raises CaptureError."""
    if not path.exists():
        return None
    try:
        rows = [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()]
        T = np.array(rows, np.float64)
    except ValueError as error:
        raise CaptureError("unreadable", f"{path} is no matrix of numbers: {error}") from error
    if T.shape != (4, 4) or not np.isfinite(T).all() or not _is_rigid(T):
        raise CaptureError("unreadable", f"{path} must hold a rigid transform: 4 lines of 4 numbers, the last 0 0 0 1")
    return T


def write_pose(path: Path, T: Pose) -> None:
    """Writes 4 lines of 4 numbers that read back to the same doubles."""
    path.write_text(pose_text(T), encoding="utf-8")


def pose_text(T: Pose) -> str:
    """4 lines of 4 numbers that read back to the same doubles."""
    return "\n".join(" ".join(repr(float(x)) for x in row) for row in T) + "\n"


def _is_rigid(T: Pose) -> bool:
    R = T[:3, :3]
    return bool(
        np.abs(R @ R.T - np.eye(3)).max() < 1e-4 and np.linalg.det(R) > 0 and np.array_equal(T[3], [0, 0, 0, 1])
    )


def camera_of(spec: CameraFile) -> CaptureCamera:
    """The camera that camera.json describes, as its pictures are read."""
    lens = _eight([] if is_taken_out(spec) else spec.distortion)
    return CaptureCamera(_intrinsics(spec, spec), lens, spec.depth_units_per_m, spec.depth)


def is_taken_out(spec: CameraFile) -> bool:
    """Whether the lens is none that the steps after this one know, so that pictures are read without it."""
    return spec.lens_model == "fisheye" or len(spec.distortion) > 8


def _eight(distortion: list[float]) -> Array:
    return frozen_array([*distortion, *[0.0] * (8 - len(distortion))])


def _intrinsics(whole: CameraFile, part: CameraFile | ViewFile) -> Intrinsics:
    """Of the camera, of one view or of depth, pixel centres at +0.5."""
    shift, size = 0.5 - float(whole.pixel_centre), part if isinstance(part, DepthFile) else whole
    numbers = {"fx": part.fx, "fy": part.fy, "cx": part.cx + shift, "cy": part.cy + shift}
    return Intrinsics(width=size.width, height=size.height, **numbers)


def read_json(path: Path, model: type[Model]) -> Model:
    """A file of JSON as its model. Raises CaptureError that names file and key."""
    try:
        return model.model_validate(json.loads(path.read_bytes(), parse_constant=_refuse_constant))
    except FileNotFoundError:
        raise CaptureError("missing", f"{path.parent} has no {path.name}") from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise CaptureError("unreadable", f"{path}: {key or 'the file'}: {first['msg']}") from error
    except (ValueError, RecursionError) as error:
        raise CaptureError("unreadable", f"{path} is no JSON: {error}") from error
    except OSError as error:
        raise CaptureError("unreadable", f"{path} cannot be read: {error.strerror or error}") from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")


def _decoded(folder: CaptureFolder, path: Path, flags: int, dtype: type, ndim: int) -> NDArray:
    """An image of the camera's size."""
    image = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), flags)
    if image is None:
        raise CaptureError("unreadable", f"{path} is no image that can be read: take it out, or copy it again")
    k = folder.stored
    if image.dtype != dtype or image.shape[:2] != (k.height, k.width) or image.ndim != ndim:
        channels = 1 if image.ndim == 2 else image.shape[2]
        kind = f"{image.shape[1]} x {image.shape[0]} of {image.dtype}, {channels} channels"
        depth = " (another size of depth: describe depth_camera)" if image.dtype == dtype == np.uint16 else ""
        wanted = f"{k.width} x {k.height} ({np.dtype(dtype)})"
        raise CaptureError("size", f"{path} is {kind}, and camera.json says {wanted}{depth}")
    return image
