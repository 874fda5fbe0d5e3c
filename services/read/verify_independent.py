"""`verso verify --independent N`: labels of some scenes derived a second time, by code that shares nothing with the first."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from schemas.dataset.codec import Row
from schemas.errors import CorruptError
from services.job.record import require_job
from services.merge.merge import read_success
from services.read.dataset_reader import choose_scenes, file_reader, find_scene
from services.read.independent.derive import StoredPair
from services.read.independent.forces import check_forces
from services.read.independent.step import check_merged, check_pair, list_underived
from workers.store.store import Store


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
        found.faults += check_forces(job, scene)
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
        f"labels of {found.pairs} pairs of {found.scenes} scenes derived from the article's definitions, and their rest from "
        "contact forces: "
        f"{len(found.faults) or 'nothing'} off"
    )
    yield from (f"  {line}" for line in found.underived)
