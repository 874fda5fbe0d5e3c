"""A capture's folder: its photographs, cameras and board, and the truth of a simulated one. Read and written here alone.

    camera.json  board.json  capture.json (name and category; may be missing)
    rgb_00000.png  depth_00000.png  mask_00000.png  board_00000.txt  correction_00000.txt
    truth/       what a simulation knows, for evaluation alone: truth.json (poses, print scale, depth camera, lens, receipt
                 of effects), mesh.glb (the true object in its own frame, metres, z up), mask_00000.png, held_out/

Depth and masks may be missing, in some views or in all. camera.json has width, height, fx, fy, cx, cy, `pixel_centre`
("0" as in OpenCV and the Azure Kinect's calibration, or "0.5" from the image's edge), `distortion` (OpenCV's order, 0
to 8 numbers), `depth_units_per_m` and `depth` ("z", or "ray" for distances along the ray).
board.json is the job file's branch `captures.board`.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from schemas.base import Array, Frozen, Pose, Positive, PositiveInt, Text, frozen_array
from schemas.capture import CaptureCamera, CapturedView, CaptureTruth
from schemas.errors import CaptureError
from schemas.job.captures import Board, BoardFrame
from schemas.job.views import Distortion
from schemas.scene.view import Intrinsics
from workers.geometry.lens import pixel_rays
from workers.store.images import encode_mask, encode_png

CAMERA_FILE, BOARD_FILE, CAPTURE_FILE, TRUTH = "camera.json", "board.json", "capture.json", "truth"
Model = TypeVar("Model", bound=Frozen)
_FILE_OF_VIEW = re.compile(r"(rgb|depth|mask|board|correction)_([0-9]{1,9})\.(png|txt)")


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
    distortion: Annotated[list[float], Field(max_length=8)] = Field(default_factory=list)
    depth_units_per_m: Positive = 1000.0
    depth: Literal["z", "ray"] = "z"
    """What a pixel of depth measures: z along the optical axis, or the distance along its ray."""


class CaptureFile(Frozen):
    """capture.json."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    category: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")] = "object"
    licence: Text = "unknown"
    frame: BoardFrame = "centre"
    """Frame of the files board_ and correction_ that others made."""


@dataclass(frozen=True)
class CaptureFolder:
    """An opened capture: its camera, its board, and the numbers of its views in ascending order."""

    path: Path
    about: CaptureFile
    camera: CaptureCamera
    board: Board
    numbers: tuple[int, ...]


def open_folder(path: Path) -> CaptureFolder:
    """Reads what describes a capture; images are read one view at a time. Raises CaptureError that names file and remedy."""
    if not path.is_dir():
        raise CaptureError("missing", f"{path} is no folder")
    numbers = _view_numbers(path)
    spec = _read_json(path / CAMERA_FILE, CameraFile)
    about = (
        _read_json(path / CAPTURE_FILE, CaptureFile)
        if (path / CAPTURE_FILE).exists()
        else CaptureFile(name=derive_name(path.resolve().name))
    )
    return CaptureFolder(path, about, camera_of(spec), _read_json(path / BOARD_FILE, Board), tuple(numbers))


