"""The images of bags as arrays: raw in any usual encoding, or compressed by image_transport.

sensor_msgs/CompressedImage has the format "ENCODING; CODEC compressed COLOURS" or "ENCODING; compressedDepth CODEC". Before the
PNG of compressedDepth are an int32 and two float32, a and b: where ENCODING is 32FC1, a code is a / metres + b cut to a whole
number, and 0 is none. Old ones have the format "ENCODING" alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from workers.door.recordings.bag_files import BagMessage
from workers.door.recordings.pictures import Size, decode_picture, decode_rgb, decode_small, read_head

LONGEST_SIDE = 20_000
"""Of an image, pixels."""

COLORS = {"rgb8": None, "bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB}
PACKED = {
    **dict.fromkeys(("yuyv", "YUYV", "yuv422_yuy2"), cv2.COLOR_YUV2RGB_YUY2),
    **dict.fromkeys(("uyvy", "UYVY", "yuv422"), cv2.COLOR_YUV2RGB_UYVY),
}
"""OpenCV's conversions of encodings of colour, of 3 or 4 bytes a pixel and of 2; the SDK has capitals, or yuv422 for UYVY."""

DEPTHS = {"mono16": "u2", "16UC1": "u2", "32FC1": "f4"}

MODES = {"L": "mono8", "I;16": "16UC1", "I;16B": "16UC1", "I": "16UC1"}
"""Encodings of pictures that have no colour, by Pillow's mode."""

QUANTIZED = np.dtype([("format", "<i4"), ("a", "<f4"), ("b", "<f4")])
"""What is before the picture of compressedDepth."""


@dataclass(frozen=True)
class BagImage:
    """An image of which only what is around its pixels has been read.

    load(small) decodes them: of colour [H, W, 3] uint8 sRGB, or if small [H / 2, W / 2] uint8 grey; of all else [H, W] of its
    encoding's numbers. It raises what the decoder raises.
    """

    stamp_us: int
    frame: str
    encoding: str
    size: Size
    load: Callable[[bool], NDArray]


def read_image(message: BagMessage) -> BagImage:
    """Of a message Image or CompressedImage; raises whatever the library does where it is damaged."""
    content = message.content()
    stamp = content.header.stamp
    read = _read_compressed if hasattr(content, "format") else _read_raw
    return BagImage(int(stamp.sec) * 1_000_000 + int(stamp.nanosec) // 1000, content.header.frame_id, *read(content))


def _read_raw(image: Any) -> tuple[str, Size, Callable[[bool], NDArray]]:
    """(encoding, size, how it is loaded)."""
    return image.encoding, (image.width, image.height), partial(_load_raw, image)


def _load_raw(image: Any, small: bool) -> NDArray:
    height, width, step = image.height, image.width, image.step
    if height * step != len(image.data) or not 0 < height <= LONGEST_SIDE or not 0 < width <= LONGEST_SIDE:
        raise ValueError(f"an image of {width} x {height} in {len(image.data)} bytes")
    rows = image.data.reshape(height, step)
    if image.encoding in DEPTHS:
        kind = np.dtype((">" if image.is_bigendian else "<") + DEPTHS[image.encoding])
        return rows[:, : width * kind.itemsize].copy().view(kind).reshape(height, width)
    channels = {**dict.fromkeys(COLORS, 3), "rgba8": 4, "bgra8": 4, **dict.fromkeys(PACKED, 2)}[image.encoding]
    pixels = np.ascontiguousarray(rows[:, : width * channels].reshape(height, width, channels))
    conversion = {**COLORS, **PACKED}[image.encoding]
    rgb = pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))
    if not small:
        return rgb
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return np.asarray(cv2.resize(gray, (width // 2, height // 2), interpolation=cv2.INTER_AREA), np.uint8)


def _read_compressed(image: Any) -> tuple[str, Size, Callable[[bool], NDArray]]:
    """As `_read_raw`; an encoding that cannot be used is the whole format, for the message that refuses it."""
    said, data = image.format, image.data.tobytes()
    raw, _, codec = (part.strip() for part in said.partition(";"))
    if "compressedDepth" in codec or (said in DEPTHS and data[QUANTIZED.itemsize :].startswith(b"\x89PNG")):
        if raw not in DEPTHS or "rvl" in codec:
            return said, (0, 0), lambda _: np.zeros(0)
        size, mode = read_head(data[QUANTIZED.itemsize :])
        return (raw if MODES.get(mode) == "16UC1" else said), size, partial(_load_depth, data, size, raw == "32FC1")
    size, mode = read_head(data)
    if mode in MODES or raw in DEPTHS:
        is_lossy = raw in DEPTHS and MODES.get(mode) != "16UC1"
        return said if is_lossy else MODES[mode], size, lambda _: decode_picture(data, size)
    is_swapped = "compressed rgb" in codec  # OpenCV's encoder was given colours in this order, and takes them for BGR
    return "rgb8", size, partial(_load_color, data, size, is_swapped)


def _load_color(data: bytes, size: Size, is_swapped: bool, small: bool) -> NDArray:
    if small:
        return decode_small(data, size)
    rgb = decode_rgb(data, size)
    return np.ascontiguousarray(rgb[..., ::-1]) if is_swapped else rgb


def _load_depth(data: bytes, size: Size, is_quantized: bool, small: bool) -> NDArray:
    codes = decode_picture(data[QUANTIZED.itemsize :], size)
    if not is_quantized:
        return codes
    head = np.frombuffer(data, QUANTIZED, 1)[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(codes > 0, head["a"] / (codes + 0.5 - head["b"]), 0.0)
