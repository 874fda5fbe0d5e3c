"""What a file says about its own length, against files that were written whole."""

from typing import Any

import pytest

from tests.workers.capture.recording.matroska import Track, element, write_recording
from workers.capture.recording.tracks import Extent, read_extent

FRAMES = [(i * 33_333, bytes(100)) for i in range(10)]


def written(**settings: Any) -> bytes:
    return write_recording([Track("COLOR", 1280, 720, b"MJPG", FRAMES)], b"{}", {}, **settings)


def test_a_whole_file_says_its_size_and_a_cut_one_the_same():
    data = written()
    assert read_extent(data) == Extent(len(data), None)
    assert read_extent(data[: len(data) // 2]) == Extent(len(data), None)


def test_the_length_of_the_recording_is_read_where_it_is_written():
    extent = read_extent(written(duration=True))
    assert extent.duration_us == pytest.approx(9 * 33_333 + 1e6 / 30)


@pytest.mark.parametrize("size", [b"\x01" + b"\xff" * 7, b"\x01" + b"\x00" * 7], ids=["unknown", "not filled in"])
def test_a_file_that_was_never_closed_says_nothing(size):
    data = written()
    at = data.index(b"\x18\x53\x80\x67") + 4
    assert read_extent(data[:at] + size + data[at + 8 :]).size_bytes is None


@pytest.mark.parametrize("data", [b"", b"\0" * 50, b"hello", element(0x1A45DFA3, b"x"), b"\x1a\x45\xdf\xa3"])
def test_what_is_no_recording_says_nothing(data):
    assert read_extent(data) == Extent()