def derive_name(words: str) -> str:
    """A name for capture.json from any words: what a name cannot have becomes `_`."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", words).lstrip("._-")[:64] or "capture"


def _view_numbers(path: Path) -> list[int]:
    """Numbers of the views, ascending. Raises CaptureError for a file of a view whose rgb_ is missing, and for odd names."""
    found: dict[str, set[int]] = {}
    for file in sorted(path.iterdir()):
        if match := _FILE_OF_VIEW.fullmatch(file.name):
            kind, digits, ending = match.groups()
            if digits != f"{int(digits):05d}":
                raise CaptureError("name", f"{file} must be named {kind}_{int(digits):05d}.{ending}")
            found.setdefault(kind, set()).add(int(digits))
    rgb = found.pop("rgb", set())
    if not rgb:
        raise CaptureError(
            "missing", f"{path} has no rgb_00000.png: images are named rgb_, depth_ and mask_ with a number"
        )
    for kind, numbers in found.items():
        if alone := sorted(numbers - rgb):
            name, counts = f"{kind}_{alone[0]:05d}", f"{len(rgb)} rgb_ and {len(numbers)} {kind}_"
            raise CaptureError("counts", f"{path}: {name} has no rgb_{alone[0]:05d}.png ({counts}): copy it again")
    return sorted(rgb)


def read_board(path: Path) -> Board:
    """The board of a board.json, wherever it is. Raises CaptureError that names the file."""
    if not path.exists():
        raise CaptureError("missing", f"{path} is not there: `verso capture board` writes one beside the print")
    return _read_json(path, Board)


def read_view(folder: CaptureFolder, number: int) -> CapturedView:
    """One view's images, depth as z. Raises CaptureError where one cannot be read or has the wrong size."""
    rgb = _read_image(folder, f"rgb_{number:05d}.png", cv2.IMREAD_COLOR_RGB, np.uint8)
    assert rgb is not None
    depth = _read_image(folder, f"depth_{number:05d}.png", cv2.IMREAD_UNCHANGED, np.uint16, optional=True)
    if depth is not None and folder.camera.depth == "ray":
        depth = depth_along_axis(depth, folder.camera)
    mask = _read_image(folder, f"mask_{number:05d}.png", cv2.IMREAD_GRAYSCALE, np.uint8, optional=True)
    return CapturedView(number, rgb, depth, None if mask is None else mask > 0)


def depth_along_axis(along_ray: NDArray[np.uint16], camera: CaptureCamera) -> NDArray[np.uint16]:
    """[H, W] z of distances along the ray [H, W], in the same units; 0 where the lens has no ray."""
    rays = pixel_rays(camera.intrinsics, camera.lens)
    return np.rint(np.nan_to_num(along_ray / np.sqrt(1.0 + (rays**2).sum(axis=2)))).astype(np.uint16)


def write_view(path: Path, view: CapturedView) -> None:
    """Writes one view's images below a folder that exists."""
    (path / f"rgb_{view.number:05d}.png").write_bytes(encode_png(view.rgb))
    if view.depth is not None:
        (path / f"depth_{view.number:05d}.png").write_bytes(encode_png(view.depth))
    if view.mask is not None:
        (path / f"mask_{view.number:05d}.png").write_bytes(encode_mask(view.mask))


def write_description(path: Path, about: CaptureFile, camera: CaptureCamera, board: Board) -> None:
    """Writes camera.json, board.json and capture.json; the principal point with pixel centres at 0, as the Kinect has it."""
    for name, model in ((CAMERA_FILE, describe_camera(camera)), (BOARD_FILE, board), (CAPTURE_FILE, about)):
        (path / name).write_text(model.model_dump_json(indent=1) + "\n", encoding="utf-8")


def describe_camera(camera: CaptureCamera) -> CameraFile:
    """What camera.json says of a camera."""
    k = camera.intrinsics
    return CameraFile(
        **k.model_dump(include={"width", "height", "fx", "fy"}),
        cx=k.cx_opencv,
        cy=k.cy_opencv,
        pixel_centre="0",
        distortion=[float(x) for x in camera.lens] if camera.has_lens else [],
        depth_units_per_m=camera.depth_units_per_m,
        depth=camera.depth,
    )


def read_pose(path: Path) -> Pose | None:
    """[4, 4] float64 of a file of four lines of four numbers, None where there is none. Raises CaptureError."""
    if not path.exists():
        return None
    try:
        T = np.array(
            [line.split() for line in path.read_text(encoding="utf-8").splitlines() if line.strip()], np.float64
        )
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
    """The camera that camera.json describes."""
    shift = 0.5 - float(spec.pixel_centre)
    lens: Array = np.zeros(8)
    lens[: len(spec.distortion)] = spec.distortion
    lens.setflags(write=False)
    size = spec.model_dump(include={"width", "height", "fx", "fy"})
    k = Intrinsics(**size, cx=spec.cx + shift, cy=spec.cy + shift)
    return CaptureCamera(k, lens, spec.depth_units_per_m, spec.depth)


