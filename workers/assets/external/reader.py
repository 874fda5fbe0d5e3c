"""Edge: the limited processes that read files from outside, seen from the process that asks."""

import atexit
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from schemas.errors import MachineError, MeshError
from schemas.job.assets import MeshLimits
from workers.assets.external.answers import read_answers
from workers.assets.external.reader_process import NO_MEMORY, send
from workers.assets.external.reader_tasks import ANSWER, Request, Task, encode_request

ROOT = Path(__file__).resolve().parents[3]
BATCH = {"list": 128, "names": 128, "check": 32, "measure": 32, "load": 1}
"""Tasks that one child works on: a fork costs some milliseconds, and a child that ends is replaced for what is left."""
MOST_PROCESSES = 8
"""Processes that read a source in parallel: each may take the memory that the limits allow."""
WORTH_A_PROCESS = {"list": 4096, "names": 4096, "check": 96, "measure": 96, "load": 96}
"""Tasks for which one more process is started, which takes a second or two."""

Watch = Callable[[int, int], None]
"""Is told how many tasks of how many are done."""


@dataclass(frozen=True)
class Usage:
    """How a child ended and what it used: exit code (negative: signal), processor seconds, greatest resident memory."""

    exit: int
    cpu_s: float
    rss_kb: int


class Reader:
    """One server process, started when it is first needed and again where it has ended. One thread at a time."""

    def __init__(self) -> None:
        self.last = Usage(0, 0.0, 0)
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._lock = threading.Lock()

    def ask(self, request: Request) -> Iterator[memoryview | MeshError]:
        """For each task what it answers, or why its file is refused, in their order.

        Raises MachineError where the process cannot be started, or was killed from outside.
        """
        left = request.tasks
        while left:
            answers = self._exchange(replace(request, tasks=left))
            if (
                not answers
            ):  # it ended in the first, before which it had read nothing else: the verdict is the file's own
                answers = [_describe_end(self.last, left[0].path, request.assets.limits)]
            yield from answers
            left = left[len(answers) :]

    def close(self) -> None:
        """Ends the process."""
        process, self._process = self._process, None
        if process is not None and self._socket is not None:
            self._socket.close()
            process.kill()
            process.wait()

    def _exchange(self, request: Request) -> list[memoryview | MeshError]:
        """Answers up to the task in which the child ended; `last` says how."""
        data = encode_request(request)
        with self._lock:
            for _ in range(2):  # the server ends when it has been idle for long
                try:
                    return self._try(data)
                except OSError:
                    self.close()
        raise MachineError("the process that reads meshes ends at once: see the lines above, and `verso doctor`")

    def _try(self, data: bytes) -> list[memoryview | MeshError]:
        if self._process is None or self._socket is None:
            self._start()
        assert self._socket is not None
        send(self._socket, data)
        head, files, _, _ = socket.recv_fds(self._socket, 4096, 1)
        if not files:
            raise BrokenPipeError
        with open(files[0], "rb") as answers:
            # Not mapped: each cached asset would hold a file descriptor.
            body = np.empty(os.fstat(answers.fileno()).st_size, dtype=np.uint8)
            answers.seek(0)
            answers.readinto(body.data)
        tree = json.loads(head)
        self.last = Usage(tree["exit"], tree["cpu_s"], tree["rss_kb"])
        if self.last.exit in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGHUP):
            raise MachineError("a process that reads meshes was killed from outside, perhaps for want of memory")
        return [_open_answer(kind, blocks) for kind, blocks in read_answers(body.data.toreadonly())]

    def _start(self) -> None:
        script = Path(__file__).with_name("reader_process.py")
        command = [sys.executable, "-P", str(script), str(ROOT)]
        self._socket, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(command, stdin=theirs.fileno(), stdout=subprocess.DEVNULL)


def _open_answer(kind: bytes, blocks: memoryview) -> memoryview | MeshError:
    if kind == ANSWER:
        return blocks
    reason, detail, kind_of_failure = json.loads(bytes(blocks).rstrip(b"\0"))
    error = MeshError(reason, detail)
    error.kind = kind_of_failure
    return error


def _describe_end(used: Usage, path: Path, limits: MeshLimits) -> MeshError:
    """Why the child ended, in terms of the file that it was reading."""
    if used.exit == -signal.SIGXCPU:
        more = f"takes more than assets.limits.max_cpu_s = {limits.max_cpu_s:g} s of processor time"
        return MeshError("too_slow", f"{path} {more}: make it simpler, or raise the limit")
    if used.exit == NO_MEMORY:
        more = f"takes more memory than assets.limits.max_memory_mb = {limits.max_memory_mb}"
        return MeshError("too_large", f"{path} {more}: make it simpler, or raise the limit")
    how = signal.Signals(-used.exit).name if used.exit < 0 else f"exit code {used.exit}"
    return MeshError("unreadable", f"{path} crashes the process that reads it ({how})")


def ask_all(request: Request, watch: Watch) -> Iterator[tuple[Task, memoryview | MeshError]]:
    """Every task, all of one kind, with its answer, in their order, by as many processes as are worth it."""
    tasks = request.tasks
    if not tasks:
        return
    size, worth = BATCH[tasks[0].kind], WORTH_A_PROCESS[tasks[0].kind]
    batches = iter([replace(request, tasks=tasks[at : at + size]) for at in range(0, len(tasks), size)])
    count = min(len(os.sched_getaffinity(0)), MOST_PROCESSES, 1 + len(tasks) // worth)
    free: queue.SimpleQueue[Reader] = queue.SimpleQueue()
    readers = [shared_reader(), *(Reader() for _ in range(count - 1))]
    for reader in readers:
        free.put(reader)

    def ask(batch: Request) -> list[tuple[Task, memoryview | MeshError]]:
        reader = free.get()
        try:
            return list(zip(batch.tasks, reader.ask(batch), strict=True))
        finally:
            free.put(reader)

    done = 0
    try:
        with ThreadPoolExecutor(count) as pool:
            waiting = [pool.submit(ask, batch) for batch in islice(batches, 2 * count)]
            while waiting:
                answers = waiting.pop(0).result()
                waiting += [pool.submit(ask, batch) for batch in islice(batches, 1)]
                yield from answers
                done += len(answers)
                watch(done, len(tasks))
    finally:
        for reader in readers[1:]:
            reader.close()


def shared_reader() -> Reader:
    """This process's reader."""
    if os.getpid() not in _shared:
        _shared.clear()  # in a fork: the pipes are the parent's
        _shared[os.getpid()] = Reader()
    return _shared[os.getpid()]


_shared: dict[int, Reader] = {}


@atexit.register
def _close() -> None:
    if (reader := _shared.pop(os.getpid(), None)) is not None:
        reader.close()
