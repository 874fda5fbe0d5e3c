"""The image, the digest that it has to reach, and checkouts to start it from; made once for all test processes."""

import os
from pathlib import Path

import pytest

from tests.kit.containers import build_image, local_digest, once


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Path:
    """A folder that all processes of this test run share."""
    base = Path(tmp_path_factory.getbasetemp())
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def image(shared) -> str:
    return once(shared, "image", lambda folder: build_image(folder / "checkout"))


@pytest.fixture(scope="session")
def expected_digest(shared) -> str:
    return once(shared, "local", local_digest)
