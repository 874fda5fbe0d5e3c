"""Recordings written from the published layout: what is read of them, and what is refused."""

import json

import cv2
import numpy as np
import pytest

from schemas.errors import CaptureError
from tests.workers.door.recordings import (
    TAGS,
    calibration,
    camera_entry,
    color_bytes,
    frames,
    recording,
    renamed,
    tracks,
    write_recording,
)
from tests.workers.geometry.made_up_kinect import COLOR_LENS, T_COLOR_DEPTH
from workers.door.recordings.formats import open_any
from workers.door.recordings.kinect import COLOR_SIZES, DEPTH_MODES, FORMATS, decode_color, read_calibration
from workers.geometry.frames import transform
from workers.geometry.pixels import pixel_rays, project_points

ATTACHED = json.dumps(calibration()).encode()


def saved(folder, data: bytes):
    path = folder / "r.mkv"
    path.write_bytes(data)
    return path


# ---------------------------------------------------------------------------------------------- tracks and frames


def test_what_the_recording_says_is_read_and_every_frame_comes_back(tmp_path):
    made = open_any(saved(tmp_path, recording(3)))
    assert made.told == {"serial_number": "000123", "depth_mode": "NFOV_2X2BINNED"}
    assert made.period_us == pytest.approx(33_333.3, abs=0.1) and made.depth_delay_us == 160.0
    assert made.color.lens == pytest.approx(COLOR_LENS) and made.color.depth_units_per_m == 1000.0
    assert made.depth.T_color_depth == pytest.approx(T_COLOR_DEPTH, abs=1e-12)
    read = list(made.frames())
    for is_depth, written in zip((False, True), frames(3), strict=True):
        assert [frame.stamp_us for frame in read if frame.is_depth == is_depth] == [stamp for stamp, _ in written]
    for frame, (_, data) in zip([frame for frame in read if not frame.is_depth], frames(3)[0], strict=True):
        assert np.array_equal(frame.load(False), cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB))
    for frame, (_, data) in zip([frame for frame in read if frame.is_depth], frames(3)[1], strict=True):
        assert np.array_equal(frame.load(False), np.frombuffer(data, ">u2").reshape(288, 320) / 1000.0), "not infra-red"


def test_a_cut_file_gives_the_frames_before_the_cut_and_no_half_frame(tmp_path):
    data, stamps = recording(4), {stamp for written in frames(4) for stamp, _ in written}
    for share in (0.35, 0.6, 0.85):
        read = list(open_any(saved(tmp_path, data[: int(len(data) * share)])).frames())
        assert 0 < len(read) < 8
        assert all(frame.stamp_us in stamps and frame.load(False) is not None for frame in read)


def test_tags_find_the_tracks_where_names_do_not(tmp_path):
    data = recording(1)
    unnamed = data.replace(b"\x53\x6e\x01\0\0\0\0\0\0\x05DEPTH", b"\x53\x6e\x01\0\0\0\0\0\0\x05other")
    assert unnamed != data
    assert len(list(open_any(saved(tmp_path, unnamed)).frames())) == 2


def test_what_is_missing_is_named_with_a_remedy(tmp_path):
    late = TAGS | {"K4A_DEPTH_DELAY_NS": "soon"}
    for reason, data, told in [
        ("mode", write_recording(renamed(tracks(1), "DEPTH", tags={}), ATTACHED, TAGS), "K4A_DEPTH_MODE"),
        ("format", write_recording(renamed(tracks(1), "DEPTH", fourcc=b"YUY2"), ATTACHED, TAGS), "b16g is read"),
        ("format", write_recording(renamed(tracks(1), "COLOR", fourcc=b"H264"), ATTACHED, TAGS), "colour frames are"),
        ("format", write_recording(tracks(1), ATTACHED, late), "no number"),
    ]:
        path = saved(tmp_path, data)
        with pytest.raises(CaptureError, match=told) as caught:
            open_any(path)
        assert caught.value.reason == reason and str(path) in caught.value.detail


# ---------------------------------------------------------------------------------------------- images

