"""Files of synthesised views."""

import json

import cv2
import numpy as np
import pytest

from schemas.errors import OutputError
from tests.workers.pipeline.captures.small_capture import processed
from workers.capture.folder import read_pose
from workers.capture.stored import read_result, write_mirrors, write_synthesized


@pytest.fixture(scope="module")
def result():
    return read_result(processed()[0])


def test_a_view_is_written_with_its_pose_and_shares(result, tmp_path):
    T = result.estimate.views[2].T_board_cam
    told = write_synthesized(result, T, tmp_path / "views")
    rgb = cv2.imread(str(tmp_path / "views" / "rgb_00000.png"))
    depth = cv2.imread(str(tmp_path / "views" / "depth_00000.png"), cv2.IMREAD_UNCHANGED)
    mask = cv2.imread(str(tmp_path / "views" / "mask_00000.png"), 0) > 0
    measured = cv2.imread(str(tmp_path / "views" / "measured_00000.png"), 0) > 0
    assert rgb.shape == (378, 672, 3) and depth.dtype == np.uint16
    assert np.array_equal(read_pose(tmp_path / "views" / "board_00000.txt"), T)
    assert (mask & (depth > 0)).sum() > 1000 and not (measured & (depth == 0)).any()
    assert told["measured_share"] == pytest.approx(measured.sum() / (depth > 0).sum())
    record = json.loads((tmp_path / "views" / "views.json").read_bytes())
    assert record["views"] == [told] and record["camera"]["width"] == 672 and told["sources"][0] == 2


def test_every_view_has_a_mirror_view_with_its_number(result, tmp_path):
    told = write_mirrors(result, tmp_path)
    assert [one["name"] for one in told] == [f"{n:05d}" for n in range(10)]
    assert all(0.3 < one["d_z_m"] < 1.2 for one in told)
    assert len(list(tmp_path.glob("rgb_*.png"))) == 10


def test_a_capture_is_not_overwritten_by_its_views(result):
    with pytest.raises(OutputError, match="name another folder"):
        write_synthesized(result, result.estimate.views[0].T_board_cam, result.folder.path)
