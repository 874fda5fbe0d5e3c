"""`verso verify`: every file against its checksum, every label against what it follows from."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from schemas.dataset.codec import Row
from schemas.dataset.layout import ASSETS, MANIFEST, stored_roles
from schemas.errors import CorruptError
from schemas.job.job import Job
from services.job.record import require_job
from services.merge.step import read_success
from services.read.dataset_reader import StoredRange, file_reader, iter_stored, read_image
from workers.pipeline.allocator import keep_freed_memory
from workers.pipeline.check_stored import check_stored_pair, check_stored_scene
from workers.store.store import Store


@dataclass
class Verdict:
    """What was read, and what is off, a sentence each."""

    files: int = 0
    bytes: int = 0
    scenes: int = 0
    pairs: int = 0
    faults: list[str] = field(default_factory=list)


def verify(store: Store, progress: Callable[[Verdict], None]) -> Verdict:
    """Read everything back. Raises OutputError where the folder is no dataset."""
    keep_freed_memory()
    record = require_job(store)
    verdict = Verdict()
    known: set[str] = set()
    for stored in _ranges(store, verdict):
        _check_files(store, stored, verdict, known)
        _check_scenes(store, stored, record.job, verdict)
        progress(verdict)
    _check_merged(store, verdict)
    _find_strays(store, known, verdict)
    return verdict


def _ranges(store: Store, verdict: Verdict) -> Iterator[StoredRange]:
    try:
        yield from iter_stored(store)
    except CorruptError as error:
        verdict.faults.append(str(error))


def _check_files(store: Store, stored: StoredRange, verdict: Verdict, known: set[str]) -> None:
    """Every file that the range's records name, against its size and SHA-256."""
    for record in stored.records:
        for entry in record.files:
            if entry.path in known and entry.path.startswith(f"{ASSETS}/"):
                continue
            known.add(entry.path)
            try:
                data = store.read(entry.path)
            except FileNotFoundError:
                verdict.faults.append(f"{entry.path}: is committed and missing")
                continue
            verdict.files += 1
            verdict.bytes += len(data)
            if hashlib.sha256(data).hexdigest() != entry.sha256:
                verdict.faults.append(f"{entry.path}: does not match the SHA-256 in its commit")


def _check_scenes(store: Store, stored: StoredRange, job: Job, verdict: Verdict) -> None:
    """Counts, and every pair's labels derived again."""
    read = file_reader(store, stored)
    made = {row["scene_id"]: row for row in stored.rows["scenes"]}
    failed = [row["scene_id"] for row in stored.rows["failures"]]
    if sorted([*made, *failed]) != list(range(stored.start, stored.stop)):
        verdict.faults.append(f"scenes {stored.start} to {stored.stop - 1}: some are missing, or both made and failed")
    verdict.scenes += len(made) + len(failed)
    for scene_id, scene in made.items():
        verdict.faults += check_stored_scene(scene)
        views = [row for row in stored.rows["views"] if row["scene_id"] == scene_id]
        objects = [row for row in stored.rows["objects"] if row["scene_id"] == scene_id]
        for parent in sorted({row["parent_id"] for row in views}):
            pair = {row["role"]: row for row in views if row["parent_id"] == parent}
            verdict.faults += _check_pair(job, read, (scene, pair, objects))
            verdict.pairs += 1


def _check_pair(job: Job, read: Callable[[str], bytes], rows: tuple[Row, dict[str, Row], list[Row]]) -> list[str]:
    scene, pair, objects = rows
    roles = stored_roles(job)
    if set(pair) != set(roles):
        return [f"scene {scene['scene_id']}: has views {sorted(pair)}, and must have {sorted(roles)}"]
    own = {row["pose_id"] for row in pair.values()}
    try:
        return check_stored_pair(
            job, pair, [row for row in objects if row["pose_id"] in own], scene, lambda path: read_image(read, path)
        )
    except (CorruptError, ValueError) as error:
        return [str(error)]


def _check_merged(store: Store, verdict: Verdict) -> None:
    """The merged files against `_SUCCESS`."""
    success = read_success(store)
    if success is None:
        return
    for path, file in success["files"].items():
        try:
            data = store.read(path)
        except FileNotFoundError:
            verdict.faults.append(f"{path}: is merged and missing")
            continue
        verdict.files += 1
        verdict.bytes += len(data)
        if hashlib.sha256(data).hexdigest() != file["sha256"]:
            verdict.faults.append(f"{path}: does not match the SHA-256 in _SUCCESS")


def _find_strays(store: Store, known: set[str], verdict: Verdict) -> None:
    """Images that no commit names."""
    for folder in store.children(""):
        if folder.startswith(("_", ".")) or folder in (MANIFEST, ASSETS):
            continue
        for entry in store.files(folder):
            if entry.key not in known:
                verdict.faults.append(f"{entry.key}: is in no commit")
