"""What was found in a folder."""

import pytest

from tests.services.init.test_guess import item


def test_an_item_knows_its_format_and_its_diagonal():
    one = item("a/B.GLB", extents=(3.0, 4.0, 12.0))
    assert one.suffix == ".glb" and one.diagonal == pytest.approx(13.0)
