"""Coordinators and workers that are stopped at any step until another machine took over and ended, or are taken for dead,
and then go on: whatever they do meanwhile, nothing is replaced and a record never wins without its files.
"""

import os
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from obstore.store import MemoryStore

from schemas.dataset.commit import Span
from schemas.dataset.layout import FENCED, STAGING, staging_path
from schemas.errors import RunError, VersoError
from services.merge.merge import merge
from services.run.lock import hold_lock
from services.run.range_planner import plan_ranges
from tests.kit.faults import REQUESTS, STILL, disk, requests, taken_over
from tests.kit.made_up_runs import FIRST, LABEL, RANGE, STOP, broken_promises, coordinator_of, make_dataset, settings_of
from tests.kit.tiers import first_of
from tests.made_up_scenes import attempt_at, small_scene, terms
from workers.store.attempt import Attempt, attempts_at, begin_attempt, sweep, sweep_attempt
from workers.store.commit import read_record
from workers.store.ledger import list_commits
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore
from workers.store.store import Store

POINTS = {"default": 3, "ci": 12}
"""Steps of each case in each scope; with --all, all."""


@dataclass(frozen=True)
class Place:
    """Kinds of stores: a new one, another client of it, and what is run at a step of the first."""

    layout: str
    make: Callable[[Path], Store]
    again: Callable[[Any], Store]
    watch: Callable

    def prepared(self, root: Path) -> Store:
        store = self.make(root)
        with disk():
            store.prepare()
        return store


def fresh_bucket() -> ObjectStore:
    return ObjectStore(MemoryStore(), "memory://")


PLACES = {
    "files": Place("files", LocalStore, lambda store: LocalStore(store.name), disk),
    "tars": Place("tar", LocalStore, lambda store: LocalStore(store.name), disk),
    "bucket": Place("tar", lambda root: fresh_bucket(), lambda store: ObjectStore(store._bucket, store.name), requests),
}


@contextmanager
def watched(place: Place, at: int = -1, then: Callable[[], object] | None = None) -> Iterator:
    """Counts the steps; runs `then` before step `at`."""
    with place.watch(at, then=then, **({"names": REQUESTS} if place.watch is requests else {})) as steps:
        yield steps


def coordinate(store: Store, layout: str) -> None:
    """A run that holds the lock, and shows no life while it is stopped."""
    with hold_lock(store, STILL) as lock:
        make_dataset(store, layout, lock=lock)


def work(store: Store, layout: str) -> None:
    """A worker: one attempt, from its beginning until it is published."""
    attempt_at(store, FIRST, FIRST + RANGE, settings_of(layout), small_scene).commit()


def steps_of(place: Place, actor: Callable[[Store, str], None], root: Path) -> int:
    store = place.prepared(root)
    with watched(place) as steps:
        actor(store, place.layout)
    return steps.count if place.watch is requests else steps.steps


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("stop", first_of([STOP, STOP + 1], 1), ids=["goes on", "extends"])
@pytest.mark.parametrize("actor", [coordinate, work], ids=["coordinator", "worker"])
@pytest.mark.parametrize("kind", first_of(PLACES, 1, 2))
def test_stopped_at_a_step_until_another_has_ended_it_replaces_nothing(
    kind, actor, stop, tmp_path, request, record_figure
):
    place = PLACES[kind]
    name = f"{kind}, {actor.__name__}, {stop}"
    total = steps_of(place, actor, tmp_path / "counted")
    wanted = POINTS.get(request.config.getoption("--scope"))
    points = range(total) if wanted is None else random.Random(name).sample(range(total), wanted)
    with disk():
        expected = make_dataset(LocalStore(tmp_path / "once"), place.layout, stop).digest
    ended = 0
    for at in points:
        store = place.prepared(tmp_path / str(at))

        def take_over(store=store):
            other = place.again(store)
            with taken_over(other):
                return make_dataset(other, place.layout, stop)

        with watched(place, at, take_over):
            try:
                actor(store, place.layout)
            except VersoError:
                ended += 1
        if store.root is not None:
            assert not broken_promises(store.root), f"step {at}"
        with disk():
            assert make_dataset(place.again(store), place.layout, stop).digest == expected, f"step {at}"
            assert not list(store.files("_staging")), f"step {at}"
    print(f"{name}: stopped at {len(points)} of {total} steps, {ended} refused to go on")
    record_figure(f"stopped: {name}", "passed", len(points))


