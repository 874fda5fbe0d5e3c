"""The truth of a simulated capture, written and read back."""

import json

import cv2
import numpy as np
import pytest

from schemas.capture import CaptureTruth
from schemas.errors import CaptureError
from schemas.job.views import Distortion
from workers.capture.folder import TrueObject, read_truth, write_true_mask, write_truth
from workers.geometry.frames import pose, uniform_rotation


def made_up(lens=None):
    rng = np.random.default_rng(4)
    poses = [pose(uniform_rotation(rng), rng.standard_normal(3)) for _ in range(5)]
    return CaptureTruth(np.stack(poses[:3]), poses[3], 1.02, poses[4], 0.01, lens)


@pytest.mark.parametrize("lens", [None, Distortion(k1=0.1, k3=-0.02)])
def test_numbers_read_back_to_the_same_doubles(tmp_path, lens):
    truth = made_up(lens)
    write_truth(tmp_path, truth, TrueObject("mug", "mug-3", b"glTF"), ("rgb",), {"exposure": "is off"})
    again = read_truth(tmp_path)
    for name in ("T_board_cam", "T_board_obj", "T_color_depth"):
        assert np.array_equal(getattr(again, name), getattr(truth, name))
    assert (again.print_scale, again.depth_bias_m, again.lens) == (1.02, 0.01, lens)
    record = json.loads((tmp_path / "truth" / "truth.json").read_text())
    assert record["effects"] == ["rgb"]
    assert record["skipped"] == [{"effect": "exposure", "why": "is off"}]
    assert (tmp_path / "truth" / "mesh.glb").read_bytes() == b"glTF"


def test_a_true_mask_is_an_image(tmp_path):
    mask = np.random.default_rng(1).random((7, 9)) < 0.5
    write_true_mask(tmp_path, 12, mask)
    image = cv2.imread(str(tmp_path / "truth" / "mask_00012.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(image, np.where(mask, 255, 0))


def test_a_real_capture_has_none_and_a_damaged_one_says_so(tmp_path):
    assert read_truth(tmp_path) is None
    (tmp_path / "truth").mkdir()
    for text in ("{", "{}", '{"T_board_cam": 3}'):
        (tmp_path / "truth" / "truth.json").write_text(text)
        with pytest.raises(CaptureError, match=r"truth\.json"):
            read_truth(tmp_path)
