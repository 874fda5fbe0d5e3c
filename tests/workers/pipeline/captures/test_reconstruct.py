"""The surface of a capture from its folder, against the true one."""

import cv2
import numpy as np
import pytest

from schemas.errors import CaptureError
from schemas.job.captures import Fusion
from tests.workers.pipeline.captures.small_capture import VIEWS, copy_of, made, true_estimates
from workers.capture.folder import open_folder
from workers.capture.reconstruct import given_files, read_posed, reconstruct
from workers.capture.score import read_whole_truth
from workers.geometry.distance import distance_to_mesh


def test_the_surface_lies_on_the_true_one():
    folder = open_folder(made())
    merged = reconstruct(given_files(folder), true_estimates(made()).estimate, Fusion())
    off, _ = distance_to_mesh(merged.surface.points, read_whole_truth(folder).surface)
    # A third of the resolution and a quarter of the views of the bars, 1 mm and 3 mm.
    assert np.median(off) < 0.0005 and np.quantile(off, 0.95) < 0.0025
    assert len(merged.body.faces) > len(merged.surface.faces)
    assert merged.notes == ()


def test_views_without_depth_are_left_out_and_told(tmp_path):
    path = copy_of(made(), tmp_path)
    (path / "depth_00003.png").unlink()
    cv2.imwrite(str(path / "depth_00005.png"), np.zeros((378, 672), np.uint16))
    merged = reconstruct(given_files(open_folder(path)), true_estimates(path).estimate, Fusion())
    assert merged.notes == ("2 used views have no depth",)


def test_a_capture_without_any_depth_is_refused(tmp_path):
    path = copy_of(made(), tmp_path)
    for number in range(VIEWS):
        (path / f"depth_{number:05d}.png").unlink()
    with pytest.raises(CaptureError, match=r"none of the 10 used views .* has depth") as refusal:
        reconstruct(given_files(open_folder(path)), true_estimates(path).estimate, Fusion())
    assert refusal.value.reason == "no_depth"


def test_a_view_without_a_pose_cannot_be_read():
    with pytest.raises(CaptureError, match="view 2 has no pose: left out by the test"):
        read_posed(given_files(open_folder(made())), true_estimates(made(), without=(2,)).estimate, 2)


def test_a_mask_of_the_user_is_kept(tmp_path):
    path = copy_of(made(), tmp_path)
    mask = np.zeros((378, 672), np.uint8)
    mask[200:300, 400:500] = 255
    cv2.imwrite(str(path / "mask_00001.png"), mask)
    estimate = true_estimates(path).estimate
    given = given_files(open_folder(path))
    assert np.array_equal(read_posed(given, estimate, 1).mask, mask > 0)
    assert read_posed(given, estimate, 2).mask is None
