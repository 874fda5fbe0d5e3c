import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import pytest

from schemas.dataset.layout import LOCK_FILE
from schemas.errors import RunError
from services.run import lock as module
from services.run.lock import Beat, Holder, hold_lock, read_holder
from workers.store.local import LocalStore

FAST = Beat(period_s=0.05, patience=4)

HOLD = """
import sys, time
from services.run.lock import Beat, hold_lock
from workers.store.local import LocalStore
with hold_lock(LocalStore(sys.argv[1]), beat=Beat(0.05, 4)):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def store(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    return store


@pytest.fixture
def holding_process(store):
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(store.root)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def elsewhere(token="theirs", beat=0) -> Holder:
    return Holder(token=token, host="far", pid=7, machine="another", born="1", beat=beat)


def write(store, holder: Holder) -> None:
    store.put(LOCK_FILE, json.dumps(holder.__dict__).encode())


def test_a_lock_is_there_while_it_is_held_and_gone_afterwards(store):
    with hold_lock(store, beat=FAST):
        holder = read_holder(store)
        assert holder.pid == os.getpid()
        time.sleep(0.3)
        assert read_holder(store).token == holder.token
        assert read_holder(store).beat > holder.beat
    assert read_holder(store) is None
    assert not list(store.files("_staging"))


def test_a_lock_is_given_back_after_an_error(store):
    with pytest.raises(ZeroDivisionError), hold_lock(store, beat=FAST):
        raise ZeroDivisionError
    assert read_holder(store) is None


def test_a_second_process_is_refused_at_once_naming_the_first(store, holding_process):
    begun = time.monotonic()
    message = f"in use by process {holding_process.pid} on .*wait until it ends or stop it"
    with pytest.raises(RunError, match=message), hold_lock(store, beat=Beat(period_s=30.0)):
        pass
    assert time.monotonic() - begun < 5


def test_the_lock_of_a_killed_process_of_this_machine_is_taken_over_at_once(store, holding_process):
    holding_process.send_signal(signal.SIGKILL)
    holding_process.wait()
    begun = time.monotonic()
    with hold_lock(store, beat=Beat(period_s=30.0)):
        assert read_holder(store).pid == os.getpid()
    assert time.monotonic() - begun < 5


def test_a_process_id_that_was_given_out_again_is_not_taken_for_the_holder(store):
    with hold_lock(store, beat=FAST):
        mine = read_holder(store)
    write(store, replace(mine, token="old", born="12"))
    with hold_lock(store, beat=Beat(period_s=30.0)):
        assert read_holder(store).token != "old"


def test_a_holder_elsewhere_that_beats_is_refused_and_one_that_is_silent_replaced(store):
    write(store, elsewhere())
    ended = threading.Event()

    def beat():
        count = 0
        while not ended.wait(0.05):
            count += 1
            write(store, elsewhere(beat=count))

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        with pytest.raises(RunError, match="in use by process 7 on far"), hold_lock(store, beat=FAST):
            pass
    finally:
        ended.set()
        thread.join()
    begun = time.monotonic()
    with hold_lock(store, beat=FAST):
        assert read_holder(store).host != "far"
    assert time.monotonic() - begun >= FAST.period_s * FAST.patience


def test_clocks_have_no_say(store):
    write(store, elsewhere())
    os.utime(store.path(LOCK_FILE), (1e9, 1e9))  # old by any clock
    taken = []

    def contend():
        with hold_lock(store, beat=Beat(period_s=0.2, patience=5)):
            taken.append(time.monotonic())

    begun = time.monotonic()
    contend()
    assert taken[0] - begun >= 1.0


@contextlib.contextmanager
def hold_when_free(store):
    """Tries again until the lock is free, as a user does."""
    with contextlib.ExitStack() as stack:
        while True:
            with contextlib.suppress(RunError):
                stack.enter_context(hold_lock(store, beat=FAST))
                break
            time.sleep(0.01)
        yield


def test_a_lock_that_was_given_back_goes_to_whoever_asks_next(store):
    order = []
    inside = threading.Event()

    def first():
        with hold_lock(store, beat=FAST):
            inside.set()
            time.sleep(0.4)
            order.append("first")

    thread = threading.Thread(target=first)
    thread.start()
    inside.wait()
    with hold_when_free(store):
        order.append("second")
    thread.join()
    assert order == ["first", "second"]


def test_a_holder_that_was_taken_over_notices_and_leaves_the_new_lock_alone(store):
    with hold_lock(store, beat=FAST):
        write(store, elsewhere("new"))
        time.sleep(0.3)
        assert read_holder(store) == elsewhere("new")
        assert "lock heartbeat" not in [thread.name for thread in threading.enumerate()]
    assert read_holder(store) == elsewhere("new")


def test_of_many_that_take_over_a_dead_holder_one_gets_it(store):
    write(store, elsewhere())
    inside, most, failures = [], [], []
    gate = threading.Barrier(6)

    def contend():
        gate.wait()
        try:
            with hold_when_free(store):
                inside.append(1)
                most.append(len(inside))
                time.sleep(0.1)
                inside.pop()
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=contend) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
    assert most == [1] * 6


def test_a_contender_that_is_late_leaves_the_new_holder_alone(store):
    old, new, late = elsewhere("old"), elsewhere("new"), elsewhere("late")
    write(store, new)
    assert not module._take_over(store, old, late, 0.01)
    assert read_holder(store) == new
    write(store, old)
    assert module._take_over(store, old, late, 0.01)
    assert read_holder(store) == late


def test_a_claim_of_a_contender_that_died_is_not_in_the_way_for_ever(store):
    write(store, elsewhere())
    real = LocalStore.put

    def dies(self, key, data, durable=True):
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LocalStore, "put", dies)
        patch.setattr(LocalStore, "remove", lambda self, key: None)
        with pytest.raises(KeyboardInterrupt), hold_lock(store, beat=FAST):
            pass
    assert LocalStore.put is real
    with hold_lock(store, beat=FAST):
        assert read_holder(store).host != "far"


@pytest.mark.parametrize("torn", [b"", b"{", b"[]", b'{"token": 1}'])
def test_a_torn_lock_is_taken_over_after_a_while(store, torn):
    store.put(LOCK_FILE, torn)
    with hold_lock(store, beat=FAST):
        assert read_holder(store).pid == os.getpid()


def test_a_heartbeat_survives_a_disk_that_is_full_for_a_while(store, monkeypatch):
    with hold_lock(store, beat=FAST):
        with monkeypatch.context() as patch:

            def full(*_, **__):
                raise OSError(28, "No space left on device")

            patch.setattr(store, "put", full)
            time.sleep(0.2)
        before = read_holder(store)
        time.sleep(0.2)
        assert read_holder(store).beat > before.beat
        assert read_holder(store).token == before.token
