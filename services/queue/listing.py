"""What people see of a queue: a row for each job, and what its drivers wrote, from Ray while it lives and then from the queue."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

from schemas.errors import MachineError, VersoError, describe_seconds
from schemas.queue import submission_id
from services.queue.queue import JobView, Queue
from services.queue.supervise import Drivers, turn, waiting_for_folder
from workers.store.ledger import list_commits
from workers.store.local import open_store

MOST_LOOKS: Final = 20
"""Output folders that are looked into for one listing: those of the latest jobs."""

COLUMNS: Final = ("id", "name", "priority", "state", "attempts", "scenes", "age", "out")


@dataclass(frozen=True)
class JobRow:
    """A job, as it is shown. `state` is `unreadable` where its files are damaged, as `note` says."""

    id: str
    name: str = ""
    priority: int = 0
    state: str = "unreadable"
    attempts: int = 0
    scenes_done: int | None = None
    scenes_asked: int | None = None
    out: str = ""
    age_s: float = 0.0
    note: str = ""
    digest: str | None = None


def list_jobs(queue: Queue, now_s: float | None = None) -> list[JobRow]:
    """The jobs in the order of their turn: those that run, those that wait, and those that have ended, the latest last."""
    views, faults = queue.read_all(queue.ids())
    waiting = waiting_for_folder(views)
    begun = [view for view in views if view.attempt > 0 and view.scenes is None]
    latest = sorted(begun, key=lambda view: (view.ended, -view.request.submitted))
    looks = {view.request.id for view in latest[:MOST_LOOKS]}
    now_s = time.time() if now_s is None else now_s
    rows = [
        _row(view, view.request.id in waiting, view.request.id in looks, now_s) for view in sorted(views, key=_place)
    ]
    return rows + [JobRow(id=job, note=fault) for job, fault in sorted(faults.items())]


def _place(view: JobView) -> tuple[bool, float, bool, tuple[int, float, str]]:
    """Sorts ended jobs last, in the order in which they were submitted, and the others in the order of their turn."""
    return view.ended, view.request.submitted if view.ended else 0.0, not view.held, turn(view)


def _row(view: JobView, waits: bool, is_looked_into: bool, now_s: float) -> JobRow:
    request, done = view.request, view.scenes
    if done is None:
        done = _scenes_done(request.out) if is_looked_into else 0 if view.attempt == 0 else None
    return JobRow(
        id=request.id,
        name=request.name,
        priority=request.priority,
        state="waiting" if waits else view.state,
        attempts=view.attempt,
        scenes_done=done,
        scenes_asked=request.scenes,
        out=request.out,
        age_s=round(max(0.0, now_s - request.submitted), 1),
        note=view.note,
        digest=view.digest,
    )


def _scenes_done(out: str) -> int | None:
    """Scenes that an output folder holds; None where it cannot be read from here."""
    try:
        return int(list_commits(open_store(out)).committed)
    except (VersoError, OSError):
        return None


def format_rows(rows: Sequence[JobRow]) -> list[str]:
    """A table, a line each, with what there is to say about a job below it."""
    cells = [COLUMNS, *(_cells(row) for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for line, note in zip(cells, ["", *(row.note for row in rows)], strict=True):
        lines.append("  ".join(map(str.ljust, line, widths)).rstrip())
        lines += [f"    {note}"] if note else []
    return lines


def _cells(row: JobRow) -> tuple[str, ...]:
    done = "?" if row.scenes_done is None else row.scenes_done
    scenes = "" if row.scenes_asked is None else f"{done}/{row.scenes_asked}"
    state = "waiting for its folder" if row.state == "waiting" else row.state
    return row.id, row.name, str(row.priority), state, str(row.attempts), scenes, describe_seconds(row.age_s), row.out


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


def follow_log(drivers: Drivers, submission: str) -> Iterator[str]:
    """What a driver writes, until it is over."""
    shown, over = 0, False
    while not over:
        over = drivers.states()[submission].state == "over"  # asked first, so that its last words are shown
        text = drivers.log(submission) or ""
        yield text[shown:]
        shown = len(text)
        if not over:
            time.sleep(EVERY_S)


def follow_logs(
    queue: Queue, drivers: Drivers, job: str, say: Callable[[str], None], sleep: Callable[[float], None] = time.sleep
) -> Iterator[str]:
    """What a job's drivers write, from the first attempt on, until the job has ended; a header comes before each attempt."""
    shown: dict[int, int] = {}
    say_once = cache(say)
    while True:
        view = queue.read(job)
        for attempt in range(max(shown, default=1), view.attempt + 1):
            text = _read(queue, drivers, view, attempt, say_once)
            if text and not shown.get(attempt):
                yield header(attempt)
            if len(text) > shown.setdefault(attempt, 0):
                yield text[shown[attempt] :]
                shown[attempt] = len(text)
        if view.ended:
            return
        sleep(EVERY_S)


def header(attempt: int) -> str:
    """The line above the log of an attempt."""
    return f"--- attempt {attempt} ---\n"
