"""The share of scenes that are checked against the ray caster; every entry of the table has its tests in tests/effects."""

import numpy as np

from schemas.job.job import Job
from workers.scene.effects import is_raycast_scene
from workers.scene.plan import SceneChance


def test_the_share_of_checked_scenes_is_the_jobs_and_a_function_of_the_scene():
    job = Job.model_validate({"name": "t", "check": {"raycast_share": 0.1}})
    chosen = [is_raycast_scene(job.check, SceneChance(job.seed, scene)) for scene in range(3000)]
    assert abs(np.mean(chosen) - 0.1) < 4 * np.sqrt(0.09 / 3000)
    assert chosen[:50] == [is_raycast_scene(job.check, SceneChance(job.seed, scene)) for scene in range(50)]
    everything = Job.model_validate({"name": "t", "check": {"raycast_share": 1}})
    assert all(is_raycast_scene(everything.check, SceneChance(everything.seed, scene)) for scene in range(50))
