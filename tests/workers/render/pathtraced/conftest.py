"""One tracer for all tests of a process."""

import pytest

from workers.render.pathtraced import Tracer


@pytest.fixture(scope="session")
def tracer() -> Tracer:
    return Tracer()
