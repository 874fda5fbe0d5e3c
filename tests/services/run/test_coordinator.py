"""The coordinator without Ray: reports and deaths counted, shards handed out, and stalls judged by what changes."""

import os
import pickle
import signal
import subprocess
import time
from collections import Counter

import obstore.store
import pytest

from schemas.dataset.commit import Span
from schemas.dataset.shard import Fingerprint, ShardReport, SpanReport
from schemas.errors import RunError
from services.run import coordinator as module
from services.run.coordinator import (
    LOOK_EVERY_S,
    NODE_PATIENCE,
    Deaths,
    count_under_way,
    hosts_of,
)
from services.run.progress import Tally
from services.run.ray_cluster import Slots
from services.run.watchdog import (
    COMMIT_FACTOR,
    SCENE_FACTOR,
    AttemptName,
    Sight,
    end_worker_here,
    find_own_workers,
    find_stalls,
    look,
    scenes_in_progress,
    watch,
)
from services.run.worker_entry import WorkerTerms
from tests.kit.made_up_runs import coordinator_of
from tests.made_up_scenes import small_scene, terms
from workers.store import attempt as module_store
from workers.store.attempt import Attempt, begin_attempt
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore
from workers.store.store import Store

STACK = Fingerprint(canary="c", code="d", libraries={}, simd="", renderer="")


def report(*spans: SpanReport, **seconds: float) -> ShardReport:
    return ShardReport(spans=spans, seconds=seconds, wall_s=2.0, cpu_s=1.5, fingerprint=STACK, host="h", pid=1)


def span(start: int, made: int, failed: dict[str, int], conflict: str | None = None) -> SpanReport:
    won = conflict is None
    return SpanReport(start=start, stop=start + 4, retry=0, won=won, conflict=conflict, made=made, failed=failed)


def spans(*starts: int) -> tuple[Span, ...]:
    return tuple(Span(start=start, stop=start + 2) for start in starts)


def test_reports_add_up_by_the_kind_of_failure_and_what_is_served_stays_as_it_was():
    tally = Tally(asked=12)
    tally.add(report(span(0, 3, {"intrinsic: left_table": 1}), span(4, 4, {}), settle=1.5))
    before = tally.counts(2)
    tally.add(report(span(8, 1, {"intrinsic: left_table": 2, "environmental: killed": 1}), settle=2.5))
    after = tally.counts(2)
    failed = {"intrinsic: left_table": 3, "environmental: killed": 1}
    names = ("made", "failed", "seconds", "asked", "slots")
    assert [before[name] for name in names] == [7, {"intrinsic: left_table": 1}, {"settle": 1.5}, 12, 2]
    assert [after[name] for name in names] == [8, failed, {"settle": 4.0}, 12, 2]
    assert (tally.done, tally.shard_wall_s, tally.shard_cpu_s, tally.conflicts) == (12, 4.0, 3.0, [])
    tally.add(report(span(12, 4, {}, conflict="two attempts made other bytes")))
    assert tally.conflicts == ["two attempts made other bytes"]


@pytest.fixture
def handed_out(monkeypatch, tmp_path):
    """A coordinator without Ray, the shards that it has handed out, by the names of their references, and its slots."""
    shards: dict[str, tuple[Span, ...]] = {}

    class Task:
        @staticmethod
        def remote(terms: WorkerTerms, order: bytes, catalogue: str) -> str:
            name = f"shard {len(shards)}"
            shards[name] = pickle.loads(order).spans
            return name

    monkeypatch.setattr(module, "_shard_task", lambda env_vars, num_gpus: Task)
    slots = [1]
    looking = Slots(1, 1, lambda: Slots(slots[0], slots[0]))
    return coordinator_of(LocalStore(tmp_path), monkeypatch, looking, attempts=1), shards, slots


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


def test_what_workers_say_of_their_devices_is_told_once_for_each_host(handed_out, monkeypatch, capsys):
    coordinator, _, _ = handed_out
    for note in ("h1 draws in software", "", "h2 draws in software", "h1 draws in software"):
        answer = report(span(0, 2, {})).model_copy(update={"note": note})
        monkeypatch.setattr(module.ray, "get", lambda ref, answer=answer: answer)
        coordinator._collect("shard", spans(0))
    assert capsys.readouterr().err.split("verso: ")[1:] == ["h1 draws in software\n", "h2 draws in software\n"]


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
    slots[0] = 9
    coordinator._fill_slots(iter([]))
    assert sorted(map(str, list(shards.values())[4:])) == sorted(map(str, [spans(0), spans(2), spans(6, 8)]))


