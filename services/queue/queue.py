"""A queue in storage. Every change of a job is one event, put if absent at the next number; a job's state is their fold."""

import json
import re
import time
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, TypeVar

from schemas.base import Frozen
from schemas.dataset.layout import COMMITS, LOCK_FILE, MANIFEST, RANGES, STAGING
from schemas.errors import CorruptError, InputError, OutputError, plain_line
from schemas.queue import (
    ID_PATTERN,
    JOBS,
    MARK_FILE,
    SHARE_FILE,
    JobEvent,
    JobRequest,
    events_folder,
    log_path,
    request_path,
)
from workers.door.opening import read_bytes
from workers.store.local import open_store
from workers.store.store import Events, Store, map_ahead, retry_if_swept

JobState = Literal["queued", "waiting", "running", "cancelling", "cancelled", "done", "failed", "lost"]
"""waiting: for its output folder. lost: drivers died more often than they are started again."""

RESTARTS: Final = 3
"""How often a job whose driver died is taken up again."""

ENDS: Final = frozenset({"cancelled", "done", "failed", "lost"})
HELD: Final = frozenset({"running", "cancelling"})
"""States in which a driver is at work, or may be."""


@dataclass(frozen=True)
class JobView:
    """A job as its events tell it."""

    request: JobRequest
    events: int = 0
    """How many there are: the number of the next one."""
    state: JobState = "queued"
    attempt: int = 0
    """The latest one that was started, from 1."""
    began: bool = False
    """Whether the driver of the latest attempt has begun its work."""
    deaths: int = 0
    note: str = ""
    """Why it is in this state, where that needs words."""
    code: int | None = None
    scenes: int | None = None
    digest: str | None = None

    @property
    def ended(self) -> bool:
        """Whether nothing will happen to it any more."""
        return self.state in ENDS

    @property
    def held(self) -> bool:
        """Whether a driver is at work for it, or may be."""
        return self.state in HELD

    @property
    def claims_folder(self) -> bool:
        """Whether another job must not work in its output folder: from its first attempt until its end."""
        return not self.ended and self.attempt > 0


def fold(request: JobRequest, events: Sequence[JobEvent]) -> JobView:
    """The job after all its events. Events that come too late, or twice, change nothing."""
    view = JobView(request)
    for event in events:
        view = replace(apply(view, event), events=view.events + 1)
    return view


def apply(view: JobView, event: JobEvent) -> JobView:
    """The job after one more event; the same job where the event does not apply."""
    if not applies(view, event):
        return view
    if event.kind == "began":
        return replace(view, began=True)
    if event.kind == "started":
        return replace(view, state="running", attempt=event.attempt, began=False, note="")
    states: dict[str, JobState] = {
        "cancel": "cancelling" if view.held else "cancelled",
        "stopped": "queued",
        "busy": "waiting",
        "died": "lost" if view.deaths >= RESTARTS else "queued",
        "ended": "done" if event.code == 0 else "failed",
    }
    state = states[event.kind]
    if view.state == "cancelling" and state != "done":  # one that was finished in time is done
        state = "cancelled"
    after: dict[str, Any] = {} if event.kind == "stopped" else {"note": event.note}
    if event.kind == "ended":
        after |= {"code": event.code, "scenes": event.scenes, "digest": event.digest}
    return replace(view, state=state, deaths=view.deaths + (event.kind == "died"), **after)


def applies(view: JobView, event: JobEvent) -> bool:
    """Whether an event means anything to a job in this state."""
    if view.ended:
        return False
    if event.kind == "cancel":
        return view.state != "cancelling"
    if event.kind == "started":
        return not view.held and event.attempt == view.attempt + 1
    if not view.held or event.attempt != view.attempt:
        return False
    if event.kind == "began":
        return not view.began and view.state == "running"
    return event.kind in ("died", "stopped") or view.began


Model = TypeVar("Model", bound=Frozen)

OWN: Final = {STAGING, LOCK_FILE, MANIFEST, "lost+found"}
"""What may stand in a folder that is about to become a queue: what somebody who makes it at this moment has put there."""

