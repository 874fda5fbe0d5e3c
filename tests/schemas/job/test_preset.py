import pytest

from schemas.job.job import PRESETS, with_preset


def test_a_preset_fills_the_keys_that_the_job_does_not_give():
    given = {"preset": "exact", "render": {"samples": 1}}
    filled = with_preset(given)
    assert filled["render"] == {"samples": 1, "tier": "raster"}
    assert filled["physics"] == {"step_hz": PRESETS["exact"]["physics.step_hz"]}
    assert given == {"preset": "exact", "render": {"samples": 1}}


@pytest.mark.parametrize("name", ["unknown", 3, None, ["fast"]])
def test_an_unknown_preset_fills_nothing(name):
    assert with_preset({"preset": name}) == {"preset": name}


def test_a_branch_that_is_no_mapping_is_left_as_it_is():
    assert with_preset({"physics": 3})["physics"] == 3
