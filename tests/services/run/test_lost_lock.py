"""A lock that is lost while its holder does not look, removed or damaged by hand, or whose heartbeat ends."""

import contextlib
import os
import threading
import time

import pytest

from schemas.dataset.layout import LOCK_FILE
from schemas.errors import RunError
from services.run import lock as module
from services.run.lock import hold_lock, read_holder
from tests.kit.faults import FAST, STILL, taken_over
from workers.store.local import LocalStore


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    return store


@contextlib.contextmanager
def paused(store, at: int, then):
    """Runs `then` once, just before step number `at` of what this process asks of the store; yields the steps so far."""
    steps = []

    def counted(name):
        real = getattr(LocalStore, name)

        def call(self, *arguments, **named):
            if self is store:
                steps.append(name)
                if len(steps) - 1 == at:
                    then()
            return real(self, *arguments, **named)

        return call

    with pytest.MonkeyPatch.context() as patch:
        for name in ("read", "put", "put_if_absent", "remove", "remove_tree"):
            patch.setattr(LocalStore, name, counted(name))
        yield steps


def silent_lock(store):
    """A lock without a heartbeat of its own that has shown no life for as long as FAST is patient."""
    mine = module.Holder("mine", "here", os.getpid(), "this", "1")
    assert store.put_if_absent(LOCK_FILE, module._encode(mine))
    return module.Lock(store, mine, FAST, module._now_s())


def test_a_lock_that_is_held_may_be_asked_at_any_time(store):
    with hold_lock(store, FAST) as lock:
        for _ in range(20):
            lock.require_held()
        assert lock.held


def test_a_holder_that_was_paused_is_told_who_took_over(store):
    with hold_lock(store, STILL) as lock:
        lock.require_held()
        with taken_over(store) as theirs:
            message = f"taken over by process {os.getpid()} on far .* so that it replaces nothing newer"
            with pytest.raises(RunError, match=message):
                lock.require_held()
            assert not lock.held
            assert theirs.held
        assert read_holder(store) is None
        with pytest.raises(RunError, match="taken over"):
            lock.require_held()  # it stays lost when the other has ended
    assert read_holder(store) is None


@pytest.mark.parametrize("ended", [False, True], ids=["still there", "ended again"])
def test_paused_at_any_step_of_a_beat_and_taken_over_a_holder_knows_that_it_lost(ended, tmp_path):
    at, lost = 0, 0
    while True:
        mine = LocalStore(tmp_path / str(at))
        mine.prepare()
        lock = silent_lock(mine)
        others = contextlib.ExitStack()
        theirs = []

        def take_over(others=others, theirs=theirs, root=mine.root):
            theirs.append(others.enter_context(taken_over(LocalStore(root))))
            if ended:
                others.close()

        with others:
            with paused(mine, at, take_over):
                lock.held  # noqa: B018 - one beat
            if not theirs:
                break
            lost += not lock.held
            if not ended:
                time.sleep(3 * FAST.period_s)
                theirs[0].require_held()
        at += 1
    assert at >= 3
    # Taken over and given back between the look and the write of one beat: only the commits tell, and the merge asks them.
    assert lost >= (1 if ended else at)


def test_a_lock_taken_over_and_given_back_before_a_beat_is_lost(store):
    lock = silent_lock(store)
    with taken_over(LocalStore(store.root)):
        pass
    assert not lock.held
    assert read_holder(store) is None


def test_a_lock_file_that_was_removed_by_hand_is_written_again(store):
    with hold_lock(store, FAST) as lock:
        store.remove(LOCK_FILE)
        lock.require_held()
        assert read_holder(store).pid == os.getpid()
        store.remove(LOCK_FILE)
        deadline = time.monotonic() + 5
        while read_holder(store) is None and time.monotonic() < deadline:
            time.sleep(FAST.period_s)
        with pytest.raises(RunError, match="is in use by process"), hold_lock(store, FAST):
            pass
        assert lock.held


@pytest.mark.parametrize("damage", [b"", b"{", b"[]", b"\xff" * 50])
def test_a_lock_file_that_was_damaged_by_hand_is_written_again(damage, store):
    with hold_lock(store, FAST) as lock:
        store.put(LOCK_FILE, damage)
        lock.require_held()
        assert read_holder(store).pid == os.getpid()


def test_of_two_coordinators_after_the_file_was_removed_by_hand_one_is_left(store):
    with hold_lock(store, STILL) as first:
        store.remove(LOCK_FILE)
        with hold_lock(LocalStore(store.root), STILL) as second:
            assert [first.held, second.held] == [False, True]


def test_a_heartbeat_that_cannot_begin_leaves_no_lock(store, monkeypatch):
    def no_threads(self):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", no_threads)
    with pytest.raises(RuntimeError), hold_lock(store, FAST):
        pass
    assert read_holder(store) is None


def test_a_heartbeat_that_ended_costs_the_lock_and_says_so(store, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(module, "_show_life", lambda *_: None)
        with hold_lock(store, FAST) as lock, taken_over(store), pytest.raises(RunError, match="on far"):
            lock.require_held()


def test_a_clock_that_is_set_back_changes_nothing(store, monkeypatch):
    with hold_lock(store, FAST) as lock:
        before = read_holder(store).beat
        monkeypatch.setattr(time, "time", lambda: -1e9)
        os.utime(store.path(LOCK_FILE), (0, 0))
        time.sleep(5 * FAST.period_s)
        lock.require_held()
        assert read_holder(store).beat > before
        with pytest.raises(RunError, match="is in use"), hold_lock(store, FAST):
            pass
