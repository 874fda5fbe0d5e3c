"""`verso verify`: every file against its checksum, and every label against derivations from the stored images."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

from schemas.dataset.codec import Row
from schemas.dataset.layout import ASSETS, MANIFEST, is_shape, stored_roles
from schemas.errors import CorruptError
from schemas.job.job import Job
from services.job.record import require_job
from services.merge.step import read_success
from services.read.dataset_reader import (
    ReadFile,
    StoredRange,
    choose_scenes,
    file_reader,
    find_scene,
    iter_stored,
    read_image,
)
from services.read.independent.derive import StoredPair
from services.read.independent.step import check_merged, check_pair, list_underived
from workers.pipeline.allocator import keep_freed_memory
from workers.pipeline.check_stored import check_stored_pair, check_stored_scene
from workers.store.commit import committed_files
from workers.store.store import Store


@dataclass
class Verdict:
    """Counts of what was read, and the faults, a sentence each."""

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
    try:
        for stored in iter_stored(store):
            digests: dict[str, str] = {}
            faults = _check_scenes(_hashing_reader(store, digests, verdict), stored, record.job, verdict)
            verdict.faults += [*_check_files(store, stored, digests, known, verdict), *faults]
            progress(verdict)
    except CorruptError as error:
        verdict.faults.append(str(error))
    _check_merged(store, verdict)
    _find_strays(store, known, verdict)
    return verdict


def _hashing_reader(store: Store, digests: dict[str, str], verdict: Verdict) -> ReadFile:
    """Reads files of the store, counts them, and keeps the SHA-256 of each: every file is read and hashed once."""

    def read(path: str) -> bytes:
        data = store.read(path)
        digests[path] = hashlib.sha256(data).hexdigest()
        verdict.files += 1
        verdict.bytes += len(data)
        return data

    return read


def _check_files(
    store: Store, stored: StoredRange, digests: dict[str, str], known: set[str], verdict: Verdict
) -> list[str]:
    """Files of the range's records that are missing or differ from their SHA-256. Reads those without a digest yet."""
    faults, read = [], _hashing_reader(store, digests, verdict)
    for entry in (entry for record in stored.records for entry in committed_files(store, record)):
        if entry.path in known and is_shape(entry.path):
            continue
        known.add(entry.path)
        try:
            if entry.path not in digests:
                read(entry.path)
        except FileNotFoundError:
            faults.append(f"{entry.path}: is committed and missing")
            continue
        if digests[entry.path] != entry.sha256:
            faults.append(f"{entry.path}: does not match the SHA-256 in its commit")
    return faults


def _check_scenes(read_file: ReadFile, stored: StoredRange, job: Job, verdict: Verdict) -> list[str]:
    """Count the range's scenes, and derive every pair's labels again."""
    made = {row["scene_id"]: row for row in stored.rows["scenes"]}
    ended = sorted([*made, *(row["scene_id"] for row in stored.rows["failures"])])
    verdict.scenes += len(ended)
    faults, roles = [], stored_roles(job)
    if ended != list(range(stored.start, stored.stop)):
        faults.append(f"scenes {stored.start} to {stored.stop - 1}: some are missing, or both made and failed")
    try:
        read = file_reader(read_file, stored)
    except CorruptError as error:
        return [*faults, str(error)]
    for scene_id, scene in made.items():
        faults += check_stored_scene(scene)
        for views, objects in stored.pairs(scene_id):
            verdict.pairs += 1
            if set(views) != set(roles):
                faults.append(f"scene {scene_id}: has views {sorted(views)}, and must have {sorted(roles)}")
                continue
            try:
                faults += check_stored_pair(job, views, objects, scene, partial(read_image, read))
            except (CorruptError, ValueError) as error:
                faults.append(str(error))
    return faults


def _check_merged(store: Store, verdict: Verdict) -> None:
    """Compare the merged files with `_SUCCESS`."""
    digests: dict[str, str] = {}
    read = _hashing_reader(store, digests, verdict)
    for path, file in (read_success(store) or {"files": {}})["files"].items():
        try:
            read(path)
        except FileNotFoundError:
            verdict.faults.append(f"{path}: is merged and missing")
            continue
        if digests[path] != file["sha256"]:
            verdict.faults.append(f"{path}: does not match the SHA-256 in _SUCCESS")


def _find_strays(store: Store, known: set[str], verdict: Verdict) -> None:
    """Find images that no commit names."""
    for folder in store.children(""):
        if folder.startswith(("_", ".")) or folder in (MANIFEST, ASSETS):
            continue
        for entry in store.files(folder):
            if entry.key not in known:
                verdict.faults.append(f"{entry.key}: is in no commit")


@dataclass
class IndependentVerdict:
    """Counts of what was derived, what has no second derivation for this job, and the faults, a sentence each."""

    scenes: int = 0
    pairs: int = 0
    underived: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def verify_independently(
    store: Store, count: int, progress: Callable[[IndependentVerdict], None]
) -> IndependentVerdict:
    """Derive the labels of `count` scenes a second time. Raises OutputError where the folder is no dataset."""
    record = require_job(store)
    job = record.job.model_dump(mode="json")
    found = IndependentVerdict(underived=list_underived(job))
    views: list[Row] = []
    objects: list[Row] = []
    for scene_id in choose_scenes(store, count, record.job.seed):
        stored = find_scene(store, scene_id)
        scene, read = stored.scene(scene_id), file_reader(store.read, stored)
        assert scene is not None
        for pair_views, pair_objects in stored.pairs(scene_id):
            try:
                found.faults += check_pair(StoredPair(job, scene, pair_views, pair_objects, read))
            except CorruptError as error:
                found.faults.append(str(error))
            views += pair_views.values()
            objects += pair_objects
            found.pairs += 1
        found.scenes += 1
        progress(found)
    if read_success(store) is not None:
        found.faults += check_merged(store.read, views, objects)
    return found


def describe_independent(found: IndependentVerdict) -> Iterator[str]:
    """Every fault, what was derived and what was not, line by line."""
    yield from found.faults
    yield (
        f"labels of {found.pairs} pairs of {found.scenes} scenes derived from the article's definitions: "
        f"{len(found.faults) or 'nothing'} off"
    )
    yield from (f"  {line}" for line in found.underived)
