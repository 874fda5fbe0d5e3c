"""Jobs of captures: what follows from the branch, and what a capture cannot have."""

import pytest
from pydantic import ValidationError

from schemas.job.identity import compare_jobs, dataset_keys, job_digest, settings_digest
from schemas.job.job import Job
from tests.datasets import overlaid

FOLDERS = {"name": "t", "captures": {"source": "folders", "folders": ["a", "b", "c"]}}
SIMULATED = {"name": "t", "captures": {}}


def job(base: dict, **changes) -> Job:
    return Job.model_validate(overlaid(base, changes))


def test_folders_say_how_many_captures_there_are_and_a_job_may_ask_for_fewer():
    assert job(FOLDERS).scenes == 3
    assert job(FOLDERS, scenes=2).stop_scene == 2


def test_pose_ids_follow_from_the_most_views_and_there_is_no_aligned_view():
    made = job(SIMULATED, captures={"most_views": 50})
    assert (made.pairs_per_scene, made.cameras.depth.enabled, made.scenes) == (50, False, 64)


def test_a_capture_is_committed_by_itself_and_may_take_long_unless_the_job_says_otherwise():
    assert (job(SIMULATED).run.range_size, job(SIMULATED).run.scene_timeout_s) == (1, 1800.0)
    assert job(SIMULATED, run={"range_size": 4}).run.range_size == 4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scenes": 4}, "3 folders"),
        ({"first_scene": 1, "scenes": 2}, "first_scene must be 0"),
        ({"pairs_per_scene": 2}, "most_views"),
        ({"cameras": {"depth": {"enabled": True}}}, "registered"),
        ({"objects_per_scene": [1, 3]}, "one object"),
        ({"sensor": {"depth_noise": {}}}, "captures.simulate"),
        ({"render": {"rgb": False}}, "render.rgb"),
        ({"captures": {"source": "simulate"}}, "folders must be named"),
        ({"captures": {"category": "a/b"}}, "letters, digits, - and _"),
    ],
)
def test_what_a_capture_cannot_have_is_refused_with_its_key(changes, words):
    with pytest.raises(ValidationError, match=words):
        job(FOLDERS, **changes)


def test_a_job_of_captures_reads_back_from_its_own_dump():
    for base in (FOLDERS, SIMULATED):
        made = job(base)
        assert Job.model_validate(made.model_dump(mode="json")) == made


def test_a_job_without_captures_is_dumped_as_before_there_were_any():
    assert "captures" not in Job(name="t").model_dump(mode="json")
    assert "captures" not in Job(name="t").model_dump_json()


def test_settings_of_captures_belong_to_the_dataset_and_paths_of_folders_do_not():
    before = job(FOLDERS)
    moved = job(FOLDERS, captures={"folders": ["x/a", "x/b", "x/c"]})
    assert compare_jobs(before, moved) == []
    assert job_digest(before, "c") == job_digest(moved, "c")
    finer = job(FOLDERS, captures={"fusion": {"voxel_m": 0.001}})
    assert compare_jobs(before, finer) == [("captures.fusion.voxel_m", 0.002, 0.001)]
    assert settings_digest(before, "c") != settings_digest(finer, "c")
    assert "folders" not in dataset_keys(before)["captures"]


def test_keys_that_the_source_does_not_use_decide_nothing():
    assert job_digest(job(FOLDERS), "c") == job_digest(job(FOLDERS, captures={"simulate": {"views": 9}}), "c")
    assert job_digest(job(SIMULATED), "c") != job_digest(job(SIMULATED, captures={"simulate": {"views": 9}}), "c")
