"""What a worker process holds: the digest of a job's settings."""

import pytest

from schemas.job.identity import settings_digest
from schemas.job.job import Job


def digest(catalogue: str = "assets", **changes) -> str:
    return settings_digest(Job.model_validate({"name": "t", **changes}), catalogue)


@pytest.mark.parametrize(
    "changes", [{"name": "other"}, {"scenes": 7}, {"first_scene": 3}, {"run": {"scene_timeout_s": 5.0}}, {"sensor": {}}]
)
def test_what_does_not_change_a_scene_is_not_in_the_digest(changes):
    assert digest(**changes) == digest()


@pytest.mark.parametrize(
    "changes", [{"seed": 1}, {"sensor": {"rgb_noise": {}}}, {"physics": {"restitution": 0.5}}, {"catalogue": "others"}]
)
def test_what_changes_a_scene_is_in_the_digest(changes):
    assert digest(**changes) != digest()