def test_a_host_is_told_once_when_it_has_no_node_any_more(handed_out, monkeypatch):
    coordinator, alive, now = handed_out[0], ["h1", "h2", "h2", "h3"], [0.0]
    monkeypatch.setattr(module, "_hosts_by_node", lambda: dict(enumerate(alive)))
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    assert coordinator._take_lost_hosts() == set()
    lost = []
    for alive[:] in (["h1", "h2", "h3"], ["h1", "h3"], ["h1", "h3"], ["h1", "h3", "h2"], ["h1"]):
        assert coordinator._take_lost_hosts() == set(), "too soon to ask again"
        now[0] += LOOK_EVERY_S
        lost.append(coordinator._take_lost_hosts())
    assert lost == [set(), {"h2"}, set(), set(), {"h2", "h3"}]


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
    assert [hosts_of(store, "ours", [one]) for one in spans(0, 2, 4, 6)] == [{"h_1"}, {"h2"}, set(), set()]
    assert hosts_of(store, "ours", spans(0, 2, 4, 6)) == {"h_1", "h2"}
    assert hosts_of(store, "others", spans(0, 2)) == set()


def test_a_scene_is_blamed_after_as_many_deaths_as_attempts_and_later_where_its_node_was_lost():
    mine, other = Span(start=4, stop=8), Span(start=8, stop=12)
    deaths = Deaths(3)
    for scene, reason in ((5, "time"), (5, "time"), (6, "killed")):
        deaths.count(4, scene, reason, "")
    assert deaths.blamed_in([mine]) == ()
    deaths.count(4, 5, "memory", "")
    (blame,) = deaths.blamed_in([mine])
    assert (blame.scene_id, blame.reason, blame.attempts) == (5, "memory", 3)
    assert deaths.blamed_in([other]) == ()
    deaths.count(8, 9, "time", "", timed_out=True)  # it would take as long again
    assert deaths.blamed_in([other])[0].attempts == 1
    lost = Deaths(1)
    for _ in range(NODE_PATIENCE - 1):
        lost.count(4, 5, "killed", "", with_node=True)
        lost.count(4, None, "killed", "", with_node=True)
    assert lost.blamed_in([mine]) == ()
    lost.count(4, 5, "killed", "", with_node=True)
    assert lost.blamed_in([mine])[0].attempts == NODE_PATIENCE
    with pytest.raises(RunError, match=rf"died {NODE_PATIENCE} times before it began one.*why"):
        lost.count(4, None, "killed", "why", with_node=True)


def test_ranges_before_the_one_in_progress_and_scenes_before_the_one_in_progress_are_made():
    shard = (Span(start=0, stop=4), Span(start=4, stop=8))
    for in_progress, made in (
        ({}, 0),
        ({0: 0}, 0),
        ({0: 3}, 3),
        ({4: 4}, 4),
        ({4: 6}, 6),
        ({4: None}, 4),
        ({0: None, 4: 6}, 6),
        ({0: 99}, 0),
        ({8: 9}, 0),
    ):
        assert count_under_way([shard], in_progress) == made
    retry = (Span(start=16, stop=32, retry=1, scenes=(17, 20, 31)),)
    assert count_under_way([shard, retry], {4: 5, 16: 31}) == 5 + 2


# ------------------------------------------------------------------------------------------------ the watchdog

MUG = AttemptName(16, "r0-1a2b3c4d-node_7.lab-4711-0123456789ab")
CAN = AttemptName(32, "r0-1a2b3c4d-node_8-4712-0123456789ab")
AGAIN = AttemptName(16, "r0-1a2b3c4d-node_8-9-ba9876543210")


def test_stalls_are_judged_by_what_changes_between_two_looks():
    def looks(*seen: dict[AttemptName, int | None]) -> dict[AttemptName, Sight]:
        known: dict[AttemptName, Sight] = {}
        for now in seen:
            known = look(known, now, 10.0)
        return known

    assert (MUG.host, MUG.pid) == ("node_7.lab", 4711)
    for last, idle_s in ((17, 20), (18, 0), (None, 0)):
        assert looks({MUG: 17}, {MUG: 17}, {MUG: last})[MUG].idle_s == idle_s
    assert looks({MUG: 17, CAN: 33}, {CAN: 33}) == {CAN: Sight(33, 10.0)}, "what has ended is forgotten"
    for scene, limit_s in ((17, 15), (None, 50)):
        late = Sight(scene, limit_s + 1)
        assert find_stalls({MUG: Sight(scene, limit_s)}, 10.0) == {}
        assert find_stalls({MUG: late, CAN: Sight(33, 1.0)}, 10.0) == {MUG: late}
    left_behind = Sight(17, 100.0)
    assert find_stalls({MUG: left_behind, AGAIN: Sight(17, 1.0)}, 10.0) == {}
    assert find_stalls({MUG: Sight(17, 1.0), AGAIN: left_behind}, 10.0) == {}
    assert find_stalls({MUG: left_behind, AGAIN: Sight(17, 20.0)}, 10.0) == {AGAIN: Sight(17, 20.0)}


