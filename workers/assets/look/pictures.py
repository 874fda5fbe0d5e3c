"""Edge: the folders of pictures that a job's `look` names: each is read when a run begins, and again where it is drawn."""

import functools
import hashlib
import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from schemas.base import frozen_array
from schemas.errors import AssetSourceError, MeshError, VersoError
from schemas.job.assets import MeshLimits
from schemas.job.look import Look
from workers.door.meshes.raw import decode_picture, open_image
from workers.door.opening import as_refusal, read_bytes

SUFFIXES = (".jpg", ".jpeg", ".png")

LARGEST_PX = 8192
"""Longest side of a picture that is read."""

KEPT_PX = 1024
"""Longest side of a picture as it is drawn: a millimetre a pixel where it repeats after a metre."""

MOST_BYTES = 256 * 2**20
"""Of a picture's file."""

MOST_PICTURES = 10_000
"""Of a folder: each is read when a run begins."""

_LIMITS = MeshLimits(max_texture_px=LARGEST_PX)


@dataclass(frozen=True)
class Picture:
    """A picture of a folder: the folder, its path below that, and the SHA-256 of its bytes."""

    folder: Path
    name: str
    sha256: str


Pictures = Mapping[str, Sequence[Picture]]
"""The pictures of each folder that `look` names, by the key that names it, in order of their names."""


def open_pictures(look: Look, job_folder: Path) -> Pictures:
    """Every picture of the folders that `look` names but hidden ones, each read once.

    Raises AssetSourceError with the key and the file.
    """
    opened = {}
    for key, named in look.folders.items():
        folder = (job_folder / Path(named).expanduser()).resolve()
        if not folder.is_dir():
            raise AssetSourceError(f"{key}: {folder}: there is no such folder")
        paths = (Path(place, name).relative_to(folder) for place, _, names in os.walk(folder) for name in names)
        shown = (path for path in paths if not any(part.startswith(".") for part in path.parts))
        files = sorted(path.as_posix() for path in shown if path.name.lower().endswith(SUFFIXES))
        if not 0 < len(files) <= MOST_PICTURES:
            raise AssetSourceError(
                f"{key}: {folder} has {len(files)} pictures ({', '.join(SUFFIXES)}): give 1 to {MOST_PICTURES}"
            )
        try:
            opened[key] = tuple(_look_at(folder, name) for name in files)
        except VersoError as error:
            raise AssetSourceError(f"{key}: {getattr(error, 'detail', error)}") from error
    return opened


def _look_at(folder: Path, name: str) -> Picture:
    data = read_bytes(folder / name, MOST_BYTES, MeshError)
    _decode(data, folder / name)
    return Picture(folder, name, hashlib.sha256(data).hexdigest())


def _decode(data: bytes, path: Path) -> NDArray[np.uint8]:
    """[h, w, 3] uint8 sRGB, upright, at most `KEPT_PX` a side. Raises MeshError."""
    size, why = open_image(data, _LIMITS)
    if max(size) > LARGEST_PX:
        why = f"is {size[0]} x {size[1]}, and at most {LARGEST_PX} a side are read: make it smaller"
    if why is not None:
        raise MeshError("unreadable", f"{path} {why}")
    notes: list[str] = []
    with as_refusal(path, MeshError):
        image = Image.open(io.BytesIO(data))
        image.draft("RGB", (KEPT_PX, KEPT_PX))  # a JPEG is decoded at a half, a quarter or an eighth
        pixels = decode_picture(ImageOps.exif_transpose(image), notes)
    if pixels is None:
        raise MeshError("unreadable", f"{path}: {notes[0]}: copy it again")
    colours = np.ascontiguousarray(pixels[..., :3])
    shrink = KEPT_PX / max(colours.shape[:2])
    if shrink < 1.0:
        height, width = (max(1, round(shrink * side)) for side in colours.shape[:2])
        colours = np.asarray(cv2.resize(colours, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    return frozen_array(colours, np.uint8)


@functools.lru_cache(maxsize=48)  # 3 MiB a picture
def load_picture(picture: Picture) -> NDArray[np.uint8]:
    """[h, w, 3] uint8 sRGB, the same array for the same picture. Raises MeshError where it is not what it was."""
    path = picture.folder / picture.name
    try:
        data = read_bytes(path, MOST_BYTES, MeshError)
    except MeshError as error:
        raise MeshError("missing", error.detail, "environmental") from error
    if hashlib.sha256(data).hexdigest() != picture.sha256:
        raise MeshError("changed", f"{path} does not hold what it held when the run began", "environmental")
    return _decode(data, path)
