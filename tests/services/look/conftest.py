"""Small datasets that the tests of the report share, because none changes them."""

import pytest

from tests.datasets import make_dataset
from workers.store.local import LocalStore


@pytest.fixture(scope="package")
def shown(tmp_path_factory) -> LocalStore:
    """Four finished scenes of two categories."""
    changes = {"scenes": 4, "categories": ["box", "mug"], "run": {"range_size": 2}}
    return make_dataset(tmp_path_factory.mktemp("shown"), **changes)[0]
