"""PNG encoding and decoding: lossless, and the same bytes for the same pixels."""

import io
import struct
import sys
from collections.abc import Iterator
from typing import cast

import numpy as np
from numpy.typing import NDArray
from zlib_ng import zlib_ng

from schemas.errors import CorruptError

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
"""[H, W, 3] uint8 RGB, [H, W, 4] uint8 with alpha, [H, W, 3] uint16, [H, W] uint8 or [H, W] uint16."""

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHUNK = struct.Struct(">I4s")
_END = b"\0\0\0\0IEND\xaeB`\x82"
"""The last chunk of every PNG."""
_RGB_16 = bytes([16, 2])
"""Bits of a channel and the kind of colour in the header of a PNG of 3 x 16 bits."""
_KINDS = {1: 0, 3: 2, 4: 6}
"""PNG's kind of colour by number of channels."""
_UP = 2
"""The PNG filter of a row: bytes are differences from the row above."""
_FPNG_SIDE = 65_535
"""The longest side that fpng encodes: it writes two bytes of each."""


def encode_png(pixels: Pixels, level: int = 1) -> bytes:
    """PNG bytes of `Pixels`. Raises ValueError for anything else.

    `level` 0 stores, 1 is fast, 9 is small; every level is lossless. Level 1 is fpng for colour, zlib-ng for colour with holes
    and for all else; other levels are zlib-ng.

    640 x 480, one core, rendered images: RGB at level 1 1.8 ms and 256 KiB, at 2 4.0 ms and 192 KiB, at 6 18 ms and 153 KiB
    (OpenCV's encoder at its level 1 11 ms and 212 KiB, at 9 420 ms and 158 KiB). ISA-L is as fast as fpng, but once in some
    thousand images makes other bytes of the same pixels; tests/kit/encoded_digests.py compares 100,000 images.
    """
    colored, clear = (pixels.ndim == 3 and pixels.shape[2] == channels for channels in (3, 4))
    if not (colored or pixels.ndim == 2 or clear) or pixels.dtype not in (np.uint8, np.uint16)[: 2 - clear]:
        raise ValueError(f"an image of shape {pixels.shape} and type {pixels.dtype} has no encoding here")
    if 0 in pixels.shape:
        raise ValueError(f"an image of shape {pixels.shape} has no pixels")
    whole: NDArray = np.ascontiguousarray(pixels)
    shaded = colored and pixels.dtype == np.uint8 and not _has_holes(pixels)
    if level == 1 and shaded and max(pixels.shape) <= _FPNG_SIDE:
        import fpng  # brings Pillow and OpenCV

        data: bytes = fpng.from_ndarray(whole)
        if not data.endswith(_END):  # it has stopped early, which it says in no other way
            raise ValueError(f"fpng made a PNG of {len(data)} bytes that does not end")
        return data
    return _deflated(whole, shaded and level > 1, level)


def encode_mask(mask: NDArray[np.bool_]) -> bytes:
    """PNG bytes of a mask [H, W]: 255 where it is true, 0 elsewhere."""
    return encode_png(mask.astype(np.uint8) * 255)


def _deflated(pixels: NDArray, sub: bool, level: int) -> bytes:
    """PNG bytes by zlib-ng, of rows as they are or, with `sub`, as differences from pixel to pixel."""
    height, width = pixels.shape[:2]
    head = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, _KINDS[pixels[0, 0].size], 0, 0, 0)
    body = zlib_ng.compress(_filtered_rows(pixels, sub).reshape(-1), level)
    return b"".join((_SIGNATURE, *_chunk(b"IHDR", head), *_chunk(b"IDAT", body), *_chunk(b"IEND", b"")))


def _filtered_rows(pixels: NDArray, sub: bool) -> NDArray[np.uint8]:
    """[H, 1 + row bytes]: each row after the number of its PNG filter, with the high byte of a sample first.

    The filter is `none` or, of 8-bit RGB with `sub`, differences from the pixel to the left.
    """
    samples = pixels.astype(">u2").view(np.uint8) if pixels.dtype == np.uint16 else pixels
    samples = samples.reshape(len(pixels), -1)
    rows = np.empty((len(pixels), 1 + samples.shape[1]), np.uint8)
    rows[:, 0] = sub
    rows[:, 1:] = samples
    if sub:
        np.subtract(samples[:, 3:], samples[:, :-3], out=rows[:, 4:])
    return rows


