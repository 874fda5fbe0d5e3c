"""The least that a machine can do for the same files: bare draws, the fastest encoder, and a durable write."""

import importlib
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from schemas.commit import CommitRecord
from services.bench.ratios import Lap
from workers.render.gbuffer import Renderer
from workers.scene_steps import Scene
from workers.store.durable import sync_folder, sync_tree
from workers.store.images import Pixels, decode_png

Encoder = Callable[[Pixels], bytes]

NO_LARGER = 2.0
"""An encoder that is fast because it hardly compresses is no floor: it may make at most this many times our bytes."""

STRATEGIES = {
    "huffman": cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
    "rle": cv2.IMWRITE_PNG_STRATEGY_RLE,
    "deflate": cv2.IMWRITE_PNG_STRATEGY_DEFAULT,
}
FILTERS = {"none": cv2.IMWRITE_PNG_FILTER_NONE, "sub": cv2.IMWRITE_PNG_FILTER_SUB, "up": cv2.IMWRITE_PNG_FILTER_UP}
REPEATS = 3


def encoders() -> dict[str, Encoder]:
    """Every lossless PNG encoder at hand, by name."""
    found: dict[str, Encoder] = {}
    for strategy, number in STRATEGIES.items():
        for row_filter, filter_number in FILTERS.items():
            settings = [
                *(cv2.IMWRITE_PNG_COMPRESSION, 1),
                *(cv2.IMWRITE_PNG_STRATEGY, number),
                *(cv2.IMWRITE_PNG_FILTER, filter_number),
            ]
            found[f"cv2 {strategy} {row_filter}"] = _opencv(settings)
    try:
        codecs = importlib.import_module("imagecodecs")
    except ImportError:
        return found
    return found | {"imagecodecs png 1": lambda pixels: bytes(codecs.png_encode(pixels, level=1))}


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
    begun = time.perf_counter()
    for pixels, _ in images:
        encode(pixels)
    return time.perf_counter() - begun


def committed_files(root: Path, record: CommitRecord) -> dict[str, bytes]:
    """Every file that a commit named, as it is on disk."""
    return {entry.path: (root / entry.path).read_bytes() for entry in record.files}


def images_of(files: Mapping[str, bytes]) -> list[tuple[Pixels, int]]:
    """Pixels and size of every PNG among the files."""
    return [(decode_png(data, path), len(data)) for path, data in files.items() if path.endswith(".png")]


def run_floor(
    renderer: Renderer,
    scenes: Sequence[Scene],
    files: Mapping[str, bytes],
    chosen: Mapping[str, tuple[str, Encoder]],
    folder: Path,
) -> Lap:
    """Draw every view, encode every image, write every byte so that it survives a loss of power. `folder` is new."""
    images = images_of(files)
    marks, cpu = [time.perf_counter()], time.process_time()
    for scene in scenes:
        for pair in scene.pairs:
            for view in pair.views[:3]:
                renderer.draw(scene.posed.things, scene.posed.appearance, view.camera)
    marks.append(time.perf_counter())
    for pixels, _ in images:
        chosen[kind_of(pixels)][1](pixels)
    marks.append(time.perf_counter())
    write_durably(files, folder)
    marks.append(time.perf_counter())
    draw, encode, write = np.diff(marks).tolist()
    stages = {"draw": draw, "encode": encode, "write": write}
    return Lap(len(scenes), marks[-1] - marks[0], time.process_time() - cpu, stages)


def write_durably(files: Mapping[str, bytes], folder: Path) -> int:
    """Write the files beside `folder`, flush them, and rename them into place at once. Returns the bytes written."""
    staging = folder.with_name(f".{folder.name}")
    written = 0
    for path, data in files.items():
        target = staging / path
        try:
            file = open(target, "wb")  # noqa: SIM115 - closed below
        except FileNotFoundError:
            target.parent.mkdir(parents=True)
            file = open(target, "wb")  # noqa: SIM115
        with file:
            written += file.write(data)
    sync_tree(staging)
    os.rename(staging, folder)
    sync_folder(folder.parent)
    return written


def clear(folder: Path) -> None:
    """Remove what a round left."""
    shutil.rmtree(folder, ignore_errors=True)
