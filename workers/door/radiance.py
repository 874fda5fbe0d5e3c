"""Edge: equirectangular maps of radiance from outside, .hdr (Radiance's RGBE) and .exr (OpenEXR), small and checked.

The size in a file's head is judged before anything is decoded. Raises InputError with the file's name, the value and the remedy.
"""

import hashlib
import io
import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from workers.door.opening import as_refusal, read_bytes

MOST_PX = 8192
"""Greatest width: eight times what is used of a map, 400 MB decoded."""

MOST_BYTES = 1 << 29
MOST_RADIANCE = 1e10
"""Above the sun's in candela per square metre."""

BELOW_ZERO = 0.01
"""Of a map's mean: sharpening leaves values so little below 0, which count as 0."""

_RESOLUTION = re.compile(rb"\n([-+][XY]) (\d+) ([-+][XY]) (\d+)\n")


def read_radiance(path: Path, sha256: str, height: int) -> NDArray[np.float32]:
    """[height, 2 height, 3] float32 linear RGB of a map of this digest; nothing is negative."""
    data = read_bytes(path, MOST_BYTES)
    if hashlib.sha256(data).hexdigest() != sha256:
        raise InputError(f"{path} has changed since the run began: run again")
    with as_refusal(path):
        picture = _read_exr(path, data) if data.startswith(b"v/1\x01") else _read_hdr(path, data)
    _check_values(path, picture)
    small = cv2.resize(picture, (2 * height, height), interpolation=cv2.INTER_AREA)
    return np.maximum(np.asarray(small, np.float32), np.float32(0.0))


def _check_size(path: Path, width: int, height: int) -> None:
    if abs(width - 2 * height) > 2 or height < 8:
        what = "an equirectangular map is twice as wide as high"
        raise InputError(f"{path} is {width} x {height}, and {what}: convert it, or take it out")
    if width > MOST_PX:
        most = f"at most {MOST_PX} x {MOST_PX // 2} are read"
        raise InputError(f"{path} is {width} x {height}, and {most}: scale it down, to 2048 x 1024 for instance")


def _read_hdr(path: Path, data: bytes) -> NDArray[np.float32]:
    stated = _RESOLUTION.search(data[:65_536])
    if not data.startswith(b"#?") or stated is None:
        raise InputError(f"{path} is neither Radiance HDR nor OpenEXR: take it out, or write it as one of them")
    if (stated[1], stated[3]) != (b"-Y", b"+X"):
        raise InputError(
            f"{path} has its rows in another order ({stated[0].decode().strip()}): write it anew with -Y +X"
        )
    _check_size(path, int(stated[4]), int(stated[2]))
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_COLOR_RGB)
    if picture is None or picture.shape[:2] != (int(stated[2]), int(stated[4])):
        raise InputError(f"{path} is Radiance HDR, and cut or altered: copy it again")
    return np.asarray(picture, np.float32)


def _read_exr(path: Path, data: bytes) -> NDArray[np.float32]:
    import OpenEXR  # a tenth of a second, of EXR alone

    head = OpenEXR.File(io.BytesIO(data), header_only=True).header()
    low, high = head["dataWindow"]
    _check_size(path, int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1)
    names = [channel.name for channel in head["channels"]]
    if not {"R", "G", "B"} <= set(names):
        raise InputError(f"{path} has the channels {', '.join(names)[:200]}, and must have R, G and B: write those")
    channels = OpenEXR.File(io.BytesIO(data), separate_channels=True).channels()
    return np.stack([np.asarray(channels[name].pixels, np.float32) for name in "RGB"], axis=2)


def _check_values(path: Path, picture: NDArray[np.float32]) -> None:
    """Raises InputError where a value is no number, negative, or beyond any light, and where there is no light."""
    finite = np.isfinite(picture)
    mean = float(picture.mean(dtype=np.float64, where=finite))
    faults = {
        "is no finite number": ~finite,
        "is negative": picture < -BELOW_ZERO * abs(mean),
        f"is above {MOST_RADIANCE:g}": picture > MOST_RADIANCE,
    }
    for what, wrong in faults.items():
        if count := int(np.count_nonzero(wrong)):
            row, column, _ = np.argwhere(wrong)[0].tolist()
            where = f"{count} of {picture.size} values, the first {picture[row, column].tolist()} in row {row}, column {column}"
            raise InputError(f"{path} holds what {what}: {where}: repair it, or take it out")
    if not mean > 0.0:
        raise InputError(f"{path} is black: take it out")
