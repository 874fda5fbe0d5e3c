"""The images of a recording, from the bytes of their frames."""

import cv2
import numpy as np
from numpy.typing import NDArray

FORMATS = ("MJPG", "NV12", "YUY2", "BGRA")
"""Of colour frames, by their four-character code."""

DEPTH_FORMAT = "b16g"


def is_whole(data: bytes, fourcc: str, size: tuple[int, int]) -> bool:
    """Whether a frame has all its bytes; `size` is (width, height)."""
    if fourcc == "MJPG":
        return data[:2] == b"\xff\xd8" and data.rstrip(b"\0")[-2:] == b"\xff\xd9"
    pixels = size[0] * size[1]
    return (
        len(data) == {"NV12": pixels * 3 // 2, "YUY2": pixels * 2, "BGRA": pixels * 4, DEPTH_FORMAT: pixels * 2}[fourcc]
    )


def decode_depth(data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    """[h, w] uint16 of 16-bit big-endian pixels."""
    return np.frombuffer(data, ">u2").reshape(size[1], size[0]).astype(np.uint16)


def decode_color(data: bytes, fourcc: str, size: tuple[int, int]) -> NDArray[np.uint8] | None:
    """[H, W, 3] uint8 sRGB, or None for bytes that cannot be read or have another size."""
    if fourcc == "MJPG":
        rgb = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    elif fourcc == "NV12":
        rgb = cv2.cvtColor(_pixels(data, (size[1] * 3 // 2, size[0])), cv2.COLOR_YUV2RGB_NV12)
    elif fourcc == "YUY2":
        rgb = cv2.cvtColor(_pixels(data, (size[1], size[0], 2)), cv2.COLOR_YUV2RGB_YUY2)
    else:
        rgb = cv2.cvtColor(_pixels(data, (size[1], size[0], 4)), cv2.COLOR_BGRA2RGB)
    return None if rgb is None or rgb.shape != (size[1], size[0], 3) else np.asarray(rgb, np.uint8)


def decode_gray(data: bytes, fourcc: str, size: tuple[int, int]) -> NDArray[np.uint8] | None:
    """[H / 2, W / 2] uint8, fast: what sharpness and movement are measured on. None for bytes that cannot be read."""
    if fourcc == "MJPG":
        gray = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_REDUCED_GRAYSCALE_2)
        return None if gray is None else np.asarray(gray, np.uint8)
    if fourcc == "NV12":
        whole = _pixels(data, (size[1] * 3 // 2, size[0]))[: size[1]]
    elif fourcc == "YUY2":
        whole = np.ascontiguousarray(_pixels(data, (size[1], size[0], 2))[:, :, 0])
    else:
        whole = np.asarray(cv2.cvtColor(_pixels(data, (size[1], size[0], 4)), cv2.COLOR_BGRA2GRAY), np.uint8)
    return np.asarray(cv2.resize(whole, (size[0] // 2, size[1] // 2), interpolation=cv2.INTER_AREA), np.uint8)


def _pixels(data: bytes, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    return np.frombuffer(data, np.uint8).reshape(shape)
