"""What a worker process holds: the digest of a job's settings, and libraries that are held to one thread."""

import cv2
import pytest

from schemas.job.identity import settings_digest
from schemas.job.job import Job
from tests.workers.render.random_scenes import built_in_assets
from workers.scene.context import open_worker


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


def test_opencv_of_a_worker_has_one_thread():
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        open_worker(Job(name="t"), built_in_assets())
        assert cv2.getNumThreads() == 1
    finally:
        cv2.setNumThreads(before)
