"""As many plain processes as there are workers, without Ray: what this machine gives to several at once.

Two processes that share nothing but the machine seldom do twice the work of one: cores share caches, memory and clock,
and are often two threads of one core. What plain processes do not gain, no scheduler can.
"""

import multiprocessing
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

from schemas.dataset.commit import Span
from schemas.errors import RunError
from schemas.job.job import Job
from services.bench.ratios import Lap
from services.bench.stages import open_workbench

WARM_UP = 8
"""Scenes that each process makes first."""


class Processes:
    """Warm processes, each with a folder of its own and, in turn, a core of its own."""

    def __init__(self, connections: Sequence[Connection]) -> None:
        self._connections = connections

    def run(self, count: int, first: int, stop: int) -> list[Lap]:
        """The first `count` of them make scenes [first, stop) at the same time, all of them the same ones."""
        for connection in self._connections[:count]:
            connection.send((first, stop))
        return [_receive(connection) for connection in self._connections[:count]]


@contextmanager
def bare_processes(job: Job, job_folder: Path, folder: Path, count: int) -> Iterator[Processes]:
    """That many processes, ready."""
    fresh = multiprocessing.get_context("spawn")
    cores = sorted(os.sched_getaffinity(0))
    connections, processes = [], []
    try:
        for number in range(count):
            ours, theirs = fresh.Pipe()
            core = cores[number % len(cores)]
            arguments = (theirs, job, job_folder, folder / f"bare{number}", core)
            process = fresh.Process(target=_work, args=arguments, daemon=True)
            process.start()
            theirs.close()
            connections.append(ours)
            processes.append(process)
        for connection in connections:
            _receive(connection)
        yield Processes(connections)
    finally:
        for process in processes:
            process.kill()
            process.join()
        for connection in connections:
            connection.close()


def _receive(connection: Connection) -> Lap:
    try:
        lap: Lap = connection.recv()
    except EOFError as error:
        raise RunError("a plain process of the benchmark died; its last words stand above") from error
    return lap


def _work(connection: Connection, job: Job, job_folder: Path, folder: Path, core: int) -> None:
    """Make what is asked for, each time into a new folder, and answer with its lap. The first answer is the warm-up's."""
    os.sched_setaffinity(0, {core})
    first, stop, number = job.first_scene, job.first_scene + WARM_UP, 0
    while True:
        bench = open_workbench(job, job_folder, folder / str(number))
        wall, cpu, made = time.perf_counter(), time.process_time(), 0
        for start in range(first, stop, job.run.range_size):
            made += bench.run(Span(start=start, stop=min(start + job.run.range_size, stop))).scenes
        connection.send(Lap(made, time.perf_counter() - wall, time.process_time() - cpu, {}))
        (first, stop), number = connection.recv(), number + 1
