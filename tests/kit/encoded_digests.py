"""Digests of many encoded images, to compare between processes, processors and contents of leftover memory.

`python -m tests.kit.encoded_digests SOURCES.npz DIGESTS.npy IMAGES [backward]` loads the encoder and nothing else of the project.
"""

import hashlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from workers.store.images import decode_png, encode_png

BLOCK = 40
"""Images that are encoded between the two times that each is."""
DIGEST = 16
"""Bytes of a digest."""


def render(scenes: int) -> list[NDArray]:
    """Every image of some scenes of the default job, as it comes from the renderer, and their textures."""
    from schemas.job.job import Job
    from workers.assets.catalogue import open_catalogue
    from workers.scene.context import open_worker
    from workers.scene.make_scene import make_scene
    from workers.stopwatch import Stopwatch

    job = Job(name="digests", seed=11, scenes=scenes)
    context = open_worker(job, open_catalogue(job.assets, Path(), tuple(job.categories)))
    images: list[NDArray] = []
    for scene_id in range(scenes):
        scene = make_scene(context, scene_id, Stopwatch())
        for view in (view for pair in scene.pairs for view in pair.views):
            images += [pixels for pixels in (view.rgb, view.depth, view.region) if pixels is not None]
        parts = [part for start in scene.plan.objects for part in start.asset.shape.parts]
        textures = [part.material.texture for part in parts]
        images += [texture for texture in textures if texture is not None and texture.shape[2] == 3]
    return images


def variant(sources: Sequence[NDArray], number: int) -> NDArray:
    """Image `number`: a part of a source from 1 x 1 up to all of it, turned, recoloured, and with noise of any strength."""
    rng = np.random.default_rng([3, number])
    source = sources[int(rng.integers(len(sources)))]
    height, width = source.shape[:2]
    whole = rng.random() < 0.03
    sides = [side if whole else int(np.exp(rng.uniform(0, np.log(side)))) for side in (height, width)]
    top, left = (int(rng.integers(full - side + 1)) for full, side in zip((height, width), sides, strict=True))
    pixels = np.rot90(source[top : top + sides[0], left : left + sides[1]], int(rng.integers(4)))
    pixels = pixels[:: int(rng.choice((-1, 1)))]
    if source.ndim == 3:
        pixels = pixels[..., rng.permutation(3)]
    strength = int(rng.choice((0, 0, 0, 1, 4, 30, 256)))
    if strength:
        noise = rng.integers(-strength, strength + 1, pixels.shape, dtype=np.int16)
        pixels = pixels + noise.astype(pixels.dtype)  # wraps, so that every value comes up
    return np.ascontiguousarray(pixels)


def digests(sources: Sequence[NDArray], numbers: Sequence[int], seed: int) -> Iterator[tuple[int, bytes]]:
    """(number, digest of its PNG) of each image, encoded twice, which must decode to its pixels.

    Between the two times lie other images, in another order and other buffers, and memory filled with random bytes.
    """
    rng = np.random.default_rng(seed)
    for begin in range(0, len(numbers), BLOCK):
        block = {number: variant(sources, number) for number in numbers[begin : begin + BLOCK]}
        first = {number: encode_png(pixels) for number, pixels in block.items()}
        for number in rng.permutation(list(block)).tolist():
            _dirty_memory(rng)
            again = encode_png(_elsewhere(block[number], rng))
            if again != first[number]:
                raise AssertionError(f"image {number} has two encodings: {len(first[number])} and {len(again)} bytes")
            decoded = decode_png(again)
            if decoded.dtype != block[number].dtype or not np.array_equal(decoded, block[number]):
                raise AssertionError(f"image {number} decodes to other pixels")
            yield number, hashlib.sha256(again).digest()[:DIGEST]


def _elsewhere(pixels: NDArray, rng: np.random.Generator) -> NDArray:
    """The same pixels in other memory, at any address that its type allows."""
    offset = pixels.itemsize * int(rng.integers(64))
    memory = np.frombuffer(rng.bytes(offset + pixels.nbytes + 64), np.uint8).copy()
    moved = memory[offset : offset + pixels.nbytes].view(pixels.dtype).reshape(pixels.shape)
    moved[...] = pixels
    return moved


def _dirty_memory(rng: np.random.Generator) -> None:
    """Leaves random bytes in memory that was just freed, in pieces as large as an encoder's tables and buffers."""
    sizes = rng.choice((200, 3_000, 33_000, 66_000, 140_000, 300_000), 4)
    noise = rng.bytes(4_096)
    pieces = [bytearray(noise * (int(size) // 4_096 + 1)) for size in sizes]
    del pieces


if __name__ == "__main__":
    sources, out, images, *backward = sys.argv[1:]
    numbers = list(range(int(images)))
    images_of_file = list(np.load(sources).values())
    found = dict(digests(images_of_file, numbers[::-1] if backward else numbers, seed=len(backward)))
    np.save(out, np.frombuffer(b"".join(found[number] for number in numbers), np.uint8).reshape(-1, DIGEST))
