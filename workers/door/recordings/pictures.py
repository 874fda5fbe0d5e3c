"""Pictures of others as arrays, and their cameras: colour as PNG or JPEG, depth in any usual encoding, one camera as another.

The size in a file's head is compared with the camera's before anything is decoded, so that no small file fills the memory.
"""

import functools
import io
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from schemas.base import Array, frozen_array
from schemas.capture import DepthCamera
from schemas.errors import CaptureError
from schemas.scene.view import Intrinsics
from workers.door.opening import as_refusal
from workers.geometry.pixels import opencv_matrix

Size = tuple[int, int]
"""Width and height, pixels."""

MAGIC = (("png", b"\x89PNG"), ("tiff", b"II*\0"), ("tiff", b"MM\0*"), ("npy", b"\x93NUMPY"), ("exr", b"v/1\x01"))
"""First bytes of the kinds of depth files; anything else is raw."""

LZFSE = (b"bvx2", b"bvxn", b"bvx1", b"bvx-", b"bvx$")
"""First bytes of data that Apple's LZFSE has compressed."""


class PictureError(ValueError):
    """A picture that cannot be used; the message has no name of the file, which the caller knows."""


def read_head(data: bytes) -> tuple[Size, str]:
    """(width and height, Pillow's mode) in the head of an image, of which nothing else is read. Raises PictureError."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the size is what is asked for
        try:
            with Image.open(io.BytesIO(data)) as image:
                return image.size, image.mode
        except Image.DecompressionBombError as error:
            raise PictureError("is an image of more pixels than any camera has") from error
        except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
            raise PictureError("is no image that can be read: take it out, or copy it again") from error


def _check_size(data: bytes, size: Size) -> None:
    stated, _ = read_head(data)
    if stated != size:
        raise PictureError(f"is {stated[0]} x {stated[1]}, and its camera has {size[0]} x {size[1]}")


def decode_rgb(data: bytes, size: Size) -> NDArray[np.uint8]:
    """[H, W, 3] uint8 sRGB of a PNG or JPEG of a size, as it is stored, not turned. Raises PictureError."""
    return np.asarray(decode_picture(data, size, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION), np.uint8)


def decode_small(data: bytes, size: Size) -> NDArray[np.uint8]:
    """[H / 2, W / 2] uint8 grey, fast: what sharpness and movement are measured on. Raises PictureError."""
    return np.asarray(decode_picture(data, size, cv2.IMREAD_REDUCED_GRAYSCALE_2), np.uint8)


def decode_picture(data: bytes, size: Size, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray:
    """The pixels as OpenCV reads them. Raises PictureError, before it decodes where the size is another."""
    _check_size(data, size)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None:
        raise PictureError("is no image that can be read: take it out, or copy it again")
    return image


def decode_depth(data: bytes, size: Size, units_per_m: float) -> Array:
    """[H, W] float64 metres, 0 for none, of depth of a size as it is stored. Raises PictureError.

    Whole numbers (PNG or TIFF of 16 bits, npy) have `units_per_m`; floating point (TIFF, npy, EXR, raw, LZFSE) is metres.
    """
    kind = next((kind for kind, start in MAGIC if data.startswith(start)), "raw")
    if kind == "exr":
        stored = _load_exr(data, size)
    elif kind == "npy":
        stored = _load_npy(data, size)
    elif kind == "raw":
        stored = _load_raw(data, size)
    else:
        stored = decode_picture(data, size)
    if stored.ndim != 2 or stored.dtype not in (np.uint16, np.float32, np.float64):
        channels = 1 if stored.ndim == 2 else stored.shape[2]
        raise PictureError(f"is {stored.dtype} with {channels} channels: depth has one, of 16 bits or floating point")
    depth: Array = stored.astype(np.float64) / (units_per_m if stored.dtype == np.uint16 else 1.0)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, 0.0)


def decode_confidence(data: bytes, size: Size) -> NDArray[np.uint8]:
    """[H, W] uint8 of a PNG or of bytes, as they are or compressed by LZFSE; 0: the lowest. Raises PictureError."""
    if data.startswith(b"\x89PNG"):
        return np.asarray(decode_picture(data, size, cv2.IMREAD_GRAYSCALE), np.uint8)
    data = _expand(data, size[0] * size[1]) if data[:4] in LZFSE else data
    if len(data) != size[0] * size[1]:
        raise PictureError(f"has a confidence of {len(data)} bytes, and its depth is {size[0]} x {size[1]}")
    return np.frombuffer(data, np.uint8).reshape(size[1], size[0])


def _load_npy(data: bytes, size: Size) -> NDArray:
    try:
        stream = io.BytesIO(data)
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
    except (ValueError, EOFError) as error:
        raise PictureError(f"is no .npy that can be read ({error})") from error
    if (
        shape != (size[1], size[0])
        or dtype.hasobject
        or len(data) - stream.tell() != dtype.itemsize * size[0] * size[1]
    ):
        raise PictureError(f"holds {shape} of {dtype}, and its camera has {size[0]} x {size[1]}")
    return np.asarray(np.load(io.BytesIO(data), allow_pickle=False))


def _load_exr(data: bytes, size: Size) -> NDArray:
    """[H, W] of the one channel of an OpenEXR image, or of its channel Z. Half precision has steps of 1 mm beyond 1 m."""
    import OpenEXR  # a tenth of a second, of EXR alone

    try:
        head = OpenEXR.File(io.BytesIO(data), header_only=True).header()
        low, high = head["dataWindow"]
        stated = int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1
        names = [channel.name for channel in head["channels"]]
        if stated == size and (len(names) == 1 or "Z" in names):
            channels = OpenEXR.File(io.BytesIO(data), separate_channels=True).channels()
            stored = np.asarray(channels[names[0] if len(names) == 1 else "Z"].pixels)
            return stored.astype(np.float32) if stored.dtype == np.float16 else stored
    except (RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise PictureError("is OpenEXR, and cut or altered: copy it again") from error
    if stated != size:
        raise PictureError(f"is {stated[0]} x {stated[1]}, and its camera has {size[0]} x {size[1]}")
    raise PictureError(f"has the channels {', '.join(names)}: depth is one channel, or the one named Z")


def _load_raw(data: bytes, size: Size) -> NDArray:
    """[H, W] of 32-bit floating point or of 16 bits, little-endian, rows from the top; also compressed by LZFSE."""
    pixels = size[0] * size[1]
    if data[:4] in LZFSE:
        data = _expand(data, 4 * pixels)
    for kind in ("<f4", "<u2"):
        if len(data) == pixels * np.dtype(kind).itemsize:
            return np.frombuffer(data, kind).reshape(size[1], size[0]).astype(kind[1:])
    raise PictureError(f"has {len(data)} bytes, and depth of {size[0]} x {size[1]} has {4 * pixels} (or {2 * pixels})")


def _expand(data: bytes, most: int) -> bytes:
    """What LZFSE has compressed; of data that stood for more than `most` bytes nobody compresses so much."""
    try:
        import lzfse  # of Record3D alone; has no types
    except ImportError as error:
        raise PictureError("is compressed by LZFSE: install the package lzfse, which reads it") from error
    if len(data) > most + 1024:
        raise PictureError(f"has {len(data)} bytes, and uncompressed it would have {most}")
    try:
        return bytes(lzfse.decompress(data))
    except (lzfse.error, MemoryError) as error:
        raise PictureError("is compressed by LZFSE, and cut or altered: copy it again") from error


def read_intrinsics(where: Path | str, size: Size, numbers: Iterable[Any], centre: float) -> Intrinsics:
    """Of fx, fy, cx, cy, whose first pixel's centre is at `centre`, in the file `where`. Raises CaptureError."""
    with as_refusal(f"{where}: its intrinsics", CaptureError):
        fx, fy, cx, cy = (float(x) for x in numbers)
        if not np.isfinite([fx, fy, cx, cy]).all() or min(fx, fy) <= 0 or max(abs(cx), abs(cy)) > 1e6:
            raise ValueError(f"fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}")
        shift = 0.5 - centre
        return Intrinsics(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx + shift, cy=cy + shift)


