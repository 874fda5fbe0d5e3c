"""Lossless PNG encoders, and the fastest of them for each kind of image."""

import importlib
import struct
import time
import zlib
from collections.abc import Callable, Sequence
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from workers.store.images import Pixels, encode_png

Encoder = Callable[[Pixels], bytes]

NO_LARGER = 2.0
"""An encoder may make at most this many times our bytes; a faster one that hardly compresses is no lower bound."""

STRATEGIES = {
    "huffman": cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    "rle": cv2.IMWRITE_PNG_STRATEGY_RLE,
    "deflate": cv2.IMWRITE_PNG_STRATEGY_DEFAULT,
}
FILTERS = {"none": cv2.IMWRITE_PNG_FILTER_NONE, "sub": cv2.IMWRITE_PNG_FILTER_SUB, "up": cv2.IMWRITE_PNG_FILTER_UP}
ISAL_LEVELS = (0, 1)
REPEATS = 3


def encoders() -> dict[str, Encoder]:
    """Every encoder, by name; ours is one of them, so that the lower bound is never above it."""
    found: dict[str, Encoder] = {"ours": encode_png}
    for row_filter, number in FILTERS.items():
        for level in ISAL_LEVELS:
            found[f"isal {level} {row_filter}"] = partial(encode_isal, row_filter=row_filter, level=level)
        for strategy, strategy_number in STRATEGIES.items():
            settings = [
                *(cv2.IMWRITE_PNG_COMPRESSION, 1),
                *(cv2.IMWRITE_PNG_STRATEGY, strategy_number),
                *(cv2.IMWRITE_PNG_FILTER, number),
            ]
            found[f"cv2 {strategy} {row_filter}"] = _opencv(settings)
    try:
        codecs = importlib.import_module("imagecodecs")
    except ImportError:
        return found
    return found | {"imagecodecs png 1": lambda pixels: bytes(codecs.png_encode(pixels, level=1))}


def encode_isal(pixels: Pixels, row_filter: str, level: int) -> bytes:
    """PNG (ISO/IEC 15948) with one filter for all rows, deflated by ISA-L in one piece."""
    from isal import isal_zlib  # of the extra `study`

    height, width = pixels.shape[:2]
    depth, color = (16, 0) if pixels.dtype == np.uint16 else (8, 2 if pixels.ndim == 3 else 0)
    rows = np.ascontiguousarray(pixels.astype(">u2") if depth == 16 else pixels).view(np.uint8).reshape(height, -1)
    lines = np.empty((height, rows.shape[1] + 1), np.uint8)
    lines[:, 0] = {"none": 0, "sub": 1, "up": 2}[row_filter]
    _filter(rows, lines[:, 1:], row_filter, rows.shape[1] // width)
    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    data = isal_zlib.compress(lines, level)
    chunks = ((b"IHDR", header), (b"IDAT", data), (b"IEND", b""))
    checks = [isal_zlib.crc32(body, zlib.crc32(kind)) for kind, body in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", check)
        for (kind, body), check in zip(chunks, checks, strict=True)
    )


def _filter(rows: NDArray[np.uint8], out: NDArray[np.uint8], row_filter: str, pixel_bytes: int) -> None:
    """Differences modulo 256 to the pixel on the left or to the row above."""
    if row_filter == "sub":
        out[:, :pixel_bytes] = rows[:, :pixel_bytes]
        np.subtract(rows[:, pixel_bytes:], rows[:, :-pixel_bytes], out=out[:, pixel_bytes:])
    elif row_filter == "up":
        out[0] = rows[0]
        np.subtract(rows[1:], rows[:-1], out=out[1:])
    else:
        out[:] = rows


def _opencv(settings: list[int]) -> Encoder:
    def encode(pixels: Pixels) -> bytes:
        bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
        return bytes(cv2.imencode(".png", bgr, settings)[1].data)

    return encode


def kind_of(pixels: Pixels) -> str:
    """`rgb`, `uint16` or `uint8`."""
    return "rgb" if pixels.ndim == 3 else str(pixels.dtype)


def choose_encoders(images: Sequence[tuple[Pixels, int]]) -> dict[str, tuple[str, Encoder]]:
    """Name and function of the fastest encoder for each kind of image, measured on `images` and the bytes of each now."""
    chosen = {}
    for kind in sorted({kind_of(pixels) for pixels, _ in images}):
        own = [(pixels, size) for pixels, size in images if kind_of(pixels) == kind]
        allowed = NO_LARGER * sum(size for _, size in own)
        timed = []
        for name, encode in encoders().items():
            took = min(_seconds(encode, own) for _ in range(REPEATS))
            if sum(len(encode(pixels)) for pixels, _ in own) <= allowed:
                timed.append((took, name, encode))
        _, name, encode = min(timed, key=lambda one: one[0])
        chosen[kind] = (name, encode)
    return chosen


def _seconds(encode: Encoder, images: Sequence[tuple[Pixels, int]]) -> float:
    begun = time.process_time()
    for pixels, _ in images:
        encode(pixels)
    return time.process_time() - begun
