"""Small datasets made in this process, without Ray, for tests of the rows and files of whole scenes."""

from pathlib import Path
from typing import Any

from schemas.dataset.commit import CommitTerms, Span
from schemas.dataset.layout import FINGERPRINT_FILE, JOB_FILE
from services.job.read import validate_job
from services.job.record import encode_job, record_job
from services.merge.step import merge
from services.read.verify import verify
from workers.assets.catalogue import open_catalogue
from workers.pipeline.context import open_worker
from workers.pipeline.fingerprint import take_fingerprint
from workers.pipeline.run_shard import run_scene
from workers.pipeline.stopwatch import Stopwatch
from workers.store.attempt import begin_attempt
from workers.store.local import LocalStore

SMALL: dict[str, Any] = {
    "name": "small",
    "seed": 11,
    "scenes": 2,
    "cameras": {"sensor": {"width": 160, "height": 120, "fx": 131.25, "fy": 131.25, "cx": 80.0, "cy": 60.0}},
    "images": {"patch": {"width": 32, "height": 24}},
    "check": {"raycast_share": 0.0, "mirror_agreement_mm": 5.0},
}


def overlaid(tree: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A tree of settings merged with changes, branch by branch."""
    merged = dict(tree)
    for key, value in changes.items():
        both = isinstance(value, dict) and isinstance(merged.get(key), dict)
        merged[key] = overlaid(merged[key], value) if both else value
    return merged


def make_dataset(out: Path, **changes: Any) -> tuple[LocalStore, str]:
    """(the finished dataset of `SMALL` with these changes, as one range; its digest)."""
    job = validate_job(overlaid(SMALL, changes), "test")
    catalogue = open_catalogue(job.assets, Path(), tuple(job.categories))
    context = open_worker(job, catalogue)
    store = LocalStore(out)
    store.prepare()
    store.write_whole(JOB_FILE, encode_job(record_job(job, catalogue.digest, Path())))
    fingerprint = take_fingerprint(context.renderer, job.render.tier)
    store.put_if_absent(FINGERPRINT_FILE, fingerprint.model_dump_json().encode())
    terms = CommitTerms(
        job_digest="j" * 64, fingerprint=fingerprint.digest, range_size=job.scenes, layout=job.output.layout
    )
    attempt = begin_attempt(store, Span(start=0, stop=job.scenes), terms)
    for scene_id in attempt.span.scene_ids:
        attempt.begin_scene(scene_id)
        attempt.add_scene(run_scene(context, scene_id, Stopwatch()))
    attempt.commit()
    return store, merge(store, 0, job.scenes).digest


def faults_of(store: LocalStore) -> list[str]:
    """The faults that `verso verify` finds."""
    return verify(store, lambda _: None).faults


def images_of(store: LocalStore) -> dict[str, bytes]:
    """Every image and patch by path."""
    paths = [path for path in Path(store.root).rglob("*.png") if "_staging" not in path.parts]
    return {str(path.relative_to(store.root)): path.read_bytes() for path in paths}
