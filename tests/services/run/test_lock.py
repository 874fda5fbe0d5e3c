"""The lock: one holder at a time, judged by its heartbeat, and a holder that lost it is told, at whatever step."""

import contextlib
import json
import os
import threading
import time
from dataclasses import replace

import pytest

from schemas.dataset.layout import LOCK_CLAIMS, LOCK_FILE
from schemas.errors import MachineError, RunError
from services.run import lock as module
from services.run.lock import Beat, Holder, explain_lost_folder, hold_lock, read_holder
from tests.kit.faults import STILL, in_threads, taken_over
from tests.kit.killed_runs import holding
from workers.store.local import LocalStore

FAST = Beat(period_s=0.05, patience=4)


THEIRS = Holder(token="theirs", host="far", pid=7, machine="another", born="1")


def write(store, holder: Holder) -> None:
    assert module._take(store, holder, read_holder(store))


def beat_of(store) -> int:
    return json.loads(store.read(LOCK_FILE))["beat"]


def test_a_lock_is_there_while_it_is_held_and_gone_afterwards_also_after_an_error(store):
    with hold_lock(store, beat=FAST) as lock:
        holder, before = read_holder(store), beat_of(store)
        assert holder.pid == os.getpid()
        time.sleep(0.3)
        lock.require_held()
        assert read_holder(store) == holder
        assert beat_of(store) > before
        assert json.loads(store.read(LOCK_FILE))["token"] == holder.token == lock.token
    with pytest.raises(ZeroDivisionError), hold_lock(store, beat=FAST):
        raise ZeroDivisionError
    assert read_holder(store) is None
    assert not list(store.files("_staging")) and not (store.root / LOCK_FILE).exists()


def test_a_second_process_is_refused_at_once_naming_the_first_and_takes_over_at_once_where_it_was_killed(store):
    with holding(store.root) as process:
        begun = time.monotonic()
        refusal = f"in use by process {process.pid} on .*wait until it ends or stop it"
        with pytest.raises(RunError, match=refusal), hold_lock(store, beat=Beat(period_s=30.0)):
            pass
    with hold_lock(store, beat=Beat(period_s=30.0)):
        assert read_holder(store).pid == os.getpid()
    assert time.monotonic() - begun < 5


def test_a_process_id_that_was_given_out_again_is_not_taken_for_the_holder(store):
    with hold_lock(store, beat=FAST):
        mine = read_holder(store)
    write(store, replace(mine, token="old", born="12"))
    with hold_lock(store, beat=Beat(period_s=30.0)):
        assert read_holder(store).token != "old"


def test_a_holder_elsewhere_that_beats_is_refused_and_one_that_is_silent_replaced_whatever_the_clocks_say(store):
    write(store, THEIRS)
    ended = threading.Event()

    def beat():
        count = 0
        while not ended.wait(0.05):
            count += 1
            store.put(LOCK_FILE, str(count).encode())

    def ask():
        try:
            with pytest.raises(RunError, match="in use by process 7 on far"), hold_lock(store, beat=FAST):
                pass
        finally:
            ended.set()

    in_threads(beat, ask)
    os.utime(store.path(LOCK_FILE), (1e9, 1e9))  # old by any clock
    begun = time.monotonic()
    with hold_lock(store, beat=FAST):
        assert read_holder(store).host != "far"
    assert time.monotonic() - begun >= FAST.period_s * FAST.patience


def test_of_many_that_take_over_a_dead_holder_one_at_a_time_gets_it(store):
    write(store, THEIRS)
    inside, most = [], []

    def contend():
        with contextlib.ExitStack() as stack:
            while True:  # as a user does
                with contextlib.suppress(RunError):
                    stack.enter_context(hold_lock(store, beat=FAST))
                    break
                time.sleep(0.01)
            inside.append(1)
            most.append(len(inside))
            time.sleep(0.1)
            inside.pop()

    in_threads(*[contend] * 6)
    assert most == [1] * 6


