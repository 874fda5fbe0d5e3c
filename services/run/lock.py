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
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from schemas.dataset.layout import LOCK_CLAIMS, LOCK_FILE
from schemas.errors import CorruptError, InUseError, MachineError, RunError, VersoError
from services.run.machine import read_process
from workers.store.store import Events, Store


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


UNREADABLE = Holder(token="", host="unknown", pid=0, machine="", born="")
"""The holder where what the store has of the lock cannot be read."""


class Lock:
    """The right to be the one coordinator of a folder. Another may take it over while this process shows no life.

    What decides is the store: each process that takes the lock is one numbered event there, and the last one has it. The
    heartbeat's file decides nothing: where it was removed or damaged by hand, it is written again.
    """

    def __init__(self, store: Store, mine: Holder, beat: Beat) -> None:
        self._store = store
        self._mine = mine
        self._silence_s = beat.patience * beat.period_s
        self._shown_at = _now_s()
        """When this process last showed life, by the clock that also counts while the machine sleeps."""
        self._beats = 0
        self._lost = False
        self._new_holder: Holder | None = None
        self._one_at_a_time = threading.Lock()

    @property
    def token(self) -> str:
        """What the heartbeat's file holds as long as this process has the lock."""
        return self._mine.token

    @property
    def held(self) -> bool:
        """Whether this process still has the lock. Asks the store, and shows life there. Raises MachineError."""
        with self._one_at_a_time:
            begun = _now_s()
            if not self._lost and self._is_last():
                self.show_life()
                self._shown_at = begun
                if _now_s() - begun >= self._silence_s:  # paused in between: another may have taken over meanwhile
                    self._is_last()
            return not self._lost

    def show_life(self) -> None:
        """Writes the heartbeat's file anew."""
        self._beats += 1
        self._store.put(LOCK_FILE, json.dumps(asdict(self._mine) | {"beat": self._beats}).encode(), durable=False)

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
        """Gives the lock back, with the events of earlier holders, unless it was lost."""
        with self._one_at_a_time:
            if not self._lost and read_holder(self._store) == self._mine:
                self._store.remove(LOCK_FILE)
                _clear(self._store)

    def _is_last(self) -> bool:
        """Whether the last event is this process's; otherwise the lock is lost.

        Where the events are gone, removed by hand, it takes the lock again, unless somebody had the time to take over, to
        work and to end.
        """
        last = read_holder(self._store)
        if last is None and _now_s() - self._shown_at < self._silence_s:
            _take(self._store, self._mine, None)
            last = read_holder(self._store)
        self._lost = last != self._mine
        self._new_holder = last if self._lost else None
        return not self._lost


@contextlib.contextmanager
def hold_lock(store: Store, beat: Beat = DEFAULT_BEAT) -> Iterator[Lock]:
    """Holds the lock of an output folder while the context lasts.

    A dead holder on this machine is replaced at once, one elsewhere after `patience` periods without a heartbeat.
    Raises InUseError naming a holder that lives.
    """
    mine = Holder(uuid.uuid4().hex, socket.gethostname(), os.getpid(), _machine(), _born(os.getpid()) or "")
    while not _take(store, mine, _find_gone(store, beat)):
        pass
    lock, ended = Lock(store, mine, beat), threading.Event()
    heartbeat = threading.Thread(
        target=_show_life, args=(lock, beat.period_s, ended), name="lock heartbeat", daemon=True
    )
    try:
        lock.show_life()
        heartbeat.start()
        yield lock
    finally:
        ended.set()
        if heartbeat.ident is not None:
            heartbeat.join()
        lock.release()


def read_holder(store: Store) -> Holder | None:
    """The holder of the lock, None where it is free; `UNREADABLE` where the store's events cannot be read."""
    try:
        return _last_of(Events(store, LOCK_CLAIMS).read())
    except FileNotFoundError:  # given back while it was read
        return None
    except (CorruptError, ValueError, TypeError):
        return UNREADABLE


def _last_of(events: Sequence[bytes]) -> Holder | None:
    return Holder(**json.loads(events[-1])) if events else None


def shows_life(store: Store, holder: Holder, beat: Beat = DEFAULT_BEAT) -> bool:
    """Whether a holder lives: by its process on this machine, elsewhere by a heartbeat that changes within the patience."""
    if is_here(holder):
        return _born(holder.pid) == holder.born
    before = _read_beat(store)
    for _ in range(beat.patience):
        time.sleep(beat.period_s)
        if _read_beat(store) != before or read_holder(store) != holder:
            return True
    return False


def _read_beat(store: Store) -> bytes | None:
    with contextlib.suppress(FileNotFoundError):
        return store.read(LOCK_FILE)
    return None


def is_here(holder: Holder) -> bool:
    """Whether the holder's process is of this machine, so that `shows_life` answers at once."""
    return bool(holder.machine) and holder.machine == _machine()


def _show_life(lock: Lock, period_s: float, ended: threading.Event) -> None:
    """Shows life in each period, until another process took the lock over."""
    while not ended.wait(period_s):
        with contextlib.suppress(Exception):  # a full disk must not end the run: the lock is only advice
            if not lock.held:
                return


def _find_gone(store: Store, beat: Beat) -> Holder | None:
    """The holder if it is dead or shows no life, None if the lock is free. Raises InUseError where it lives."""
    holder = read_holder(store)
    if holder is None or not shows_life(store, holder, beat):
        return holder
    if (now := read_holder(store)) is None:
        return None
    by = f"process {now.pid} on {now.host}"
    raise InUseError(
        f"{store.name} is in use by {by}: wait until it ends or stop it, then start again; `verso status` shows how far it is",
        store.name,
        by,
    )


def _take(store: Store, mine: Holder, gone: Holder | None) -> bool:
    """Puts the event by which this process follows `gone` (None: a lock that is free); False where another was faster."""
    if gone == UNREADABLE:
        _clear(store)
        gone = None
    event = json.dumps(asdict(mine)).encode()
    try:
        return Events(store, LOCK_CLAIMS).append(lambda before: event if _last_of(before) == gone else None) is not None
    except (CorruptError, FileNotFoundError, ValueError, TypeError):  # given back, or damaged, at this moment
        return False


def _clear(store: Store) -> None:
    """Removes the events, and the folder only where nobody has taken the lock meanwhile."""
    for name in store.names(LOCK_CLAIMS):
        store.remove(f"{LOCK_CLAIMS}/{name}")
    store.remove_empty(LOCK_CLAIMS)


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
        deadline = time.monotonic() + (REMOVAL_S if type(error) in LOOKS_LOST else 0.0)
        while (
            there := root.exists() and os.path.samestat(os.fstat(folder), os.stat(root))
        ) and time.monotonic() < deadline:
            time.sleep(0.1)  # whoever removes it may not be done
        if there:
            raise
        raise MachineError(
            f"{root} was removed or moved while the run worked in it: move it back, or start again to make it anew"
        ) from error
    finally:
        os.close(folder)
