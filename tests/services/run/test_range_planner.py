import itertools
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.commit import CommitSummary, Ledger, Span, join_rows, rows_of
from schemas.errors import OutputError
from schemas.job.job import Job
from services.run.range_planner import (
    committed_ranges,
    deal_shards,
    group_shards,
    plan_ranges,
    plan_retries,
    plan_spans,
)


def test_ranges_lie_on_the_grid_and_the_last_is_cut_short():
    assert list(plan_ranges(5, 14, 4, [])) == [(5, 9), (9, 13), (13, 14)]


def test_an_extension_begins_at_the_last_stop_and_ends_at_the_next_line():
    assert list(plan_ranges(0, 12, 4, [(0, 4), (4, 6)])) == [(6, 8), (8, 12)]
    assert list(plan_ranges(0, 7, 4, [(0, 4), (4, 6)])) == [(6, 7)]
    assert list(plan_ranges(0, 6, 4, [(0, 4), (4, 6)])) == []


def test_gaps_are_filled():
    assert list(plan_ranges(0, 12, 4, [(4, 8)])) == [(0, 4), (8, 12)]


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


def listed_ranges(first: int, stop: int, size: int, committed: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """The same plan as a plain list over every cell: what the lazy one must give."""
    stops, missing = dict(committed), []
    for line in range(first, stop, size):
        start, end = line, min(line + size, stop)
        while start in stops:
            start = stops[start]
        if start < end:
            missing.append((start, end))
    return missing


@given(st.data())
def test_the_lazy_plan_is_that_of_a_list_over_every_cell(data):
    first, size = data.draw(st.integers(0, 5), "first"), data.draw(st.integers(1, 6), "range size")
    stop = first + data.draw(st.integers(1, 40), "scenes")
    committed = []
    for line in range(first, stop, size):
        inner = data.draw(
            st.lists(st.integers(line + 1, min(line + size, stop)), unique=True, max_size=3), f"cuts {line}"
        )
        committed += itertools.pairwise([line, *sorted(inner)])
    shuffled = data.draw(st.permutations(committed), "order")
    assert list(plan_ranges(first, stop, size, shuffled)) == listed_ranges(first, stop, size, committed)


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


def summary(start, retry=0, failed=(), scenes=(), stop=None):
    told = tuple((scene, kind, "left_table") for scene, kind in failed)
    return CommitSummary(start, stop or start + 4, retry, 4 - len(failed), told, tuple(scenes))


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
    assert committed_ranges(ledger).tolist() == [[0, 4], [4, 8], [8, 12]]
    plan = plan_spans(
        Job.model_validate({"name": "a", "scenes": 14, "run": {"range_size": 4}}), ledger, retry_failed=True
    )
    assert (plan.scenes, [span.start for span in plan]) == (4, [12, 0, 8])


@pytest.mark.parametrize(("size", "grouped"), [(1, [1, 1, 1, 1]), (4, [1, 1, 1, 1]), (5, [2, 2]), (100, [4])])
def test_a_shard_is_whole_ranges_in_order(size, grouped):
    spans = [Span(start=start, stop=min(start + 4, 14)) for start in range(0, 14, 4)]
    shards = list(group_shards(spans, size))
    assert [len(shard) for shard in shards] == grouped
    assert [span for shard in shards for span in shard] == spans


@pytest.mark.parametrize(
    ("scenes", "slots", "size", "sizes"),
    [
        (256, 2, 16, [64, 48, 48, 32, 16, 16, 16, 16]),
        (24, 2, 2, [6, 6, 4, 2, 2, 2, 2]),
        (1, 2, 16, [1]),
        (5, 4, 1, [1, 1, 1, 1, 1]),
        (40, 1, 4, [16, 12, 8, 4]),
    ],
)
def test_shards_get_smaller_towards_the_end(scenes, slots, size, sizes):
    spans = [Span(start=start, stop=min(start + size, scenes)) for start in range(0, scenes, size)]
    shards = list(deal_shards(spans, scenes, size, lambda: slots))
    assert [sum(span.count for span in shard) for shard in shards] == sizes
    assert [span for shard in shards for span in shard] == spans


@pytest.mark.parametrize(("size", "first"), [(16, 64), (1, 4)])
def test_no_shard_of_a_large_job_is_too_large(size, first):
    spans = (Span(start=start, stop=start + size) for start in range(0, 10**6, size))
    assert sum(span.count for span in next(deal_shards(spans, 10**6, size, lambda: 2))) == first


def test_shards_follow_the_slots_of_the_moment():
    slots, spans = iter([1, 8]), [Span(start=start, stop=start + 1) for start in range(32)]
    shards = deal_shards(spans, 32, 8, lambda: next(slots))
    assert [len(next(shards)), len(next(shards))] == [16, 1]


@st.composite
def _deals(draw):
    scenes, size = draw(st.integers(1, 400)), draw(st.integers(1, 16))
    seconds = draw(st.lists(st.floats(0.1, 0.2), min_size=scenes, max_size=scenes))
    return scenes, size, draw(st.integers(1, 8)), seconds


@given(_deals())
def test_slots_end_within_the_time_of_one_range(deal):
    """Each slot takes the next shard when it is free, as Ray does; scenes take from 0.1 to 0.2 s."""
    scenes, size, slots, seconds = deal
    spans = [Span(start=start, stop=min(start + size, scenes)) for start in range(0, scenes, size)]
    free_at = [0.0] * slots
    for shard in deal_shards(spans, scenes, size, lambda: slots):
        first = free_at.index(min(free_at))
        free_at[first] += sum(seconds[scene] for span in shard for scene in span.scene_ids)
    assert max(free_at) - min(free_at) <= size * 0.2 + 1e-9
