"""A process killed before any of its requests to an object store, or without the answer to one: the next run finishes."""

import gc
import random
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import obstore
import pytest
from obstore.store import MemoryStore

from schemas.dataset.layout import staging_path
from schemas.errors import VersoError
from tests.kit.faults import Fault, Killed, requests, unflushed
from tests.kit.made_up_runs import FIRST, RANGE, STOP, make_dataset, settings_of
from tests.made_up_scenes import attempt_at, failed_scene, small_scene
from workers.store import attempt as attempt_module
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

__all__ = ["unflushed"]
pytestmark = pytest.mark.usefixtures("unflushed", "killed_files_are_closed")

POINTS = {"default": 3, "ci": 30}
"""Points of each program and fault in each scope; with --all, all."""


@pytest.fixture
def killed_files_are_closed():
    """What a killed process had open is closed without a warning, as the kernel does."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


def nothing(store: ObjectStore) -> None:
    """A run begins in an empty bucket."""


def smaller(store: ObjectStore) -> None:
    """A finished dataset that is to be extended."""
    make_dataset(store, "tar", stop=STOP - 1)


def fails_once(scene_id: int):
    return failed_scene(scene_id, "environmental") if scene_id == FIRST else small_scene(scene_id)


def with_a_failure(store: ObjectStore) -> None:
    """A merged dataset with a scene to try again."""
    make_dataset(store, "tar", make=fails_once)


def littered(store: ObjectStore) -> None:
    """A range committed and not published, a loser, a fenced attempt, and one that ended half way."""
    settings = settings_of("tar")
    attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene)
    fenced = attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(attempt_module, "publish", lambda *_: None)
        assert attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene).commit().won
    store.revoke(staging_path(FIRST, fenced.name))
    attempt_at(store, FIRST + RANGE, STOP, settings, small_scene)


@dataclass(frozen=True)
class Program:
    """A run from what `before` left."""

    before: Callable[[ObjectStore], None]
    retry: bool = False

    def __call__(self, store: ObjectStore) -> str:
        return make_dataset(store, "tar", retry=self.retry).digest


PROGRAMS = {
    "a run": Program(nothing),
    "an extension": Program(smaller),
    "a retry": Program(with_a_failure, retry=True),
    "a sweep": Program(littered),
}


def copy_of(held: MemoryStore) -> ObjectStore:
    copied = MemoryStore()
    for meta in obstore.list(held).collect():
        obstore.put(copied, meta["path"], bytes(obstore.get(held, meta["path"]).bytes()))
    return ObjectStore(copied, "memory://")


def keys_of(store: ObjectStore) -> set[str]:
    return {entry.key for entry in store.files("")}


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("fault", ["killed before", "answer lost"])
@pytest.mark.parametrize("name", PROGRAMS)
def test_ended_at_a_request_and_started_again_it_makes_the_same_dataset(name, fault: Fault, tmp_path, request):
    program = PROGRAMS[name]
    held = MemoryStore()
    program.before(ObjectStore(held, "memory://"))
    whole = copy_of(held)
    with requests() as counted:
        assert program(whole) == (digest := make_dataset(LocalStore(tmp_path), "tar").digest)
    wanted = POINTS.get(request.config.getoption("--scope"))
    points = range(counted.count) if wanted is None else random.Random(name).sample(range(counted.count), wanted)
    ended = 0
    for at in points:
        store = copy_of(held)
        with requests(at, fault):
            try:
                program(store)  # a decision or a removal without an answer is made again
            except (Killed, VersoError):
                ended += 1
        assert program(store) == digest, f"request {at}"
        assert keys_of(store) == keys_of(whole), f"request {at}"
    print(f"{name}, {fault}: {len(points)} of {counted.count} points, {ended} ended there")
    assert ended == len(points) or fault == "answer lost"
