import pytest

from tests.launcher.checkout import Checkout


@pytest.fixture
def checkout(tmp_path):
    return Checkout(tmp_path)