SIZE = (64, 48)
SMOOTH = cv2.resize(np.random.default_rng(5).integers(60, 200, (3, 4, 3)).astype(np.uint8), SIZE)


@pytest.mark.parametrize("fourcc", FORMATS)
def test_colour_comes_back_and_its_grey_picture_at_half_the_size(fourcc):
    data = color_bytes(SMOOTH, fourcc)
    rgb, gray = (decode_color(data, fourcc, SIZE, small) for small in (False, True))
    assert rgb.dtype == np.uint8 and np.abs(rgb.astype(int) - SMOOTH).mean() < (0.01 if fourcc == "BGRA" else 4.0)
    true = cv2.resize(cv2.cvtColor(SMOOTH, cv2.COLOR_RGB2GRAY), (32, 24), interpolation=cv2.INTER_AREA)
    scale = 1.0 if fourcc in ("MJPG", "BGRA") else 219 / 255  # video range, from 16 up
    assert np.corrcoef(gray.ravel(), true.ravel())[0, 1] > 0.99
    assert gray.astype(float).std() == pytest.approx(true.std() * scale, rel=0.1)
    assert decode_color(data[:-40], fourcc, SIZE, False) is None and decode_color(b"", fourcc, SIZE, True) is None


def test_jpeg_frames_may_be_padded_or_lack_huffman_tables_and_other_bytes_are_none():
    data = color_bytes(SMOOTH, "MJPG")
    whole = decode_color(data, "MJPG", SIZE, False)
    assert np.array_equal(decode_color(data + bytes(7), "MJPG", SIZE, False), whole)
    assert decode_color(b"\xff\xd8nothing\xff\xd9", "MJPG", SIZE, False) is None
    assert decode_color(data, "MJPG", (48, 64), True) is None, "another size than the track's"
    at, bare = 2, data[:2]  # cameras leave the standard tables out (segments DHT, 0xFFC4), as AVI's MJPG allows
    while data[at + 1] != 0xDA:
        length = 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        bare += b"" if data[at + 1] == 0xC4 else data[at : at + length]
        at += length
    bare += data[at:]
    assert len(bare) < len(data)
    assert np.array_equal(decode_color(bare, "MJPG", SIZE, False), whole)


# ---------------------------------------------------------------------------------------------- calibration

# The calibration of a device, and where its SDK 1.x puts one point: tests/Transformation/transformation.cpp and
# ut_calibration_data.h of Microsoft's Azure Kinect Sensor SDK (MIT). Millimetres; pixel centres on whole numbers.
SDK_DEPTH = [0.50218582153320313, 0.50179535150527954, 0.49281969666481018, 0.49292713403701782, 0.58251643180847168,
             0.0061361165717244148, -0.0013186802389100194, 0.92561346292495728, 0.12568977475166321,
             -0.0065302476286888123, 0, 0, -0.000020833556845900603, -0.00012877916742581874]  # fmt: skip
SDK_COLOR = [0.49626153707504272, 0.50453948974609375, 0.48109495639801025, 0.85502892732620239, -1.05756676197052,
             -1.3993426561355591, 1.7508856058120728, -1.1485179662704468, -1.1924415826797485, 1.6220585107803345,
             0, 0, -0.000012259531104064081, 0.00069101608823984861]  # fmt: skip
SDK_ROTATION = [[0.99999475479125977, 0.000089527980890125036, -0.0032330064568668604],
                [0.0001289974752580747, 0.99771732091903687, 0.0675286054611206],
                [0.00323167210444808, -0.067528672516345978, 0.99771207571029663]]  # fmt: skip
SDK_TRANSLATION = [-0.031942266970872879, -0.0024762286338955164, 0.0036488529294729233]


def sdk() -> bytes:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = SDK_ROTATION, SDK_TRANSLATION
    depth = camera_entry("D0", SDK_DEPTH, np.eye(4), (1024, 1024))
    cameras = [depth, camera_entry("PV0", SDK_COLOR, T, (3840, 2160))]
    return json.dumps({"CalibrationInformation": {"Cameras": cameras}}).encode() + b"\0"


