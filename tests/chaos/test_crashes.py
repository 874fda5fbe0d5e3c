"""A run that ends anywhere, and the next one, which finishes: a crash of a disk, or a request to an object store cut.

On a disk each point is a step of a recorded run with a legal loss of what was not flushed; points that leave equal files are
made once. In a store it is a request before which the process is killed, or whose answer never comes.
"""

import gc
import random
import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import obstore
import pytest
from obstore.store import MemoryStore

from schemas.dataset.layout import staging_path
from schemas.errors import VersoError
from tests.kit.crash_states import Disk, losses, recorded, write_tree
from tests.kit.faults import Fault, Killed, requests
from tests.kit.made_up_runs import FIRST, RANGE, STOP, broken_promises, contents, leftovers, make_dataset, settings_of
from tests.kit.tiers import first_of
from tests.made_up_scenes import attempt_at, failed_scene, small_scene
from workers.store import attempt as attempt_module
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore
from workers.store.store import Store

MIXTURES = 3
POINTS = {"default": 4, "ci": 30}
REQUEST_POINTS = {"default": 3, "ci": 15}
"""Points of each program (and fault) in each scope; with --all, all."""


def nothing(store: Store, layout: str) -> None:
    """A run begins in an empty place."""


def smaller(store: Store, layout: str) -> None:
    """A finished dataset that is to be extended."""
    make_dataset(store, layout, stop=STOP - 1)


def with_a_failure(store: Store, layout: str) -> None:
    """A merged dataset with a scene to try again."""

    def fails_once(scene_id: int):
        return failed_scene(scene_id, "environmental") if scene_id == FIRST else small_scene(scene_id)

    make_dataset(store, layout, make=fails_once)


def littered(store: Store, layout: str) -> None:
    """Ranges committed and not published, a loser, a fenced attempt, one that ended half way, and a temporary file."""
    store.prepare()
    settings = settings_of(layout)
    loser = attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene)
    fenced = attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(attempt_module, "publish", lambda *_: None)
        assert attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene).commit().won
    store.revoke(staging_path(FIRST, fenced.name))
    attempt_at(store, FIRST + RANGE, STOP, settings, small_scene)
    if store.root is not None:
        store.put("_staging/_tmp/.dead", b"x")
        assert store.size(f"{staging_path(FIRST, loser.name)}/_current") is not None


@dataclass(frozen=True)
class Program:
    """A run from what `before` left, on a file system where one syncfs is trusted or each file is flushed."""

    before: Callable[[Store, str], None]
    layout: str = "files"
    retry: bool = False
    by_syncfs: bool = True

    def __call__(self, store: Store) -> str:
        return make_dataset(store, self.layout, retry=self.retry).digest


PROGRAMS = {
    "files": Program(nothing),
    "files, each flushed": Program(nothing, by_syncfs=False),
    "tars": Program(nothing, layout="tar"),
    "extension": Program(smaller),
    "retry": Program(with_a_failure, retry=True),
    "sweep": Program(littered),
}
REQUESTED = {name: replace(PROGRAMS[name], layout="tar") for name in ("files", "extension", "retry", "sweep")}


@contextmanager
def nothing_flushed() -> Iterator[None]:
    """Recovery loses no power, so that it need not wait for a disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda descriptor: None)
        patch.setattr("workers.store.file_system._syncfs", lambda descriptor: None)
        patch.setattr("workers.store.file_system._trusts_syncfs", lambda folder: True)
        yield


def crash_points(
    program: Program, place: Path, share: float, chance: random.Random
) -> Iterator[tuple[str, dict[str, bytes | None]]]:
    """A share of a program's points, each as the name of its step and loss and what the crash leaves."""
    program.before(LocalStore(place), program.layout)
    disk = Disk(place)
    with recorded(place, program.by_syncfs) as steps:
        program(LocalStore(place))
    for number, step in enumerate([*steps, ("nothing",)]):
        for loss in losses(MIXTURES):
            if chance.random() < share or number == len(steps):
                yield f"before step {number} of {len(steps)}, {step[:2]}: {loss.name} lost", disk.after_a_crash(loss)
        if number < len(steps):
            disk.play(step)