def scaled_camera(k: Intrinsics, size: Size) -> DepthCamera:
    """A depth camera that sees the same as a colour camera, in an image of another size."""
    x, y = size[0] / k.width, size[1] / k.height
    small = Intrinsics(width=size[0], height=size[1], fx=x * k.fx, fy=y * k.fy, cx=x * k.cx, cy=y * k.cy)
    return DepthCamera(small, frozen_array(np.zeros(8)), frozen_array(np.eye(4)))


@functools.lru_cache(maxsize=4)
def pinhole_maps(
    k: Intrinsics, lens: tuple[float, ...], fisheye: bool = False
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(column [H, W], row [H, W]) in the image of a lens of each pixel of a pinhole with the same numbers, for cv2.remap.

    Lenses of OpenCV's: 4 to 14 numbers, or 4 of its fisheye model.
    """
    matrix, size = opencv_matrix(k), (k.width, k.height)
    numbers = np.array(lens, np.float64)
    if fisheye:
        maps = cv2.fisheye.initUndistortRectifyMap(matrix, numbers[:, None], np.eye(3), matrix, size, cv2.CV_32FC1)
    else:
        maps = cv2.initUndistortRectifyMap(matrix, numbers, np.eye(3), matrix, size, cv2.CV_32FC1)
    return np.asarray(maps[0], np.float32), np.asarray(maps[1], np.float32)


def remap(image: NDArray, maps: Sequence[NDArray[np.float32]], between: bool) -> NDArray:
    """The image at places of `pinhole_maps`, 0 outside; `between` its pixels, or the nearest, as depth and masks need it."""
    how = cv2.INTER_LINEAR if between else cv2.INTER_NEAREST
    return np.asarray(cv2.remap(image, maps[0], maps[1], how, borderMode=cv2.BORDER_CONSTANT, borderValue=0))


def change_camera(image: NDArray, before: Intrinsics, after: Intrinsics, between: bool) -> NDArray:
    """The image of one camera as another of the same lens, at the same place, has it: scaled and moved. 0 outside."""
    if before == after:
        return image
    x, y = after.fx / before.fx, after.fy / before.fy
    M = np.array([[x, 0.0, after.cx_opencv - x * before.cx_opencv], [0.0, y, after.cy_opencv - y * before.cy_opencv]])
    how = cv2.INTER_LINEAR if between else cv2.INTER_NEAREST
    size = (after.width, after.height)
    return np.asarray(cv2.warpAffine(image, M, size, flags=how, borderMode=cv2.BORDER_CONSTANT, borderValue=0))
