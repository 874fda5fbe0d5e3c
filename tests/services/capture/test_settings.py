import pytest

from schemas.errors import JobError
from services.capture import capture_job, capture_settings


def test_options_come_first_and_set_has_the_last_word():
    keys = {"captures.simulate.views": 12, "captures.simulate.image_scale": None, "seed": 5, "categories": ["mug"]}
    job = capture_job(["captures.simulate.views=9"], keys)
    assert job.captures is not None
    assert (job.captures.simulate.views, job.captures.simulate.image_scale, job.seed) == (9, 1.0, 5)
    assert list(job.categories) == ["mug"]


def test_settings_without_changes_are_the_defaults_of_a_job_file():
    assert capture_settings().estimation.estimate == "joint"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("captures.fusion.voxl_m=0.1", "did you mean 'voxel_m'"),
        ("captures.fusion.voxel_m=9", "at most 0.02"),
        ("voxel_m", "path.to.key=value"),
    ],
)
def test_a_wrong_change_is_wrong_input_that_names_its_key(change, words):
    with pytest.raises(JobError, match=words) as caught:
        capture_settings([change])
    assert caught.value.exit_code == 2
