"""The process that reads files from outside: a server that forks a child with limits for every batch of files.

A script, started by `workers.assets.external.reader`, which speaks to it through a socket: a request in, preceded by its
length; out, how the child ended and a file in memory. The child has written its answers into that file, so that those
before the one in which it ended are kept, and nothing large is copied. Ends by itself where nothing is asked for `IDLE_S`.
"""

import ctypes
import errno
import gc
import json
import os
import resource
import select
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from math import ceil
from typing import TYPE_CHECKING, NamedTuple, NoReturn

if TYPE_CHECKING:
    from workers.assets.external.answers import Answer

NO_MEMORY = 12
"""Exit code of a child that had no memory left."""

IDLE_S = 300
"""After this long without a request the process ends; the next request starts another."""

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
    from PIL import Image

    from workers.assets.external.reader_tasks import answer_task, open_request

    Image.preinit()
    gc.collect()
    gc.freeze()  # a child's collector would copy every page of what was imported
    with suppress(BrokenPipeError, ConnectionResetError), socket.socket(fileno=0) as asker:
        while select.select([asker], [], [], IDLE_S)[0] and (data := receive(asker)) is not None:
            tree = json.loads(data)
            request = open_request(tree)
            work = partial(_work, Limits(tree["memory_mb"], tree["cpu_s"]), partial(answer_task, request), asker)
            _serve(work, len(request.tasks), asker)


def _serve(work: Callable[[int, int], NoReturn], count: int, asker: socket.socket) -> None:
    """Sends how a child that does the work ended, what it used, and the file with its answers."""
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
        socket.send_fds(asker, [json.dumps(head).encode()], [sink])


def _work(limits: Limits, answer: "Callable[[int], Answer]", asker: socket.socket, count: int, sink: int) -> NoReturn:
    """In the child: answers every task under the limits, and exits."""
    from workers.assets.external.answers import write_answer  # found once `main` has set the search path

    code = 1
    try:
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        for standard in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), standard)
        asker.close()
        for limit in (resource.RLIMIT_AS, resource.RLIMIT_FSIZE):
            resource.setrlimit(limit, (limits.memory_mb << 20, limits.memory_mb << 20))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in range(count):
            # Processor time, so that the verdict is the same on a busy machine; for each task alone, not for the batch.
            resource.setrlimit(resource.RLIMIT_CPU, (ceil(time.process_time() + limits.cpu_s), resource.RLIM_INFINITY))
            write_answer(sink, answer(number))
        code = 0
    except MemoryError:
        code = NO_MEMORY
    except OSError as error:
        code = NO_MEMORY if error.errno in (errno.ENOMEM, errno.EFBIG) else 1
    finally:
        os._exit(code)


def send(to: socket.socket, data: bytes) -> None:
    """Sends a length and the bytes."""
    to.sendall(len(data).to_bytes(8, "little") + data)


def receive(source: socket.socket) -> bytes | None:
    """What `send` sent; None where the other side is gone."""
    head = source.recv(8, socket.MSG_WAITALL)
    if len(head) < 8:
        return None
    size = int.from_bytes(head, "little")
    data = source.recv(size, socket.MSG_WAITALL)
    return data if len(data) == size else None


if __name__ == "__main__":
    main(sys.argv[1])
