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
from tests.encoded_digests import digests, main, render, save_sources
from workers.store.images import decode_png, encode_mask, encode_png

SIDES = st.integers(1, 9)


def image_arrays():
    colour = st.tuples(SIDES, SIDES, st.just(3)).flatmap(lambda shape: hnp.arrays(np.uint8, shape))
    gray = st.tuples(SIDES, SIDES).flatmap(lambda shape: hnp.arrays(np.uint8, shape))
    depth = st.tuples(SIDES, SIDES).flatmap(lambda shape: hnp.arrays(np.uint16, shape))
    return st.one_of(colour, gray, depth)


@given(image_arrays(), st.integers(0, 9))
def test_every_level_gives_back_the_pixels_and_their_type(pixels, level):
    decoded = decode_png(encode_png(pixels, level))
    assert decoded.dtype == pixels.dtype
    np.testing.assert_array_equal(decoded, pixels)


@given(hnp.arrays(np.bool_, st.tuples(SIDES, SIDES)))
def test_a_mask_is_white_where_it_is_true_and_black_elsewhere(mask):
    decoded = decode_png(encode_mask(mask))
    assert decoded.dtype == np.uint8
    np.testing.assert_array_equal(decoded, np.where(mask, 255, 0))


@given(image_arrays())
def test_another_decoder_reads_the_same_pixels_with_red_first(pixels):
    with Image.open(io.BytesIO(encode_png(pixels, 1))) as image:
        assert (
            image.mode
            == {("uint8", 3): "RGB", ("uint8", 2): "L", ("uint16", 2): "I;16"}[(pixels.dtype.name, pixels.ndim)]
        )
        np.testing.assert_array_equal(np.asarray(image), pixels)


def test_what_another_encoder_wrote_is_read_with_red_first():
    pixels = np.zeros((2, 3, 3), np.uint8)
    pixels[0, 0] = (250, 120, 5)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    np.testing.assert_array_equal(decode_png(file.getvalue()), pixels)


def test_the_same_pixels_give_the_same_bytes_whatever_their_layout_in_memory():
    pixels = np.random.default_rng(1).integers(0, 256, (40, 60, 3), dtype=np.uint8)
    strided = np.asfortranarray(np.concatenate([pixels, pixels], axis=1))[:, :60]
    assert encode_png(strided, 1) == encode_png(pixels, 1)


@pytest.mark.parametrize("shape", [(1, 65_535, 3), (1, 65_536, 3), (65_536, 2, 3)])
def test_shaded_colour_of_any_length_reads_back(shape):
    pixels = np.random.default_rng(2).integers(0, 256, shape, dtype=np.uint8)
    np.testing.assert_array_equal(decode_png(encode_png(pixels)), pixels)


def test_an_encoder_that_stops_early_is_noticed(monkeypatch):
    pixels = np.random.default_rng(2).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    cut = encode_png(pixels)[:-3]
    monkeypatch.setattr("fpng.from_ndarray", lambda _: cut)
    with pytest.raises(ValueError, match="does not end"):
        encode_png(pixels)


@pytest.mark.parametrize(
    "pixels",
    [
        np.zeros((4, 4, 4), np.uint8),
        np.zeros((4, 4), np.float32),
        np.zeros((4, 4, 3), np.uint16),
        np.zeros((0, 4), np.uint8),
    ],
    ids=["alpha", "float", "16-bit colour", "empty"],
)
def test_an_image_that_has_no_encoding_is_refused(pixels):
    with pytest.raises(ValueError, match="image of shape"):
        encode_png(pixels, 1)


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


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    path = tmp_path_factory.mktemp("sources") / "sources.npy"
    save_sources(path, render(2))
    return path


@pytest.mark.parametrize(
    "images", [pytest.param(400, id="400"), pytest.param(100_000, id="100000", marks=pytest.mark.slow)]
)
@pytest.mark.timeout(3_600)
def test_two_processes_encode_alike_in_any_order_whatever_is_left_in_memory(sources, tmp_path, images):
    files = [tmp_path / "forward.npy", tmp_path / "backward.npy"]
    for file, more in zip(files, ([], ["--backward"]), strict=True):
        command = [sys.executable, "-m", "tests.encoded_digests", "digest", str(sources), str(file)]
        # glibc fills whatever is allocated or freed, in the second process alone.
        extra = {"MALLOC_PERTURB_": "165"} if more else {}
        subprocess.run([*command, "--images", str(images), *more], env={**os.environ, **extra}, check=True)
    assert len(np.load(files[0])) == images
    assert main(["compare", *map(str, files)]) == 0


def test_an_encoder_that_remembers_what_it_did_before_is_found(monkeypatch):
    counted = iter(range(10_000))

    def encode_and_count(pixels):
        return bytes([next(counted) % 256])

    monkeypatch.setattr("tests.encoded_digests.encode_png", encode_and_count)
    with pytest.raises(AssertionError, match="two encodings"):
        list(digests([np.zeros((4, 4), np.uint8)], range(10), seed=0))


def test_one_other_byte_is_told(tmp_path, capsys):
    files = [tmp_path / "one.npy", tmp_path / "two.npy"]
    one = np.zeros((5, 16), np.uint8)
    np.save(files[0], one)
    one[3, 7] = 1
    np.save(files[1], one)
    assert main(["compare", *map(str, files)]) == 1
    assert "5 images, 1 with other bytes: [3]" in capsys.readouterr().out
