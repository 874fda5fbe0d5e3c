"""The lower bound of time for the same files: bare draws, the fastest lossless encoder, and a durable write."""

import importlib
import os
import struct
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import cv2
import fpng
import numpy as np
from numpy.typing import NDArray

from services.bench.figures import Lap
from workers.render.raster.gbuffer import FLAT, Renderer
from workers.scene.make_scene import Scene
from workers.store.file_system import sync_path, sync_tree
from workers.store.images import Pixels, decode_png, encode_png

Encoder = Callable[[Pixels], bytes]

NO_LARGER = 2.0
"""An encoder may make at most this many times our bytes; a faster one that hardly compresses is no lower bound."""

STRATEGIES = {
    "huffman": cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    "rle": cv2.IMWRITE_PNG_STRATEGY_RLE,
    "deflate": cv2.IMWRITE_PNG_STRATEGY_DEFAULT,
}
FILTERS = {"none": cv2.IMWRITE_PNG_FILTER_NONE, "sub": cv2.IMWRITE_PNG_FILTER_SUB, "up": cv2.IMWRITE_PNG_FILTER_UP}


def encoders() -> dict[str, Encoder]:
    """Every encoder, by name; ours is one of them, so that the lower bound is never above it."""
    found: dict[str, Encoder] = {"ours": encode_png, "fpng": encode_fpng}
    for row_filter, number in FILTERS.items():
        for level in (0, 1):
            found[f"isal {level} {row_filter}"] = partial(encode_isal, row_filter=row_filter, level=level)
        for strategy, strategy_number in STRATEGIES.items():
            options = {cv2.IMWRITE_PNG_STRATEGY: strategy_number, cv2.IMWRITE_PNG_FILTER: number}
            found[f"cv2 {strategy} {row_filter}"] = partial(_encode_opencv, options=options)
    try:
        codecs = importlib.import_module("imagecodecs")
    except ImportError:
        return found
    return found | {"imagecodecs png 1": lambda pixels: bytes(codecs.png_encode(pixels, level=1))}


def encode_fpng(pixels: Pixels) -> bytes:
    """PNG of colour by fpng, also where it has holes and becomes twice as large; ours for what fpng does not encode."""
    return bytes(fpng.from_ndarray(np.ascontiguousarray(pixels))) if pixels.ndim == 3 else encode_png(pixels)


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
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", isal_zlib.crc32(body, zlib.crc32(kind)))
        for kind, body in ((b"IHDR", header), (b"IDAT", data), (b"IEND", b""))
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


def _encode_opencv(pixels: Pixels, options: Mapping[int, int]) -> bytes:
    bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, *(number for option in options.items() for number in option)]
    return bytes(cv2.imencode(".png", bgr, settings)[1].data)


def kind_of(pixels: Pixels) -> str:
    """`rgb`, `uint16` or `uint8`."""
    return "rgb" if pixels.ndim == 3 else str(pixels.dtype)


def choose_encoders(images: Sequence[tuple[Pixels, int]]) -> dict[str, tuple[str, Encoder]]:
    """Name and function of the fastest encoder for each kind of image, measured on `images` and the bytes of each now."""
    chosen = {}
    for kind in sorted({kind_of(pixels) for pixels, _ in images}):
        own = [pixels for pixels, _ in images if kind_of(pixels) == kind]
        allowed = NO_LARGER * sum(size for pixels, size in images if kind_of(pixels) == kind)
        timed = {
            name: min(_encode_s(encode, own) for _ in range(3))
            for name, encode in encoders().items()
            if sum(len(encode(pixels)) for pixels in own) <= allowed
        }
        name = min(timed, key=timed.__getitem__)
        chosen[kind] = (name, encoders()[name])
    return chosen


def _encode_s(encode: Encoder, images: Sequence[Pixels]) -> float:
    begun = time.process_time()
    for pixels in images:
        encode(pixels)
    return time.process_time() - begun


def images_of(files: Mapping[str, bytes]) -> list[tuple[Pixels, int]]:
    """Pixels and size of every PNG among the files."""
    return [(decode_png(data, path), len(data)) for path, data in files.items() if path.endswith(".png")]


def run_lower_bound(
    renderer: Renderer,
    scenes: Sequence[Scene],
    files: Mapping[str, bytes],
    chosen: Mapping[str, tuple[str, Encoder]],
    folder: Path,
) -> Lap:
    """Draw every view, encode every image, and write every byte so that it survives a loss of power. `folder` is new.

    The lap's `apart_s` is a first draw of each scene, which uploads its shapes.
    """
    upload, draw, draw_cpu = _draw(renderer, scenes)
    images = images_of(files)
    begun, cpu = time.perf_counter(), time.process_time()
    for pixels, _ in images:
        chosen[kind_of(pixels)][1](pixels)
    encoded = time.perf_counter()
    write_durably(files, folder)
    written = time.perf_counter()
    stages = {"draw": draw, "encode": encoded - begun, "write": written - encoded}
    return Lap(len(scenes), sum(stages.values()), draw_cpu + time.process_time() - cpu, stages, upload)


def _draw(renderer: Renderer, scenes: Sequence[Scene]) -> tuple[float, float, float]:
    """Seconds of uploading every scene's shapes, then of the clock and of the processor for bare passes.

    A bare pass draws and reads back colour without shadows, depth and region, as tier flat does, whatever the job's tier.
    """
    upload, wall, cpu = 0.0, 0.0, 0.0
    for scene in scenes:
        views = [view.camera for pair in scene.pairs for view in pair.views if view.role != "projected"]
        things, appearance = scene.posed.things, scene.posed.appearance
        begun = time.perf_counter()
        renderer.draw(things, appearance, views[0], FLAT)
        drawn, drawn_cpu = time.perf_counter(), time.process_time()
        for camera in views:
            renderer.draw(things, appearance, camera, FLAT)
        upload, wall = upload + drawn - begun, wall + time.perf_counter() - drawn
        cpu += time.process_time() - drawn_cpu
    return upload, wall, cpu


def write_durably(files: Mapping[str, bytes], folder: Path) -> int:
    """Write the files beside `folder`, flush them, and rename them into place at once. Returns the bytes written."""
    staging = folder.with_name(f".{folder.name}")
    for parent in {(staging / path).parent for path in files}:
        parent.mkdir(parents=True, exist_ok=True)
    written = sum((staging / path).write_bytes(data) for path, data in files.items())
    sync_tree(staging)
    os.rename(staging, folder)
    sync_path(folder.parent)
    return written