def _chunk(kind: bytes, data: bytes) -> tuple[bytes, bytes, bytes]:
    """A PNG chunk: length and kind, data, CRC-32 of kind and data."""
    return _CHUNK.pack(len(data), kind), data, zlib_ng.crc32(data, zlib_ng.crc32(kind)).to_bytes(4, "big")


def decode_png(data: bytes, name: str = "an image") -> Pixels:
    """The pixels that `encode_png` took.

    Raises CorruptError naming a file that is torn, altered or no PNG.
    """
    body = b"".join(chunk for kind, chunk in _read_chunks(data, name) if kind == b"IDAT")
    if (pixels := _decode_plain(data, body)) is not None:  # in half of Pillow's time, and two thirds of OpenCV's
        return pixels
    if data[24:26] == _RGB_16:
        raise CorruptError(
            f"{name} is a PNG file of 3 x 16 bits that is damaged, or has filters, which none of this data set's has"
        )
    from PIL import Image  # loads with the first image; OpenCV takes 1.2 times as long

    try:
        with Image.open(io.BytesIO(data), formats=("PNG",)) as image:
            return cast(Pixels, np.array(image))
    except (OSError, SyntaxError, ValueError) as error:
        raise CorruptError(f"{name} is a PNG file that cannot be decoded: {error}") from error


def _decode_plain(data: bytes, body: bytes) -> Pixels | None:
    """The pixels of a grey, RGB or RGBA PNG whose rows have no filter or that of fpng, `up`, as written here; None of others."""
    width, height, bits, kind, *_, interlaced = struct.unpack_from(">IIBBBBB", data, len(_SIGNATURE) + _CHUNK.size)
    channels = next((number for number, code in _KINDS.items() if code == kind), 0)
    if bits not in (8, 16) or not channels or interlaced:
        return None
    row = 1 + width * channels * bits // 8
    try:
        raw = zlib_ng.decompressobj().decompress(body, height * row + 1)
    except zlib_ng.error:  # type: ignore[misc]
        return None
    if len(raw) != height * row:
        return None
    rows = np.frombuffer(raw, np.uint8).reshape(height, row)
    filters = rows[:, 0]
    if (filters & ~np.uint8(_UP)).any():
        return None
    samples = np.array(rows[:, 1:])
    for number in np.flatnonzero(filters[1:]) + 1:  # `accumulate` along the columns takes five times as long
        np.add(samples[number - 1], samples[number], out=samples[number])
    if bits == 16 and sys.byteorder == "little":  # high byte first; at six times the speed of `astype`
        samples.view(np.uint16).byteswap(inplace=True)
    pixels = samples.view(np.uint16) if bits == 16 else samples
    return pixels.reshape((height, width) if channels == 1 else (height, width, channels))


def _read_chunks(data: bytes, name: str) -> Iterator[tuple[bytes, bytes]]:
    """(kind, data) of every chunk. Raises CorruptError unless all are whole: a decoder may fill up what a damaged one lacks."""
    position, kind = len(_SIGNATURE), b""
    if not data.startswith(_SIGNATURE):
        raise CorruptError(f"{name} is not a PNG file")
    while kind != b"IEND":
        size, kind = _CHUNK.unpack(data[position : position + _CHUNK.size].ljust(_CHUNK.size))
        end = position + _CHUNK.size + size
        if data[end : end + 4] != zlib_ng.crc32(data[position + 4 : end]).to_bytes(4, "big"):
            raise CorruptError(f"{name} is torn or altered at byte {position}: a PNG chunk fails its checksum")
        yield kind, data[position + _CHUNK.size : end]
        position = end + 4


def _has_holes(pixels: Pixels) -> bool:
    """True where a tenth of the values are 0, in a sixteenth of the rows.

    0.65 to 0.78 of a projected view are, 0.11 to 0.69 of its patches, and fewer than 0.01 of what a camera sees.
    """
    rows = pixels[::16]
    return bool(10 * np.count_nonzero(rows) <= 9 * rows.size)
