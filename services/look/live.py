"""The live page: how far a dataset is, what the page shows of it, and a thread that follows it."""

import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from html import escape
from typing import Literal

from cachetools import LRUCache

from schemas.dataset.layout import commit_path
from schemas.errors import OutputError, VersoError, describe_seconds, number, plural
from services.dataset.dataset import Dataset
from services.job.record import read_job
from services.look.charts import DEPTH_M, Histogram
from services.look.pictures import PLAIN, SHOWN_ROLES, Picture, ShownScene, show_pair
from services.look.report import Section, View, page_of, read_report
from services.look.sheets import Address, strip_html
from services.read.status import Status, read_status
from services.read.verdict import explain_damage
from services.run.lock import shows_life
from workers.store.commit import list_codes, split_code
from workers.store.ledger import read_range
from workers.store.store import Store

Phase = Literal["empty", "making", "stopped", "finished", "unreadable"]

LATEST = 4
"""Scenes whose pictures the live page shows."""

LOOKS = 64
"""Ranges at the end of the dataset among which the latest are looked for."""


NOTHING = Status(0, 0, {}, 0, None, None, (), None)


@dataclass(frozen=True)
class Progress:
    """What a person who waits wants to know."""

    phase: Phase
    name: str = ""
    """Of the job."""
    status: Status = NOTHING
    damage: str = ""
    """Why the folder cannot be read."""

    @property
    def done(self) -> int:
        """Scenes made or failed."""
        return self.status.made + sum(self.status.failed.values())


def read_progress(store: Store) -> Progress:
    """The progress of a folder; never raises for what the folder holds."""
    try:
        with explain_damage(store):
            record = read_job(store)
            if record is None:
                return Progress("empty")
            job = record.job
            try:
                status = read_status(store, job.first_scene, job.stop_scene)
            except OutputError:  # the job is written, and nothing is begun
                return Progress("empty", job.name, replace(NOTHING, asked=job.scenes))
            lives = status.holder is not None and shows_life(store, status.holder)
    except VersoError as error:
        return Progress("unreadable", damage=str(error))
    if lives:
        return Progress("making", job.name, status)
    begun = status.made or status.failed or status.lost
    return Progress(
        "finished" if status.digest and not status.missing else "stopped" if begun else "empty", job.name, status
    )


def latest_scenes(store: Store, count: int = LATEST) -> list[ShownScene]:
    """The scenes of the newest commits, the newest first; those that cannot be read just now are left out."""
    codes = [split_code(code) for code in list_codes(store)[-LOOKS:]]
    entries = {start: store.stat(commit_path(start, retry)) for start, retry in codes}
    written = {start: entry.modified_s if entry else 0.0 for start, entry in entries.items()}
    shown: list[ShownScene] = []
    dataset, depth = Dataset(store), {role: Histogram(*DEPTH_M) for role in SHOWN_ROLES}
    for start in sorted(written, key=lambda start: (-written[start], -start)):
        # Committed a moment ago and not in its place yet, or damaged, which the report tells.
        with suppress(VersoError):
            (first, *_) = read_range(store, start, [retry for begun, retry in codes if begun == start])
            for scene_id in reversed(first.span.scene_ids):
                if len(shown) < count and (pairs := dataset.scene(scene_id)):
                    shown.append(show_pair(pairs[0], depth, PLAIN))
        if len(shown) == count:
            break
    return shown


STATES: dict[Phase, str] = {
    "empty": "Waiting for a job",
    "making": "Making scenes",
    "stopped": "Stopped",
    "finished": "Finished",
    "unreadable": "Cannot be read",
}


def live_html(progress: Progress, latest: Sequence[ShownScene], address: Address) -> str:
    """The contents of the live section."""
    failed = [f"{count:,} failed, {reason.replace('_', ' ')}" for reason, count in progress.status.failed.items()]
    wrong = [*([progress.damage] if progress.damage else ()), *progress.status.lost, *failed]
    troubles = f'<ul class="troubles">{"".join(f"<li>{escape(line)}</li>" for line in wrong)}</ul>' if wrong else ""
    pictures = "".join(strip_html(scene, address) for scene in latest)
    return _state(progress) + troubles + (f'<div class="latest">{pictures}</div>' if pictures else "")


def title_of(progress: Progress) -> str:
    """The title of the window: the share that is done, and the job."""
    share = f"{progress.done / max(progress.status.asked, 1):.0%} · " if progress.phase == "making" else ""
    return f"{share}{progress.name or 'Verso'}"