def test_events_that_cannot_be_read_are_taken_over_after_a_while(store):
    for torn in (b"", b"{", b"[]", b'{"token": 1}'):
        store.put(f"{LOCK_CLAIMS}/00000000.json", torn)
        store.put(f"{LOCK_CLAIMS}/00000004.json", b"{}")
        assert read_holder(store).host == "unknown"
        with hold_lock(store, beat=FAST):
            assert read_holder(store).pid == os.getpid()


def test_a_heartbeat_survives_a_full_disk_and_a_clock_that_is_set_back(store, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    with hold_lock(store, FAST) as lock:
        with monkeypatch.context() as patch:
            patch.setattr(store, "put", full)
            time.sleep(0.2)
        before = beat_of(store)
        monkeypatch.setattr(time, "time", lambda: -1e9)
        os.utime(store.path(LOCK_FILE), (0, 0))
        time.sleep(5 * FAST.period_s)
        lock.require_held()
        assert beat_of(store) > before
        with pytest.raises(RunError, match="is in use"), hold_lock(store, FAST):
            pass


# ------------------------------------------------------------------------------------------------ losing it


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
        for name in ("names", "read", "put", "put_if_absent", "remove", "remove_tree"):
            patch.setattr(LocalStore, name, counted(name))
        yield steps


def test_a_holder_that_was_paused_is_told_who_took_over_and_leaves_the_new_lock_alone(store):
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
    with hold_lock(store, beat=FAST):
        write(store, THEIRS)
        time.sleep(0.3)
        assert "lock heartbeat" not in [thread.name for thread in threading.enumerate()]
    assert read_holder(store) == THEIRS


@pytest.mark.minute
@pytest.mark.parametrize("ended", [False, True], ids=["still there", "ended again"])
def test_paused_at_any_step_of_a_beat_and_taken_over_a_holder_knows_that_it_lost(ended, tmp_path):
    at, lost = 0, 0
    while True:
        mine = LocalStore(tmp_path / str(at))
        mine.prepare()
        me = Holder("mine", "here", os.getpid(), "this", "1")
        write(mine, me)
        lock = module.Lock(mine, me, FAST)  # without a heartbeat of its own
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


def test_what_was_removed_or_damaged_by_hand_is_written_again(store):
    with hold_lock(store, FAST) as lock:
        for damage in (b"", b"{", b"[]", b"\xff" * 50):
            store.put(LOCK_FILE, damage)
            lock.require_held()
            assert json.loads(store.read(LOCK_FILE))["token"] == lock.token
        store.remove_tree(LOCK_CLAIMS)
        store.remove(LOCK_FILE)  # last: a heartbeat between the two would write this one again, and find nothing amiss
        deadline = time.monotonic() + 5
        while read_holder(store) is None and time.monotonic() < deadline:
            time.sleep(FAST.period_s)
        with pytest.raises(RunError, match="is in use by process"), hold_lock(store, FAST):
            pass
        assert lock.held
    with hold_lock(store, STILL) as first:
        store.remove_tree(LOCK_CLAIMS)
        with hold_lock(LocalStore(store.root), STILL) as second:
            assert [first.held, second.held] == [False, True], "of two coordinators one is left"


def test_a_removed_or_a_moved_folder_is_told_even_where_parts_of_it_were_made_anew(tmp_path, monkeypatch):
    swept = RunError("swept: another coordinator works on this folder")

    def lose(out, how: str, error: Exception) -> None:
        if how == "moved":
            out.rename(tmp_path / "elsewhere")
        else:
            out.rmdir()
        if how == "made anew":
            (out / "manifest").mkdir(parents=True)
        raise error

    gone = FileNotFoundError("x")
    for number, (how, error) in enumerate(
        (("removed", swept), ("removed", gone), ("made anew", swept), ("moved", gone))
    ):
        out = tmp_path / str(number)
        out.mkdir()
        with pytest.raises(MachineError, match=f"^{out} was removed or moved"), explain_lost_folder(out):
            lose(out, how, error)
    monkeypatch.setattr(module, "REMOVAL_S", 0.2)
    for place in (tmp_path, None):  # None: a bucket
        with pytest.raises(RunError, match="as it was"), explain_lost_folder(place):
            raise RunError("as it was")
