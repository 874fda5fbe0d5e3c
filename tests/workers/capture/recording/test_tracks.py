"""Tracks, tags and the attachment of files that were written from the published layout."""

import json

import pytest

from schemas.errors import CaptureError
from tests.workers.capture.recording.made_up_recording import (
    TAGS,
    calibration,
    frames,
    recording,
    renamed,
    tracks,
    without,
)
from tests.workers.capture.recording.matroska import write_recording
from workers.capture.recording.tracks import open_recording, read_frames

CALIBRATION = json.dumps(calibration()).encode()


def saved(tmp_path, data: bytes):
    path = tmp_path / "r.mkv"
    path.write_bytes(data)
    return path


def test_what_the_recording_says_is_read(tmp_path):
    found = open_recording(saved(tmp_path, recording(2)))
    assert (found.color_format, found.color_size, found.depth_size) == ("MJPG", (1280, 720), (320, 288))
    assert (found.depth_mode, found.serial_number) == ("NFOV_2X2BINNED", "000123")
    assert found.calibration == CALIBRATION
    assert found.period_us == pytest.approx(33_333.3, abs=0.1) and found.depth_delay_us == 160.0


def test_every_frame_comes_back_byte_for_byte_with_its_time(tmp_path):
    path = saved(tmp_path, recording(3))
    color, depth = frames(3)
    found = list(read_frames(open_recording(path)))
    assert [(f.stamp_us, f.data) for f in found if not f.is_depth] == color
    assert [(f.stamp_us, f.data) for f in found if f.is_depth] == depth, "and not the infra-red track's"


def test_a_cut_file_gives_the_frames_before_the_cut_and_no_half_frame(tmp_path):
    data = recording(4)
    color, depth = frames(4)
    whole_frames = dict(color + depth)
    for share in (0.35, 0.6, 0.85):
        found = list(read_frames(open_recording(saved(tmp_path, data[: int(len(data) * share)]))))
        assert 0 < len(found) < 8
        assert all(frame.data == whole_frames[frame.stamp_us] for frame in found)


def test_tags_find_the_tracks_where_names_do_not(tmp_path):
    data = recording(1)
    unnamed = data.replace(b"\x53\x6e\x01\0\0\0\0\0\0\x05DEPTH", b"\x53\x6e\x01\0\0\0\0\0\0\x05other")
    assert unnamed != data
    assert open_recording(saved(tmp_path, unnamed)).depth_size == (320, 288)


BROKEN = [
    ("color", write_recording(without(tracks(1), "COLOR"), CALIBRATION, TAGS), "no colour track"),
    ("depth", write_recording(without(tracks(1), "DEPTH"), CALIBRATION, TAGS), "no depth track"),
    ("calibration", write_recording(tracks(1), None, TAGS), "no attachment calibration.json"),
    ("mode", write_recording(renamed(tracks(1), "DEPTH", tags={}), CALIBRATION, TAGS), "K4A_DEPTH_MODE"),
    ("format", write_recording(renamed(tracks(1), "DEPTH", fourcc=b"YUY2"), CALIBRATION, TAGS), "b16g is read"),
    ("format", write_recording(renamed(tracks(1), "COLOR", fourcc=b"H264"), CALIBRATION, TAGS), "colour frames are"),
    ("format", write_recording(tracks(1), CALIBRATION, TAGS | {"K4A_DEPTH_DELAY_NS": "soon"}), "no number"),
    ("empty", b"", "no bytes"),
    ("unreadable", b"hello" * 1000, "Matroska"),
    ("unreadable", recording(1)[:200], "Matroska"),
]


@pytest.mark.parametrize(("reason", "data", "told"), BROKEN, ids=[told for _, _, told in BROKEN])
def test_what_is_missing_is_named_with_a_remedy(tmp_path, reason, data, told):
    path = saved(tmp_path, data)
    with pytest.raises(CaptureError, match=told) as caught:
        open_recording(path)
    assert caught.value.reason == reason and str(path) in caught.value.detail


def test_a_path_that_is_no_file_is_named(tmp_path):
    with pytest.raises(CaptureError, match="no file"):
        open_recording(tmp_path)
