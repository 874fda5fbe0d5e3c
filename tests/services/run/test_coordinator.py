"""Counting of reports; deaths, retries and interruptions on a real Ray are in test_step.py."""

from collections import Counter

from schemas.dataset.fingerprint import Fingerprint
from schemas.dataset.shard import ShardReport, SpanReport
from services.run.tally import Tally

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
