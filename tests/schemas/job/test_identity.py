"""Which keys make a job the same. The digests are those of datasets that exist: they must not change."""

import pytest

from schemas.job.identity import compare_jobs, job_digest, settings_digest
from schemas.job.job import Job
from tests.datasets import overlaid

URDF = {"source": "urdf", "folder": "/somewhere"}
BASE = {"name": "t", "assets": {"objects": [URDF]}}


def job(**changes) -> Job:
    return Job.model_validate(overlaid(BASE, changes))


@pytest.mark.parametrize(
    ("changes", "same_dataset", "same_scene"),
    [
        ({"scenes": 7}, True, True),
        ({"run": {"workers": 3, "fingerprint": "record"}}, True, True),
        ({"assets": {"objects": [{**URDF, "folder": "/elsewhere"}]}}, True, True),
        ({"name": "u"}, False, True),
        ({"first_scene": 4}, False, True),
        ({"output": {"layout": "tar"}}, False, True),
        ({"preset": "exact", "physics": {"step_hz": 960}, "render": {"samples": 1}}, False, True),
        ({"seed": 1}, False, False),
        ({"cameras": {"mirror": {"T_z_m": 1.4}}}, False, False),
        ({"sensor": {"rgb_noise": {}}}, False, False),
        ({"assets": {"objects": [{**URDF, "scale": 2.0}]}}, False, False),
    ],
)
def test_a_key_belongs_to_the_dataset_to_its_scenes_or_to_neither(changes, same_dataset, same_scene):
    before, after = job(), job(**changes)
    assert (job_digest(before, "c") == job_digest(after, "c")) is same_dataset
    assert (settings_digest(before, "c") == settings_digest(after, "c")) is same_scene
    assert (compare_jobs(before, after) == []) is same_dataset


def test_other_asset_files_are_another_job():
    assert job_digest(job(), "c") != job_digest(job(), "d")
    assert settings_digest(job(), "c") != settings_digest(job(), "d")


def test_a_difference_names_its_key_and_both_values():
    assert compare_jobs(job(), job(seed=2, start={"pose": "tumbled"})) == [
        ("seed", 0, 2),
        ("start.pose", "upright", "tumbled"),
    ]


def test_digests_of_a_job_are_those_of_datasets_that_were_made_before():
    plain = Job(name="t")
    assert job_digest(plain, "c")[:16] == "d3ee8e0fe9559a68"
    assert settings_digest(plain, "c")[:16] == "938ee36c17800eba"
