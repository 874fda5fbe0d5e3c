"""Edge: the one pool of processes. It asks many questions side by side, limits each, and keeps the answers on disk.

multiprocessing's fork server has imported the module of the work once and starts each child from there. A child answers one
item after the other through a pipe. An answer is bytes and never a pickle, because a child may have read a stranger's file.
"""

import errno
import fcntl
import gc
import json
import multiprocessing
import os
import resource
import signal
import sys
import threading
import time
import traceback
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from math import ceil, inf
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, Literal, NoReturn, TypeVar

from schemas.errors import InUseError, MachineError, OutputError

Item = TypeVar("Item")

# ---------------------------------------------------------------------------------------------------- answers on disk


@contextmanager
def alone_in(folder: Path, lock: str, name: str, wait: bool = False) -> Iterator[None]:
    """Within the block no other process has a file `lock` below a folder, which is made. name: of the command that writes there.

    Raises InUseError where another has it, or waits, and OutputError where the folder cannot be written.
    """
    is_new = not folder.exists()
    try:
        (folder / lock).parent.mkdir(parents=True, exist_ok=True)
        file = open(folder / lock, "ab")  # noqa: SIM115 - a lock that ends with the process, however it ends; closed below
    except OSError as error:
        raise OutputError(f"{folder} cannot be written: {error.strerror or error}; choose another folder") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError as error:
            raise InUseError(f"another `{name}` writes {folder}: wait for it, or choose another folder") from error
        try:
            yield
        except BaseException:
            with suppress(OSError):
                if is_new and not os.path.getsize(file.name):  # nothing stays of what was not begun
                    os.unlink(file.name)
                    folder.rmdir()
            raise


_HEAD = b"\n@"
"""Begins each record, so that the next one is found behind a torn one."""


class Answers:
    """Answers by key: in one file to which whole records are appended, or in memory alone.

    A record is a line with a checksum, the length of the answer and the key, and then the answer. One that the end of a process
    or a full disk cut off does not match its checksum, and is asked again. Several processes may append to one file. Where the
    file cannot be written, answers are kept in memory.
    """

    def __init__(self, path: Path | None) -> None:
        """Reads the places of the answers in a file; it may be absent, and so may its folder."""
        self._path = path
        self._kept: dict[str, bytes | tuple[int, int]] = {}
        if path is not None:
            with suppress(OSError):
                self._scan(path.read_bytes())

    def __contains__(self, key: str) -> bool:
        return key in self._kept

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[str]:
        """The keys, in the order of their answers."""
        return iter(self._kept)

    def get(self, key: str) -> bytes | None:
        """The answer; None where there is none."""
        kept = self._kept.get(key)
        if not isinstance(kept, tuple):
            return kept
        assert self._path is not None
        at, length = kept
        try:
            with self._path.open("rb") as file:
                file.seek(at)
                answer = file.read(length)
        except OSError:
            answer = b""
        return answer if len(answer) == length else None

    def put(self, key: str, answer: bytes) -> None:
        """Keeps an answer; the key has no line break."""
        self._kept[key] = answer
        if self._path is None:
            return
        name = key.encode()
        record = b"%s%08x %d %s\n%s\n" % (_HEAD, zlib.crc32(name + answer), len(answer), name, answer)
        with suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            to = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                if os.write(to, record) == len(record):
                    end = os.lseek(to, 0, os.SEEK_CUR)  # behind this process's own record
                    self._kept[key] = end - 1 - len(answer), len(answer)
            finally:
                os.close(to)

    def _scan(self, data: bytes) -> None:
        at = 0
        while (at := data.find(_HEAD, at)) >= 0:
            at += len(_HEAD)
            end = data.find(b"\n", at)
            with suppress(ValueError):
                checksum, length, name = data[at:end].split(b" ", 2)
                start, size = end + 1, int(length)
                answer = data[start : start + size]
                if len(answer) == size and int(checksum, 16) == zlib.crc32(name + answer):
                    self._kept[name.decode()] = start, size
                    at = end + size  # the record that follows a cut one begins with the line break that ends it