# ---------------------------------------------------------------------------------------------- workers that are given up

TAR = terms(layout="tar", range_size=2)

WORKER = """
import os, sys
from schemas.dataset.commit import Span
from schemas.errors import VersoError
from tests.made_up_scenes import small_scene, terms
from workers.store.attempt import begin_attempt
from workers.store import file_system
from workers.store.local import LocalStore
os.fsync = file_system._syncfs = lambda place: None  # no power is lost here
store = LocalStore(sys.argv[1])
for start in range(0, 2 * int(sys.argv[2]), 2):
    attempt = begin_attempt(store, Span(start=start, stop=start + 2), terms(range_size=2), sys.argv[3])
    for scene_id in (start, start + 1):
        attempt.begin_scene(scene_id)
        attempt.add_scene(small_scene(scene_id))
    print("ready", flush=True)
    sys.stdin.readline()
    try:
        print(attempt.commit().won, flush=True)
    except VersoError as error:
        print(error, flush=True)
"""


def files_are_whole(store, record) -> bool:
    """Whether every file that the record names is published, or staged where publishing finds it."""
    folders = ("", *(f"{staging_path(record.span.start, record.attempt)}{end}/" for end in ("", FENCED)))
    return all(any(store.size(folder + entry.path) == entry.bytes for folder in folders) for entry in record.files)


@pytest.mark.parametrize("trials", [20, pytest.param(300, marks=pytest.mark.slow)])
def test_a_worker_that_lives_and_commits_while_it_is_given_up_keeps_its_files(
    trials, tmp_path, monkeypatch, record_figure, unflushed
):
    store = LocalStore(tmp_path)
    store.prepare()
    coordinator = coordinator_of(store, monkeypatch)
    chance = random.Random(1)
    command = [sys.executable, "-c", WORKER, str(tmp_path), str(trials), LABEL]
    committed = lost = 0
    commit_s = 0.004
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as worker:
        for start in range(0, 2 * trials, 2):
            assert worker.stdout.readline() == "ready\n"
            begun = time.perf_counter()
            worker.stdin.write("go\n")
            worker.stdin.flush()
            if chance.random() < 0.1:  # let it end, to learn how long it takes
                answer = worker.stdout.readline()
                commit_s = time.perf_counter() - begun
                coordinator._find_evidence([Span(start=start, stop=start + 2)])
            else:
                time.sleep(chance.uniform(0.3, 1.1) * commit_s)
                coordinator._find_evidence([Span(start=start, stop=start + 2)])
                answer = worker.stdout.readline()
            record = read_record(store, start)
            assert answer == "True\n" or record is None or not files_are_whole(store, record)
            committed += record is not None
            lost += record is not None and not files_are_whole(store, record)
    record_figure("records that won without their files", "passed" if not lost else "failed", lost, 0)
    assert lost == 0
    assert 0 < committed < trials, "both outcomes are needed"
    for start, end in plan_ranges(0, 2 * trials, 2, list_commits(store).ranges):
        attempt_at(store, start, end, terms(range_size=2), small_scene).commit()
    assert merge(store, 0, 2 * trials).rows["scenes"] > 0


