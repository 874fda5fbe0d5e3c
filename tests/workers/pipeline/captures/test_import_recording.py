"""Imported recordings against the analytic scene that they show."""

import json

import cv2
import numpy as np
import pytest

from schemas.errors import CaptureError
from tests.workers.capture.recording.made_up_recording import (
    BOARD,
    COLOR,
    COLOR_LENS,
    PERIOD_US,
    START_US,
    TAGS,
    calibration,
    photograph,
    poses,
    recording,
    renamed,
    tracks,
    true_depth,
)
from tests.workers.capture.recording.matroska import write_recording
from workers.capture.board.layout import marker_corners, open_dictionary
from workers.capture.folder import CaptureFile, CaptureFolder, open_folder, read_view
from workers.capture.recording.import_recording import Imported, import_recording

ABOUT = CaptureFile(name="made-up", category="ball")
COUNT = 4
QUANTA_MM = 1.3
"""Half a millimetre of the recording, half a unit of the folder, and the former once more where a surface is steep."""


def imported(tmp_path, data: bytes, views: int = 40) -> tuple[Imported, CaptureFolder]:
    (tmp_path / "r.mkv").write_bytes(data)
    out = tmp_path / "capture"
    out.mkdir()
    made = import_recording(tmp_path / "r.mkv", out, ABOUT, BOARD, views)
    return made, open_folder(out)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Imported, CaptureFolder]:
    return imported(tmp_path_factory.mktemp("whole"), recording(COUNT))


def test_every_frame_becomes_a_view_with_its_own_time(whole):
    made, folder = whole
    assert folder.numbers == tuple(range(COUNT))
    assert [view.color_us for view in made.views] == [START_US + i * PERIOD_US for i in range(COUNT)]
    assert (made.losses.dropped, made.losses.without_depth, made.losses.damaged, made.losses.cut) == (0, 0, 0, 0)
    assert json.loads((folder.path / "recording.json").read_text())["serial_number"] == "000123"


def test_camera_and_board_are_those_of_the_recording(whole):
    _, folder = whole
    for name, value in COLOR.model_dump().items():
        assert getattr(folder.camera.intrinsics, name) == pytest.approx(value, abs=1e-9)
    assert folder.camera.lens == pytest.approx(COLOR_LENS)
    assert folder.board == BOARD and folder.about == ABOUT
    stored = json.loads((folder.path / "camera.json").read_text())
    assert stored["pixel_centre"] == "0" and stored["cx"] == pytest.approx(COLOR.cx - 0.5)


@pytest.mark.parametrize("number", range(COUNT))
def test_depth_is_the_scene_s_in_the_colour_camera(whole, number):
    _, folder = whole
    depth_mm = read_view(folder, number).depth.astype(np.float64)
    true, ball = true_depth("color", poses(COUNT)[number])
    edge = (
        cv2.dilate(ball.astype(np.uint8), np.ones((41, 41))) - cv2.erode(ball.astype(np.uint8), np.ones((41, 41))) > 0
    )
    seen = (depth_mm > 0) & ~edge
    error = np.abs(depth_mm - true * 1000)
    assert error[seen & ~ball].max() < QUANTA_MM
    assert error[seen & ball].max() < QUANTA_MM + 1.0  # the sag of a triangle of 3 mm on the sphere's slope
    assert np.median(error[seen]) < 0.45
    middle = np.zeros_like(seen)
    middle[200:600, 400:900] = True
    assert (depth_mm > 0)[middle & ~edge].mean() > 0.97


def test_depth_hides_what_the_sphere_hides_and_nothing_floats_beside_it(whole):
    _, folder = whole
    for number in range(COUNT):
        depth_mm = read_view(folder, number).depth.astype(np.float64)
        true, ball = true_depth("color", poses(COUNT)[number])
        near = cv2.dilate(ball.astype(np.uint8), np.ones((9, 9))) > 0
        wrong = near & (depth_mm > 0) & (np.abs(depth_mm - true * 1000) > 20.0)
        assert wrong.sum() < 0.06 * ball.sum()


def test_markers_of_an_imported_view_are_where_the_pose_puts_them(whole):
    _, folder = whole
    rgb = read_view(folder, 1).rgb
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = 3
    corners, ids, _ = cv2.aruco.ArucoDetector(open_dictionary(BOARD), parameters).detectMarkers(rgb)
    T_cam_board = np.linalg.inv(poses(COUNT)[1])
    k = folder.camera.intrinsics
    matrix = np.array([[k.fx, 0, k.cx_opencv], [0, k.fy, k.cy_opencv], [0, 0, 1]])
    rotation, _ = cv2.Rodrigues(T_cam_board[:3, :3])
    points = marker_corners(BOARD)[ids.ravel()].reshape(-1, 3)
    at, _ = cv2.projectPoints(points, rotation, T_cam_board[:3, 3], matrix, folder.camera.lens)
    assert len(ids) >= 25
    miss = np.concatenate(corners, axis=1)[0] - at[:, 0]
    assert np.median(np.linalg.norm(miss, axis=1)) < 0.3
    assert np.abs(np.median(miss, axis=0)).max() < 0.1, "half a pixel would be another convention"


@pytest.mark.parametrize("fourcc", ["BGRA", "NV12", "YUY2"])
def test_other_colour_formats_show_the_same(tmp_path, fourcc):
    _, folder = imported(tmp_path, recording(1, fourcc))
    difference = np.abs(read_view(folder, 0).rgb.astype(int) - photograph(poses(1)[0]))
    assert np.median(difference) <= 2 and difference.mean() < (0.01 if fourcc == "BGRA" else 4.0)


def test_as_many_views_as_asked_are_taken_and_the_same_each_time(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    made, folder = imported(tmp_path / "a", recording(COUNT), views=2)
    _, again = imported(tmp_path / "b", recording(COUNT), views=2)
    assert made.frames == COUNT and len(made.views) == 2
    names = sorted(path.name for path in folder.path.iterdir())
    assert names == sorted(path.name for path in again.path.iterdir())
    assert all((folder.path / name).read_bytes() == (again.path / name).read_bytes() for name in names)


def test_depth_later_than_half_a_frame_belongs_to_no_colour_frame(tmp_path):
    late = write_recording(tracks(1), json.dumps(calibration()).encode(), TAGS | {"K4A_DEPTH_DELAY_NS": "-20000000"})
    with pytest.raises(CaptureError, match="within half a frame's time"):
        imported(tmp_path, late)


def test_an_image_that_is_not_of_its_mode_is_refused_before_anything_is_written(tmp_path):
    other = renamed(tracks(2), "DEPTH", width=288, height=320)
    with pytest.raises(CaptureError, match="mode NFOV_2X2BINNED has"):
        imported(tmp_path, write_recording(other, json.dumps(calibration()).encode(), TAGS))
    assert not list((tmp_path / "capture").iterdir())
