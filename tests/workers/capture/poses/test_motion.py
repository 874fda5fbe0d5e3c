import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from workers.capture.poses.markers import cross_matrix, exponential, logarithm, moved
from workers.geometry.frames import pose


def test_exponential_and_logarithm_agree_with_scipy():
    rng = np.random.default_rng(0)
    for length in (0.0, 1e-14, 1e-9, 1e-4, 0.5, 3.0):
        vector = rng.standard_normal(3)
        vector *= length / np.linalg.norm(vector)
        R = Rotation.from_rotvec(vector).as_matrix()
        assert exponential(vector) == pytest.approx(R, abs=1e-15)
        assert exponential(vector) == pytest.approx(expm(cross_matrix(vector)), abs=1e-13)
        assert logarithm(R) == pytest.approx(vector, abs=1e-12)


def test_cross_matrices_multiply_as_cross_products():
    a, b = np.random.default_rng(1).standard_normal((2, 5, 3))
    assert np.einsum("nij,nj->ni", cross_matrix(a), b) == pytest.approx(np.cross(a, b))


def test_a_motion_is_made_in_the_axes_of_the_camera():
    R = Rotation.from_euler("xyz", [0.3, -0.4, 0.5]).as_matrix()
    T = moved(pose(R, np.array([1.0, 2, 3])), np.array([0.1, 0, 0, 0, 0, 0.2]))
    assert T[:3, 3] == pytest.approx(np.array([1, 2, 3]) + 0.1 * R[:, 0])
    assert T[:3, :3] == pytest.approx(R @ Rotation.from_rotvec([0, 0, 0.2]).as_matrix())
    assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-15
