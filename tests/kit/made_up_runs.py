"""What a coordinator with one worker does to a dataset of made-up scenes, and what must be true of the result."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import cast

import pytest

from schemas.dataset.commit import CommitTerms
from schemas.dataset.layout import STAGING
from schemas.dataset.shard import ShardOrder
from schemas.scene.scene import SceneOutput
from services.job.job_file import validate_job
from services.merge.merge import merge
from services.merge.tables import MergeResult
from services.run import coordinator
from services.run.coordinator import Coordinator, Limits
from services.run.lock import Lock
from services.run.progress import Tally
from services.run.range_planner import plan_ranges, plan_retries
from services.run.ray_cluster import Slots
from services.run.worker_entry import Pattern, WorkerTerms
from tests.made_up_scenes import attempt_at, failed_scene, small_scene, terms
from workers.assets.catalogue import Catalogue
from workers.store.attempt import sweep
from workers.store.ledger import list_commits
from workers.store.store import Store

FIRST, STOP, RANGE = 4, 7, 2
LABEL = "ours"


def settings_of(layout: str) -> CommitTerms:
    return terms(layout=layout, first_scene=FIRST, range_size=RANGE)


def make_dataset(
    store: Store,
    layout: str = "files",
    stop: int = STOP,
    make: Callable[[int], SceneOutput] = small_scene,
    retry: bool = False,
    lock: Lock | None = None,
) -> MergeResult:
    """Clears up, makes what is missing, tries failures again where asked to, and merges."""
    store.prepare()
    sweep(store, fenced=None)
    for start, end in plan_ranges(FIRST, stop, RANGE, list_commits(store).ranges):
        attempt_at(store, start, end, settings_of(layout), make).commit()
    for span in plan_retries(list_commits(store)) if retry else ():
        again = {"retry": span.retry, "scenes": span.scenes}
        attempt_at(store, span.start, span.stop, settings_of(layout), make, **again).commit()
    return merge(store, FIRST, stop, *([lock.require_held] if lock else []))


def half_merged(store: Store, layout: str = "files") -> None:
    """Two ranges and a retry of a scene that was killed; the first range was merged before the others came."""

    def first_try(scene_id: int) -> SceneOutput:  # its file of failures has no successor after the retry
        return failed_scene(scene_id, "environmental") if scene_id == 1 else small_scene(scene_id)

    settings = terms(layout=layout, range_size=2)
    store.prepare()
    attempt_at(store, 0, 2, settings, first_try).commit()
    merge(store, 0, 2)
    attempt_at(store, 0, 2, settings, small_scene, retry=1, scenes=(1,)).commit()
    attempt_at(store, 2, 4, settings, small_scene).commit()


def coordinator_of(
    store: Store, patch: pytest.MonkeyPatch, slots: Slots | None = None, attempts: int = 3
) -> Coordinator:
    """A coordinator without Ray, that knows attempts with `LABEL` as its own and bears no failed scene."""
    patch.setattr(coordinator.ray, "put", lambda value: value)
    order = ShardOrder.of(store.name, validate_job({"name": "made-up", "scenes": 8}, "test"), "j" * 64)
    pattern = Pattern(order, cast(Catalogue, None), WorkerTerms((), "", ""))
    made = Coordinator(store, pattern, Limits(slots or Slots(1, 1), attempts, 0), Tally(asked=8))
    made._order = order.model_copy(update={"label": LABEL})
    return made


def contents_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "nothing"


def contents(root: Path) -> dict[str, str]:
    """Every file and its digest, but for what names an attempt or a time."""
    files = [path for path in root.rglob("*") if path.is_file()]
    found = {str(path.relative_to(root)): contents_of(path) for path in files}
    varying = ("manifest/_commits/", "manifest/timings/", "manifest/_ranges/", "_SUCCESS")
    return {name: "" if name.startswith(varying) else digest for name, digest in found.items()}


def leftovers(root: Path) -> list[str]:
    return [str(path) for path in (root / STAGING).rglob("*") if path.is_file() or path.parent.name.isdigit()]


def broken_promises(root: Path) -> list[str]:
    """What `_SUCCESS`, if it is there, says of files and is not so."""
    success = root / "_SUCCESS"
    if not success.exists():
        return []
    files = json.loads(success.read_text())["files"]
    return [name for name, file in files.items() if file["sha256"] != contents_of(root / name)]
