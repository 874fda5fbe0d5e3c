import numpy as np
import pytest

from workers.capture.poses.joint import FLOOR_M, INFLATION_OF_FEW, VIEW_FLOOR_M, inflation, patch_sigma, row_inflation

V, N = 40, 60
VIEW = np.repeat(np.arange(V), N)


def residuals(rng, together):
    """Residuals of planes in sigma: independent, and what a whole view has in common."""
    x = rng.uniform(-1, 1, (V * N, 2))
    J = np.column_stack([np.ones(V * N), x])
    common = rng.normal(0, together, (V, 3))
    return rng.standard_normal(V * N) + (J * common[VIEW]).sum(axis=1), J


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_independent_patches_are_not_inflated_and_those_that_err_alike_are(seed):
    rng = np.random.default_rng(seed)
    none = np.zeros((V, 3, 3))
    assert inflation(*residuals(rng, 0.0), VIEW, none) < 1.5
    assert inflation(*residuals(rng, 0.5), VIEW, none) > 8  # of 60 patches, a common error of half a sigma


def test_misfit_that_unknown_poses_explain_does_not_count():
    rng = np.random.default_rng(3)
    residual, J = residuals(rng, 0.3)
    assert inflation(residual, J, VIEW, np.tile(0.3**2 * np.eye(3), (V, 1, 1))) < 3
    assert inflation(residual, J, VIEW, np.zeros((V, 3, 3))) > 6


def test_few_views_are_not_trusted():
    rng = np.random.default_rng(4)
    residual, J = residuals(rng, 0.0)
    few = VIEW < 3
    assert inflation(residual[few], J[few], VIEW[few], np.zeros((V, 3, 3))) == INFLATION_OF_FEW


def test_the_sigma_of_a_patch_is_at_1_m():
    rng = np.random.default_rng(5)
    growth = rng.uniform(0.3, 1.5, 5000)
    assert patch_sigma(rng.normal(0, 0.002, 5000) * growth, growth) == pytest.approx(0.002, rel=0.05)
    assert patch_sigma(np.zeros(9), np.ones(9)) == FLOOR_M == patch_sigma(np.zeros(0), np.zeros(0))


def test_no_view_is_better_than_its_floor_and_few_patches_keep_their_weight():
    view = np.array([0] * 100 + [1])
    sigma = np.full(101, 0.001)
    factor = row_inflation(1.0, sigma, view)
    assert 1 / np.sqrt((1 / (sigma**2 * factor))[:100].sum()) == pytest.approx(VIEW_FLOOR_M)
    assert factor[100] == 1.0
