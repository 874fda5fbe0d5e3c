import cv2
import numpy as np
import pytest

from schemas.job.captures import Board
from schemas.scene.view import Camera, Intrinsics
from tests.captures import rolled_pose
from workers.capture.rows import capture_regions
from workers.geometry.camera import look_at
from workers.geometry.frames import invert

K = Intrinsics(width=320, height=180, fx=152.0, fy=150.0, cx=160.4, cy=91.1)


@pytest.mark.parametrize("number", [0, 1, 2, 3])
@pytest.mark.parametrize("scale", [1.0, 0.8])
def test_the_board_is_the_polygon_that_opencv_projects_its_corners_to(number, scale):
    board = Board(measured_ruler_m=0.2 * scale)
    camera = Camera(K, rolled_pose(number, 4))
    region = capture_regions(camera, board, np.zeros((K.height, K.width), bool))
    x, y = 0.3 * scale, 0.2 * scale
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    T = invert(camera.T_world_cam)
    matrix = np.array([[K.fx, 0, K.cx_opencv], [0, K.fy, K.cy_opencv], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(corners, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], matrix, None)
    drawn = cv2.fillConvexPoly(
        np.zeros((K.height, K.width), np.uint8), np.round(pixels * 16).astype(int), 2, cv2.LINE_8, 4
    )
    rim = cv2.polylines(np.zeros_like(drawn), [np.round(pixels).astype(int)], True, 1, 3)
    assert set(np.unique(region)) == {0, 2}
    assert (region == drawn)[rim == 0].all()
    assert 2000 < np.count_nonzero(region) < region.size


def test_the_object_hides_the_board_and_lies_where_its_mask_is():
    camera = Camera(K, rolled_pose(1, 4))
    mask = np.zeros((K.height, K.width), bool)
    mask[:60] = True
    region = capture_regions(camera, Board(), mask)
    assert ((region == 3) == mask).all()


def test_a_board_seen_from_below_or_behind_the_camera_is_nothing():
    nothing = np.zeros((K.height, K.width), bool)
    below = look_at(np.array([0.1, 0.0, -0.5]), np.zeros(3))
    away = look_at(np.array([0.3, 0.0, 0.5]), np.array([1.0, 0.0, 1.5]))
    for T in (below, away):
        assert not capture_regions(Camera(K, T), Board(), nothing).any()
