import numpy as np
import pytest

from tests.workers.capture.photographs import hand_held
from tests.workers.capture.poses.scenes import PINHOLE, evidence_of, observe


def test_the_sigma_of_a_corner_is_that_of_all_views():
    rng = np.random.default_rng(0)
    evidence = evidence_of([observe(T, rng, corner_px=0.4) for T in hand_held(rng, 6)])
    assert evidence.corner_px == pytest.approx(0.4, rel=0.1)
    assert evidence.camera is PINHOLE and evidence.board.columns == 7 and evidence.spec.estimate == "joint"
