"""One renderer for all tests of a process: there is one OpenGL context."""

import pytest

from workers.render.raster.gbuffer import Renderer, shared_renderer


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    return shared_renderer()