# ---------------------------------------------------------------------------------------------------- what is asked


@dataclass(frozen=True)
class Limits:
    """Limits of one item; None: no limit.

    Memory is MiB of address space beyond that of a child that has begun, and of each file. Times are processor seconds and
    seconds by the clock.
    """

    memory_mb: int | None = None
    cpu_s: float | None = None
    wall_s: float | None = None


@dataclass(frozen=True)
class Ended:
    """In place of an answer: how an item ended the process that worked on it. `killed`: from outside, perhaps for memory."""

    how: Literal["cpu", "memory", "wall", "killed", "crashed"]
    detail: str


_ANSWER, _ENDED, _FAULT = b"+", b"-", b"!"
"""The first byte of a message or a kept answer: bytes, an `Ended`, or the traceback of a fault of this project."""

_NO_MEMORY = 12
"""Exit code of a child that had no memory left."""

_LOST_SERVER = 255
"""The exit code that multiprocessing gives a child whose fork server has ended."""

_MOST_LOST_SERVERS = 8
"""Ends for want of a fork server after which a pool gives up: all of its children end with the server."""

_MOST_ANSWER_BYTES = (1 << 31) - 1

MOST_PROCESSES = 8
"""Processes of a pool, unless its caller says: each may take the memory that the limits allow."""


