import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.commit import CommitSummary, Span
from schemas.errors import CorruptError, OutputError
from services.run.range_planner import (
    choose_shard_size,
    committed_ranges,
    effective_failures,
    group_shards,
    plan_ranges,
    plan_retries,
)
from tests.made_up_scenes import attempt_at, failed_scene, made_scene
from workers.store.committed_rows import list_commits
from workers.store.local import LocalStore

pytestmark = pytest.mark.usefixtures("unflushed")


def test_ranges_lie_on_the_grid_and_the_last_is_cut_short():
    assert plan_ranges(5, 14, 4, []) == [(5, 9), (9, 13), (13, 14)]


def test_an_extension_begins_at_the_last_stop_and_ends_at_the_next_line():
    assert plan_ranges(0, 12, 4, [(0, 4), (4, 6)]) == [(6, 8), (8, 12)]
    assert plan_ranges(0, 7, 4, [(0, 4), (4, 6)]) == [(6, 7)]
    assert plan_ranges(0, 6, 4, [(0, 4), (4, 6)]) == []


def test_gaps_are_filled():
    assert plan_ranges(0, 12, 4, [(4, 8)]) == [(0, 4), (8, 12)]


def test_fewer_scenes_than_committed_are_refused():
    with pytest.raises(OutputError, match="scenes 0 to 7 are committed, more than the job's 0 to 5: fewer scenes"):
        plan_ranges(0, 6, 4, [(0, 4), (4, 8)])
    with pytest.raises(OutputError, match="are committed"):
        plan_ranges(4, 8, 4, [(0, 4)])


@pytest.mark.parametrize("ranges", [[(0, 5)], [(1, 4)], [(0, 2), (3, 4)], [(0, 4), (2, 4)]])
def test_ranges_of_another_size_are_refused(ranges):
    with pytest.raises(OutputError, match="a dataset keeps the range_size of its first run"):
        plan_ranges(0, 12, 4, ranges)


@pytest.mark.parametrize(("first", "stop", "size"), [(0, 0, 4), (5, 4, 4), (0, 4, 0)])
def test_nothing_to_plan_is_a_mistake(first, stop, size):
    with pytest.raises(ValueError, match="no ranges"):
        plan_ranges(first, stop, size, [])


@given(st.data())
def test_planners_with_old_views_and_other_ends_never_overlap_and_cover_all_in_the_end(data):
    """Two planners, each with a view that may be old and an end that grows; a commit is put if its start is free."""
    first = data.draw(st.integers(0, 5), "first")
    size = data.draw(st.integers(1, 5), "range size")
    log: list[tuple[int, int]] = []
    taken: dict[int, int] = {}
    seen = [0, 0]
    stops = [first + data.draw(st.integers(1, 12), "stop") for _ in range(2)]
    for _ in range(data.draw(st.integers(0, 25), "steps")):
        me = data.draw(st.integers(0, 1), "who")
        action = data.draw(st.sampled_from(["look", "extend", "commit"]), "what")
        if action == "look":
            seen[me] = len(log)
        elif action == "extend":
            stops[me] += data.draw(st.integers(1, 7), "more")
        else:
            view = log[: seen[me]]
            if view and max(stop for _, stop in view) > stops[me]:
                continue  # refused: fewer scenes than committed
            missing = plan_ranges(first, stops[me], size, view)
            if missing:
                start, stop = data.draw(st.sampled_from(missing), "range")
                if start not in taken:
                    taken[start] = stop
                    log.append((start, stop))
    end = max([*stops, *taken.values()])
    while missing := plan_ranges(first, end, size, log):
        for start, stop in missing:
            assert start not in taken
            taken[start] = stop
            log.append((start, stop))
    scenes = [scene for start, stop in log for scene in range(start, stop)]
    assert sorted(scenes) == list(range(first, end))


def summary(start, retry=0, failed=(), scenes=()):
    told = tuple((scene, kind, "left_table") for scene, kind in failed)
    return CommitSummary(start, start + 4, retry, 4 - len(failed), told, tuple(scenes))


def test_only_environmental_failures_that_still_stand_are_tried_again():
    summaries = [
        summary(0, failed=[(1, "environmental"), (2, "intrinsic"), (3, "environmental")]),
        summary(0, retry=1, scenes=(1, 3), failed=[(3, "environmental")]),
        summary(4, failed=[(5, "environmental")]),
        summary(4, retry=1, scenes=(5,), failed=[(5, "intrinsic")]),
        summary(8, failed=[(9, "environmental")]),
    ]
    spans = plan_retries(summaries)
    assert [(span.start, span.stop, span.retry, span.scenes) for span in spans] == [(0, 4, 2, (3,)), (8, 12, 1, (9,))]
    assert spans[0].scene_ids == (3,)
    assert effective_failures(summaries[:2]) == [(2, "intrinsic"), (3, "environmental")]
    assert committed_ranges(summaries) == [(0, 4), (4, 8), (8, 12)]


def test_commits_are_listed_with_their_retries_and_a_missing_retry_is_told(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    attempt_at(store, 4, 8, make=made_scene).commit()
    attempt_at(store, 0, 4, make=lambda i: failed_scene(i, "environmental")).commit()
    attempt_at(store, 0, 4, retry=1, scenes=(1, 2), make=made_scene).commit()
    listed = list_commits(store)
    assert [(one.start, one.retry, one.made, len(one.failed)) for one in listed] == [
        (0, 0, 0, 4),
        (0, 1, 2, 0),
        (4, 0, 4, 0),
    ]
    assert plan_retries(listed)[0].scenes == (0, 3)
    (tmp_path / "manifest/_commits/0000000000.json").unlink()
    with pytest.raises(CorruptError, match=r"retries \[1\] of the range from scene 0"):
        list_commits(store)


@pytest.mark.parametrize(("size", "grouped"), [(1, [1, 1, 1, 1]), (4, [1, 1, 1, 1]), (5, [2, 2]), (100, [4])])
def test_a_shard_is_whole_ranges_in_order(size, grouped):
    spans = [Span(start=start, stop=min(start + 4, 14)) for start in range(0, 14, 4)]
    shards = list(group_shards(spans, size))
    assert [len(shard) for shard in shards] == grouped
    assert [span for shard in shards for span in shard] == spans


def test_every_slot_has_two_shards_and_none_is_too_large():
    assert choose_shard_size(24, 2) == 6
    assert choose_shard_size(1, 2) == 1
    assert choose_shard_size(10**6, 2) == 64
