"""A surface against a mesh in a frame of its own."""

import numpy as np

from schemas.scene.shape import Mesh
from tests.workers.pipeline.captures.small_capture import processed
from workers.capture.score import read_whole_truth, score_against_mesh
from workers.capture.stored import read_result
from workers.geometry.frames import pose, rotation_about, transform


def test_the_true_mesh_from_elsewhere_is_aligned_and_scored_as_in_place():
    result = read_result(processed()[0])
    true = read_whole_truth(result.folder).surface
    away = pose(rotation_about(np.array([0.0, 0.0, 1.0]), 2.0), np.array([3.0, -1.0, 0.5]))
    errors, alignment = score_against_mesh(result, Mesh(transform(away, true.vertices), true.faces))
    assert alignment.rms_mm < 1.0
    assert errors.cloud_median_mm < 1.0 and errors.cloud_p95_mm < 3.0 and errors.completeness > 0.9
