import numpy as np
import pytest

from tests.workers.capture.photographs import hand_held
from workers.capture.poses.markers import moved
from workers.capture.poses.observation import Patches
from workers.capture.poses.terms import NAMES, BoardTerm, CornerTerm, ObjectTerm, Shared, robust

RNG = np.random.default_rng(0)
POSES = np.stack(hand_held(RNG, 3))
SHARED = Shared().moved(np.array([0.01, -0.02, 0.01, 0.02, -0.01, 0.03, -0.02, 0.01, 0.005]))
VIEW = RNG.integers(0, 3, 12)
RAY = np.column_stack([RNG.uniform(-0.3, 0.3, (12, 2)), np.ones(12)])
PATCHES = Patches(RAY * RNG.uniform(0.5, 1.2, (12, 1)), RAY, -RAY, np.full(12, 9), np.full(12, 0.001))
ONES = np.ones(12)
PAIRS = np.array([[0, 1], [2, 5], [3, 9]])
PAIRS = PAIRS[VIEW[PAIRS[:, 0]] != VIEW[PAIRS[:, 1]]]
NORMAL = np.tile(np.array([[0.6, 0, 0.8]]), (len(PAIRS), 1))
TERMS = {
    "corners": CornerTerm(
        VIEW, np.column_stack([RNG.uniform(-0.2, 0.2, (12, 2)), np.zeros(12)]), RAY[:, :2], np.array([900.0, 910]), 0.2
    ),
    "board": BoardTerm(VIEW, PATCHES, 0.1 * ONES, 2 * ONES),
    "object": ObjectTerm(VIEW, PATCHES, PAIRS, NORMAL, np.full(len(PAIRS), 0.1), np.ones(len(PAIRS))),
}


@pytest.mark.parametrize("name", TERMS)
def test_derivatives_equal_finite_differences(name):
    term = TERMS[name]
    rows = term.rows(POSES, SHARED)
    for axis in range(len(NAMES)):
        step = np.zeros(9)
        step[axis] = 1e-6
        change = term.rows(POSES, SHARED.moved(step)).residual - term.rows(POSES, SHARED.moved(-step)).residual
        assert rows.by_shared[:, axis] == pytest.approx(change / 2e-6, rel=1e-4, abs=1e-3)
    for number in range(3):
        for axis in range(6):
            step = np.zeros(6)
            step[axis] = 1e-6
            ahead, back = POSES.copy(), POSES.copy()
            ahead[number], back[number] = moved(POSES[number], step), moved(POSES[number], -step)
            change = term.rows(ahead, SHARED).residual - term.rows(back, SHARED).residual
            own = np.where(rows.first == number, rows.by_first[:, axis], 0)
            own += np.where(rows.second == number, rows.by_second[:, axis], 0)
            assert own == pytest.approx(change / 2e-6, rel=1e-4, abs=2e-2)


def test_the_pairs_of_the_test_are_of_two_views():
    assert len(PAIRS) >= 2


@pytest.mark.parametrize("name", ["board", "object"])
def test_a_smaller_world_does_not_fit_better(name):
    """Depth and poses scaled alike leave residuals over sigma as they are: noise shrinks with the world."""
    small = POSES.copy()
    small[:, :3, 3] *= 0.9
    before, after = TERMS[name].rows(POSES, Shared()), TERMS[name].rows(small, Shared(scale=0.9))
    assert after.residual == pytest.approx(before.residual)


def test_weights_are_those_of_cauchys_loss():
    squares = np.array([0.0, 9.0, 900.0])
    weights, cost = robust(squares)
    assert weights == pytest.approx([1, 0.5, 1 / 101])
    slope = (robust(squares + 1e-6)[1] - cost) / 1e-6
    assert slope == pytest.approx(weights.sum(), rel=1e-4)  # the weight is the derivative of the loss
    assert robust(squares, 0.5)[1] == pytest.approx(0.5 * cost)