class Pool(Generic[Item]):
    """Within `with`, child processes that answer `work(item)` for the items of one `run` after the other.

    work: a function of a module, whose answer is bytes. Whatever it raises is a fault of this project and is raised again as a
    RuntimeError with the child's traceback; a MemoryError, or an OSError for want of memory, ends the child. Ctrl-C is left to
    the process that asks, with which the children end.
    key: the name under which `kept` keeps an item's answer, a digest of all that it follows from.
    kept: what it has is not asked; new answers are put there, and so are the ends that the item itself caused.
    batch: items that a child answers before another takes its place; None: all.
    quiet: whether what a child prints is thrown away.
    """

    def __init__(
        self,
        work: Callable[[Item], bytes],
        *,
        key: Callable[[Item], str] | None = None,
        kept: Answers | None = None,
        limits: Limits = Limits(),
        processes: int | None = None,
        batch: int | None = None,
        quiet: bool = True,
    ) -> None:
        """Starts none yet."""
        self._work, self._key, self._kept, self._limits, self._batch = work, key, kept, limits, batch
        self._quiet = quiet
        self._count = processes or min(len(os.sched_getaffinity(0)), MOST_PROCESSES)
        self._children: list[_Child] = []
        self._busy: list[_Child] = []
        self._lost_servers = 0

    def __enter__(self) -> "Pool[Item]":
        return self

    def __exit__(self, *_: object) -> None:
        for child in self._children:
            child.end()
        self._children, self._busy = [], []

    def run(
        self, items: Iterable[Item], deadline: float = inf, latest: float | None = None
    ) -> Iterator[tuple[Item, bytes | Ended]]:
        """Each item with its answer, as answers come; `items` is asked for the next one when a child is free.

        Nothing is begun after the deadline, by the monotonic clock; what is under way at `latest` (default: never) is ended and
        has no answer. An item that ends a child which had answered others is asked once more, of a child of its own.

        Raises MachineError where no process can be started.
        """
        ahead, again, latest = iter(items), deque[Item](), inf if latest is None else latest
        more = True
        try:
            while True:
                while len(self._busy) < self._count and time.monotonic() < deadline and (again or more):
                    if again:
                        self._begin(again.popleft(), fresh=True)
                        continue
                    try:
                        item = next(ahead)
                    except StopIteration:
                        more = False
                        break
                    if (answer := self._known(item)) is not None:
                        yield item, answer
                    else:
                        self._begin(item)
                if not self._busy or time.monotonic() >= latest:
                    return
                for child in self._ready(latest):
                    yield from self._take(child, again)
        finally:  # also where the caller stops half-way
            for child in list(self._busy):
                self._drop(child)

    def _known(self, item: Item) -> bytes | Ended | None:
        if self._kept is None or self._key is None or (answer := self._kept.get(self._key(item))) is None:
            return None
        return _open(answer)

    def _begin(self, item: Item, fresh: bool = False) -> None:
        idle = [child for child in self._children if child not in self._busy]
        child = next((child for child in idle if not (fresh and child.answered) and child.is_alive()), None)
        if child is None:
            for old in idle[: max(0, len(self._children) + 1 - self._count)]:
                self._drop(old)
            child = _Child(self._work, self._limits, self._quiet)
            self._children.append(child)
        self._busy.append(child)
        child.begin(item, self._limits.wall_s)

    def _ready(self, latest: float) -> list["_Child"]:
        """Children that have answered or ended; those whose time is over are ended first."""
        first = min([latest, *(child.until for child in self._busy)])
        left_s = min(max(0.0, first - time.monotonic()), 3600.0)
        ready = wait([child.pipe for child in self._busy], left_s)
        done = [child for child in self._busy if child.pipe in ready]
        for child in self._busy:
            if child not in done and time.monotonic() >= child.until:
                child.is_late = True
                done.append(child)
        return done

    def _take(self, child: "_Child", again: deque[Item]) -> Iterator[tuple[Item, bytes | Ended]]:
        item = child.item
        message = None if child.is_late else child.receive()
        if message is None:
            end = child.describe_end(self._limits)
            self._drop(child)
            if self._is_to_repeat(child, end):
                again.append(item)
                return
            if end.how not in ("killed", "wall"):
                self._keep(item, _ENDED + json.dumps([end.how, end.detail]).encode())
            yield item, end
            return
        self._busy.remove(child)
        if child.answered == self._batch:
            self._drop(child)
        if message[:1] == _FAULT:
            raise RuntimeError(f"work in a process of its own failed:\n{message[1:].decode(errors='replace')}")
        self._keep(item, message)
        yield item, message[1:]

    def _is_to_repeat(self, child: "_Child", end: Ended) -> bool:
        """Whether something else than the item may be to blame: what the child had read before, or a killed fork server."""
        if child.has_lost_server and self._lost_servers < _MOST_LOST_SERVERS:
            self._lost_servers += 1
            return True
        return child.answered > 0 and end.how in ("cpu", "memory", "crashed")

    def _keep(self, item: Item, message: bytes) -> None:
        if self._kept is not None and self._key is not None:
            self._kept.put(self._key(item), message)

    def _drop(self, child: "_Child") -> None:
        child.end()
        self._children.remove(child)
        if child in self._busy:
            self._busy.remove(child)


def run_pool(
    work: Callable[[Item], bytes],
    items: Iterable[Item],
    *,
    deadline: float = inf,
    latest: float | None = None,
    **how: Any,
) -> Iterator[tuple[Item, bytes | Ended]]:
    """Each item with the answer of `work`, by a `Pool` made with `how` for this alone."""
    with Pool(work, **how) as pool:
        yield from pool.run(items, deadline, latest)


def _open(message: bytes) -> bytes | Ended:
    return message[1:] if message[:1] == _ANSWER else Ended(*json.loads(message[1:]))


# ---------------------------------------------------------------------------------------------------- a child

_processes = multiprocessing.get_context("forkserver")
_lock = threading.Lock()
"""Held while a child is started or joined: multiprocessing looks after its children in whichever thread starts the next."""


