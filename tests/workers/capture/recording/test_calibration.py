"""The device's calibration against numbers of Microsoft's SDK, and what is refused."""

import json

import numpy as np
import pytest

from schemas.errors import CaptureError
from tests.workers.capture.recording.made_up_recording import calibration, camera_entry
from tests.workers.geometry.made_up_kinect import COLOR_LENS, T_COLOR_DEPTH
from workers.capture.recording.calibration import COLOR_SIZES, DEPTH_MODES, read_calibration
from workers.geometry.frames import transform
from workers.geometry.rational_lens import pixel_rays, project_points

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
AT_DEPTH_PX, AT_DEPTH_MM = (256, 256), [-2.45376134, -1.66107690, 1000.0]
AT_COLOR_PX, AT_COLOR_MM = [1835.689453, 1206.290039], [-37.6291695, 63.3947754, 1001.46521]


def encoded(made: dict) -> bytes:
    return json.dumps(made).encode() + b"\0"


def sdk() -> bytes:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = SDK_ROTATION, SDK_TRANSLATION
    cameras = [
        camera_entry("D0", SDK_DEPTH, np.eye(4), (1024, 1024)),
        camera_entry("PV0", SDK_COLOR, T, (3840, 2160)),
    ]
    return encoded({"CalibrationInformation": {"Cameras": cameras}})


def test_a_point_is_where_the_sdk_puts_it():
    device = read_calibration(sdk(), (3840, 2160), "WFOV_2X2BINNED")
    column, row = AT_DEPTH_PX
    ray = pixel_rays(device.depth.intrinsics, device.depth.lens)[row, column]
    point = np.array([[*ray, 1.0]])
    assert point[0] * 1000 == pytest.approx(AT_DEPTH_MM, abs=1e-3)
    seen = transform(device.depth.T_color_depth, point)
    assert seen[0] * 1000 == pytest.approx(AT_COLOR_MM, abs=1e-3)
    at = project_points(seen, device.color.intrinsics, device.color.lens)
    assert at[0] - 0.5 == pytest.approx(AT_COLOR_PX, abs=2e-3)


@pytest.mark.parametrize("size", COLOR_SIZES)
def test_every_colour_mode_sees_a_direction_at_the_same_share_of_its_width(size):
    """All modes use the sensor's whole width and its middle height."""
    device = read_calibration(sdk(), size, "NFOV_UNBINNED")
    reference = read_calibration(sdk(), (4096, 3072), "NFOV_UNBINNED").color.intrinsics
    k, times = device.color.intrinsics, size[0] / 4096
    assert (k.fx, k.fy, k.cx) == pytest.approx((reference.fx * times, reference.fy * times, reference.cx * times))
    assert k.cy - 0.5 * k.height == pytest.approx((reference.cy - 1536) * times)


def test_depth_modes_are_parts_of_one_sensor():
    whole = read_calibration(sdk(), (1280, 720), "WFOV_UNBINNED").depth.intrinsics
    for mode, (across, cut, _) in DEPTH_MODES.items():
        k, times = read_calibration(sdk(), (1280, 720), mode).depth.intrinsics, across / 1024
        assert (k.fx, k.cx + cut[0], k.cy + cut[1]) == pytest.approx(
            (whole.fx * times, whole.cx * times, whole.cy * times)
        )
    narrow = read_calibration(sdk(), (1280, 720), "NFOV_2x2BINNED").depth.intrinsics  # as old recordings write it
    assert (narrow.width, narrow.height) == (320, 288)


def test_a_later_calibration_of_the_whole_sensor_gives_lens_and_place():
    device = read_calibration(encoded(calibration()), (1280, 720), "NFOV_2X2BINNED")
    assert device.color.lens == pytest.approx(COLOR_LENS)
    assert device.depth.T_color_depth == pytest.approx(T_COLOR_DEPTH, abs=1e-12)
    assert device.color.depth_units_per_m == 1000.0


def changed(keys: list, value: object) -> bytes:
    made = calibration()
    part = made["CalibrationInformation"]["Cameras"]
    for key in keys[:-1]:
        part = part[key]
    part[keys[-1]] = value
    return encoded(made)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "no JSON"),
        (b"\xff\xfe", "no JSON"),
        (b"{}", "CalibrationInformation"),
        (changed([0, "Location"], "elsewhere"), "no camera CALIBRATION_CameraLocationD0"),
        (changed([1, "Intrinsics", "ModelType"], "CALIBRATION_LensDistortionModelRational6KT"), "Rational6KT"),
        (changed([1, "Intrinsics", "ModelParameters"], [0.5] * 13), "14 parameters"),
        (changed([1, "Intrinsics", "ModelParameters"], [0.5, 0.5, 0.0, 0.5, *[0.0] * 10]), "positive focal"),
        (
            changed([1, "Intrinsics", "ModelParameters"], [0.5] * 4 + [0.0] * 6 + [0.1] + [0.0] * 3),
            "centre of distortion",
        ),
        (changed([1, "Intrinsics", "ModelParameters", 3], float("nan")), "finite"),
        (changed([1, "SensorHeight"], 3000), "neither 4:3 nor 16:9"),
        (changed([0, "SensorHeight"], 1000), "1024 x 1024"),
        (changed([0, "Rt", "Rotation"], [1.0, 0, 0, 0, 1, 0, 0, 0, -1]), "rotation"),
        (changed([0, "Rt", "Translation"], [1.0, 0]), "Translation"),
    ],
)
def test_a_calibration_that_cannot_be_used_is_refused_with_a_reason(data, told):
    with pytest.raises(CaptureError, match=told) as caught:
        read_calibration(data, (1280, 720), "NFOV_2X2BINNED")
    assert caught.value.reason == "calibration" and "take the recording" in caught.value.detail


@pytest.mark.parametrize(
    ("size", "mode"), [((640, 480), "NFOV_UNBINNED"), ((1280, 720), "PASSIVE_IR"), ((1280, 720), "")]
)
def test_a_mode_that_the_device_does_not_have_is_refused(size, mode):
    with pytest.raises(CaptureError) as caught:
        read_calibration(sdk(), size, mode)
    assert caught.value.reason == "mode"