def _read_json(path: Path, model: type[Model]) -> Model:
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


def _read_image(folder: CaptureFolder, name: str, flags: int, dtype: type, optional: bool = False) -> NDArray | None:
    path = folder.path / name
    if not path.exists():
        if optional:
            return None
        raise CaptureError("missing", f"{folder.path} has no {name}")
    image = cv2.imdecode(np.frombuffer(path.read_bytes() or b"\0", np.uint8), flags)
    if image is None:
        raise CaptureError("unreadable", f"{path} is no image that can be read: take it out, or copy it again")
    k = folder.camera.intrinsics
    if (
        image.dtype != dtype
        or image.shape[:2] != (k.height, k.width)
        or image.ndim != (3 if flags == cv2.IMREAD_COLOR_RGB else 2)
    ):
        kind = (
            f"{image.shape[1]} x {image.shape[0]} of {image.dtype}, {1 if image.ndim == 2 else image.shape[2]} channels"
        )
        raise CaptureError("size", f"{path} is {kind}, and camera.json says {k.width} x {k.height} ({np.dtype(dtype)})")
    return image


TRUTH_FILE, MESH_FILE, HELD_OUT = "truth.json", "mesh.glb", "held_out"


@dataclass(frozen=True, eq=False)
class TrueObject:
    """The object of a capture: its asset's names, and its mesh as the bytes of a GLB file in the object frame."""

    category: str
    instance_id: str
    glb: bytes


def write_truth(
    path: Path, truth: CaptureTruth, thing: TrueObject, ran: tuple[str, ...], skipped: Mapping[str, str]
) -> None:
    """Writes truth.json and mesh.glb below a capture's folder; `ran` and `skipped` are the receipt of effects."""
    record = {
        "object": {"category": thing.category, "instance_id": thing.instance_id, "mesh": MESH_FILE},
        "T_board_cam": [T.tolist() for T in truth.T_board_cam],
        "T_board_obj": truth.T_board_obj.tolist(),
        "print_scale": truth.print_scale,
        "T_color_depth": truth.T_color_depth.tolist(),
        "depth_bias_m": truth.depth_bias_m,
        "lens": None if truth.lens is None else truth.lens.model_dump(),
        "effects": list(ran),
        "skipped": [{"effect": name, "why": why} for name, why in skipped.items()],
    }
    folder = path / TRUTH
    folder.mkdir(exist_ok=True)
    (folder / MESH_FILE).write_bytes(thing.glb)
    (folder / TRUTH_FILE).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def write_true_mask(path: Path, number: int, mask: NDArray[np.bool_]) -> None:
    """Writes the object's true pixels [H, W] of one view."""
    folder = path / TRUTH
    folder.mkdir(exist_ok=True)
    (folder / f"mask_{number:05d}.png").write_bytes(encode_mask(mask))


def read_truth(path: Path) -> CaptureTruth | None:
    """What a capture's folder says of its truth; None where it has none. Raises CaptureError where it cannot be read."""
    file = path / TRUTH / TRUTH_FILE
    if not file.exists():
        return None
    try:
        record: dict[str, Any] = json.loads(file.read_bytes())
        lens = record["lens"]
        return CaptureTruth(
            T_board_cam=frozen_array(record["T_board_cam"]).reshape(-1, 4, 4),
            T_board_obj=frozen_array(record["T_board_obj"]).reshape(4, 4),
            print_scale=float(record["print_scale"]),
            T_color_depth=frozen_array(record["T_color_depth"]).reshape(4, 4),
            depth_bias_m=float(record["depth_bias_m"]),
            lens=None if lens is None else Distortion(**lens),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise CaptureError("unreadable", f"{file} is no truth of a simulated capture: {error!r}") from error


def read_receipt(path: Path) -> tuple[tuple[str, ...], tuple[dict[str, str], ...]]:
    """(names of the effects that ran, [{effect, why}] of those that did not) of a simulated capture's folder."""
    record = json.loads((path / TRUTH / TRUTH_FILE).read_bytes())
    return tuple(record["effects"]), tuple(record["skipped"])
