import json

import pytest

from schemas.dataset.layout import LEDGER_FILE, SUCCESS_FILE, commit_path
from services.merge.merge import merge
from services.run import range_planner as losses
from services.run.range_planner import find_lost
from tests.made_up_datasets import FIRST, STOP, dataset_at
from tests.made_up_scenes import attempt_at, failed_scene
from workers.store.ledger import list_commits, save_rows

pytestmark = pytest.mark.usefixtures("unflushed")


@pytest.fixture
def finished(tmp_path):
    """Scenes 3 to 29 in ranges of four, one with a retry, merged."""
    store = dataset_at(tmp_path)
    attempt_at(store, 3, 7, retry=1, scenes=(5,), make=failed_scene).commit()
    merge(store, FIRST, STOP)
    return store


def test_nothing_is_lost_of_a_whole_dataset(finished):
    assert find_lost(finished) == []
    save_rows(finished, list_commits(finished).rows)
    assert find_lost(finished) == []


@pytest.mark.parametrize("start", range(3, 30, 4))
def test_a_range_that_is_gone_is_told_by_the_kept_summary(finished, start):
    save_rows(finished, list_commits(finished).rows)
    for retry in (0, 1):
        finished.remove(commit_path(start, retry))
    line = find_lost(finished)[0]
    assert line.startswith(
        f"{commit_path(start)} is lost: it was committed, and is gone; restore it from a copy, or run"
    )
    assert len(line.splitlines()) == 1


@pytest.mark.parametrize(("start", "scenes"), [(3, "3 to 6"), (15, "15 to 18"), (27, "27 to 29")])
def test_a_range_that_is_gone_is_told_by_the_success_file_where_there_is_no_summary(finished, start, scenes):
    for retry in (0, 1):
        finished.remove(commit_path(start, retry))
    assert finished.size(LEDGER_FILE) is None
    (line,) = find_lost(finished)
    assert line.startswith(f"the commits of scenes {scenes} of the finished dataset are lost; ")


def test_a_retry_that_is_gone_is_told_by_the_digest_of_the_commits(finished):
    finished.remove(commit_path(3, 1))
    (line,) = find_lost(finished)
    assert line.startswith("the commits are not those that the finished dataset was merged from: ")


def test_of_very_many_commits_the_counts_of_scenes_are_compared(finished, monkeypatch):
    monkeypatch.setattr(losses, "DIGEST_UP_TO", 3)
    assert find_lost(finished) == []
    success = json.loads(finished.read(SUCCESS_FILE))
    success["scenes"]["made"] += 1
    finished.put(SUCCESS_FILE, json.dumps(success).encode())
    assert find_lost(finished)[0].startswith("the commits are not those that the finished dataset was merged from: ")


def test_where_all_commits_are_gone_few_lines_tell_it(finished, monkeypatch):
    monkeypatch.setattr(losses, "MOST_TOLD", 3)
    save_rows(finished, list_commits(finished).rows)
    finished.remove_tree("manifest/_commits")
    lines = find_lost(finished)
    assert len(lines) == 4
    assert lines[-1].startswith("5 more commits are lost; ")
    finished.remove(LEDGER_FILE)
    assert find_lost(finished)[0].startswith("the commits of scenes 3 to 29 of the finished dataset are lost; ")


@pytest.mark.parametrize("damage", [{"stop_scene": None}, {"stop_scene": "x"}, {"first_scene": []}, {}])
def test_a_damaged_success_file_ends_nothing(finished, damage):
    success = json.loads(finished.read(SUCCESS_FILE)) | damage
    finished.put(SUCCESS_FILE, json.dumps(success).encode())
    assert find_lost(finished) == []


def test_an_unfinished_dataset_lacks_scenes_and_has_lost_none(tmp_path):
    store = dataset_at(tmp_path, stop=11)
    store.remove(commit_path(3))
    assert find_lost(store) == []