def wrong_after(program: Program, root: Path, digest: str, files: dict[str, str]) -> str:
    """What is wrong once the next run has ended; empty if nothing is."""
    if broken := broken_promises(root):
        return f"_SUCCESS is there, and these are not whole: {broken}"
    try:
        with nothing_flushed():
            made = program(LocalStore(root))
    except VersoError as error:
        return f"the next run ends with: {error}"
    if made != digest:
        return "another digest"
    if (now := contents(root)) != files:
        return f"other files: {set(now.items()) ^ set(files.items())}"
    return f"left over: {left}" if (left := leftovers(root)) else ""


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", PROGRAMS)
def test_after_a_crash_at_a_step_with_any_loss_the_next_run_makes_the_same_dataset(
    name, tmp_path, request, record_figure
):
    program, chance = PROGRAMS[name], random.Random(name)
    wanted = POINTS.get(request.config.getoption("--scope"))
    with nothing_flushed():
        points = list(crash_points(program, tmp_path / "whole", 1.0 if wanted is None else 0.1, chance))
        digest = make_dataset(LocalStore(tmp_path / "once"), program.layout).digest
    files = contents(tmp_path / "whole")
    distinct = {hash(tuple(sorted(left.items()))): (where, left) for where, left in points}
    chosen = list(distinct.values())
    if wanted is not None:
        chosen = chance.sample(chosen, min(wanted, len(chosen)))
    wrong = []
    for number, (where, left) in enumerate(chosen):
        write_tree(left, tmp_path / str(number))
        if why := wrong_after(program, tmp_path / str(number), digest, files):
            wrong.append(f"{where}: {why}")
        shutil.rmtree(tmp_path / str(number))
    print(f"{name}: {len(points)} points, {len(distinct)} states, {len(chosen)} tried, {len(wrong)} wrong")
    record_figure(f"crashes in {name}", "failed" if wrong else "passed", len(wrong), 0)
    assert not wrong


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_finished_dataset_loses_nothing_in_a_crash(name, tmp_path):
    with nothing_flushed():
        points = list(crash_points(PROGRAMS[name], tmp_path, 0.0, random.Random(0)))
    whole = {str(path.relative_to(tmp_path)): path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert len(points) == len(losses(MIXTURES))
    for where, left in points:
        assert {path: data for path, data in left.items() if path in whole} == whole, where


# ------------------------------------------------------------------------------------------------ an object store


@pytest.fixture
def killed_files_are_closed():
    """What a killed process had open is closed without a warning, as the kernel does."""
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


def copy_of(held: MemoryStore) -> ObjectStore:
    copied = MemoryStore()
    for meta in obstore.list(held).collect():
        obstore.put(copied, meta["path"], bytes(obstore.get(held, meta["path"]).bytes()))
    return ObjectStore(copied, "memory://")


def keys_of(store: ObjectStore) -> set[str]:
    return {entry.key for entry in store.files("")}


@pytest.mark.timeout(3600)
@pytest.mark.usefixtures("unflushed", "killed_files_are_closed")
@pytest.mark.parametrize("fault", ["killed before", "answer lost"])
@pytest.mark.parametrize("name", first_of(REQUESTED, 2))
def test_ended_at_a_request_and_started_again_it_makes_the_same_dataset(name, fault: Fault, tmp_path, request):
    program = REQUESTED[name]
    held = MemoryStore()
    program.before(ObjectStore(held, "memory://"), "tar")
    whole = copy_of(held)
    with requests() as counted:
        assert program(whole) == (digest := make_dataset(LocalStore(tmp_path), "tar").digest)
    wanted = REQUEST_POINTS.get(request.config.getoption("--scope"))
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
    assert ended == len(points) or fault == "answer lost"
