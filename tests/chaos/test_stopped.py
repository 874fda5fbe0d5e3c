"""Coordinators and workers that are stopped at any step, until another machine took over and ended, and then go on."""

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from obstore.store import MemoryStore

from schemas.errors import VersoError
from services.run.lock import hold_lock
from tests.kit.faults import REQUESTS, STILL, disk, requests, taken_over
from tests.kit.made_up_runs import FIRST, RANGE, STOP, broken_promises, make_dataset, settings_of
from tests.made_up_scenes import attempt_at, small_scene
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
    again: Callable[[Store], Store]
    watch: Callable

    def prepared(self, root: Path) -> Store:
        store = self.make(root)
        with disk():
            store.prepare()
        return store


def another_client(store: Store) -> Store:
    assert isinstance(store, ObjectStore)
    return ObjectStore(store._bucket, store.name)


PLACES = {
    "files": Place("files", LocalStore, lambda store: LocalStore(store.name), disk),
    "tars": Place("tar", LocalStore, lambda store: LocalStore(store.name), disk),
    "bucket": Place("tar", lambda root: ObjectStore(MemoryStore(), "memory://"), another_client, requests),
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
@pytest.mark.parametrize("stop", [STOP, STOP + 1], ids=["goes on", "extends"])
@pytest.mark.parametrize("actor", [coordinate, work], ids=["coordinator", "worker"])
@pytest.mark.parametrize("kind", PLACES)
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
