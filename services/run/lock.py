"""The hold on an output folder: one coordinator at a time, and an answer where the folder itself goes away.

The lock is advisory: it saves two coordinators from doing the same work, and commits are correct without it. Its heartbeat is
judged by observed change, never by comparing clocks.
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
from schemas.errors import CorruptError, InUseError, MachineError, RunError, VersoError
from services.run.machine import read_process
from workers.store.store import Store


@dataclass(frozen=True)
class Beat:
    """The period of the heartbeat, and how many periods without a change mean that the holder is gone."""

    period_s: float = 2.0
    patience: int = 5


DEFAULT_BEAT = Beat()

UNREADABLE = "unknown"
"""The host of a holder whose lock file cannot be read."""


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


class Lock:
    """The right to be the one coordinator of a folder. Another may take it over while this process shows no life.

    What decides is the store: a claim on this holder ends its right for good, whatever the lock file says. A lock file
    that was removed or damaged by hand is written again.
    """

    def __init__(self, store: Store, mine: Holder, beat: Beat, shown_at: float) -> None:
        self._store = store
        self._mine = mine
        self._silence_s = beat.patience * beat.period_s
        self._shown_at = shown_at
        """When the lock file last showed life, by the clock that also counts while the machine sleeps."""
        self._lost = False
        self._new_holder: Holder | None = None
        self._one_at_a_time = threading.Lock()

    @property
    def token(self) -> str:
        """What the lock file holds as long as this process has the lock."""
        return self._mine.token

    @property
    def held(self) -> bool:
        """Whether this process still has the lock. Asks the store, and shows life there. Raises MachineError."""
        with self._one_at_a_time:
            if not self._lost and not self._beat():
                self._lost = True
                self._new_holder = _claimant(self._store, self._mine) or read_holder(self._store)
                self._give_back()
            return not self._lost

    def require_held(self) -> None:
        """Raises RunError naming the process that took over. To be called before anything that would replace its work."""
        if self.held:
            return
        by = self._new_holder
        raise RunError(
            f"{self._store.name} was taken over {f'by process {by.pid} on {by.host}' if by else 'by another process'} "
            f"while this one showed no life for more than {self._silence_s:g} s: it stops here, so that it replaces nothing "
            "newer; start again when the other has ended, what is committed stays"
        )

    def release(self) -> None:
        """Gives the lock back, with the claims on earlier holders, unless it was lost."""
        with self._one_at_a_time:
            if not self._lost and _is_held_by(self._store, self._mine):
                self._store.remove(LOCK_FILE)
                self._store.remove_tree(LOCK_CLAIMS)

    def _beat(self) -> bool:
        """Writes the lock file anew; False where the lock was lost, even if only while this function ran."""
        begun = _now_s()
        found = read_holder(self._store)
        if _claimant(self._store, self._mine) is not None or not self._may_write(found, begun):
            return False
        self._mine = replace(self._mine, beat=self._mine.beat + 1)
        if found is not None:
            self._store.put(LOCK_FILE, _encode(self._mine), durable=False)
        elif not self._store.put_if_absent(LOCK_FILE, _encode(self._mine)):
            return False
        if self._is_late() and _claimant(self._store, self._mine) is not None:
            return False
        self._shown_at = begun
        return True

    def _may_write(self, found: Holder | None, now: float) -> bool:
        """Whether what is in the lock file is this process's to replace."""
        if found is None:  # removed by hand, unless somebody had the time to take over, to work and to end
            return not self._is_late()
        ours = found.token == self._mine.token or found.host == UNREADABLE
        return ours or _claimant(self._store, found) is not None  # written late by a holder that was replaced

    def _is_late(self) -> bool:
        return _now_s() - self._shown_at >= self._silence_s

    def _give_back(self) -> None:
        """Removes a lock file that this process wrote before it saw that the lock was lost; its holder writes it again."""
        if _is_held_by(self._store, self._mine):
            self._store.remove(LOCK_FILE)


@contextlib.contextmanager
def hold_lock(store: Store, beat: Beat = DEFAULT_BEAT) -> Iterator[Lock]:
    """Holds the lock of an output folder while the context lasts.

    A dead holder on this machine is replaced at once, one elsewhere after `patience` periods without a heartbeat.
    Raises InUseError naming a holder that lives.
    """
    mine = Holder(uuid.uuid4().hex, socket.gethostname(), os.getpid(), _machine(), _born(os.getpid()) or "")
    shown_at = _now_s()
    while not store.put_if_absent(LOCK_FILE, _encode(mine)):
        gone = _find_gone(store, beat)
        shown_at = _now_s()
        if gone is not None and _take_over(store, gone, mine, beat.period_s):
            break
    lock = Lock(store, mine, beat, shown_at)
    ended = threading.Event()
    heartbeat = threading.Thread(
        target=_show_life, args=(lock, beat.period_s, ended), name="lock heartbeat", daemon=True
    )
    try:
        heartbeat.start()
        yield lock
    finally:
        ended.set()
        if heartbeat.ident is not None:
            heartbeat.join()
        lock.release()


