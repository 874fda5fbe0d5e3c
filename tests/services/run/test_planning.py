"""What of a dataset is still to be made, without ever an overlap; in which shards; and what it had once and has lost."""

import itertools
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.commit import CommitSummary, Ledger, Span, join_rows, rows_of
from schemas.dataset.layout import commit_path
from schemas.errors import OutputError
from schemas.job.job import Job
from services.run import range_planner as module
from services.run.range_planner import (
    deal_shards,
    find_lost,
    plan_ranges,
    plan_retries,
    plan_spans,
)
from tests.made_up_datasets import dataset_at
from tests.made_up_scenes import attempt_at, failed_scene
from workers.store.ledger import list_commits, save_rows

pytestmark = pytest.mark.usefixtures("unflushed")


def test_fewer_scenes_and_ranges_of_another_size_are_refused():
    fewer = "scenes 0 to 7 are committed, more than the job's 0 to 5: fewer scenes"
    other_size = "a dataset keeps the range_size of its first run"
    for first, stop, committed, words in (
        (0, 6, [(0, 4), (4, 8)], fewer),
        (4, 8, [(0, 4)], "are committed"),
        *((0, 12, ranges, other_size) for ranges in ([(0, 5)], [(1, 4)], [(0, 2), (3, 4)], [(0, 4), (2, 4)])),
    ):
        with pytest.raises(OutputError, match=words):
            plan_ranges(first, stop, 4, committed)


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
            missing = list(plan_ranges(first, stops[me], size, view))
            if missing:
                start, stop = data.draw(st.sampled_from(missing), "range")
                if start not in taken:
                    taken[start] = stop
                    log.append((start, stop))
    end = max([*stops, *taken.values()])
    while missing := list(plan_ranges(first, end, size, log)):
        for start, stop in missing:
            assert start not in taken
            taken[start] = stop
            log.append((start, stop))
    scenes = [scene for start, stop in log for scene in range(start, stop)]
    assert sorted(scenes) == list(range(first, end))


@given(st.data())
def test_the_lazy_plan_is_that_of_a_list_over_every_cell(data):
    first, size = data.draw(st.integers(0, 5), "first"), data.draw(st.integers(1, 6), "range size")
    stop = first + data.draw(st.integers(1, 40), "scenes")
    committed, missing = [], []
    for line in range(first, stop, size):
        cuts = st.lists(st.integers(line + 1, min(line + size, stop)), unique=True, max_size=3)
        inner = [line, *sorted(data.draw(cuts, f"cuts {line}"))]
        committed += itertools.pairwise(inner)
        if inner[-1] < min(line + size, stop):
            missing.append((inner[-1], min(line + size, stop)))
    shuffled = data.draw(st.permutations(committed), "order")
    assert list(plan_ranges(first, stop, size, shuffled)) == missing


def summary(start, retry=0, failed=(), scenes=(), stop=None):
    failures = tuple((scene, kind, "left_table") for scene, kind in failed)
    return CommitSummary(start, stop or start + 4, retry, 4 - len(failed), failures, tuple(scenes))


def test_a_plan_of_a_thousand_million_scenes_is_made_on_demand():
    """The list took 12 GB."""
    job = Job.model_validate({"name": "large", "scenes": 10**9})
    ledger = Ledger(join_rows([rows_of([summary(16 * 40_000_000 - 16, stop=16 * 40_000_000)])]))
    tracemalloc.start()  # after the imports of a first job
    plan = plan_spans(job, ledger, False)
    assert plan.scenes == 10**9 - 16
    shards = deal_shards(plan, plan.scenes, 16, lambda: 2)
    assert [span.start for span in next(shards)] == [0, 16, 32, 48]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_only_environmental_failures_that_still_stand_are_tried_again():
    summaries = [
        summary(0, failed=[(1, "environmental"), (2, "intrinsic"), (3, "environmental")]),
        summary(0, retry=1, scenes=(1, 3), failed=[(3, "environmental")]),
        summary(4, failed=[(5, "environmental")]),
        summary(4, retry=1, scenes=(5,), failed=[(5, "intrinsic")]),
        summary(8, failed=[(9, "environmental")]),
    ]
    ledger = Ledger(join_rows([rows_of(summaries)]))
    spans = plan_retries(ledger)
    assert [(span.start, span.stop, span.retry, span.scenes) for span in spans] == [(0, 4, 2, (3,)), (8, 12, 1, (9,))]
    assert spans[0].scene_ids == (3,)
    assert ledger.failures.column("scene_id").to_pylist() == [2, 3, 5, 9]
    assert ledger.ranges.tolist() == [[0, 4], [4, 8], [8, 12]]
    job = Job.model_validate({"name": "a", "scenes": 14, "run": {"range_size": 4}})
    plan = plan_spans(job, ledger, retry_failed=True)
    assert (plan.scenes, [span.start for span in plan]) == (4, [12, 0, 8])


