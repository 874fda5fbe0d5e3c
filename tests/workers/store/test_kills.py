"""The commit protocol, ended or disturbed at every single step that it takes on the disk."""

import shutil
from pathlib import Path

import pytest

from schemas.errors import RunError
from tests.kit.faults import Killed, check_published, disk, lose_power
from tests.kit.made_up_runs import FIRST, RANGE, STOP, broken_promises, contents, leftovers, make_dataset
from tests.made_up_scenes import attempt_at, small_scene, terms
from tests.stored_images import iter_records
from workers.store.attempt import sweep
from workers.store.commit import publish
from workers.store.local import LocalStore

LAYOUTS = ("files", "tar")
SOME = 13
"""Every so many steps by default; `--all` takes each of them."""


def work(root: Path, layout: str, stop: int = STOP) -> str:
    """A run from whatever is there; the dataset's digest."""
    return make_dataset(LocalStore(root), layout, stop).digest


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Digest, contents and number of disk steps of a run that nothing disturbs, by layout."""
    runs = {}
    for layout in LAYOUTS:
        root = tmp_path_factory.mktemp(layout)
        with disk() as watched:
            digest = work(root, layout)
        runs[layout] = (digest, contents(root), watched.steps)
    return runs


def end_and_start_again(root: Path, layout: str, step: int, power: bool, undisturbed) -> None:
    digest, files, _ = undisturbed[layout]
    with pytest.raises(Killed), disk(at=step) as watched:
        work(root, layout)
    if power:
        lose_power(watched, root)
    assert not broken_promises(root), f"step {step}"
    with disk():
        assert work(root, layout) == digest, f"step {step}"
    assert contents(root) == files, f"step {step}"
    assert not leftovers(root), f"step {step}"


some_or_every = pytest.mark.parametrize(
    "stride", [SOME, pytest.param(1, marks=pytest.mark.slow)], ids=["some", "every"]
)


@some_or_every
@pytest.mark.parametrize("power", [False, True], ids=["kill", "loss of power"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_ended_at_a_step_and_started_again_it_makes_the_same_dataset(layout, power, stride, undisturbed, tmp_path):
    stride *= 7 if stride > 1 else 1  # test_crashes.py tries more of these
    for step in range(2 * power if stride > 1 else 0, undisturbed[layout][2], stride):
        end_and_start_again(tmp_path / str(step), layout, step, power, undisturbed)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_loss_of_power_after_the_end_costs_nothing(layout, undisturbed, tmp_path):
    with disk() as watched:
        work(tmp_path, layout)
    lose_power(watched, tmp_path)
    assert contents(tmp_path) == undisturbed[layout][1]
    assert not broken_promises(tmp_path)
    for record in iter_records(LocalStore(tmp_path)):
        check_published(LocalStore(tmp_path), record)


def test_both_layouts_have_one_digest(undisturbed):
    assert undisturbed["files"][0] == undisturbed["tar"][0]


@some_or_every
def test_swept_by_another_coordinator_at_any_step_an_attempt_commits_all_or_nothing(stride, undisturbed, tmp_path):
    settings = terms(first_scene=FIRST, range_size=RANGE)
    outcomes = set()
    step = 0
    while True:
        root = tmp_path / str(step)
        store = LocalStore(root)
        with disk():
            store.prepare()
        with disk(at=step, then=lambda root=root: sweep(LocalStore(root), fenced=None)) as watched:
            try:
                won = attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene).commit().won
            except RunError:
                won = False
        if watched.steps <= step:
            break
        outcomes.add(won)
        with disk():
            sweep(LocalStore(root))
            records = list(iter_records(store))
            assert len(records) == won, f"step {step}"
            for record in records:
                check_published(store, record)
            assert work(root, "files") == undisturbed["files"][0], f"step {step}"
        step += stride
    assert outcomes == {True, False}


@some_or_every
@pytest.mark.parametrize("dies", [False, True], ids=["lives", "dies once it has decided"])
def test_an_attempt_that_commits_while_it_is_swept_commits_all_or_nothing(
    dies, stride, undisturbed, tmp_path, monkeypatch
):
    settings = terms(first_scene=FIRST, range_size=RANGE)
    outcomes = set()
    step = 0
    while True:
        root = tmp_path / str(step)
        store = LocalStore(root)
        won, attempts = [], []

        def commit(won=won, attempts=attempts):
            with monkeypatch.context() as patch:
                if dies:
                    patch.setattr("workers.store.attempt.publish", lambda *_: None)
                try:
                    won.append(attempts[0].commit().won)
                except RunError:
                    won.append(False)

        with disk():
            store.prepare()
            attempts.append(attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene))
        with disk(at=step, then=commit) as watched:
            sweep(LocalStore(root), fenced=None)
        if watched.steps <= step:
            break
        outcomes.add(won[0])
        with disk():
            assert [record.attempt for record in iter_records(store)] == [attempts[0].name] * won[0], f"step {step}"
            assert work(root, "files") == undisturbed["files"][0], f"step {step}"
        assert not leftovers(root), f"step {step}"
        step += min(stride, 5)
    assert outcomes == {True, False}


@some_or_every
def test_overtaken_by_a_rival_at_any_step_an_attempt_loses_and_leaves_no_trace(stride, undisturbed, tmp_path):
    settings = terms(first_scene=FIRST, range_size=RANGE)
    rivals_won = 0
    step = 0
    while True:
        root = tmp_path / str(step)
        store = LocalStore(root)
        with disk():
            store.prepare()
        rival = []

        def overtake(root=root, rival=rival):
            rival.append(attempt_at(LocalStore(root), FIRST, FIRST + RANGE, settings, small_scene).commit())

        with disk(at=step, then=overtake) as watched:
            mine = attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene).commit()
        if watched.steps <= step:
            break
        assert mine.won != rival[0].won
        assert mine.record == rival[0].record
        assert mine.conflict is None
        assert rival[0].conflict is None
        rivals_won += rival[0].won
        assert not leftovers(root), f"step {step}"
        with disk():
            assert work(root, "files") == undisturbed["files"][0]
        step += stride
    assert 0 < rivals_won < step


@some_or_every
def test_published_by_others_at_any_step_a_commit_is_published_once(stride, tmp_path):
    settings = terms(first_scene=FIRST, range_size=RANGE)
    step = 0
    while True:
        root = tmp_path / str(step)
        store = LocalStore(root)

        def roll_forward(root=root):
            for record in iter_records(LocalStore(root)):
                publish(LocalStore(root), record)

        with disk():
            store.prepare()
        with disk(at=step, then=roll_forward) as watched:
            result = attempt_at(store, FIRST, FIRST + RANGE, settings, small_scene).commit()
        if watched.steps <= step:
            break
        assert result.won
        check_published(store, result.record)
        assert not leftovers(root)
        step += stride


@some_or_every
def test_an_extension_ended_at_any_step_makes_the_same_dataset_as_one_made_at_once(stride, undisturbed, tmp_path):
    seed = tmp_path / "seed"
    with disk():
        work(seed, "files", STOP - 1)
    with disk() as watched:
        shutil.copytree(seed, tmp_path / "whole")
        before = watched.steps
        assert work(tmp_path / "whole", "files") == undisturbed["files"][0]
    for step in range(0, watched.steps - before, stride * (3 if stride > 1 else 1)):
        root = tmp_path / str(step)
        shutil.copytree(seed, root)
        with pytest.raises(Killed), disk(at=step):
            work(root, "files")
        assert not broken_promises(root), f"step {step}"
        with disk():
            assert work(root, "files") == undisturbed["files"][0], f"step {step}"
        assert not leftovers(root)