LIMIT_S = 0.2
TERMS = terms(layout="tar", fingerprint_mode="record")


@pytest.fixture(params=["folder", "object store"])
def store(request, tmp_path) -> Store:
    far = request.param == "object store"
    made: Store = ObjectStore(obstore.store.MemoryStore(), "memory://") if far else LocalStore(tmp_path)
    made.prepare()
    return made


def first_stall(take_stalls, within_s: float) -> tuple[AttemptName | None, Sight, float]:
    begun = time.monotonic()
    while time.monotonic() - begun < within_s:
        if stalls := take_stalls():
            return *stalls[0], time.monotonic() - begun
        time.sleep(0.01)
    raise TimeoutError


@pytest.mark.minute
def test_a_worker_that_stays_in_a_scene_is_found_and_one_that_goes_on_is_not(store):
    stuck = begin_attempt(store, Span(start=4, stop=8), TERMS, "label")
    lively = begin_attempt(store, Span(start=8, stop=12), TERMS, "label")
    begin_attempt(store, Span(start=12, stop=16), TERMS, "others").begin_scene(12)
    stuck.begin_scene(5)
    with watch(store, "label", 2 * LIMIT_S) as take_stalls:
        stalls = []
        for number in range(40):
            lively.begin_scene(8 + number % 4)
            time.sleep(0.03)
            stalls += take_stalls()
    assert {(attempt.start, sight.scene_id) for attempt, sight in stalls} == {(4, 5)}
    attempt, sight = stalls[0]
    assert (attempt.name, attempt.pid) == (stuck.name, os.getpid())
    assert sight.idle_s > SCENE_FACTOR * 2 * LIMIT_S


@pytest.mark.minute
def test_a_run_in_which_nothing_begins_is_found_and_a_worker_between_scenes_has_longer(store):
    with watch(store, "label", LIMIT_S) as take_stalls:
        attempt, _, _ = first_stall(take_stalls, 20)
    assert attempt is None
    assert scenes_in_progress(store, "label") == {}
    begin_attempt(store, Span(start=4, stop=8), TERMS, "label")
    with watch(store, "label", LIMIT_S) as take_stalls:
        attempt, sight, after_s = first_stall(take_stalls, 20)
    assert (attempt.start, sight.scene_id) == (4, None)
    assert after_s > COMMIT_FACTOR * LIMIT_S


@pytest.mark.minute
def test_a_store_that_does_not_answer_for_a_while_is_no_stall(store, monkeypatch):
    """The looks that fail count as time, but never as a look."""
    begin_attempt(store, Span(start=4, stop=8), TERMS, "label").begin_scene(5)
    real = type(store).children
    monkeypatch.setattr(type(store), "children", lambda *_: 1 / 0)
    with watch(store, "label", LIMIT_S) as take_stalls:
        time.sleep(4 * LIMIT_S)
        assert take_stalls() == []
        monkeypatch.setattr(type(store), "children", real)
        assert first_stall(take_stalls, 20)[1].scene_id == 5


def test_only_rays_workers_are_ended_whatever_the_process_id():
    shell = ["/bin/bash", "-c"]
    worker, other = (
        subprocess.Popen([*shell, f"exec -a {title} sleep 600"]) for title in ("ray::run_shard", "somebody")
    )
    try:
        deadline = time.monotonic() + 10
        while worker.pid not in {process.pid for process in find_own_workers()}:
            assert time.monotonic() < deadline
        assert other.pid not in {process.pid for process in find_own_workers()}
        assert not end_worker_here(other.pid) and not end_worker_here(2**22 + 1)
        assert end_worker_here(worker.pid)
        assert worker.wait(10) == -signal.SIGKILL
        assert other.poll() is None
    finally:
        for process in (worker, other):
            process.kill()
            process.wait()