def spans_of(scenes: int, size: int) -> list[Span]:
    return [Span(start=start, stop=min(start + size, scenes)) for start in range(0, scenes, size)]


def test_a_shard_is_whole_ranges_in_order_and_shards_get_smaller_towards_the_end():
    for size, grouped in ((1, [1, 1, 1, 1]), (4, [1, 1, 1, 1]), (5, [2, 2]), (100, [4])):
        shards = list(deal_shards(spans_of(14, 4), 14, 4, int, size))
        assert [len(shard) for shard in shards] == grouped
        assert [span for shard in shards for span in shard] == spans_of(14, 4)
    for scenes, slots, size, sizes in (
        (256, 2, 16, [64, 48, 48, 32, 16, 16, 16, 16]),
        (24, 2, 2, [6, 6, 4, 2, 2, 2, 2]),
        (1, 2, 16, [1]),
        (5, 4, 1, [1, 1, 1, 1, 1]),
        (40, 1, 4, [16, 12, 8, 4]),
    ):
        shards = list(deal_shards(spans_of(scenes, size), scenes, size, lambda slots=slots: slots))
        assert [sum(span.count for span in shard) for shard in shards] == sizes
        assert [span for shard in shards for span in shard] == spans_of(scenes, size)
    for size, first in ((16, 64), (1, 4)):
        shard = next(deal_shards(spans_of(10**4, size), 10**6, size, lambda: 2))
        assert sum(span.count for span in shard) == first
    slots = iter([1, 8])
    following = deal_shards(spans_of(32, 1), 32, 8, lambda: next(slots))
    assert [len(next(following)), len(next(following))] == [16, 1]


@given(st.integers(1, 400), st.integers(1, 16), st.integers(1, 8), st.randoms(use_true_random=False))
def test_slots_end_within_the_time_of_one_range(scenes, size, slots, chance):
    """Each slot takes the next shard when it is free, as Ray does; scenes take from 0.1 to 0.2 s."""
    seconds = [chance.uniform(0.1, 0.2) for _ in range(scenes)]
    free_at = [0.0] * slots
    for shard in deal_shards(spans_of(scenes, size), scenes, size, lambda: slots):
        first = free_at.index(min(free_at))
        free_at[first] += sum(seconds[scene] for span in shard for scene in span.scene_ids)
    assert max(free_at) - min(free_at) <= size * 0.2 + 1e-9


def test_ranges_that_are_gone_are_told_by_the_kept_summary_in_few_lines(tmp_path, monkeypatch):
    """Scenes 3 to 29 in ranges of four, one with a retry."""
    store = dataset_at(tmp_path)
    attempt_at(store, 3, 7, retry=1, scenes=(5,), make=failed_scene).commit()
    save_rows(store, list_commits(store).rows)
    assert find_lost(list_commits(store)) == []
    for start in range(3, 30, 4):
        keys = [key for key in (commit_path(start), commit_path(start, 1)) if store.size(key) is not None]
        whole = {key: store.read(key) for key in keys}
        for key in whole:
            store.remove(key)
        line = find_lost(list_commits(store))[0]
        lost = f"{commit_path(start)} is lost: it was committed, and is gone; restore it from a copy, or run"
        assert line.startswith(lost) and "\n" not in line
        for key, data in whole.items():
            store.put(key, data)
    monkeypatch.setattr(module, "MOST_TOLD", 3)
    store.remove_tree("manifest/_commits")
    lines = find_lost(list_commits(store))
    assert len(lines) == 4 and lines[-1].startswith("5 more commits are lost; ")
