"""`verso logs`: what a job's drivers wrote, from Ray while it lives and from the queue afterwards."""

import time
from collections.abc import Callable, Iterator

from schemas.errors import MachineError
from schemas.queue import submission_id
from services.queue.fold import JobView
from services.queue.ray_jobs import Drivers
from services.queue.store import Queue

EVERY_S = 1.0
"""Between two looks at a log that is followed."""


def read_logs(queue: Queue, drivers: Drivers, view: JobView, say: Callable[[str], None]) -> dict[int, str]:
    """By attempt: its log, of those that can be read. `say` gets a line about one that cannot."""
    return {
        attempt: text for attempt in range(1, view.attempt + 1) if (text := _read(queue, drivers, view, attempt, say))
    }


def _read(queue: Queue, drivers: Drivers, view: JobView, attempt: int, say: Callable[[str], None]) -> str:
    kept = queue.read_log(view.request.id, attempt)
    if kept is not None:
        return kept
    try:
        return drivers.log(submission_id(view.request.id, attempt)) or ""
    except MachineError as error:
        say(f"attempt {attempt}: no copy of its log is in the queue yet, and {error}")
        return ""


def follow_logs(
    queue: Queue, drivers: Drivers, job: str, say: Callable[[str], None], sleep: Callable[[float], None] = time.sleep
) -> Iterator[str]:
    """What a job's drivers write, from the first attempt on, until the job has ended; a header comes before each attempt."""
    attempt, shown = 1, 0
    said: set[str] = set()

    def say_once(line: str) -> None:
        if line not in said:
            said.add(line)
            say(line)

    while True:
        view = queue.read(job)
        while attempt <= view.attempt:
            text = _read(queue, drivers, view, attempt, say_once)
            if text and not shown:
                yield header(attempt)
            if len(text) > shown:
                yield text[shown:]
                shown = len(text)
            if attempt == view.attempt:
                break
            attempt, shown = attempt + 1, 0
        if view.ended:
            return
        sleep(EVERY_S)


def header(attempt: int) -> str:
    """The line above the log of an attempt."""
    return f"--- attempt {attempt} ---\n"
