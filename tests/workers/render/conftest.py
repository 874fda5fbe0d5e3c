"""One renderer and one tracer for all tests of a process: there is one OpenGL context."""

import pytest

from workers.render.pathtraced import Tracer
from workers.render.raster.gbuffer import Renderer, shared_renderer


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    return shared_renderer()


@pytest.fixture(scope="session")
def tracer() -> Tracer:
    return Tracer()
