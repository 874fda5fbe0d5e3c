"""The process that reads files from outside: a server that forks a child with limits for every batch of files.

A script, started by `workers.assets.external.reader`, which speaks to it through pipes: a request in, a header and the
answers out, each preceded by its length in eight bytes. The child writes its answers into a file in memory, so that those
before the one in which it ended are kept. It ends by itself where nothing is asked for `IDLE_S`.
"""

import ctypes
import errno
import gc
import json
import os
import resource
import select
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from math import ceil
from typing import NamedTuple, NoReturn

NO_MEMORY = 12
"""Exit code of a child that had no memory left."""

IDLE_S = 300
"""After this long without a request the process ends; the next request starts another."""

LENGTH = 8

PR_SET_PDEATHSIG = 1
"""The option of prctl(2) by which a child ends with its parent."""


class Limits(NamedTuple):
    """What a child may use: address space and answers, MiB; processor time for one task, seconds."""

    memory_mb: int
    cpu_s: float


def main(root: str) -> None:
    """Serves until its input ends. `root` is the folder that holds the project's packages."""
    sys.path.insert(0, root)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the worker that asks decides when to stop
    from workers.assets.external.reader_tasks import answer_task, open_request

    out = os.dup(1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    gc.collect()
    gc.freeze()  # a child's collector would copy every page of what was imported
    with suppress(BrokenPipeError):
        while select.select([0], [], [], IDLE_S)[0] and (data := receive(0)) is not None:
            tree = json.loads(data)
            request = open_request(tree)
            work = partial(_work, Limits(tree["memory_mb"], tree["cpu_s"]), partial(answer_task, request), out)
            _serve(work, len(request.tasks), out)


def _serve(work: Callable[[int, int], NoReturn], count: int, out: int) -> None:
    """Sends how a child that does the work ended, what it used, and its answers."""
    with open(os.memfd_create("answers"), "rb") as answers:
        sink = answers.fileno()
        child = os.fork()
        if child == 0:
            work(count, sink)
        _, status, used = os.wait4(child, 0)
        head = {
            "exit": os.waitstatus_to_exitcode(status),
            "cpu_s": used.ru_utime + used.ru_stime,
            "rss_kb": used.ru_maxrss,
        }
        send(out, json.dumps(head).encode())
        size = os.fstat(sink).st_size
        os.write(out, size.to_bytes(LENGTH, "little"))
        at = 0
        while at < size:
            at += os.sendfile(out, sink, at, size - at)


def _work(limits: Limits, answer: Callable[[int], bytes], out: int, count: int, sink: int) -> NoReturn:
    """In the child: answers every task under the limits, and exits."""
    code = 1
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        os.dup2(1, 2)
        os.close(0)
        os.close(out)
        for limit in (resource.RLIMIT_AS, resource.RLIMIT_FSIZE):
            resource.setrlimit(limit, (limits.memory_mb << 20, limits.memory_mb << 20))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in range(count):
            # Processor time, so that the verdict is the same on a busy machine; for each task alone, not for the batch.
            resource.setrlimit(resource.RLIMIT_CPU, (ceil(time.process_time() + limits.cpu_s), resource.RLIM_INFINITY))
            send(sink, answer(number))
        code = 0
    except MemoryError:
        code = NO_MEMORY
    except OSError as error:
        code = NO_MEMORY if error.errno in (errno.ENOMEM, errno.EFBIG) else 1
    finally:
        os._exit(code)


def send(to: int, data: bytes) -> None:
    """Writes a length and the bytes."""
    os.write(to, len(data).to_bytes(LENGTH, "little"))
    view = memoryview(data)
    while view:
        view = view[os.write(to, view) :]


def receive(source: int) -> bytes | None:
    """What `send` wrote; None where the other side is gone."""
    head = _read(source, LENGTH)
    return None if head is None else _read(source, int.from_bytes(head, "little"))


def _read(source: int, count: int) -> bytes | None:
    blocks = []
    while count:
        block = os.read(source, min(count, 1 << 24))
        if not block:
            return None
        blocks.append(block)
        count -= len(block)
    return b"".join(blocks)


if __name__ == "__main__":
    main(sys.argv[1])
