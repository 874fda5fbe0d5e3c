"""The state of a job of the queue: the fold of its events. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

from schemas.queue import JobEvent, JobRequest

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
    busy: int = 0
    """How often a driver found another run in the output folder, since one last began without."""
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
    if event.kind == "started":
        return replace(view, state="running", attempt=event.attempt, began=False, note="")
    if event.kind == "began":
        return replace(view, began=True)
    if event.kind == "cancel":
        return replace(view, state="cancelling" if view.held else "cancelled", note=event.note)
    if event.kind == "stopped":
        return replace(view, state="cancelled")
    if event.kind == "busy":
        state: JobState = "cancelled" if view.state == "cancelling" else "waiting"
        return replace(view, state=state, busy=view.busy + 1, note=event.note)
    if event.kind == "died":
        return _after_death(view, event)
    return _after_end(view, event)


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
    if event.kind == "stopped":
        return view.state == "cancelling"
    return event.kind == "died" or view.began


def _after_death(view: JobView, event: JobEvent) -> JobView:
    """The job whose driver is gone: it is to be taken up again, unless it was cancelled or that happened too often."""
    deaths = view.deaths + 1
    state: JobState = "cancelled" if view.state == "cancelling" else "lost" if deaths > RESTARTS else "queued"
    return replace(view, state=state, deaths=deaths, note=event.note)


def _after_end(view: JobView, event: JobEvent) -> JobView:
    """The job whose driver told its end: a cancelled one that was finished in time is done."""
    state: JobState = "done" if event.code == 0 else "cancelled" if view.state == "cancelling" else "failed"
    return replace(
        view, state=state, code=event.code, note=event.note, scenes=event.scenes, digest=event.digest, busy=0
    )
