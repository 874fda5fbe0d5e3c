"""The size of ranges where the job does not give it."""

import math

import pytest

from schemas.job.job import Job


def size_of(**keys) -> int:
    return Job.model_validate({"name": "t", **keys}).range_size


def test_what_the_job_says_holds():
    assert size_of(scenes=2, run={"range_size": 40}) == 40


@pytest.mark.parametrize("workers", [1, 4, 16, 32])
@pytest.mark.parametrize("scenes", [1, 2, 31, 32, 64, 500, 10_000])
def test_every_worker_has_a_range_where_there_are_as_many_scenes(scenes, workers):
    assert math.ceil(scenes / size_of(scenes=scenes)) >= min(scenes, workers)


def test_many_quick_scenes_are_committed_sixteen_at_a_time():
    assert size_of(scenes=10**6) == 16
    assert size_of(scenes=10**6, objects_per_scene=[1, 16]) < 16


def test_sixteen_piles_of_eight_are_sixteen_ranges_and_a_range_of_a_long_job_takes_ten_seconds_at_most():
    """Two cores share sixteen; and such a pile takes 1.7 s."""
    piles = {"objects_per_scene": 8, "start": {"pose": "tumbled", "arrange": "pile"}}
    assert size_of(scenes=16, **piles) == 1
    assert 1 < size_of(scenes=10**6, **piles) <= 10 / 1.7


def test_ranges_of_slow_pictures_are_shorter():
    traced = [size_of(scenes=10**4, render={"tier": "pathtraced", "path_samples": n}) for n in (4, 16, 256)]
    assert traced == sorted(traced, reverse=True)
    assert traced[0] > traced[1] >= traced[2] == 1


def test_a_capture_is_a_range():
    assert size_of(captures={}) == 1
