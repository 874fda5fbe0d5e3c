"""Fixtures that tests in this folder may ask for."""

import pytest

from services.merge.merge import merge
from tests.made_up_datasets import FIRST, STOP, dataset_at


@pytest.fixture(scope="session")
def merged(tmp_path_factory):
    """A merged dataset, and what merging said. Not to be changed."""
    store = dataset_at(tmp_path_factory.mktemp("merged"))
    return store, merge(store, FIRST, STOP)
