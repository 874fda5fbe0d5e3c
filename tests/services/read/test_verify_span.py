"""Lost commits of a finished dataset are named, each with its scenes, and what remains is checked all the same."""

import shutil

import pytest

from services.read.verdict import Verdict
from services.read.verify_range import Spans, commit_groups
from tests.datasets import faults_of
from workers.store.attempt import reopen
from workers.store.local import LocalStore


def drop_range(out, start: int) -> None:
    """Deletes a range as if it had never been: its commit, tables, images."""
    (out / f"manifest/_commits/{start:010d}.json").unlink()
    shutil.rmtree(out / f"manifest/_ranges/{start:010d}")
    for pose in (2 * start, 2 * start + 1):
        for path in out.glob(f"*/**/*{pose:05d}.png"):
            path.unlink()


@pytest.mark.parametrize("start", [0, 1, 2])
def test_a_deleted_range_is_named_with_its_scenes_and_nothing_else_is_blamed(copy, start):
    drop_range(copy, start)
    told = f"manifest/_commits/{start:010d}.json: scenes {start} to {start} are not committed: run the job again"
    assert [fault for fault in faults_of(LocalStore(copy)) if fault.startswith(told)]
    assert not [fault for fault in faults_of(LocalStore(copy)) if "manifest/_commits" in fault and told not in fault]


def test_each_of_several_deleted_ranges_is_named(copy):
    drop_range(copy, 0)
    drop_range(copy, 1)
    told = "\n".join(faults_of(LocalStore(copy)))
    assert "manifest/_commits/0000000000.json: is missing: scenes 0 to 0 are not committed" in told
    assert "manifest/_commits/0000000001.json: is missing: scenes 1 to 1 are not committed" in told


def test_of_a_lost_commit_the_files_that_stand_are_not_called_strays(copy):
    (copy / "manifest/_commits/0000000001.json").unlink()
    faults = faults_of(LocalStore(copy))
    assert any("scenes 1 to 1 are not committed" in fault for fault in faults)
    assert not any("RGB" in fault for fault in faults)


def test_a_dataset_that_is_not_finished_says_so_and_what_it_lacks(copy):
    reopen(LocalStore(copy))
    drop_range(copy, 1)
    faults = faults_of(LocalStore(copy))
    assert "scenes 1 to 1 are not committed: run the job again" in faults[0]
    assert faults[1].startswith("_SUCCESS: is missing, not finished: 2 of 3 scenes are committed: run the job again")
    assert len(faults) == 2


def test_a_commit_of_other_scenes_and_one_without_its_range_are_told(copy):
    commits = copy / "manifest/_commits"
    shutil.copy(commits / "0000000001.json", commits / "0000000007.json")
    (commits / "0000000002.json").rename(commits / "0000000002.retry-1.json")
    told = "\n".join(faults_of(LocalStore(copy)))
    assert "manifest/_commits/0000000007.json: holds the record of another range" in told
    assert "manifest/_commits/0000000002.json: is missing, and later tries of its range are there" in told


def test_a_gap_of_a_billion_scenes_is_one_line():
    found = Verdict()
    spans = Spans((0, 10**9), 16, True, found)
    spans.finish()
    assert len(found.faults) == 1 and spans.gaps == [(0, 10**9)]


def test_commits_are_grouped_with_their_retries_in_order(tmp_path):
    folder = tmp_path / "manifest/_commits"
    folder.mkdir(parents=True)
    for name in ("0000000016.json", "0000000000.retry-10.json", "0000000000.retry-2.json", "0000000000.json", "x"):
        (folder / name).touch()
    assert list(commit_groups(LocalStore(tmp_path))) == [(0, [0, 2, 10]), (16, [0])]