@dataclass(eq=False)
class _Child:
    """A process, the end of its pipe, the item that it works on, and how many it has answered."""

    work: Callable[[Any], bytes]
    limits: Limits
    quiet: bool
    item: Any = None
    answered: int = 0
    until: float = inf
    is_late: bool = False
    pipe: Connection = field(init=False)

    def __post_init__(self) -> None:
        for _ in range(2):  # the fork server may have been killed
            self.pipe, theirs = _processes.Pipe()
            self._process = _processes.Process(target=_serve, args=(self.work, self.limits, self.quiet, theirs))
            with theirs, suppress(OSError, EOFError):
                _start(self._process, self.work.__module__)
            if self._process.pid is not None and self._process.exitcode != _LOST_SERVER:
                return
        raise MachineError("processes of this program end at once: see the lines above, and `verso doctor`")

    def is_alive(self) -> bool:
        return self._process.is_alive()

    @property
    def has_lost_server(self) -> bool:
        return not self.is_late and self._process.exitcode == _LOST_SERVER

    def begin(self, item: Any, wall_s: float | None) -> None:
        self.item, self.until = item, inf if wall_s is None else time.monotonic() + wall_s
        with suppress(OSError):  # a process that is gone is told when its answer is taken
            self.pipe.send(item)

    def receive(self) -> bytes | None:
        """Its answer; None where it has ended in place of one."""
        most = _MOST_ANSWER_BYTES if self.limits.memory_mb is None else self.limits.memory_mb << 20
        try:
            message = self.pipe.recv_bytes(most)
        except (EOFError, OSError):
            return None
        self.answered += 1
        return message

    def describe_end(self, limits: Limits) -> Ended:
        if self.is_late:
            return Ended("wall", f"takes more than {limits.wall_s:g} s")
        with _lock:
            self._process.join()
        code = self._process.exitcode
        if code == -signal.SIGXCPU:
            return Ended("cpu", f"takes more than {limits.cpu_s:g} s of processor time")
        if code == _NO_MEMORY:
            return Ended("memory", f"takes more than {limits.memory_mb} MiB of memory")
        if code in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP, _LOST_SERVER):
            return Ended("killed", "its process was killed from outside, perhaps for want of memory")
        how = signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"
        return Ended("crashed", f"crashes its process ({how})")

    def end(self) -> None:
        with _lock:
            self._process.kill()
            self._process.join()
        self.pipe.close()


def _start(process: Any, module: str) -> None:
    """Starts a child without this process's main module, which it does not need: a script without a guard would run again."""
    with _lock:
        # Of the first work: the server imports it once for all.
        _processes.set_forkserver_preload([module, "workers.warm"])
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            process.start()
        finally:
            sys.modules["__main__"] = main


def _serve(work: Callable[[Any], bytes], limits: Limits, quiet: bool, pipe: Connection) -> NoReturn:
    """In the child: answers items under the limits until the other end is gone, and exits."""
    code = 1
    try:
        _set_limits(limits, quiet)
        while True:
            item = pipe.recv()
            if limits.cpu_s is not None:  # processor time, so that the verdict is the same on a busy machine
                most = ceil(time.process_time() + limits.cpu_s)
                resource.setrlimit(resource.RLIMIT_CPU, (most, resource.RLIM_INFINITY))
            try:
                message = _ANSWER + work(item)
            except Exception as error:
                if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in _WANT_OF_MEMORY):
                    raise
                message = _FAULT + traceback.format_exc().encode()
            pipe.send_bytes(message)
    except EOFError:
        code = 0
    except MemoryError:
        code = _NO_MEMORY
    except OSError as error:
        code = _NO_MEMORY if error.errno in _WANT_OF_MEMORY else 1
    finally:
        os._exit(code)


def _end_with_asker() -> None:
    asker = multiprocessing.parent_process()
    assert asker is not None
    asker.join()
    os._exit(1)


_WANT_OF_MEMORY = (errno.ENOMEM, errno.EFBIG)


def _set_limits(limits: Limits, quiet: bool) -> None:
    """In the child: ends with the process that asks, leaves no core, and has so much address space and file size."""
    gc.freeze()  # the collector would copy every page of what was imported
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that asks decides when to stop
    threading.Thread(target=_end_with_asker, daemon=True).start()
    if quiet:
        for standard in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), standard)
    if limits.memory_mb is not None:
        most = limits.memory_mb << 20
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
        with open("/proc/self/statm") as pages:  # what was loaded before the item is not the item's
            most += int(pages.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
