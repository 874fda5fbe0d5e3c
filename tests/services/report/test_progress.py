import os

import pytest

from schemas.job.job import Job
from services.job.record import encode_job, record_job
from services.look.live import latest_scenes, progress_of, read_progress
from services.merge.merge import merge
from services.read.status import Running, Status
from services.run.lock import hold_lock
from tests.made_up_scenes import attempt_at
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path / "out")
    store.prepare()
    return store


def begin(store, scenes: int) -> None:
    store.put("job.yaml", encode_job(record_job(Job(name="small", seed=1, scenes=scenes), "0" * 64, store.root)))


def test_a_folder_that_is_not_there_and_an_empty_one_wait_for_a_job(tmp_path, store):
    assert read_progress(LocalStore(tmp_path / "nowhere")).phase == "empty"
    assert read_progress(store).phase == "empty"
    begin(store, 12)
    progress = read_progress(store)
    assert (progress.phase, progress.name, progress.asked) == ("empty", "small", 12)


def test_what_is_made_and_failed_is_counted_while_a_run_lives(store):
    begin(store, 12)
    attempt_at(store, 0, 4).commit()
    attempt_at(store, 4, 8).commit()  # scene 5 fails
    with hold_lock(store):
        progress = read_progress(store)
    assert (progress.phase, progress.asked, progress.made, progress.done) == ("making", 12, 7, 8)
    assert progress.failed == {"intrinsic: left_table": 1}
    assert read_progress(store).phase == "stopped"


def test_a_merged_dataset_is_finished(store):
    begin(store, 4)
    attempt_at(store, 0, 4).commit()
    merge(store, 0, 4)
    assert read_progress(store).phase == "finished"


def test_a_damaged_job_is_told_and_not_raised(store):
    store.put("job.yaml", b"verso: [")
    progress = read_progress(store)
    assert progress.phase == "unreadable" and "job.yaml" in progress.told[0]


def status(**changes) -> Status:
    plain = {
        "asked": 100,
        "made": 38,
        "failed": {"intrinsic: x": 2},
        "missing": 60,
        "scenes_per_s": 3.0,
        "digest": None,
    }
    return Status(**{**plain, "running": (Running(40, "a", 41), Running(50, "b", None)), "holder": None, **changes})


def test_time_left_is_what_is_missing_at_the_rate_of_now():
    assert progress_of("small", status(), True).left_s == 20.0
    assert progress_of("small", status(), True).running == (41,)
    assert progress_of("small", status(scenes_per_s=None), True).left_s is None


def test_what_died_has_no_rate_and_nothing_running():
    gone = progress_of("small", status(), False)
    assert (gone.phase, gone.scenes_per_s, gone.left_s, gone.running) == ("stopped", None, None, ())


def test_an_extension_that_has_not_begun_is_not_finished():
    assert progress_of("small", status(digest="d" * 64), False).phase == "stopped"
    assert progress_of("small", status(digest="d" * 64, missing=0), False).phase == "finished"


def test_the_latest_scenes_are_those_of_the_newest_commits(shown):
    for start, age in ((0, 1e9), (2, 2e9)):
        os.utime(shown.path(f"manifest/_commits/{start:010d}.json"), (age, age))
    assert [scene.scene_id for scene in latest_scenes(shown, 3)] == [3, 2, 1]
    os.utime(shown.path("manifest/_commits/0000000000.json"), (3e9, 3e9))
    assert [scene.scene_id for scene in latest_scenes(shown, 3)] == [1, 0, 3]


def test_scenes_whose_images_cannot_be_read_now_are_left_out(store):
    begin(store, 4)
    attempt_at(store, 0, 4).commit()  # its images are no PNG
    assert latest_scenes(store) == []
    assert latest_scenes(LocalStore(store.root / "nowhere")) == []
