"""Counting of reports; deaths, retries and interruptions on a real Ray are in test_step.py."""

from collections import Counter

from schemas.dataset.commit import Span
from schemas.dataset.fingerprint import Fingerprint
from schemas.dataset.shard import ShardOrder, ShardReport, SpanReport
from services.job.read import validate_job
from services.run.coordinator import Coordinator, Limits, Tally
from tests.datasets import SMALL
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


def test_what_is_given_to_ray_follows_a_room_that_changes(monkeypatch, tmp_path):
    given: list[int] = []

    class Task:
        def remote(self, order, catalogue) -> object:
            given.append(order.spans[0].start)
            return object()

    monkeypatch.setattr("services.run.coordinator.ray.put", lambda value: value)
    monkeypatch.setattr("services.run.coordinator._run_shard", Task())
    job, room = validate_job(SMALL, "test"), [4]
    order = ShardOrder.of(str(tmp_path), job, "digest")
    limits = Limits(lambda: room[0], 3, 0)
    coordinator = Coordinator(LocalStore(tmp_path), order, Catalogue(job.assets, (), (), ""), limits, Tally(asked=40))
    shards = iter([(Span(start=start, stop=start + 1),) for start in range(40)])
    seen = []
    for jobs, ended in ((4, 0), (2, 0), (2, 3), (1, 0), (4, 1)):
        room[0] = jobs
        for ref in list(coordinator._running)[:ended]:
            coordinator._running.pop(ref)
        coordinator._fill_slots(shards)
        seen.append(len(coordinator._running))
    assert seen == [4, 4, 2, 2, 4]
    assert given == list(range(8))
