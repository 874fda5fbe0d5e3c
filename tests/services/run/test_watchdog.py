"""Stalls are judged by what changes between two looks, never by a clock of another host."""

import os
import signal
import subprocess
import time

import obstore.store
import pytest

from schemas.dataset.commit import CommitTerms, Span
from services.run.watchdog import (
    COMMIT_FACTOR,
    SCENE_FACTOR,
    AttemptName,
    Sight,
    Stall,
    Watchdog,
    end_worker_here,
    find_own_workers,
    find_stalls,
    look,
    scenes_in_progress,
)
from workers.store.attempt import begin_attempt
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore
from workers.store.store import Store

MUG = AttemptName(16, "r0-1a2b3c4d-node_7.lab-4711-0123456789ab")
CAN = AttemptName(32, "r0-1a2b3c4d-node_8-4712-0123456789ab")
AGAIN = AttemptName(16, "r0-1a2b3c4d-node_8-9-ba9876543210")


def looks(*seen: dict[AttemptName, int | None], every_s: float = 10.0) -> dict[AttemptName, Sight]:
    known: dict[AttemptName, Sight] = {}
    for now in seen:
        known = look(known, now, every_s)
    return known


def test_an_attempts_name_tells_its_process():
    assert (MUG.host, MUG.pid) == ("node_7.lab", 4711)


def test_whoever_goes_on_to_another_scene_starts_anew():
    assert looks({MUG: 17}, {MUG: 17}, {MUG: 17})[MUG].idle_s == 20
    assert looks({MUG: 17}, {MUG: 17}, {MUG: 18})[MUG].idle_s == 0
    assert looks({MUG: 17}, {MUG: 17}, {MUG: None})[MUG].idle_s == 0


@pytest.mark.parametrize(("scene", "limit_s"), [(17, 15), (None, 50)])
def test_a_scene_may_take_longer_than_its_time_limit_and_a_commit_longer_still(scene, limit_s):
    assert find_stalls({MUG: Sight(scene, limit_s)}, 10.0) == {}
    assert find_stalls({MUG: Sight(scene, limit_s + 1), CAN: Sight(33, 1.0)}, 10.0) == {MUG: Sight(scene, limit_s + 1)}


def test_what_a_lost_worker_left_behind_is_not_taken_for_the_one_that_replaced_it():
    assert find_stalls({MUG: Sight(17, 100.0), AGAIN: Sight(17, 1.0)}, 10.0) == {}
    assert find_stalls({MUG: Sight(17, 100.0), AGAIN: Sight(17, 20.0)}, 10.0) == {AGAIN: Sight(17, 20.0)}


def test_an_attempt_that_has_ended_is_forgotten():
    assert looks({MUG: 17, CAN: 33}, {CAN: 33}) == {CAN: Sight(33, 10.0)}


LIMIT_S = 0.4
TERMS = CommitTerms(
    job_digest="j",
    fingerprint="f",
    fingerprint_mode="record",
    layout="tar",
    first_scene=0,
    range_size=4,
    pairs_per_scene=1,
)


@pytest.fixture(params=["folder", "object store"])
def store(request, tmp_path) -> Store:
    made: Store = (
        LocalStore(tmp_path) if request.param == "folder" else ObjectStore(obstore.store.MemoryStore(), "memory://")
    )
    made.prepare()
    return made


def first_stall(watchdog: Watchdog, within_s: float) -> tuple[Stall | None, float]:
    begun = time.monotonic()
    while time.monotonic() - begun < within_s:
        if found := watchdog.take_stalls():
            return found[0], time.monotonic() - begun
        time.sleep(0.01)
    return None, within_s


def test_a_worker_that_stays_in_a_scene_is_found_and_one_that_goes_on_is_not(store):
    stuck = begin_attempt(store, Span(start=4, stop=8), TERMS, "label")
    lively = begin_attempt(store, Span(start=8, stop=12), TERMS, "label")
    begin_attempt(store, Span(start=12, stop=16), TERMS, "others").begin_scene(12)
    stuck.begin_scene(5)
    with Watchdog(store, "label", LIMIT_S) as watchdog:
        found = []
        for number in range(40):
            lively.begin_scene(8 + number % 4)
            time.sleep(0.03)
            found += watchdog.take_stalls()
    assert found[0].attempt is not None
    assert {(stall.attempt.start, stall.scene_id) for stall in found if stall.attempt} == {(4, 5)}
    assert (found[0].attempt.name, found[0].attempt.pid) == (stuck.name, os.getpid())
    assert found[0].idle_s > SCENE_FACTOR * LIMIT_S


def test_a_worker_that_hangs_between_scenes_has_longer(store):
    begin_attempt(store, Span(start=4, stop=8), TERMS, "label")
    with Watchdog(store, "label", LIMIT_S) as watchdog:
        stall, after_s = first_stall(watchdog, 20)
    assert stall is not None and stall.attempt is not None
    assert (stall.attempt.start, stall.scene_id) == (4, None)
    assert after_s > COMMIT_FACTOR * LIMIT_S


def test_a_run_in_which_nothing_begins_is_found_too(store):
    with Watchdog(store, "label", LIMIT_S) as watchdog:
        stall, _ = first_stall(watchdog, 20)
    assert stall is not None
    assert stall.attempt is None
    assert scenes_in_progress(store, "label") == {}


def test_a_store_that_does_not_answer_for_a_while_is_no_stall(store, monkeypatch):
    """The looks that fail count as time, but never as a look."""
    begin_attempt(store, Span(start=4, stop=8), TERMS, "label").begin_scene(5)
    real = type(store).children
    monkeypatch.setattr(type(store), "children", lambda *_: 1 / 0)
    with Watchdog(store, "label", LIMIT_S) as watchdog:
        assert first_stall(watchdog, 4 * LIMIT_S)[0] is None
        monkeypatch.setattr(type(store), "children", real)
        stall, _ = first_stall(watchdog, 20)
    assert stall is not None and stall.attempt is not None
    assert stall.scene_id == 5


def start_titled(title: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(["/bin/sh", "-c", f"exec -a {title} sleep 600"], executable="/bin/bash")


def test_only_rays_workers_are_ended_whatever_the_process_id():
    worker, other = start_titled("ray::run_shard"), start_titled("somebody")
    try:
        deadline = time.monotonic() + 10
        while worker.pid not in {process.pid for process in find_own_workers()}:
            assert time.monotonic() < deadline
        assert other.pid not in {process.pid for process in find_own_workers()}
        assert not end_worker_here(other.pid)
        assert not end_worker_here(2**22 + 1)
        assert end_worker_here(worker.pid)
        assert worker.wait(10) == -signal.SIGKILL
        assert other.poll() is None
    finally:
        for process in (worker, other):
            process.kill()
            process.wait()
