"""How far a dataset is: an empty folder, one being made, one that stands still, one that is finished."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from schemas.dataset.layout import commit_path
from schemas.errors import OutputError, VersoError
from services.job.record import read_job
from services.read.damage import explain_damage
from services.read.dataset_reader import file_reader, read_stored
from services.read.status import Status, read_status
from services.report.histogram import Histogram
from services.report.sample import DEPTH_M, ShownScene, show_scene
from services.run.lock import shows_life
from workers.store.commit import list_codes, split_code
from workers.store.ledger import read_range
from workers.store.store import Store

Phase = Literal["empty", "making", "stopped", "finished", "unreadable"]

LATEST = 4
"""Scenes whose pictures the live page shows."""

LOOKS = 64
"""Ranges at the end of the dataset among which the latest are looked for."""


@dataclass(frozen=True)
class Progress:
    """What a person who waits wants to know."""

    phase: Phase
    name: str = ""
    """Of the job."""
    asked: int = 0
    made: int = 0
    failed: Mapping[str, int] = field(default_factory=dict)
    """By `kind: reason`."""
    scenes_per_s: float | None = None
    """Of the latest commits; None where nothing runs."""
    left_s: float | None = None
    running: tuple[int, ...] = ()
    """Scenes in progress."""
    told: tuple[str, ...] = ()
    """What is wrong with the folder, a sentence each."""

    @property
    def done(self) -> int:
        """Scenes made or failed."""
        return self.made + sum(self.failed.values())


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
                return Progress("empty", job.name, job.scenes)
            lives = status.holder is not None and shows_life(store, status.holder)
    except VersoError as error:
        return Progress("unreadable", told=(str(error),))
    return progress_of(job.name, status, lives)


def progress_of(name: str, status: Status, lives: bool) -> Progress:
    """The progress in a status; `lives`: whether a run shows life."""
    begun = status.made or status.failed or status.lost
    ended: Phase = "finished" if status.digest and not status.missing else "stopped" if begun else "empty"
    phase: Phase = "making" if lives else ended
    rate = status.scenes_per_s if lives else None
    return Progress(
        phase,
        name,
        status.asked,
        status.made,
        status.failed,
        rate,
        status.missing / rate if rate else None,
        tuple(one.scene_id for one in status.running if lives and one.scene_id is not None),
        status.lost,
    )


def latest_scenes(store: Store, count: int = LATEST) -> list[ShownScene]:
    """The scenes of the newest commits, the newest first; those that cannot be read just now are left out."""
    codes = [split_code(code) for code in list_codes(store)[-LOOKS:]]
    found = {start: store.stat(commit_path(start, retry)) for start, retry in codes}
    written = {start: entry.modified_s if entry else 0.0 for start, entry in found.items()}
    shown: list[ShownScene] = []
    for start in sorted(written, key=lambda start: (-written[start], -start)):
        if len(shown) >= count:
            break
        try:
            stored = read_stored(store, read_range(store, start, [retry for one, retry in codes if one == start]))
            read, depth = file_reader(store.read, stored), {role: Histogram(*DEPTH_M) for role in ("input", "mirror")}
            for row in stored.rows["scenes"][: -(count - len(shown)) - 1 : -1]:
                shown.append(show_scene(read, stored, row, depth))
        except VersoError:  # committed a moment ago and not in its place yet, or damaged, which the report tells
            continue
    return shown
