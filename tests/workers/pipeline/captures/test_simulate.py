"""Virtual captures: the folder, the truth, and every effect against what it should change."""

import hashlib

import cv2
import numpy as np
import pytest

from schemas.errors import CaptureError
from schemas.job.assets import ProceduralSource
from schemas.job.captures import Board, Simulate
from workers.assets.builtin.make import make_asset
from workers.geometry.frames import invert, transform
from workers.pipeline.captures.simulate import simulate_capture
from workers.plan.randomness import SceneChance
from workers.store.capture_folder import open_folder, read_view
from workers.store.capture_truth import read_truth

SMALL = Simulate(views=2, image_scale=0.25)


def asset_of(category="can"):
    return make_asset(category, ProceduralSource(source="procedural"), 3, 600.0)


def digests(path):
    return {
        str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    path = tmp_path_factory.mktemp("plain") / "capture"
    return path, simulate_capture(SMALL, Board(), asset_of(), SceneChance(11, 0), path)


def test_the_folder_is_read_as_that_of_a_real_capture(plain):
    path, truth = plain
    folder = open_folder(path)
    assert folder.numbers == (0, 1)
    assert folder.about.category == "can"
    k = folder.camera.intrinsics
    assert (k.width, k.height) == (480, 270)
    assert k.fx == pytest.approx(0.25 * 912.37)
    view = read_view(folder, 1)
    assert view.mask is None
    assert view.depth is not None
    assert (view.depth > 0).mean() > 0.3
    again = read_truth(path)
    assert np.array_equal(again.T_board_cam, truth.T_board_cam)
    assert np.array_equal(again.T_board_obj, truth.T_board_obj)


def test_the_same_seed_writes_the_same_bytes(plain, tmp_path):
    path, _ = plain
    simulate_capture(SMALL, Board(), asset_of(), SceneChance(11, 0), tmp_path)
    assert digests(tmp_path) == digests(path)
    other = tmp_path / "other"
    simulate_capture(SMALL, Board(), asset_of(), SceneChance(12, 0), other)
    assert digests(other)["rgb_00000.png"] != digests(path)["rgb_00000.png"]


def test_a_folder_with_files_is_refused(plain):
    path, _ = plain
    with pytest.raises(CaptureError, match="holds files"):
        simulate_capture(SMALL, Board(), asset_of(), SceneChance(11, 0), path)


def test_depth_of_the_board_is_that_of_its_plane(plain):
    """Where OpenCV's own projection puts points of the board, stored depth is the distance along the optical axis."""
    path, truth = plain
    folder = open_folder(path)
    k = folder.camera.intrinsics
    K = np.array([[k.fx, 0.0, k.cx_opencv], [0.0, k.fy, k.cy_opencv], [0.0, 0.0, 1.0]])
    for number in folder.numbers:
        depth = read_view(folder, number).depth
        T_cam_board = invert(truth.T_board_cam[number])
        points = np.array([[x, y, 0.0] for x in (-0.27, 0.27) for y in (-0.18, 0.0, 0.18)])
        pixels = cv2.projectPoints(points, cv2.Rodrigues(T_cam_board[:3, :3])[0], T_cam_board[:3, 3], K, None)[0]
        columns, rows = np.rint(pixels[:, 0]).astype(int).T
        expected = transform(T_cam_board, points)[:, 2]
        inside = (columns >= 0) & (columns < k.width) & (rows >= 0) & (rows < k.height)
        found = depth[rows[inside], columns[inside]] / 1000.0
        seen = found > 0.0
        assert seen.sum() >= 2
        # Rounding to whole pixels moves the point by up to 3 mm, and to millimetres by half of one.
        assert np.abs(found[seen] - expected[inside][seen]).max() < 0.004
