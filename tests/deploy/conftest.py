"""The image and the digest that it has to reach, made once for all test processes, and a checkout with a small job."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.kit.containers import IMAGE, JOB, SCENES, Compose, build_image, copy_checkout, local_digest, once


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


@pytest.fixture(scope="module")
def compose(image, tmp_path_factory, request) -> Iterator[Compose]:
    """A checkout whose example job is small, and nothing of it left afterwards."""
    checkout = copy_checkout(tmp_path_factory.mktemp("compose") / "checkout")
    job = checkout / JOB
    job.write_text(job.read_text().replace("scenes: 64\n", f"scenes: {SCENES}\n"))
    compose = Compose(checkout, f"{IMAGE}-{request.path.stem.replace('_', '-')}")
    try:
        yield compose
    finally:
        compose("down", "--volumes", "--timeout", "0")
