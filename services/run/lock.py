"""An advisory lock: one coordinator at a time. Its heartbeat is judged by observed change, never by clocks.

It saves two coordinators from doing the same work. Commits are correct without it.
"""

import contextlib
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from schemas.dataset.layout import LOCK_CLAIMS, LOCK_FILE
from schemas.errors import RunError
from workers.store.store import Store


@dataclass(frozen=True)
class Beat:
    """The period of the heartbeat, and how many periods without a change mean that the holder is gone."""

    period_s: float = 2.0
    patience: int = 5


DEFAULT_BEAT = Beat()


@dataclass(frozen=True)
class Holder:
    """The process that holds the lock.

    `machine` identifies one boot and one process namespace; `born` is the start of the process in the machine's own
    ticks, because process ids are used again.
    """

    token: str
    host: str
    pid: int
    machine: str
    born: str
    beat: int = 0


@contextlib.contextmanager
def hold_lock(store: Store, beat: Beat = DEFAULT_BEAT) -> Iterator[None]:
    """Holds the lock of an output folder while the context lasts.

    A dead holder on this machine is replaced at once, one elsewhere after `patience` periods without a heartbeat.
    Raises RunError naming a holder that lives.
    """
    mine = Holder(uuid.uuid4().hex, socket.gethostname(), os.getpid(), _machine(), _born(os.getpid()) or "")
    while not store.put_if_absent(LOCK_FILE, _encode(mine)):
        gone = _find_gone(store, beat)
        if gone is not None and _take_over(store, gone, mine, beat.period_s):
            break
    ended = threading.Event()
    heartbeat = threading.Thread(
        target=_show_life, args=(store, mine, beat.period_s, ended), name="lock heartbeat", daemon=True
    )
    heartbeat.start()
    try:
        yield
    finally:
        ended.set()
        heartbeat.join()
        if _is_held_by(store, mine):
            store.remove(LOCK_FILE)


def read_holder(store: Store) -> Holder | None:
    """The holder of the lock, None where it is free. A lock file that cannot be read names `unknown`."""
    try:
        data = store.read(LOCK_FILE)
    except FileNotFoundError:
        return None
    try:
        return Holder(**json.loads(data))
    except (ValueError, TypeError):
        return Holder(token=f"unreadable {data[:40]!r}", host="unknown", pid=0, machine="", born="")


def _show_life(store: Store, mine: Holder, period_s: float, ended: threading.Event) -> None:
    """Writes the lock file anew in each period, until another process took the lock over."""
    while not ended.wait(period_s):
        mine = replace(mine, beat=mine.beat + 1)
        with contextlib.suppress(Exception):  # a full disk must not end the run: the lock is only advice
            if not _is_held_by(store, mine):
                return
            store.write_whole(LOCK_FILE, _encode(mine), durable=False)


def _find_gone(store: Store, beat: Beat) -> Holder | None:
    """The holder if it is dead or shows no life, None if the lock is free. Raises RunError where it lives."""
    first = now = read_holder(store)
    if first is None:
        return None
    on_this_machine = bool(first.machine) and first.machine == _machine()
    if on_this_machine and _born(first.pid) != first.born:
        return first
    if not on_this_machine:
        for _ in range(beat.patience):
            time.sleep(beat.period_s)
            if (now := read_holder(store)) != first:
                break
        else:
            return first
    if now is None:
        return None
    raise RunError(
        f"{store.name} is in use by process {now.pid} on {now.host}: wait until it ends or stop it, "
        "then start again; `verso status` shows how far it is"
    )


def _take_over(store: Store, gone: Holder, mine: Holder, period_s: float) -> bool:
    """Replaces a holder that is gone; False where another was faster.

    One contender for each holder gets the claim, and it looks again before it writes.
    """
    claim = f"{LOCK_CLAIMS}/{uuid.uuid5(uuid.NAMESPACE_OID, gone.token).hex}"
    if not store.put_if_absent(claim, _encode(mine)):
        time.sleep(period_s)
        if read_holder(store) == gone:  # the process with the claim died before it wrote
            store.remove(claim)
        return False
    try:
        if read_holder(store) != gone:
            return False
        store.write_whole(LOCK_FILE, _encode(mine))
        return True
    finally:
        store.remove(claim)


def _is_held_by(store: Store, holder: Holder) -> bool:
    current = read_holder(store)
    return current is not None and current.token == holder.token


def _encode(holder: Holder) -> bytes:
    return json.dumps(asdict(holder)).encode()


def _machine() -> str:
    """This boot of this machine, and this namespace of process ids; empty where Linux does not say."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return ""


def _born(pid: int) -> str | None:
    """The start of a process of this machine, in ticks since boot; None where there is no such process."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    state, *fields = stat.rpartition(")")[2].split()
    return None if state in "ZX" else fields[18]
