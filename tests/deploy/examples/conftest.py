"""The examples as a user runs them: scripts that import one another from their own folder."""

import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from services.dataset.dataset import open_dataset
from services.dataset.pair import Pair
from tests.datasets import make_dataset
from workers.store.local import LocalStore

EXAMPLES = Path(__file__).resolve().parents[3] / "deploy/examples"

if str(EXAMPLES) not in sys.path:
    sys.path.append(str(EXAMPLES))

FULL_SIZE = {
    "cameras": {"sensor": {"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 320.0, "cy": 240.0}},
    "images": {"patch": {"width": 128, "height": 96}},
    "assets": {"split": {"train": 0.5, "val": 0.0, "test": 0.5}},
}


@pytest.fixture(scope="package")
def few(tmp_path_factory) -> LocalStore:
    """A few pairs in the article's size with targets, half of them to train on."""
    targets = {"shape": ["volume"], "points": 4000}
    out = tmp_path_factory.mktemp("few")
    return make_dataset(out, scenes=6, categories=["mug", "box"], targets=targets, **FULL_SIZE)[0]


@pytest.fixture(scope="package")
def pairs(few) -> list[Pair]:
    return list(open_dataset(few.root).pairs())


def is_behind(pair: Pair, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[N] whether the object is before points [N, 3] of the world, as the input camera sees them."""
    eye = pair.input.T_world_cam[:3, 3]
    first = np.full(len(points), np.inf)
    places, at, _ = pair.mesh().ray.intersects_location(
        np.tile(eye, (len(points), 1)), points - eye, multiple_hits=False
    )
    first[at] = np.linalg.norm(places - eye, axis=1)
    return first < np.linalg.norm(points - eye, axis=1)
