"""The same pixels give the same PNG bytes, whatever was encoded before, wherever they lie, in every process."""

import io
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from schemas.errors import CorruptError
from tests.kit.encoded_digests import digests, render
from workers.store.images import decode_png, encode_mask, encode_png

SIDES = st.integers(1, 9)
MODES = {("uint8", 3): "RGB", ("uint8", 2): "L", ("uint16", 2): "I;16"}
NOISE = np.random.default_rng(2).integers(0, 256, (131_072, 3), dtype=np.uint8)


def image_arrays():
    colour = st.tuples(SIDES, SIDES, st.just(3)).flatmap(lambda shape: hnp.arrays(np.uint8, shape))
    gray = st.tuples(SIDES, SIDES).flatmap(lambda shape: hnp.arrays(np.uint8, shape))
    depth = st.tuples(SIDES, SIDES).flatmap(lambda shape: hnp.arrays(np.uint16, shape))
    wide = st.tuples(SIDES, SIDES, st.just(3)).flatmap(lambda shape: hnp.arrays(np.uint16, shape))
    return st.one_of(colour, gray, depth, wide)


@given(image_arrays(), st.integers(0, 9))
def test_every_level_gives_back_the_pixels_and_their_type_here_and_in_another_decoder(pixels, level):
    data = encode_png(pixels, level)
    decoded = decode_png(data)
    assert decoded.dtype == pixels.dtype and np.array_equal(decoded, pixels)
    seen = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(seen[..., ::-1] if pixels.ndim == 3 else seen, pixels)
    if (pixels.dtype, pixels.ndim) == (np.uint16, 3):  # of which Pillow drops the lower byte
        return
    with Image.open(io.BytesIO(data)) as image:
        assert image.mode == MODES[pixels.dtype.name, pixels.ndim]
        np.testing.assert_array_equal(np.asarray(image), pixels)
    if pixels.ndim == 2:
        mask = pixels % 2 == 1
        assert np.array_equal(decode_png(encode_mask(mask)), np.where(mask, np.uint8(255), np.uint8(0)))


def test_colour_of_any_length_layout_and_encoder_reads_back_with_red_first():
    for shape in ((1, 65_535, 3), (1, 65_536, 3), (65_536, 2, 3)):
        pixels = NOISE[: shape[0] * shape[1]].reshape(shape)
        np.testing.assert_array_equal(decode_png(encode_png(pixels)), pixels)
    pixels = NOISE[:2400].reshape(40, 60, 3)
    strided = np.asfortranarray(np.concatenate([pixels, pixels], axis=1))[:, :60]
    assert encode_png(strided, 1) == encode_png(pixels, 1)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    np.testing.assert_array_equal(decode_png(file.getvalue()), pixels)


def test_what_has_no_encoding_is_refused_and_an_encoder_that_stops_early_is_noticed(monkeypatch):
    for shape, kind in (
        ((4, 4, 4), np.uint16),
        ((4, 4, 5), np.uint8),
        ((4, 4), np.float32),
        ((4, 4, 2), np.uint16),
        ((0, 4), np.uint8),
    ):
        with pytest.raises(ValueError, match="image of shape"):
            encode_png(np.zeros(shape, kind), 1)
    pixels = NOISE[:64].reshape(8, 8, 3)
    cut = encode_png(pixels)[:-3]
    monkeypatch.setattr("fpng.from_ndarray", lambda _: cut)
    with pytest.raises(ValueError, match="does not end"):
        encode_png(pixels)


def test_every_flipped_bit_and_every_cut_is_found():
    data = encode_png(np.arange(200, dtype=np.uint16).reshape(10, 20) * 300, 1)
    for position in range(len(data)):
        damaged = bytearray(data)
        damaged[position] ^= 1 << (position % 8)
        with pytest.raises(CorruptError, match="mug"):
            decode_png(bytes(damaged), "mug/depth00000.png")
        with pytest.raises(CorruptError):
            decode_png(data[:position], "mug/depth00000.png")


def test_fast_is_no_larger_than_what_opencv_does_by_itself_but_for_a_seventh_with_noise():
    y, x = np.mgrid[0:480, 0:640]
    noise = np.random.default_rng(0).normal(size=(480, 640, 3))
    rendered = np.stack([120 + x // 40, 110 + y // 12, 90 + (x + y) // 30], axis=-1)
    holes = np.where(noise[..., :1] > 1, rendered, 0).astype(np.uint8)
    depth = np.where(noise[..., 0] > 1, 10_000 + 3 * y, 0).astype(np.uint16)
    noisy = np.clip(rendered + 3 * noise, 0, 255).astype(np.uint8)
    for pixels, share in ((holes, 0.9), (depth, 0.9), (noisy, 8 / 7)):
        assert len(encode_png(pixels, 1)) <= share * len(cv2.imencode(".png", pixels)[1])
        assert len(encode_png(pixels, 6)) < len(encode_png(pixels, 2)) < len(encode_png(pixels, 1))


def drawn() -> list[np.ndarray]:
    """Colour with and without holes, depth and regions."""
    y, x = np.mgrid[0:120, 0:160]
    rgb = np.stack([120 + x // 10, 110 + y // 4, 90 + (x + y) // 9], axis=-1).astype(np.uint8)
    region = (2 + (x > 50) + (y > 70)).astype(np.uint8)
    return [rgb, np.where(region[..., None] > 2, rgb, np.uint8(0)), (10_000 + 3 * y).astype(np.uint16), region]


@pytest.mark.parametrize(
    ("images", "make"),
    [(100, drawn), pytest.param(100_000, lambda: render(2), marks=pytest.mark.slow)],
    ids=["few", "all"],
)
@pytest.mark.timeout(3_600)
def test_two_processes_encode_alike_in_any_order_whatever_is_left_in_memory(tmp_path, images, make):
    sources, files = tmp_path / "sources.npz", [tmp_path / "forward.npy", tmp_path / "backward.npy"]
    np.savez(sources, *make())
    for file, more in zip(files, ([], ["backward"]), strict=True):
        command = [sys.executable, "-m", "tests.kit.encoded_digests", str(sources), str(file), str(images), *more]
        # glibc fills whatever is allocated or freed, in the second process alone.
        extra = {"MALLOC_PERTURB_": "165"} if more else {}
        subprocess.run(command, env={**os.environ, **extra}, check=True)
    forward, backward = map(np.load, files)
    assert len(forward) == images and np.array_equal(forward, backward)


def test_an_encoder_that_remembers_what_it_did_before_is_found(monkeypatch):
    counted = iter(range(10_000))
    monkeypatch.setattr("tests.kit.encoded_digests.encode_png", lambda pixels: bytes([next(counted) % 256]))
    with pytest.raises(AssertionError, match="two encodings"):
        list(digests([np.zeros((4, 4), np.uint8)], range(10), seed=0))
