"""Counting of reports and handing out of shards; deaths, retries and interruptions on a real Ray are in test_step.py."""

import pickle
from collections import Counter
from typing import cast

import pytest

from schemas.dataset.commit import Span
from schemas.dataset.shard import Fingerprint, ShardOrder, ShardReport, SpanReport
from schemas.errors import RunError
from services.job.job_file import validate_job
from services.run import coordinator as module
from services.run.coordinator import (
    LOOK_EVERY_S,
    NODE_PATIENCE,
    Coordinator,
    Death,
    Deaths,
    Limits,
    LostNodes,
    count_under_way,
    hosts_of,
)
from services.run.joining import Pattern
from services.run.metrics import Tally
from services.run.ray_cluster import ClusterSlots, Slots
from services.run.worker_entry import WorkerTerms
from tests.made_up_scenes import small_scene, terms
from workers.assets.catalogue import Catalogue
from workers.store import attempt as module_store
from workers.store.attempt import Attempt, begin_attempt
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


SPAN = Span(start=4, stop=8)


def test_a_scene_is_blamed_after_as_many_deaths_as_attempts():
    deaths = Deaths(3)
    for _ in range(2):
        deaths.count(Death(4, 5, "time", ""))
    deaths.count(Death(4, 6, "killed", ""))
    assert deaths.blamed_in([SPAN]) == ()
    deaths.count(Death(4, 5, "memory", ""))
    (blame,) = deaths.blamed_in([SPAN])
    assert (blame.scene_id, blame.reason, blame.attempts) == (5, "memory", 3)
    assert deaths.blamed_in([Span(start=8, stop=12)]) == ()


def test_workers_that_die_before_they_begin_end_the_run():
    deaths = Deaths(2)
    deaths.count(Death(4, None, "killed", "why"))
    with pytest.raises(RunError, match=r"died 2 times before it began one.*why"):
        deaths.count(Death(4, None, "killed", "why"))


def test_a_lost_node_is_not_the_scenes_fault_until_it_happens_again_and_again():
    deaths = Deaths(1)
    for _ in range(NODE_PATIENCE - 1):
        deaths.count(Death(4, 5, "killed", "", with_node=True))
        deaths.count(Death(4, None, "killed", "", with_node=True))
    assert deaths.blamed_in([SPAN]) == ()
    deaths.count(Death(4, 5, "killed", "", with_node=True))
    assert deaths.blamed_in([SPAN])[0].attempts == NODE_PATIENCE
    with pytest.raises(RunError):
        deaths.count(Death(4, None, "killed", "", with_node=True))


SHARD = (Span(start=0, stop=4), Span(start=4, stop=8))


@pytest.mark.parametrize(
    ("in_progress", "made"),
    [
        ({}, 0),
        ({0: 0}, 0),
        ({0: 3}, 3),
        ({4: 4}, 4),
        ({4: 6}, 6),
        ({4: None}, 4),
        ({0: None, 4: 6}, 6),
        ({0: 99}, 0),
        ({8: 9}, 0),
    ],
)
def test_ranges_before_the_one_in_progress_and_scenes_before_the_one_in_progress_are_made(in_progress, made):
    assert count_under_way([SHARD], in_progress) == made


def test_shards_add_up_and_a_retry_counts_its_own_scenes():
    retry = (Span(start=16, stop=32, retry=1, scenes=(17, 20, 31)),)
    assert count_under_way([SHARD, retry], {4: 5, 16: 31}) == 5 + 2


def test_a_host_is_told_once_when_it_has_no_node_any_more():
    alive, now = ["h1", "h2", "h2", "h3"], [0.0]
    nodes = LostNodes(lambda: set(alive), lambda: now[0])
    assert nodes.take() == set()
    found = []
    for alive[:] in (["h1", "h2", "h3"], ["h1", "h3"], ["h1", "h3"], ["h1", "h3", "h2"], ["h1"]):
        assert nodes.take() == set(), "too soon to ask again"
        now[0] += LOOK_EVERY_S
        found.append(nodes.take())
    assert found == [set(), {"h2"}, set(), set(), {"h2", "h3"}]


def test_a_shards_hosts_are_those_that_began_or_committed_its_ranges(tmp_path, monkeypatch):
    store = LocalStore(tmp_path)
    store.prepare()

    def begin(start: int, host: str) -> Attempt:
        monkeypatch.setattr(module_store.socket, "gethostname", lambda: host)
        attempt = begin_attempt(store, Span(start=start, stop=start + 2), terms(range_size=2), "ours")
        for scene_id in attempt.span.scene_ids:
            attempt.add_scene(small_scene(scene_id))
        return attempt

    begin(0, "h-1").commit()
    begin(2, "h2")
    begin(4, "h3").abandon()
    spans = [Span(start=start, stop=start + 2) for start in (0, 2, 4, 6)]
    assert [hosts_of(store, "ours", [span]) for span in spans] == [{"h_1"}, {"h2"}, set(), set()]
    assert hosts_of(store, "ours", spans) == {"h_1", "h2"}
    assert hosts_of(store, "others", spans) == set()


def test_what_is_served_is_what_was_counted_and_stays_when_the_run_goes_on():
    tally = Tally(asked=12)
    tally.add(report(span(0, 3, {"intrinsic: left_table": 1})).model_copy(update={"seconds": {"settle": 1.5}}))
    before = tally.counts(2)
    tally.add(report(span(4, 3, {"intrinsic: left_table": 1})).model_copy(update={"seconds": {"settle": 2.5}}))
    after = tally.counts(2)
    assert (before.made, before.failed, before.seconds) == (3, {"intrinsic: left_table": 1}, {"settle": 1.5})
    assert (after.made, after.failed, after.seconds) == (6, {"intrinsic: left_table": 2}, {"settle": 4.0})
    assert (after.asked, after.slots) == (12, 2)
