"""Alignment of a mesh to a cloud, against poses that are known."""

import numpy as np
import pytest
import trimesh

from schemas.errors import CaptureError
from schemas.scene.shape import Mesh
from workers.capture.surface.evaluate import align_mesh, sample_surface
from workers.geometry.frames import angle_between, pose, rotation_about, transform

UP = np.array([0.0, 0.0, 1.0])


def wedge():
    """A body that no turn takes to itself."""
    parts = [trimesh.creation.box((0.16, 0.1, 0.06)), trimesh.creation.box((0.05, 0.04, 0.12))]
    parts[1].apply_translation((0.05, 0.02, 0.03))
    whole = trimesh.util.concatenate(parts)
    return Mesh(np.array(whole.vertices), np.array(whole.faces, np.int32))


@pytest.mark.parametrize("seed", range(3))
def test_the_pose_is_found_from_a_noisy_part_of_the_surface(seed):
    rng = np.random.default_rng(seed)
    mesh = wedge()
    tilt = rotation_about(np.array([1.0, 0.0, 0.0]), rng.normal(0, 0.03))
    T = pose(tilt @ rotation_about(UP, rng.uniform(0, 6.28)), rng.normal(0, 0.3, 3))
    points, normals = sample_surface(mesh, 6000)
    cloud = transform(T, points[normals[:, 2] > -0.5])  # nobody saw the bottom
    found = align_mesh(cloud + rng.normal(0, 0.0005, cloud.shape), mesh)
    assert np.linalg.norm(found.T_board_obj[:3, 3] - T[:3, 3]) < 0.001
    assert np.degrees(angle_between(found.T_board_obj[:3, :3], T[:3, :3])) < 0.5
    assert found.rms_mm < 0.6


def test_a_few_points_cannot_be_aligned():
    with pytest.raises(CaptureError, match="50 points cannot be aligned"):
        align_mesh(np.zeros((50, 3)), wedge())
