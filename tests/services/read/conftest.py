"""A dataset that every test of reading may share, because none changes it."""

import pytest

from tests.datasets import make_dataset
from workers.store.local import LocalStore


@pytest.fixture(scope="package")
def three_objects(tmp_path_factory) -> LocalStore:
    """One finished scene of three objects."""
    changes = {"scenes": 1, "objects_per_scene": 3, "categories": ["box", "camera", "bottle"]}
    return make_dataset(tmp_path_factory.mktemp("three"), **changes)[0]
