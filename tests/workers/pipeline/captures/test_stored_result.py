"""A processed capture read back is what was written."""

import json

import numpy as np
import pytest

from schemas.errors import CaptureError
from tests.workers.pipeline.captures.small_capture import CAPTURES, copy_of, made, processed
from workers.capture.stored import read_result


def test_poses_correction_and_surface_are_those_of_the_run():
    path, done = processed()
    result = read_result(path)
    chosen = done.estimates.estimate
    for stored, view in zip(result.estimate.views, chosen.views, strict=True):
        assert (stored.number, stored.status) == (view.number, view.status)
        assert np.allclose(stored.T_board_cam, view.T_board_cam, atol=1e-12)
    assert result.estimate.depth.offset_m == chosen.depth.offset_m and result.estimate.depth.scale == chosen.depth.scale
    assert np.array_equal(result.estimate.depth.T_cam_depth, chosen.depth.T_cam_depth)
    assert np.allclose(result.surface.vertices, done.merged.surface.vertices, atol=1e-7)
    assert np.array_equal(result.surface.views, done.merged.surface.views)
    assert result.captures.fusion == CAPTURES.fusion
    assert len(result.views.body.faces) == len(done.merged.body.faces)


def test_a_folder_that_was_not_processed_is_refused():
    with pytest.raises(CaptureError, match="run `verso capture process") as refusal:
        read_result(made())
    assert refusal.value.reason == "not_processed"


@pytest.mark.parametrize("key", ["depth", "settings", "views", "board_as_measured"])
def test_a_damaged_record_is_refused(tmp_path, key):
    path = copy_of(processed()[0], tmp_path)
    record = json.loads((path / "process.json").read_bytes())
    record[key] = "nonsense"
    (path / "process.json").write_text(json.dumps(record))
    with pytest.raises(CaptureError, match="is damaged"):
        read_result(path)
