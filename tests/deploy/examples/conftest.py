"""The examples as a user runs them: scripts that import one another from their own folder."""

import sys
from pathlib import Path

import pytest

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