def _state(progress: Progress) -> str:
    state, status = f'<span class="state {progress.phase}">{STATES[progress.phase]}</span>', progress.status
    asked = plural(status.asked, "scene")
    if progress.phase == "empty":
        job = f"The job {progress.name} asks for {asked}." if progress.name else "There is no job yet."
        return f'<p class="lead">{state}</p><p class="empty">{escape(job)} This page follows the folder.</p>'
    if progress.phase == "unreadable":
        return f'<p class="lead">{state}</p>'
    facts = [f"{progress.done:,} of {asked}", f"{sum(status.failed.values()):,} failed"]
    if progress.phase == "making":
        if status.scenes_per_s:
            facts.append(f"{number(float(f'{status.scenes_per_s:.2g}'))} a second")
            facts.append(f"{describe_seconds(status.missing / status.scenes_per_s)} left")
        running = [str(run.scene_id) for run in status.running if run.scene_id is not None]
        if running:
            facts.append(f"now at {', '.join(running[:4])}{' and more' if len(running) > 4 else ''}")
    bar = f'<progress max="{max(status.asked, 1)}" value="{progress.done}" aria-label="Scenes done"></progress>'
    return f'<p class="lead">{state} {escape(" · ".join(facts))}</p>{bar}'


LOOK_S = 2.0
"""Seconds between two looks, and at least four times as long as a look takes."""

REPORT_S = 10.0
"""Fewest seconds between two reports of a dataset that grows, and at least ten times as long as one takes."""

SHELF_BYTES = 96_000_000
"""Pictures of earlier looks that a page may still ask for."""


class PictureShelf:
    """Pictures by name; those that were not asked for the longest go where there are too many."""

    def __init__(self, most_bytes: int = SHELF_BYTES) -> None:
        self._lock = threading.Lock()
        self._pictures: LRUCache[str, Picture] = LRUCache(most_bytes, lambda picture: len(picture.data))

    def put(self, picture: Picture) -> str:
        """Keeps a picture; returns its address on the server."""
        with self._lock:
            self._pictures[picture.name] = picture
        return f"/picture/{picture.name}"

    def get(self, name: str) -> Picture | None:
        """The picture of a name, None where it is not kept."""
        with self._lock:
            return self._pictures.get(name)


class Follower:
    """Keeps the `view` of a folder up to date, in a thread of its own between `start` and `stop`."""

    def __init__(self, store: Store, scenes: int) -> None:
        self.shelf = PictureShelf()
        self._store, self._scenes = store, scenes
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="follower", daemon=True)
        self._latest: list[ShownScene] = []
        self._sections: tuple[Section, ...] = ()
        self._version, self._reported, self._not_before = 0, (-1, ""), 0.0
        self._tried: str = ""
        """The phase at the last try of a report."""
        self._shown = Progress("empty")
        self.view = View("Verso", "Verso", live_html(self._shown, (), self.shelf.put), (), 0)

    def start(self) -> None:
        """Looks once, so that the first page has something to show, and goes on in the thread."""
        self.look()
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread, after the look that it is at."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(30)

    def look(self) -> None:
        """One look at the folder, without the report."""
        progress = read_progress(self._store)
        if progress.done != self._shown.done or progress.phase != self._shown.phase:
            self._latest = []
            # Damage is told by the progress.
            with suppress(VersoError), explain_damage(self._store):
                self._latest = latest_scenes(self._store) if progress.done else []
        self._shown = progress
        self._publish()

    def report(self) -> None:
        """Makes the sections anew where the dataset has changed and the last time is long enough ago."""
        progress, now = self._shown, time.monotonic()
        about = (progress.done, progress.phase)
        ended = progress.phase not in ("making", self._tried)  # nothing newer comes, so it need not wait
        if about == self._reported or (now < self._not_before and not ended):
            return
        self._tried = progress.phase
        sections = self._read_sections() if progress.done else ()
        self._not_before = time.monotonic() + max(REPORT_S, 10.0 * (time.monotonic() - now))
        if sections is not None:
            self._reported = about
            if sections != self._sections:
                self._sections, self._version = sections, self._version + 1
                self._publish()

    def _run(self) -> None:
        pause = 0.0
        while not self._ended.wait(pause):
            began = time.monotonic()
            self.look()
            looked = time.monotonic() - began
            self.report()
            pause = max(LOOK_S, 4.0 * looked)

    def _publish(self) -> None:
        live = live_html(self._shown, self._latest, self.shelf.put)
        self.view = View(self._shown.name or "Verso", title_of(self._shown), live, self._sections, self._version)

    def _read_sections(self) -> tuple[Section, ...] | None:
        """The sections of a report; None where a file is being moved or merged just now."""
        with suppress(VersoError), explain_damage(self._store):
            return tuple(page_of(read_report(self._store, self._scenes), self.shelf.put).sections)
        return None