def read_holder(store: Store) -> Holder | None:
    """The holder of the lock, None where it is free. A lock file that cannot be read names `unknown`."""
    return _holder_at(store, LOCK_FILE)


def shows_life(store: Store, holder: Holder, beat: Beat = DEFAULT_BEAT) -> bool:
    """Whether a holder lives: by its process on this machine, elsewhere by a heartbeat that changes within the patience."""
    if is_here(holder):
        return _born(holder.pid) == holder.born
    for _ in range(beat.patience):
        time.sleep(beat.period_s)
        if read_holder(store) != holder:
            return True
    return False


def is_here(holder: Holder) -> bool:
    """Whether the holder's process is of this machine, so that `shows_life` answers at once."""
    return bool(holder.machine) and holder.machine == _machine()


def _holder_at(store: Store, key: str) -> Holder | None:
    try:
        data = store.read(key)
    except FileNotFoundError:
        return None
    try:
        return Holder(**json.loads(data))
    except (ValueError, TypeError):
        return Holder(token=f"unreadable {data[:40]!r}", host=UNREADABLE, pid=0, machine="", born="")


def _show_life(lock: Lock, period_s: float, ended: threading.Event) -> None:
    """Writes the lock file anew in each period, until another process took the lock over."""
    while not ended.wait(period_s):
        with contextlib.suppress(Exception):  # a full disk must not end the run: the lock is only advice
            if not lock.held:
                return


def _find_gone(store: Store, beat: Beat) -> Holder | None:
    """The holder if it is dead or shows no life, None if the lock is free. Raises InUseError where it lives."""
    first = read_holder(store)
    if first is None:
        return None
    if not shows_life(store, first, beat):
        return first
    now = read_holder(store)
    if now is None:
        return None
    by = f"process {now.pid} on {now.host}"
    raise InUseError(
        f"{store.name} is in use by {by}: wait until it ends or stop it, then start again; `verso status` shows how far it is",
        store.name,
        by,
    )


def _take_over(store: Store, gone: Holder, mine: Holder, period_s: float) -> bool:
    """Replaces a holder that is gone; False where another was faster.

    One contender for each holder gets the claim, and it looks again before and after it writes. The claim stays while
    the lock is held: it tells the old holder, should it wake, that it was replaced.
    """
    claim = _claim_on(gone)
    if not store.put_if_absent(claim, _encode(mine)):
        time.sleep(period_s)
        if read_holder(store) == gone:  # the process with the claim died before it wrote
            store.remove(claim)
        return False
    if read_holder(store) != gone:
        store.remove(claim)
        return False
    store.put(LOCK_FILE, _encode(mine))
    if _claimant(store, gone) == mine:
        return True
    if _is_held_by(store, mine):
        store.remove(LOCK_FILE)
    return False


def _claim_on(holder: Holder) -> str:
    return f"{LOCK_CLAIMS}/{uuid.uuid5(uuid.NAMESPACE_OID, holder.token).hex}"


def _claimant(store: Store, holder: Holder) -> Holder | None:
    """The process that claimed the lock of `holder`, None where nobody did."""
    return _holder_at(store, _claim_on(holder))


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
    process = read_process(pid)
    return None if process is None or process.ended else process.born


def _now_s() -> float:
    """Seconds by a clock that nobody sets and that counts while the machine sleeps."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


REMOVAL_S = 3.0
"""Time for a removal to end: its first missing file is met before its last one is gone."""

LOOKS_LOST = (CorruptError, RunError, FileNotFoundError)
"""What a run meets in a folder that is just being removed."""


@contextlib.contextmanager
def explain_lost_folder(root: Path | None) -> Iterator[None]:
    """An error in the block that comes of the folder's removal is a MachineError that says so; nothing without a folder.

    Work in a folder that is gone fails in many ways: a file is not found, an attempt looks as if another coordinator had
    swept it. Parts of the folder may even have been made anew.
    """
    if root is None:
        yield
        return
    folder = os.open(root, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield
    except (VersoError, OSError) as error:
        lost = _how_lost(folder, root)
        deadline = time.monotonic() + REMOVAL_S
        while lost is None and type(error) in LOOKS_LOST and time.monotonic() < deadline:
            time.sleep(0.1)  # whoever removes it may not be done
            lost = _how_lost(folder, root)
        if lost:
            raise MachineError(f"{root} was {lost} while the run worked in it: {_REMEDIES[lost]}") from error
        raise
    finally:
        os.close(folder)


_REMEDIES = {
    "removed": "what it held is gone, start again to make it anew",
    "moved": "move it back and start again, what is committed is kept",
}


def _how_lost(folder: int, root: Path) -> str | None:
    """What became of the folder that was opened; None where it is still what is found at `root`."""
    opened = os.fstat(folder)
    with contextlib.suppress(OSError):
        if os.path.samestat(opened, os.stat(root)):
            return None
    return "moved" if opened.st_nlink else "removed"
