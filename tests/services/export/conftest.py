"""Datasets that every test of exporting may share, because none changes them."""

import os
import tempfile

# Read by the package `datasets` when it is imported: nothing goes to a network, nothing into the user's cache.
os.environ.update(HF_HUB_OFFLINE="1", HF_HUB_DISABLE_TELEMETRY="1", HF_HOME=f"{tempfile.gettempdir()}/verso-tests-hf")

import pytest

from tests.captures import captures_job, use_exact_captures
from tests.datasets import make_dataset, run_here
from workers.store.local import LocalStore

TWO_PAIRS = {"scenes": 4, "pairs_per_scene": 2, "categories": ["box", "can"], "run": {"range_size": 2}, "seed": 3}


@pytest.fixture(scope="package")
def files(tmp_path_factory) -> LocalStore:
    """Two ranges of two scenes of two pairs, finished, a file for each image."""
    return make_dataset(tmp_path_factory.mktemp("files"), **TWO_PAIRS)[0]


@pytest.fixture(scope="package")
def tars(tmp_path_factory) -> LocalStore:
    """The same in tars."""
    return make_dataset(tmp_path_factory.mktemp("tars"), output={"layout": "tar"}, **TWO_PAIRS)[0]


@pytest.fixture(scope="package")
def pile(tmp_path_factory) -> LocalStore:
    """One finished scene of three objects that hide one another."""
    changes = {"scenes": 1, "objects_per_scene": 3, "categories": ["box", "camera", "bottle"]}
    return make_dataset(tmp_path_factory.mktemp("pile"), seed=2, start={"offset_m": [-0.12, 0.12]}, **changes)[0]


@pytest.fixture(scope="package")
def captures(tmp_path_factory) -> LocalStore:
    """Two virtual captures, finished."""
    with pytest.MonkeyPatch.context() as patch:
        use_exact_captures(patch)
        return run_here(captures_job(), tmp_path_factory.mktemp("captures"))[0]