MOST_BYTES: Final = 1 << 20
"""Larger than any request or event."""

MOST_LOG_BYTES: Final = 1 << 20
"""As much of a driver's log is kept, from its end."""


def _read_entry(store: Store, key: str) -> bytes:
    """What somebody put into the queue. Raises FileNotFoundError, and CorruptError for what is no file or too large."""
    if store.root is None or store.size(key) is None:
        return store.read(key)
    return read_bytes(store.root / key, MOST_BYTES, lambda reason, sentence: CorruptError(sentence))


class _JobEvents(Events):
    """The events of a job, of which what is no file is refused."""

    def _read(self, key: str) -> bytes:
        return _read_entry(self._store, key)


class Queue:
    """A queue that exists; `store` is the place that it lies in."""

    def __init__(self, store: Store) -> None:
        self.store = store
        self.name = store.name
        self._requests: dict[str, JobRequest] = {}
        """By job: its request, which never changes."""
        self._logs: dict[str, Events] = {}
        """By job: its events, of which each is read once."""

    def ids(self) -> list[str]:
        """The ids of all jobs."""
        return [name for name in self.store.children(JOBS) if re.match(ID_PATTERN, name)]

    def put_request(self, request: JobRequest) -> bool:
        """Stores a new job; False where the id is taken."""
        return self.store.put_if_absent(request_path(request.id), _encode(request))

    def read(self, job: str) -> JobView:
        """A job as it is now. Raises InputError where there is none, CorruptError where it cannot be read."""
        key = request_path(job)
        try:
            if job not in self._requests:
                self._requests[job] = _decode(JobRequest, _read_entry(self.store, key), f"{self.name}/{key}")
        except FileNotFoundError:
            raise InputError(
                f"{self.name} has no job {plain_line(job)}: `verso jobs` lists those that there are"
            ) from None
        request = self._requests[job]
        if request.id != job:
            raise CorruptError(f"{self.name}/{key} is the request of another job, {request.id}")
        log = self._logs.setdefault(job, _JobEvents(self.store, events_folder(job)))
        return fold(request, self._decoded(job, log.read()))

    def read_all(self, ids: Iterable[str]) -> tuple[list[JobView], dict[str, str]]:
        """The jobs as they are now; what cannot be read is told by id. A job whose request is not there yet is left out."""
        views, faults = [], {}
        for job, found in map_ahead(self.store, self._read_or_fault, ids):
            if isinstance(found, JobView):
                views.append(found)
            elif isinstance(found, CorruptError):
                faults[job] = str(found)
        return views, faults

    def _read_or_fault(self, job: str) -> tuple[str, JobView | InputError | CorruptError]:
        try:
            return job, self.read(job)
        except (InputError, CorruptError) as error:
            return job, error

    def append(self, job: str, kind: Any, attempt: int = 0, **fields: Any) -> JobView | None:
        """Adds an event to a job and returns the job after it; None where the event does not apply to it any more.

        Whether it applies is decided by the very events before it: a writer who loses the number reads and decides again.
        So nothing is decided twice, however many supervisors, drivers and users there are.
        """
        request = self.read(job).request
        event = JobEvent(kind=kind, attempt=attempt, at=time.time(), nonce=uuid.uuid4().hex, **fields)

        def decide(before: Sequence[bytes]) -> bytes | None:
            return _encode(event) if applies(fold(request, self._decoded(job, before)), event) else None

        after = self._logs[job].append(decide)
        return None if after is None else fold(request, self._decoded(job, after))

    def put_log(self, job: str, attempt: int, text: str) -> None:
        """Keeps the end of a driver's log, once."""
        self.store.put_if_absent(log_path(job, attempt), text.encode(errors="replace")[-MOST_LOG_BYTES:])

    def read_log(self, job: str, attempt: int) -> str | None:
        """The kept log of an attempt, None where there is none."""
        try:
            return _read_entry(self.store, log_path(job, attempt)).decode(errors="replace")
        except FileNotFoundError:
            return None

    def has_log(self, job: str, attempt: int) -> bool:
        """Whether the log of an attempt is kept."""
        return self.store.size(log_path(job, attempt)) is not None

    def share(self) -> int:
        """How many jobs share the cluster, at least 1, as the supervisor said last."""
        try:
            return max(1, int(json.loads(_read_entry(self.store, SHARE_FILE))["running"]))
        except (FileNotFoundError, ValueError, TypeError, KeyError):
            return 1

    def put_share(self, running: int) -> None:
        """Tells the drivers how many jobs share the cluster."""
        self.store.put(SHARE_FILE, json.dumps({"running": running}).encode(), durable=False)

    def _decoded(self, job: str, events: Sequence[bytes]) -> list[JobEvent]:
        """A job's events. Raises CorruptError naming one that this program did not write."""
        name = f"{self.name}/{events_folder(job)}"
        return [_decode(JobEvent, data, f"{name}/{number:08d}.json") for number, data in enumerate(events)]


