"""A crash at every step of a run on a disk, with every legal loss of what was not flushed: the next run finishes.

Each point is a step of a recorded run and a kind of loss. Points that leave equal files are made once.
"""

import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from schemas.errors import VersoError
from tests.kit.crash_states import Disk, losses, recorded, write_tree
from tests.kit.made_up_runs import FIRST, RANGE, STOP, broken_promises, contents, leftovers, make_dataset, settings_of
from tests.made_up_scenes import attempt_at, failed_scene, small_scene
from workers.store import attempt as attempt_module
from workers.store.local import LocalStore

MIXTURES = 3
POINTS = {"default": 4, "ci": 60}
"""Points of each program in each scope; with --all, all."""


def nothing(root: Path) -> None:
    """A run begins in an empty folder."""


def smaller(root: Path) -> None:
    """A finished dataset that is to be extended."""
    make_dataset(LocalStore(root), stop=STOP - 1)


def fails_once(scene_id: int):
    return failed_scene(scene_id, "environmental") if scene_id == FIRST else small_scene(scene_id)


def with_a_failure(root: Path) -> None:
    """A merged dataset with a scene to try again."""
    make_dataset(LocalStore(root), make=fails_once)


def littered(root: Path) -> None:
    """Ranges committed and not published, a loser, a fenced attempt, a temporary file, and an attempt that ended half way."""
    store = LocalStore(root)
    store.prepare()
    settings = settings_of("files")
    loser = attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene)
    fenced = attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(attempt_module, "publish", lambda *_: None)
        assert attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene).commit().won
    store.revoke(f"_staging/{FIRST:010d}/{fenced.name}")
    attempt_at(store, FIRST + RANGE, STOP, settings, small_scene)
    store.put("_staging/_tmp/.dead", b"x")
    assert store.size(f"_staging/{FIRST:010d}/{loser.name}/_current") is not None


@dataclass(frozen=True)
class Program:
    """A run from what `before` left, on a file system where one syncfs is trusted or each file is flushed."""

    before: Callable[[Path], None]
    layout: str = "files"
    retry: bool = False
    by_syncfs: bool = True

    def __call__(self, root: Path) -> str:
        return make_dataset(LocalStore(root), self.layout, retry=self.retry).digest


PROGRAMS = {
    "files": Program(nothing),
    "files, each flushed": Program(nothing, by_syncfs=False),
    "tars": Program(nothing, layout="tar"),
    "extension": Program(smaller),
    "retry": Program(with_a_failure, retry=True),
    "sweep": Program(littered),
}


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
    program.before(place)
    disk = Disk(place)
    with recorded(place, program.by_syncfs) as steps:
        program(place)
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
            made = program(root)
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
