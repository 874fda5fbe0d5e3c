"""One coordinator at a time: an advisory lock with a heartbeat, judged by observed change and never by clocks.

It spares two coordinators the same work. What is committed stays right without it.
"""

import contextlib
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from schemas.dataset.layout import LOCK_FILE, STAGING
from schemas.errors import RunError
from workers.store.store import Store


@dataclass(frozen=True)
class Beat:
    """How often a holder shows that it lives, and for how many of those periods silence is borne."""

    period_s: float = 2.0
    patience: int = 5


@dataclass(frozen=True)
class Holder:
    """Whoever holds the lock.

    `machine` tells one boot and one process namespace from another; `born` is the start of the process in the machine's
    own ticks, so that a process id that was given out again is not mistaken for it.
    """

    token: str
    host: str
    pid: int
    machine: str
    born: str
    beat: int = 0


class Lock:
    """A lock that is held; `lost` turns true if somebody took it over, because this process was silent for too long."""

    def __init__(self, store: Store, holder: Holder, period_s: float) -> None:
        self.lost = False
        self._store = store
        self._holder = holder
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, args=(period_s,), name="lock heartbeat", daemon=True)
        self._thread.start()

    def release(self) -> None:
        """Ends the heartbeat and takes the lock file away, if it is still ours."""
        self._ended.set()
        self._thread.join()
        current = read_holder(self._store)
        if current is not None and current.token == self._holder.token:
            self._store.remove(LOCK_FILE)

    def _beat(self, period_s: float) -> None:
        count = 0
        while not self._ended.wait(period_s):
            count += 1
            with contextlib.suppress(Exception):  # a full disk must not end the run: the lock is only advice
                current = read_holder(self._store)
                if current is not None and current.token != self._holder.token:
                    self.lost = True
                    return
                self._store.write_whole(LOCK_FILE, _encode(self._holder, count), durable=False)


@contextlib.contextmanager
def hold_lock(store: Store, wait: bool = False, beat: Beat | None = None) -> Iterator[Lock]:
    """Holds the lock of an output folder while the context lasts.

    A holder on this machine that is dead is replaced at once, one elsewhere after `patience` periods without a sign of
    life. Raises RunError naming a holder that lives, unless `wait` asks to wait until it is done.
    """
    beat = beat or Beat()
    mine = _myself()
    while not store.put_if_absent(LOCK_FILE, _encode(mine)):
        silent = _watch(store, beat, wait)
        if silent is not None and _take_over(store, silent, mine, beat.period_s):
            break
    lock = Lock(store, mine, beat.period_s)
    try:
        yield lock
    finally:
        lock.release()


def read_holder(store: Store) -> Holder | None:
    """Who holds the lock, None where nobody does. A lock file that cannot be read names `unknown`."""
    try:
        data = store.read(LOCK_FILE)
    except FileNotFoundError:
        return None
    try:
        return Holder(**json.loads(data))
    except (ValueError, TypeError):
        return Holder(token=f"unreadable {data[:40]!r}", host="unknown", pid=0, machine="", born="")


def _watch(store: Store, beat: Beat, wait: bool) -> Holder | None:
    """The holder if it is dead or fell silent, None if the lock was given back.

    Raises RunError where it lives and `wait` is false.
    """
    first = read_holder(store)
    silent = 0
    while first is not None:
        if _is_dead(first):
            return first
        if not wait and _is_on_this_machine(first):
            raise RunError(_refusal(store, first))
        time.sleep(beat.period_s)
        now = read_holder(store)
        if now is None:
            return None
        if now == first:
            silent += 1
            if silent >= beat.patience:
                return first
            continue
        if not wait:
            raise RunError(_refusal(store, now))
        first, silent = now, 0
    return None


def _take_over(store: Store, silent: Holder, mine: Holder, period_s: float) -> bool:
    """Replaces a silent holder; False where another was faster.

    One contender for each holder gets the claim, and it looks again before it writes.
    """
    claim = f"{STAGING}/_lock/{uuid.uuid5(uuid.NAMESPACE_OID, silent.token).hex}"
    if not store.put_if_absent(claim, _encode(mine)):
        time.sleep(period_s)
        if read_holder(store) == silent:  # whoever claimed it died in here
            store.remove(claim)
        return False
    try:
        if read_holder(store) != silent:
            return False
        store.write_whole(LOCK_FILE, _encode(mine))
        return True
    finally:
        store.remove(claim)


def _refusal(store: Store, holder: Holder) -> str:
    return (
        f"{store.name} is in use by process {holder.pid} on {holder.host}: wait until it ends or stop it, "
        "then start again; `verso status` shows how far it is"
    )


def _encode(holder: Holder, beat: int = 0) -> bytes:
    return json.dumps({**asdict(holder), "beat": beat}).encode()


def _myself() -> Holder:
    pid = os.getpid()
    return Holder(uuid.uuid4().hex, socket.gethostname(), pid, _machine(), _born(pid) or "")


def _machine() -> str:
    """This boot of this machine, and this namespace of process ids; empty where Linux does not say."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _born(pid: int) -> str | None:
    """When a process of this machine began, in ticks since boot; None where there is none of that id."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    state, *fields = stat.rpartition(")")[2].split()
    return None if state in "ZX" else fields[18]


def _is_on_this_machine(holder: Holder) -> bool:
    return bool(holder.machine) and holder.machine == _machine()


def _is_dead(holder: Holder) -> bool:
    return _is_on_this_machine(holder) and _born(holder.pid) != holder.born
