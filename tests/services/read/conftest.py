"""Datasets that every test of reading may share, because none changes them, and what tests do to copies of them."""

import shutil
from pathlib import Path

import pytest

from tests.datasets import make_dataset
from workers.store.local import LocalStore

TINY = {
    "scenes": 3,
    "run": {"range_size": 1},
    "categories": ["box", "can"],
    "cameras": {
        "sensor": {"width": 64, "height": 48, "fx": 52.5, "fy": 52.5, "cx": 32.0, "cy": 24.0},
        "more": [
            {"name": "side", "beside": "input", "offset_m": [0.06, 0, 0]},
            {"name": "around", "ring": {"count": 2}},
        ],
    },
    "images": {"patch": {"width": 16, "height": 12}},
}


@pytest.fixture(scope="package")
def tiny(tmp_path_factory) -> LocalStore:
    """Three ranges of one scene, finished."""
    return make_dataset(tmp_path_factory.mktemp("tiny"), **TINY)[0]


@pytest.fixture(scope="package")
def packed(tmp_path_factory) -> LocalStore:
    """The same in tars."""
    return make_dataset(tmp_path_factory.mktemp("packed"), output={"layout": "tar"}, **TINY)[0]


@pytest.fixture
def copy(tiny, tmp_path) -> Path:
    """A copy of `tiny` that a test may damage."""
    shutil.copytree(tiny.root, tmp_path / "copy")
    return tmp_path / "copy"


def spoil(path: Path) -> None:
    """Turns a bit in the middle."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
