"""Counting of reports and handing out of shards; deaths, retries and interruptions on a real Ray are in test_step.py."""

import pickle
from collections import Counter
from typing import cast

import pytest

from schemas.dataset.commit import Span
from schemas.dataset.shard import Fingerprint, ShardOrder, ShardReport, SpanReport
from services.job.job_file import validate_job
from services.run import coordinator as module
from services.run.coordinator import Coordinator, Limits
from services.run.joining import Pattern
from services.run.metrics import Tally
from services.run.ray_cluster import ClusterSlots, Slots
from services.run.worker_entry import WorkerTerms
from workers.assets.catalogue import Catalogue
from workers.store.local import LocalStore

STACK = Fingerprint(canary="c", code="d", libraries={}, simd="", renderer="")


def report(*spans: SpanReport) -> ShardReport:
    return ShardReport(spans=spans, seconds={}, wall_s=2.0, cpu_s=1.5, fingerprint=STACK, host="h", pid=1)


def span(start: int, made: int, failed: dict[str, int], conflict: str | None = None) -> SpanReport:
    return SpanReport(
        start=start, stop=start + 4, retry=0, won=conflict is None, conflict=conflict, made=made, failed=failed
    )


def test_reports_add_up_by_the_kind_of_failure():
    tally = Tally(asked=12)
    tally.add(report(span(0, 3, {"intrinsic: left_table": 1}), span(4, 4, {})))
    tally.add(report(span(8, 1, {"intrinsic: left_table": 2, "environmental: killed": 1})))
    assert (tally.made, tally.done) == (8, 12)
    assert tally.failed == Counter({"intrinsic: left_table": 3, "environmental: killed": 1})
    assert (tally.shard_wall_s, tally.shard_cpu_s) == (4.0, 3.0)
    assert tally.conflicts == []


def test_a_conflict_is_kept_word_for_word():
    tally = Tally(asked=4)
    tally.add(report(span(0, 4, {}, conflict="two attempts made other bytes")))
    assert tally.conflicts == ["two attempts made other bytes"]


@pytest.fixture
def handed_out(monkeypatch, tmp_path):
    """A coordinator without Ray, and the shards that it has handed out, by the names of their references."""
    shards: dict[str, tuple[Span, ...]] = {}

    class Task:
        @staticmethod
        def remote(terms: WorkerTerms, order: bytes, catalogue: str) -> str:
            name = f"shard {len(shards)}"
            shards[name] = pickle.loads(order).spans
            return name

    monkeypatch.setattr(module.ray, "put", lambda value: "catalogue")
    monkeypatch.setattr(module, "_shard_task", lambda enter, env_vars: Task)
    order = ShardOrder.of(str(tmp_path), validate_job({"name": "drained", "scenes": 8}, "test"), "j" * 64)
    pattern = Pattern(order, cast(Catalogue, None), WorkerTerms((), "", ""))
    slots = [1]
    looking = ClusterSlots(1, 1, lambda: Slots(slots[0], slots[0]))
    return Coordinator(LocalStore(tmp_path), pattern, Limits(looking, 1, 0), Tally(asked=8)), shards, slots


def spans(*starts: int) -> tuple[Span, ...]:
    return tuple(Span(start=start, stop=start + 2) for start in starts)


def test_what_a_node_that_is_to_end_gives_back_is_handed_out_again_without_counting_a_death(handed_out, monkeypatch):
    coordinator, shards, _ = handed_out
    waiting = iter([spans(0, 2, 4), spans(6)])
    for done in (1, 0, 0, 0, 2):  # more empty answers than attempts
        assert coordinator._fill_slots(waiting)
        (name,) = coordinator._running
        given = coordinator._running.pop(name)
        answer = report(*(span(one.start, 2, {}) for one in given[:done]))
        monkeypatch.setattr(module.ray, "get", lambda ref, answer=answer: answer)
        coordinator._collect(name, given)
    assert list(shards.values()) == [spans(0, 2, 4), *[spans(2, 4)] * 4]
    assert (coordinator._tally.made, coordinator._deaths._counts) == (6, Counter())
    assert coordinator._fill_slots(waiting) and list(shards.values())[-1] == spans(6)


def test_shards_are_handed_out_as_the_cluster_grows_and_held_back_as_it_shrinks(handed_out):
    coordinator, shards, slots = handed_out
    waiting = (spans(start) for start in range(0, 100, 2))
    for slots[0], expected in ((2, 2), (5, 5), (1, 5), (6, 6)):
        assert coordinator._fill_slots(waiting)
        assert len(shards) == expected


def test_what_a_lost_host_had_is_handed_out_again_and_what_others_work_on_is_not(handed_out, monkeypatch):
    """Also what no worker has begun: Ray does not say whether it was sent there."""
    coordinator, shards, slots = handed_out
    slots[0] = 4
    assert coordinator._fill_slots(iter([spans(0, 2), spans(4), spans(6, 8), spans(10)]))
    had = {0: {"h2"}, 4: {"h1"}, 6: set(), 10: {"h2", "h1"}}
    monkeypatch.setattr(module, "hosts_of", lambda store, label, those: had[those[0].start])
    cancelled: list[str] = []
    monkeypatch.setattr(module.ray, "cancel", lambda ref, force: cancelled.append(ref))
    coordinator._give_up_on({"h2"})
    assert cancelled == ["shard 0", "shard 2"]
    assert set(coordinator._running) == {"shard 1", "shard 3"}
    assert coordinator._fill_slots(iter([]))
    assert sorted(map(str, list(shards.values())[4:])) == sorted(map(str, [spans(0), spans(2)]))
    slots[0] = 9
    coordinator._fill_slots(iter([]))
    assert list(shards.values())[6:] == [spans(6, 8)]
