"""Follows a dataset for the live page: a thread that looks every few seconds and keeps the newest answers ready."""

import threading
import time
from collections import OrderedDict

from schemas.errors import VersoError
from services.read.damage import explain_damage
from services.report.live import live_html, title_of
from services.report.page import Section
from services.report.pictures import Picture
from services.report.progress import Progress, latest_scenes, read_progress
from services.report.report import page_of, read_report
from services.report.sample import ShownScene
from services.report.view import View
from workers.store.store import Store

LOOK_S = 2.0
"""Seconds between two looks, and at least four times as long as a look takes."""

REPORT_S = 10.0
"""Fewest seconds between two reports of a dataset that grows, and at least ten times as long as one takes."""

SHELF_BYTES = 96_000_000
"""Pictures of earlier looks that a page may still ask for."""


class PictureShelf:
    """Pictures by name; the oldest go where there are too many."""

    def __init__(self, most_bytes: int = SHELF_BYTES) -> None:
        self._most, self._bytes, self._lock = most_bytes, 0, threading.Lock()
        self._pictures: OrderedDict[str, Picture] = OrderedDict()

    def put(self, picture: Picture) -> str:
        """Keeps a picture; returns its address on the server."""
        with self._lock:
            if picture.name not in self._pictures:
                self._bytes += len(picture.data)
            self._pictures[picture.name] = picture
            self._pictures.move_to_end(picture.name)
            while self._bytes > self._most and len(self._pictures) > 1:
                self._bytes -= len(self._pictures.popitem(last=False)[1].data)
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
            self._thread.join(10)

    def look(self) -> None:
        """One look at the folder, without the report."""
        progress = read_progress(self._store)
        if progress.done != self._shown.done or progress.phase != self._shown.phase:
            self._latest = self._read_latest() if progress.phase in ("making", "stopped", "finished") else []
        self._shown = progress
        self._publish()

    def report(self) -> None:
        """Makes the sections anew where the dataset has changed and the last time is long enough ago."""
        progress, now = self._shown, time.monotonic()
        about = (progress.done, progress.phase)
        if about == self._reported or now < self._not_before:
            return
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

    def _read_latest(self) -> list[ShownScene]:
        try:
            with explain_damage(self._store):
                return latest_scenes(self._store)
        except VersoError:  # told by the progress
            return []

    def _read_sections(self) -> tuple[Section, ...] | None:
        """The sections of a report; None where a file is being moved or merged just now."""
        try:
            with explain_damage(self._store):
                page = page_of(read_report(self._store, self._scenes), self.shelf.put)
        except VersoError:
            return None
        return tuple(page.sections)
