import pytest
from tests.services.study.label_views import camera_above, seen_of_block


@pytest.fixture(scope="module")
def seen():
    """(depth in metres, region) of the block, by formula."""
    return seen_of_block(camera_above())