def test_a_link_under_way_when_its_attempt_is_given_up_wins_before_the_sweep_looks_or_not_at_all(
    tmp_path, monkeypatch, unflushed
):
    """As the kernel does it: a link's source is found first, and by then its folder may have another name."""
    store = LocalStore(tmp_path)
    store.prepare()
    link, remove_tree, ended = os.link, LocalStore.remove_tree, list[str]()

    def link_late(source, target):
        with open(source, "rb") as found:

            def go_on(self, prefix):
                if not ended:  # the sweep has looked for a record, and removes what it takes for a loser's
                    try:
                        link(f"/proc/self/fd/{found.fileno()}", target, src_dir_fd=found.fileno())
                        ended.append("linked")
                    except FileNotFoundError:
                        ended.append("refused")
                remove_tree(self, prefix)

            monkeypatch.setattr(os, "link", link)
            monkeypatch.setattr(LocalStore, "remove_tree", go_on)
            sweep_attempt(store, 0, attempt.name, given_up=True)
        raise FileNotFoundError(source)  # what the worker does now is of no concern

    attempt = attempt_at(store, 0, 2, terms(range_size=2), small_scene)
    monkeypatch.setattr(os, "link", link_late)
    with pytest.raises(RunError, match="was swept before it could commit"):
        attempt.commit()
    assert ended == ["refused"] and read_record(store, 0) is None


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["some", "every"])
@pytest.mark.parametrize("gives_up", ["the coordinator", "the next run's sweep"])
def test_on_a_store_a_worker_given_up_at_any_request_leaves_a_dataset_that_a_run_can_finish(
    gives_up, every, monkeypatch
):
    store = fresh_bucket()
    attempt = whole_attempt(store)
    with requests(names=REQUESTS) as whole:
        attempt.commit()
    expected = finish(store)
    outcomes = set()
    points = range(whole.count) if every else (0, *range(whole.decision - 2, whole.decision + 3), whole.count - 1)
    for at in points:
        store = fresh_bucket()
        attempt = whole_attempt(store)

        def give_up(store=store):
            if gives_up == "the coordinator":
                coordinator_of(store, monkeypatch)._find_evidence([Span(start=0, stop=2)])
            else:
                sweep(store, fenced=None)

        with requests(at, then=give_up, names=REQUESTS) as watched:
            try:
                outcomes.add(attempt.commit().won)
            except RunError:
                outcomes.add(False)
        assert watched.count > at
        record = read_record(store, 0)
        assert record is None or files_are_whole(store, record), f"request {at}"
        assert finish(store) == expected, f"request {at}"
        assert not list(store.files(STAGING)), f"request {at}"
    assert outcomes == {True, False}


@pytest.mark.parametrize("kind", ["disk", "bucket"])
def test_the_scene_in_progress_is_evidence_while_the_range_before_it_is_committed(kind, monkeypatch, tmp_path):
    store = LocalStore(tmp_path) if kind == "disk" else fresh_bucket()
    store.prepare()
    whole_attempt(store).end_scenes()
    begin_attempt(store, Span(start=2, stop=4), TAR, LABEL).begin_scene(3)
    coordinator, left = coordinator_of(store, monkeypatch), [Span(start=start, stop=start + 2) for start in (0, 2, 4)]
    assert coordinator._find_evidence(left) == (left[1], 3, False)
    assert not [name for start in (0, 2) for name in attempts_at(store, start)], "both attempts are given up"
    assert coordinator._find_evidence(left) == (left[0], None, False)


def whole_attempt(store) -> Attempt:
    """An attempt at the scenes 0 and 1, ready to commit."""
    attempt = begin_attempt(store, Span(start=0, stop=2), TAR, LABEL)
    for scene_id in (0, 1):
        attempt.begin_scene(scene_id)
        attempt.add_scene(small_scene(scene_id))
    return attempt


def finish(store: ObjectStore) -> str:
    """What the next run does; the dataset's digest."""
    sweep(store, fenced=None)
    for start, end in plan_ranges(0, 4, 2, list_commits(store).ranges):
        attempt_at(store, start, end, TAR, small_scene).commit()
    return merge(store, 0, 4).digest
