"""A pair as it is stored, and what every definition starts from. Imports nothing of the project, as all of this package.

Matrices are [4, 4] float64, `T_a_b` takes frame b to frame a, metres; camera frames are optical (x right, y down, z forward).
A pixel (column, row) has its centre at (column + 0.5, row + 0.5).
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Row = Mapping[str, Any]
Array = NDArray[np.float64]

ROUNDING = 1e-9
"""Largest difference of poses, distances and angles (metres, radians) between two orders of the same arithmetic."""

FLOOR, TABLE, FIRST_OBJECT = 1, 2, 3

IMAGES = {
    "input": {"rgb": "RGB", "depth": "depth", "region": "segment"},
    "aligned": {"rgb": "RGBaligned", "depth": "depthAligned", "region": "segmentAligned"},
    "mirror": {"rgb": "RGB", "depth": "depth", "region": "segment"},
    "projected": {"rgb": "RGBprojected", "depth": "depthProjected"},
}
"""Content word of each image, by role and kind of pixel."""


@dataclass(frozen=True)
class StoredPair:
    """The job's keys, the rows of one pair (views by role), and a function that reads a file by its path."""

    job: Mapping[str, Any]
    scene: Row
    views: Mapping[str, Row]
    objects: Sequence[Row]
    read: Callable[[str], bytes]
    images: dict[tuple[str, str], NDArray] = field(default_factory=dict)
    """Decoded images by role and kind of pixel."""


def read_images(pair: StoredPair, view: Row) -> Iterator[str]:
    """Decode the view's images; yield those of a wrong type or size, and files that differ from their row's digest."""
    role, size = view["role"], (view["height"], view["width"])
    for kind in kinds_of(pair, role):
        path = path_of(view, kind)
        image = pair.images[role, kind] = decode(pair.read(path))
        dtype, shape = (np.uint16 if kind == "depth" else np.uint8), ((*size, 3) if kind == "rgb" else size)
        if image.dtype != dtype or image.shape != shape:
            yield f"{path}: is {image.dtype} {image.shape}, and must be {np.dtype(dtype)} {shape}"
    for file in view["files"]:
        data = pair.read(file["path"])
        if (len(data), hashlib.sha256(data).hexdigest()) != (file["bytes"], file["sha256"]):
            yield f"{file['path']}: bytes or sha256 in views are not the file's"


def path_of(view: Row, kind: str, folder: str = "", suffix: str = "") -> str:
    """`mug/depth00000.png`: the mirror camera's own images have the mirror's odd id, all others the input's."""
    number = view["parent_id"] + (view["role"] == "mirror")
    return f"{view['category']}/{folder}{IMAGES[view['role']][kind]}{number:05d}{suffix}.png"


def kinds_of(pair: StoredPair, role: str) -> list[str]:
    """Kinds of pixel that the job stores of a view."""
    return [kind for kind in IMAGES[role] if kind != "rgb" or pair.job["render"]["rgb"]]


def decode(data: bytes) -> NDArray:
    """[H, W] or [H, W, 3] RGB; empty where the bytes are no image."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        return np.zeros(0)
    return image[:, :, ::-1] if image.ndim == 3 else image


def matrix(row: Row, name: str) -> Array:
    """[4, 4] from 16 numbers, row-major."""
    return np.array(row[name], np.float64).reshape(4, 4)


def distance(a: Array, b: Array) -> float:
    """Largest difference of two arrays' elements."""
    return float(np.abs(a - b).max())


def unproject(pair: StoredPair, view: Row, chosen: NDArray[np.bool_] | np.bool_) -> tuple[Array, NDArray[np.int64]]:
    """([4, N] homogeneous points in the camera's frame of the chosen pixels that have depth, their flat indices [N])."""
    depth = pair.images[view["role"], "depth"]
    rows, columns = np.nonzero(chosen & (depth > 0))
    z = depth[rows, columns] / view["depth_units_per_m"]
    x, y = (columns + 0.5 - view["cx"]) / view["fx"] * z, (rows + 0.5 - view["cy"]) / view["fy"] * z
    return np.stack([x, y, z, np.ones_like(z)]), rows * view["width"] + columns
