"""What a supervisor does next, from the states of all jobs and what Ray says of their drivers. Pure."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from schemas.queue import submission_id
from services.queue.fold import JobView


class Driver(NamedTuple):
    """A driver as Ray's job API knows it: it waits or runs, or it has ended in any way; and Ray's words for that."""

    state: Literal["running", "over"]
    said: str = ""


PAUSES_S: Final = (10.0, 60.0, 300.0)
"""Before a job is taken up again after its first, second and third death."""

BUSY_PAUSE_S: Final = 30.0
"""Before a driver looks again whether another run has left the output folder."""

Deed = Literal["start", "hand over", "stop", "note death", "note stop"]
"""start: decide on a new attempt. hand over: give the driver of the decided attempt to Ray. stop: ask Ray to end it."""


@dataclass(frozen=True)
class Action:
    """One thing to do about one job."""

    deed: Deed
    job: str
    attempt: int
    note: str = ""


def tend_drivers(views: Sequence[JobView], drivers: Mapping[str, Driver]) -> list[Action]:
    """What to do about jobs that have a driver, or should have one; `drivers` by submission id, as Ray knows them."""
    return [action for view in views if view.held and (action := _tend(view, drivers)) is not None]


def _tend(view: JobView, drivers: Mapping[str, Driver]) -> Action | None:
    job, attempt = view.request.id, view.attempt
    found = drivers.get(submission_id(job, attempt))
    if view.state == "cancelling":
        return Action("stop" if found is not None and found.state == "running" else "note stop", job, attempt)
    if found is not None and found.state == "running":
        return None
    if found is not None:
        said = f" ({found.said})" if found.said else ""
        return Action("note death", job, attempt, f"its driver ended without telling how{said}")
    if view.began:
        return Action("note death", job, attempt, "Ray does not know its driver any more")
    return Action("hand over", job, attempt)  # the supervisor was killed in between, or Ray forgot it


def choose_starts(
    views: Sequence[JobView], at_once: int, is_due: Callable[[JobView], bool] = lambda view: True
) -> list[Action]:
    """The jobs whose turn it is, by priority and then by age, while fewer than `at_once` have a driver.

    A job waits while another that began earlier in its output folder has not ended. `is_due` tells whether a pause is over.
    """
    room = at_once - sum(view.held for view in views)
    taken = {view.request.out for view in views if view.claims_folder}
    chosen: list[Action] = []
    for view in sorted((view for view in views if view.state in ("queued", "waiting")), key=turn):
        own = view.claims_folder
        if room <= len(chosen) or not is_due(view) or (view.request.out in taken and not own):
            continue
        taken.add(view.request.out)
        chosen.append(Action("start", view.request.id, view.attempt + 1))
    return chosen


def turn(view: JobView) -> tuple[int, float, str]:
    """Sorts jobs by their turn."""
    return -view.request.priority, view.request.submitted, view.request.id


def pause_of(view: JobView) -> float:
    """Seconds that a job rests before it is taken up again."""
    if view.state == "waiting":
        return BUSY_PAUSE_S
    return PAUSES_S[min(view.deaths, len(PAUSES_S)) - 1] if view.deaths else 0.0


def waiting_for_folder(views: Sequence[JobView]) -> Collection[str]:
    """Ids of queued jobs whose output folder another job works in."""
    taken = {view.request.out: view.request.id for view in views if view.claims_folder}
    return {
        view.request.id
        for view in views
        if view.state == "queued" and taken.get(view.request.out, view.request.id) != view.request.id
    }
