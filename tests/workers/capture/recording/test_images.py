"""Frames as bytes, against arrays that were encoded by OpenCV."""

import cv2
import numpy as np
import pytest

from tests.workers.capture.recording.made_up_recording import color_bytes
from workers.capture.recording.tracks import FORMATS, decode_color, decode_depth, decode_gray, is_whole

SIZE = (64, 48)
SMOOTH = cv2.resize(np.random.default_rng(5).integers(60, 200, (3, 4, 3)).astype(np.uint8), SIZE)


@pytest.mark.parametrize("fourcc", FORMATS)
def test_colour_comes_back(fourcc):
    data = color_bytes(SMOOTH, fourcc)
    rgb = decode_color(data, fourcc, SIZE)
    assert rgb.dtype == np.uint8 and np.abs(rgb.astype(int) - SMOOTH).mean() < (0.01 if fourcc == "BGRA" else 4.0)


@pytest.mark.parametrize("fourcc", FORMATS)
def test_the_grey_picture_has_half_the_size_and_the_brightness(fourcc):
    gray = decode_gray(color_bytes(SMOOTH, fourcc), fourcc, SIZE)
    true = cv2.resize(cv2.cvtColor(SMOOTH, cv2.COLOR_RGB2GRAY), (32, 24), interpolation=cv2.INTER_AREA)
    assert gray.shape == (24, 32)
    scale = 1.0 if fourcc in ("MJPG", "BGRA") else 219 / 255  # video range, from 16 up
    assert np.corrcoef(gray.ravel(), true.ravel())[0, 1] > 0.99
    assert gray.astype(float).std() == pytest.approx(true.std() * scale, rel=0.1)


@pytest.mark.parametrize("fourcc", FORMATS)
def test_a_frame_that_lost_its_end_is_not_whole(fourcc):
    data = color_bytes(SMOOTH, fourcc)
    assert is_whole(data, fourcc, SIZE)
    assert not is_whole(data[:-40], fourcc, SIZE) and not is_whole(b"", fourcc, SIZE)


def test_jpeg_frames_may_be_padded_and_other_bytes_are_none():
    data = color_bytes(SMOOTH, "MJPG")
    assert is_whole(data + bytes(7), "MJPG", SIZE)
    assert decode_color(b"\xff\xd8nothing\xff\xd9", "MJPG", SIZE) is None
    assert decode_gray(b"\xff\xd8nothing\xff\xd9", "MJPG", SIZE) is None
    assert decode_color(data, "MJPG", (48, 64)) is None, "another size than the track's"


def test_motion_jpeg_without_huffman_tables_is_read():
    """Cameras leave the standard tables out (segments DHT, 0xFFC4), as AVI's MJPG allows."""
    data = color_bytes(SMOOTH, "MJPG")
    at, bare = 2, data[:2]
    while data[at + 1] != 0xDA:
        length = 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        bare += b"" if data[at + 1] == 0xC4 else data[at : at + length]
        at += length
    bare += data[at:]
    assert len(bare) < len(data)
    assert np.array_equal(decode_color(bare, "MJPG", SIZE), decode_color(data, "MJPG", SIZE))


def test_depth_is_big_endian():
    data = bytes([0x01, 0x02, 0xFF, 0x00, 0x00, 0x07])
    assert decode_depth(data, (3, 1)).tolist() == [[0x0102, 0xFF00, 7]]
    assert decode_depth(data, (1, 3)).dtype == np.uint16
