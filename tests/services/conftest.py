"""Datasets that every test of services may share, because none changes them."""

import pytest

from tests.captures import captures_job, use_exact_captures
from tests.datasets import make_dataset, run_here
from tests.kit.faults import unflushed
from workers.store.local import LocalStore

__all__ = ["unflushed"]

TWO_PAIRS = {"scenes": 4, "pairs_per_scene": 2, "categories": ["box", "can"], "run": {"range_size": 2}, "seed": 3}


@pytest.fixture
def store(tmp_path, unflushed) -> LocalStore:
    store = LocalStore(tmp_path)
    store.prepare()
    return store


@pytest.fixture(scope="session")
def files(tmp_path_factory) -> LocalStore:
    """Two ranges of two scenes of two pairs, finished, a file for each image."""
    return make_dataset(tmp_path_factory.mktemp("files"), **TWO_PAIRS)[0]


@pytest.fixture(scope="session")
def tars(tmp_path_factory) -> LocalStore:
    """The same in tars."""
    return make_dataset(tmp_path_factory.mktemp("tars"), output={"layout": "tar"}, **TWO_PAIRS)[0]


@pytest.fixture(scope="session")
def pile(tmp_path_factory) -> LocalStore:
    """One finished scene of three objects that hide one another."""
    changes = {"scenes": 1, "objects_per_scene": 3, "categories": ["box", "camera", "bottle"]}
    return make_dataset(tmp_path_factory.mktemp("pile"), seed=2, start={"offset_m": [-0.12, 0.12]}, **changes)[0]


@pytest.fixture(scope="session")
def captures(tmp_path_factory) -> LocalStore:
    """Two virtual captures, finished."""
    with pytest.MonkeyPatch.context() as patch:
        use_exact_captures(patch)
        return run_here(captures_job(), tmp_path_factory.mktemp("captures"))[0]
