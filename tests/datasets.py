"""Small datasets made in this process, without Ray, for tests of the rows and files of whole scenes."""

from pathlib import Path
from typing import Any

import obstore
from obstore.store import MemoryStore

from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE
from schemas.dataset.shard import ShardOrder
from schemas.job.job import Job
from services.job.job_file import validate_job
from services.job.record import encode_job, record_job
from services.merge.merge import merge
from services.merge.tables import write_card
from services.read.verify import verify
from services.run.range_planner import plan_spans
from workers.capture.results import open_sources
from workers.scene.context import open_worker
from workers.shard.fingerprint import take_fingerprint
from workers.shard.run_shard import run_scene
from workers.stopwatch import Stopwatch
from workers.store.attempt import begin_attempt
from workers.store.ledger import list_commits
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

SMALL: dict[str, Any] = {
    "name": "small",
    "seed": 11,
    "scenes": 2,
    "cameras": {"sensor": {"width": 160, "height": 120, "fx": 131.25, "fy": 131.25, "cx": 80.0, "cy": 60.0}},
    "images": {"patch": {"width": 32, "height": 24}},
    "check": {"raycast_share": 0.0, "mirror_agreement_mm": 5.0},
}

LOOK: dict[str, Any] = {
    "recolour": "packaging",
    "room": True,
    "clutter": {"count": 2},
    "floor": {"colours": [[0.4, 0.4, 0.4], [0.6, 0.5, 0.4]]},
    "lights": {},
    "environment": {"built_in": ["overcast", "window_room"]},
}
"""Light and surroundings, drawn for each scene."""


def overlaid(tree: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A tree of settings merged with changes, branch by branch."""
    merged = dict(tree)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = overlaid(merged[key], value) if both else value
    return merged


def make_dataset(out: Path, **changes: Any) -> tuple[LocalStore, str]:
    """(the finished dataset of `SMALL` with these changes, as one run would leave it; its digest)."""
    return run_here(validate_job(overlaid(SMALL, changes), "test"), out)


def run_here(job: Job, out: Path, folder: Path = Path()) -> tuple[LocalStore, str]:
    """(the finished dataset of a job file in `folder`, as one run would leave it; its digest)."""
    catalogue = open_sources(job, folder)
    context = open_worker(job, catalogue)
    store = LocalStore(out)
    store.prepare()
    record = record_job(job, catalogue.digest, folder, tuple(one.sha256 for one in catalogue.captures))
    store.put(JOB_FILE, encode_job(record))
    fingerprint = take_fingerprint(context.renderer, job.drawn.tier)
    store.put_if_absent(FINGERPRINT_FILE, fingerprint.model_dump_json(indent=1).encode())
    terms = ShardOrder.of(str(out), job, record.digest).terms.model_copy(update={"fingerprint": fingerprint.digest})
    for span in plan_spans(job, list_commits(store), False):
        attempt = begin_attempt(store, span, terms)
        for scene_id in span.scene_ids:
            attempt.begin_scene(scene_id)
            attempt.add_scene(run_scene(context, scene_id, Stopwatch()))
        attempt.commit()
    merged = merge(store, job.first_scene, job.stop_scene)
    write_card(store, record, catalogue, merged)
    return store, merged.digest


def faults_of(store: LocalStore) -> list[str]:
    """The faults that `verso verify` finds."""
    return verify(store, lambda _: None).faults


def images_of(store: LocalStore) -> dict[str, bytes]:
    """Every image and patch by path."""
    paths = [path for path in Path(store.root).rglob("*.png") if "_staging" not in path.parts]
    return {str(path.relative_to(store.root)): path.read_bytes() for path in paths}


def in_a_bucket(root: Path, kind: type[ObjectStore] = ObjectStore) -> ObjectStore:
    """The same files in a bucket in memory."""
    bucket = MemoryStore()
    for path in (path for path in root.rglob("*") if path.is_file() and "_staging" not in path.parts):
        obstore.put(bucket, path.relative_to(root).as_posix(), path)
    return kind(bucket, "memory://bucket")