def open_queue(url: str) -> Queue:
    """The queue at a folder or a URL. Raises InputError where there is none."""
    store = open_store(url)
    if store.root is not None and not store.root.is_dir():
        raise InputError(
            f"--queue {url}: there is no such folder; `verso submit` or `verso supervise` makes a new queue"
        )
    if store.size(MARK_FILE) is None:
        raise InputError(
            f"--queue {url} is no queue: it holds no {MARK_FILE}; `verso submit` or `verso supervise` makes one in a new or "
            "empty folder"
        )
    _decode(Mark, _read_entry(store, MARK_FILE), f"{store.name}/{MARK_FILE}")
    return Queue(store)


def make_queue(url: str) -> Queue:
    """The queue at a folder or a URL, made where there is nothing yet.

    Raises InputError where something else lies there or the folder's own folder is missing, OutputError where the place
    cannot keep a queue.
    """
    store = open_store(url)
    if store.root is not None and not store.root.parent.is_dir():
        raise InputError(
            f"--queue {url}: there is no folder {store.root.parent}: make it, or mount what should be there"
        )
    names = set(store.names(""))
    if MARK_FILE in names:
        return open_queue(url)
    if foreign := sorted(names - OWN):
        holds = f"it holds {plain_line(', '.join(foreign[:3]))} and no {MARK_FILE}"
        raise InputError(f"--queue {url} is no queue: {holds}; choose a new or an empty folder")
    try:
        retry_if_swept(store.prepare)
    except (FileNotFoundError, OutputError) as error:
        if store.size(MARK_FILE) is not None:  # somebody else has made it since, and removed what a queue does not keep
            return open_queue(url)
        raise InputError(f"--queue: {error}".replace("--out", "--queue")) from error
    store.put_if_absent(MARK_FILE, _encode(Mark(nonce=uuid.uuid4().hex)))
    for folder in (COMMITS, RANGES, MANIFEST):  # of a dataset, to which the same store belongs
        store.remove_empty(folder)
    return Queue(store)


class Mark(Frozen):
    """`queue.json`."""

    queue: int = 1
    nonce: str


def new_id() -> str:
    """An id for a new job."""
    return f"j{uuid.uuid4().hex[:8]}"


def _encode(model: Frozen) -> bytes:
    return json.dumps(model.model_dump(mode="json"), ensure_ascii=False).encode() + b"\n"


def _decode(model: type[Model], data: bytes, name: str) -> Model:
    """A stored model. Raises CorruptError naming the file, with one line."""
    if len(data) > MOST_BYTES:
        raise CorruptError(f"{name} has {len(data)} bytes, and should have less than {MOST_BYTES}")
    try:
        tree = json.loads(data)
        version = tree.get("queue", 1) if isinstance(tree, dict) else 1
        if isinstance(version, int) and version > 1:
            raise CorruptError(
                f"{name}: queue: {version} is newer than this program, which reads 1: install a newer Verso"
            )
        return model.model_validate(tree)
    except ValueError as error:  # of JSON or of the model
        raise CorruptError(f"{name} was not written by this program: {plain_line(str(error), 200)}") from error