def test_a_point_is_where_the_sdk_puts_it():
    color, depth = read_calibration(sdk(), (3840, 2160), "WFOV_2X2BINNED")
    point = np.array([[*pixel_rays(depth.intrinsics, depth.lens)[256, 256], 1.0]])
    assert point[0] * 1000 == pytest.approx([-2.45376134, -1.66107690, 1000.0], abs=1e-3)
    seen = transform(depth.T_color_depth, point)
    assert seen[0] * 1000 == pytest.approx([-37.6291695, 63.3947754, 1001.46521], abs=1e-3)
    at = project_points(seen, color.intrinsics, color.lens)
    assert at[0] - 0.5 == pytest.approx([1835.689453, 1206.290039], abs=2e-3)


def test_modes_are_parts_of_one_sensor():
    """All colour modes use the sensor's whole width and its middle height; depth modes are cut out and binned."""
    reference = read_calibration(sdk(), (4096, 3072), "NFOV_UNBINNED")[0].intrinsics
    for size in COLOR_SIZES:
        k, times = read_calibration(sdk(), size, "NFOV_UNBINNED")[0].intrinsics, size[0] / 4096
        assert (k.fx, k.fy, k.cx) == pytest.approx((reference.fx * times, reference.fy * times, reference.cx * times))
        assert k.cy - 0.5 * k.height == pytest.approx((reference.cy - 1536) * times)
    whole = read_calibration(sdk(), (1280, 720), "WFOV_UNBINNED")[1].intrinsics
    for mode, (across, cut, _) in DEPTH_MODES.items():
        k, times = read_calibration(sdk(), (1280, 720), mode)[1].intrinsics, across / 1024
        expected = (whole.fx * times, whole.cx * times, whole.cy * times)
        assert (k.fx, k.cx + cut[0], k.cy + cut[1]) == pytest.approx(expected)
    narrow = read_calibration(sdk(), (1280, 720), "NFOV_2x2BINNED")[1].intrinsics  # as old recordings write it
    assert (narrow.width, narrow.height) == (320, 288)
    for size, mode in (((640, 480), "NFOV_UNBINNED"), ((1280, 720), "PASSIVE_IR"), ((1280, 720), "")):
        with pytest.raises(CaptureError) as caught:
            read_calibration(sdk(), size, mode)
        assert caught.value.reason == "mode"


def changed(keys: list, value: object) -> bytes:
    made = calibration()
    part = made["CalibrationInformation"]["Cameras"]
    for key in keys[:-1]:
        part = part[key]
    part[keys[-1]] = value
    return json.dumps(made).encode()


def test_a_calibration_that_cannot_be_used_is_refused_with_a_reason():
    numbers = [1, "Intrinsics", "ModelParameters"]
    for data, told in [
        (b"", "no JSON"),
        (b"\xff\xfe", "no JSON"),
        (b"{}", "CalibrationInformation"),
        (changed([0, "Location"], "elsewhere"), "no camera CALIBRATION_CameraLocationD0"),
        (changed([1, "Intrinsics", "ModelType"], "CALIBRATION_LensDistortionModelRational6KT"), "Rational6KT"),
        (changed(numbers, [0.5] * 13), "14 parameters"),
        (changed(numbers, [0.5, 0.5, 0.0, 0.5, *[0.0] * 10]), "positive focal"),
        (changed(numbers, [0.5] * 4 + [0.0] * 6 + [0.1] + [0.0] * 3), "centre of distortion"),
        (changed([*numbers, 3], float("nan")), "finite"),
        (changed([1, "SensorHeight"], 3000), "neither 4:3 nor 16:9"),
        (changed([0, "SensorHeight"], 1000), "1024 x 1024"),
        (changed([0, "Rt", "Rotation"], [1.0, 0, 0, 0, 1, 0, 0, 0, -1]), "rotation"),
        (changed([0, "Rt", "Translation"], [1.0, 0]), "Translation"),
    ]:
        with pytest.raises(CaptureError, match=told) as caught:
            read_calibration(data, (1280, 720), "NFOV_2X2BINNED")
        assert caught.value.reason == "calibration" and "take the recording" in caught.value.detail
