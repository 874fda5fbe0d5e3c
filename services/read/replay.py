"""`verso replay`: makes scenes again from their job, and compares them with what is stored."""

from dataclasses import dataclass

import numpy as np

from schemas.dataset.layout import (
    FINGERPRINT_FILE,
    JOB_FILE,
    is_glb,
    is_shape,
)
from schemas.dataset.shard import Fingerprint
from schemas.dataset.tables import DETERMINISTIC_TABLES, SCHEMAS, SORT_KEYS
from schemas.errors import CorruptError
from schemas.job.job import job_digest
from schemas.scene.scene import SceneOutput
from services.job.record import JobRecord, require_job
from services.read.dataset_reader import StoredRange, committed_reader, decode_samples, file_reader, find_scene
from services.read.scene_geometry import open_recorded
from workers.scene.context import WorkerContext, open_worker
from workers.shard.fingerprint import take_fingerprint
from workers.shard.run_shard import run_scene
from workers.stopwatch import Stopwatch
from workers.store.images import decode_png
from workers.store.manifest import files_of_rows, table_of_rows
from workers.store.store import Store

DEPTH_UNITS = 2
"""Tolerance of depth on another stack: depth may round the other way, and a rest pose may differ in its last bits."""

PIXEL_SHARE = 0.002
"""Tolerated share of pixels that differ by more on another stack: pixels at silhouettes."""

RGB_STEPS = 3
"""Tolerance of a colour on another stack, of 255 steps."""

SAMPLE_STEP = 1e-6
"""Tolerance of a shape's samples on another stack, metres for points."""


@dataclass(frozen=True)
class Replay:
    """The result of making a scene again."""

    same_stack: bool
    compared: int
    """Number of files and tables that were compared."""
    differences: tuple[str, ...]


def replay_scene(store: Store, scene_id: int) -> Replay:
    """Make one scene again and compare its files and rows: to the byte on the same stack, within tolerances on another.

    Raises CorruptError where job.yaml is not the job of the scene's commit.
    """
    record, stored = require_job(store), find_scene(store, scene_id)
    if job_digest(record.job, record.catalogue) not in {one.terms.job_digest for one in stored.records}:
        raise CorruptError(
            f"{store.name}/{JOB_FILE} is not the job that scene {scene_id} was made from: restore it from a copy"
        )
    context = open_context(record)
    same_stack = is_same_stack(store, context)
    output = run_scene(context, scene_id, Stopwatch())
    differences = compare_files(store, stored, output, same_stack)
    if same_stack:
        differences += compare_rows(stored, output)
    return Replay(same_stack, len(output.files) + (len(DETERMINISTIC_TABLES) if same_stack else 0), tuple(differences))


def open_context(record: JobRecord) -> WorkerContext:
    """The context that makes a stored job's scenes here. Raises MachineError where the assets have changed."""
    return open_worker(record.job, open_recorded(record))


def is_same_stack(store: Store, context: WorkerContext) -> bool:
    """Whether the stack of a dataset's first worker is this one."""
    theirs = Fingerprint.model_validate_json(store.read(FINGERPRINT_FILE))
    return take_fingerprint(context.renderer, context.job.drawn.tier) == theirs


def compare_files(store: Store, stored: StoredRange, output: SceneOutput, same_stack: bool) -> list[str]:
    """Differences of a scene's new images and samples from the stored ones, a sentence each."""
    used = {row["instance_id"] for row in output.rows.get("assets", [])}
    rows = {
        "views": [view for view in stored.rows["views"] if view["scene_id"] == output.scene_id],
        "assets": [asset for asset in stored.rows["assets"] if asset["instance_id"] in used],
    }
    scene_files = {file["path"]: file["sha256"] for file in files_of_rows(rows)}
    made = {file.path: file for file in output.files if not is_glb(file.path)}
    only = sorted(made.keys() ^ scene_files.keys())
    differences = [f"{path}: only {'stored' if path in scene_files else 'made now'}" for path in only]
    read = file_reader(committed_reader(store, stored.records), stored.records)
    for path in sorted(made.keys() & scene_files.keys()):
        if made[path].sha256 == scene_files[path]:
            continue
        compare = _compare_samples if is_shape(path) else _compare_pixels
        within, how = compare(read(path), made[path].data, path)
        if same_stack or not within:
            differences.append(f"{path}: {how}")
    return differences


def _compare_pixels(before: bytes, now: bytes, path: str) -> tuple[bool, str]:
    """(whether two images agree within the tolerances of another stack, how they differ)."""
    a, b = decode_png(before, path), decode_png(now, path)
    if a.shape != b.shape or a.dtype != b.dtype:
        return False, f"was {a.dtype} {a.shape}, is {b.dtype} {b.shape}"
    gap = np.abs(a.astype(np.int64) - b.astype(np.int64))
    allowed = DEPTH_UNITS if a.dtype == np.uint16 else RGB_STEPS if a.ndim == 3 else 0
    share = float((gap > allowed).mean())
    return share <= PIXEL_SHARE, f"{share:.4%} of its values differ by more than {allowed}, at most {gap.max()}"


def _compare_samples(before: bytes, now: bytes, path: str) -> tuple[bool, str]:
    """The same for the samples of a shape."""
    a, b = decode_samples(before, path), decode_samples(now, path)
    if a.keys() != b.keys() or any(a[name].shape != b[name].shape for name in a):
        return False, f"has {', '.join(a)}, and now {', '.join(b)}"
    share = max(float((np.abs(a[name].astype(np.float64) - b[name]) > SAMPLE_STEP).mean()) for name in a)
    return share <= PIXEL_SHARE, f"{share:.4%} of an array's values differ by more than {SAMPLE_STEP}"


def compare_rows(stored: StoredRange, output: SceneOutput, ignored: frozenset[str] = frozenset()) -> list[str]:
    """Differences of a scene's new rows from the stored ones in all columns but `ignored`, a sentence each; rows pair by key."""
    differences = []
    for table in DETERMINISTIC_TABLES:
        made = output.rows.get(table, [])
        key = "instance_id" if table == "assets" else "scene_id"
        wanted = {row["instance_id"] for row in made} if table == "assets" else {output.scene_id}
        before, now = (
            {tuple(row[name] for name in SORT_KEYS[table]): row for row in rows}
            for rows in (
                [row for row in stored.rows[table] if row[key] in wanted],
                table_of_rows(table, made).to_pylist(),
            )
        )
        phrases = [f"{len(before)} stored, {len(now)} made now"] if before.keys() != now.keys() else []
        names = [name for name in SCHEMAS[table].names if name not in ignored]
        both = [(before[one], now[one]) for one in before.keys() & now.keys()]
        phrases += [name for name in sorted(names) if any(repr(a.get(name)) != repr(b.get(name)) for a, b in both)]
        if phrases:
            differences.append(f"rows of {table}: {', '.join(phrases)}")
    return differences
