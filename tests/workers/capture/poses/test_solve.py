import numpy as np
import pytest

from schemas.job.captures import Estimation
from tests.workers.capture.photographs import hand_held
from tests.workers.capture.poses.scenes import PINHOLE, errors, observe
from workers.capture.poses.joint import Problem, minimise
from workers.capture.poses.markers import logarithm, moved
from workers.capture.poses.terms import NAMES, CornerTerm, Shared, prior_sigma

FOCAL = np.array([PINHOLE.intrinsics.fx, PINHOLE.intrinsics.fy])


def problem(truth, rng, corner_px=0.2):
    seen = [observe(T, rng, corner_px=corner_px).corners for T in truth]
    view = np.repeat(np.arange(len(seen)), [len(c.board) for c in seen])
    board, rays = (np.concatenate([getattr(c, name) for c in seen]) for name in ("board", "rays"))
    return CornerTerm(view, board, rays, FOCAL, max(corner_px, 0.1))


def test_without_noise_every_pose_is_the_true_one():
    rng = np.random.default_rng(0)
    truth = hand_held(rng, 5)
    start = np.stack([moved(T, rng.normal(0, 0.02, 6)) for T in truth])
    found = minimise(Problem([problem(truth, rng, 0)], np.zeros(9), np.zeros(5, bool)), start, Shared(), 50)
    assert found.converged and found.iterations < 15
    assert max(max(errors(a, b)) for a, b in zip(found.poses, truth, strict=True)) < 1e-4


def test_a_fixed_pose_stays_and_a_parameter_without_data_stays_at_its_prior():
    rng = np.random.default_rng(1)
    truth = hand_held(rng, 3)
    start = np.stack([moved(T, rng.normal(0, 0.01, 6)) for T in truth])
    prior = prior_sigma(Estimation(), True)
    found = minimise(Problem([problem(truth, rng)], prior, np.array([False, True, False])), start, Shared(), 50)
    assert np.abs(found.poses[1] - start[1]).max() < 1e-14
    assert np.abs(found.shared.deviation()).max() < 1e-9
    sigma = np.sqrt(np.diag(found.covariance()))
    assert not sigma[6:12].any()
    assert sigma[18 + NAMES.index("offset_m")] == pytest.approx(prior[0], rel=1e-3)


def test_the_covariance_is_the_scatter_of_the_solution():
    rng = np.random.default_rng(2)
    truth = hand_held(rng, 1)
    off, told = [], None
    for _ in range(60):
        found = minimise(Problem([problem(truth, rng)], np.zeros(9), np.zeros(1, bool)), np.stack(truth), Shared(), 20)
        T = np.linalg.inv(truth[0]) @ found.poses[0]
        off.append([*T[:3, 3], *logarithm(T[:3, :3])])
        told = found.covariance()[:6, :6]
    scatter = np.sqrt(np.mean(np.square(off), axis=0))
    assert scatter == pytest.approx(np.sqrt(np.diag(told)), rel=0.3)


def test_iterations_are_limited():
    rng = np.random.default_rng(3)
    truth = hand_held(rng, 2)
    start = np.stack([moved(T, rng.normal(0, 0.05, 6)) for T in truth])
    found = minimise(Problem([problem(truth, rng)], np.zeros(9), np.zeros(2, bool)), start, Shared(), 1)
    assert found.iterations == 1 and not found.converged
