"""Errors of smooth cases fall with the step."""

import pytest

from services.study.measure import slopes


def test_errors_fall_with_the_step_in_the_order_of_the_integrator():
    found = slopes()
    assert found["free fall"] == pytest.approx(1.0, abs=1e-3)
    assert found["sliding to rest"] == pytest.approx(1.0, abs=0.05)
