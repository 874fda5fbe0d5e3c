"""One matrix of crashes: operation x point. Each ends in a dataset without loss or double, or in a refusal.

An operation is killed, loses its power, or meets another process at a point: just before one of the steps that it takes on the
disk, or of the requests that it makes to a bucket. With `--ci` each row tries two points, with `--all` all of them.
"""

import hashlib
import io
import json
import shutil
from pathlib import Path

import obstore
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from obstore.store import MemoryStore

from schemas.errors import RunError
from services.job.record import read_success
from services.merge import merge as merge_module
from services.merge import reading
from services.merge.merge import merge
from tests.kit.crash_states import Disk, losses, recorded, write_tree
from tests.kit.faults import REQUESTS, check_published, disk, requests
from tests.kit.made_up_runs import (
    FIRST,
    RANGE,
    contents,
    half_merged,
    leftovers,
    make_dataset,
    settings_of,
)
from tests.kit.stored_images import iter_records
from tests.made_up_scenes import attempt_at, small_scene, terms
from workers.store import ledger
from workers.store import store as store_module
from workers.store.attempt import sweep
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore
from workers.store.store import Events

NEVER = 10**9
TWO = pytest.param(False, marks=pytest.mark.minute, id="two")
EVERY = pytest.param(True, marks=[pytest.mark.slow, pytest.mark.timeout(1800)], id="every")
every_point = pytest.mark.parametrize("every", [TWO, EVERY])


def points(steps: int, every: bool) -> tuple[int, ...]:
    """Numbers of the steps before which something happens."""
    return tuple(range(steps)) if every else (steps // 3, 2 * steps // 3)


def work(root: Path) -> str:
    """A run from whatever is there; the dataset's digest."""
    return make_dataset(LocalStore(root)).digest


def append_three(root: Path) -> list[bytes]:
    """Three events, each decided on those before it, as a queue or a lock decides."""
    log = Events(LocalStore(root), "jobs/j/events")
    while log.append(lambda before: json.dumps(len(before)).encode() if len(before) < 3 else None):
        pass
    return log.read()


@every_point
def test_events_ended_at_a_point_with_any_loss_and_appended_again_come_to_the_same(every, tmp_path):
    """Runs, extensions and retries, their merges too, are ended at points in tests/chaos/test_crashes.py."""
    whole = tmp_path / "whole"
    with disk():
        LocalStore(whole).prepare()
    crashed = Disk(whole)
    with recorded(whole) as steps:
        result = append_three(whole)
    kept, chosen = contents(whole), points(len(steps), every)
    for number, step in enumerate(steps):
        for loss in losses(0) if number in chosen else ():
            root, where = tmp_path / f"{number}-{loss.name}", f"before step {number}, {step[:2]}: {loss.name} lost"
            write_tree(crashed.after_a_crash(loss), root)
            with disk():
                assert append_three(root) == result, where
                sweep(LocalStore(root))
            assert contents(root) == kept and not leftovers(root), where
        crashed.play(step)


def prepared(root: Path) -> LocalStore:
    store = LocalStore(root)
    with disk():
        store.prepare()
    return store


def attempt_of(store: LocalStore):
    return attempt_at(store, FIRST, FIRST + RANGE, settings_of("files"), small_scene)


def commits(attempt) -> bool:
    """Whether an attempt wins; False also where it was swept."""
    try:
        return attempt.commit().won
    except RunError:
        return False


def swept(root: Path, step: int) -> tuple[int, object]:
    """An attempt meets a coordinator that believes it dead."""
    store = prepared(root)
    with disk(at=step, then=lambda: sweep(LocalStore(root), fenced=None)) as watched:
        won = commits(attempt_of(store))
    with disk():
        sweep(LocalStore(root))
        records = list(iter_records(store))
        assert len(records) == won, f"step {step}"
        for record in records:
            check_published(store, record)
    return watched.steps, won


def sweeping(root: Path, step: int, dies: bool = False) -> tuple[int, object]:
    """A coordinator that sweeps meets an attempt that commits, and that dies, if it does, once it has decided."""
    store, won = prepared(root), []
    with disk():
        attempt = attempt_of(store)

    def commit():
        with pytest.MonkeyPatch.context() as patch:
            if dies:
                patch.setattr("workers.store.attempt.publish", lambda *_: None)
            won.append(commits(attempt))

    with disk(at=step, then=commit) as watched:
        sweep(LocalStore(root), fenced=None)
    with disk():
        assert [record.attempt for record in iter_records(store)] == [attempt.name] * sum(won), f"step {step}"
    return watched.steps, won[0] if won else None


MEETINGS = {
    "an attempt is swept": (swept, {True, False}),
    "a sweep meets a commit": (sweeping, {True, False}),
    "a sweep meets a worker that dies decided": (lambda root, step: sweeping(root, step, dies=True), {True, False}),
}


@every_point
@pytest.mark.parametrize("name", MEETINGS)
def test_meeting_another_process_at_a_point_nothing_is_lost_or_double(name, every, tmp_path):
    """A worker that meets a rival, or somebody who publishes its range, is stopped in tests/chaos/test_stopped.py."""
    meet, outcomes = MEETINGS[name]
    with disk():
        digest = work(tmp_path / "whole")
    steps, _ = meet(tmp_path / "count", NEVER)
    seen = set()
    for step in points(steps, every):
        root = tmp_path / str(step)
        seen.add(meet(root, step)[1])
        with disk():
            assert work(root) == digest, f"step {step}"
        assert not leftovers(root), f"step {step}"
    assert seen == outcomes if every else seen <= outcomes


def promised(store) -> str | None:
    """The digest in `_SUCCESS`, all of which must be so; None where there is none."""
    success = read_success(store)
    if success is None:
        return None
    seen = {entry.key for entry in store.files("manifest") if not entry.key.startswith("manifest/_")}
    stray = seen - set(success["files"])
    assert store.root is None or not stray
    assert not any(pq.read_metadata(io.BytesIO(store.read(key))).num_rows for key in stray)
    for path, file in success["files"].items():
        assert hashlib.sha256(store.read(path)).hexdigest() == file["sha256"], path
    return success["digest"]


def merge_newer(store, stop: int) -> None:
    """A coordinator that took the lock while the merge was paused merges the scenes up to `stop`, having made what lacks."""
    if stop == 6:
        attempt_at(store, 4, 6, terms(layout=store.layouts[0], range_size=2), small_scene).commit()
    merge(store, 0, stop)


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The digest of each dataset, made by one coordinator, and its rows of views; scene 5 fails."""
    digests = {}
    for stop in (4, 6):
        store = prepared(tmp_path_factory.mktemp("alone"))
        with disk():
            for start in range(0, stop, 2):
                attempt_at(store, start, start + 2, terms(range_size=2), small_scene).commit()
            digests[stop] = merge(store, 0, stop).digest
            assert ds.dataset(store.root / "manifest/views", partitioning="hive").count_rows() == {4: 8, 6: 10}[stop]
    return digests


def pause_on_disk(tmp_path: Path, stop: int):
    """A function that pauses a merge at a step, and what is left then: (steps, store, what the merge said)."""
    with disk():
        half_merged(LocalStore(tmp_path / "seed"))

    def pause(step: int):
        root = tmp_path / str(step)
        shutil.copytree(tmp_path / "seed", root)
        with disk(at=step, then=lambda: merge_newer(LocalStore(root), stop)) as watched:
            message = refusal(LocalStore(root))
        return watched.steps, LocalStore(root), message

    return pause


def pause_in_bucket(_: Path, stop: int):
    """The same at the requests to an object store."""
    seed = MemoryStore()
    half_merged(ObjectStore(seed, "memory://"), "tar")

    def pause(step: int):
        bucket = MemoryStore()
        for meta in obstore.list(seed).collect():
            obstore.put(bucket, meta["path"], obstore.get(seed, meta["path"]).bytes())
        store = ObjectStore(bucket, "memory://")
        with pytest.MonkeyPatch.context() as patch:
            for module in (store_module, merge_module, reading, ledger):  # requests in the same order each time
                patch.setattr(module, "map_ahead", lambda store, function, items, at_once=None: map(function, items))
            with requests(at=step, then=lambda: merge_newer(store, stop), names=REQUESTS) as watched:
                message = refusal(store)
        return watched.count, store, message

    return pause


def refusal(store) -> str:
    try:
        merge(store, 0, 4)
    except RunError as error:
        return str(error)
    return ""


@every_point
@pytest.mark.parametrize("stop", [6, 4], ids=["extends", "merges again"])
@pytest.mark.parametrize("where", [pause_on_disk, pause_in_bucket], ids=["disk", "bucket"])
def test_paused_at_a_point_while_a_newer_merge_completes_one_of_them_stands(where, stop, every, expected, tmp_path):
    pause = where(tmp_path, stop)
    steps = pause(NEVER)[0]
    finished, refused = [], []
    for step in points(steps, every):
        _, store, message = pause(step)
        assert not message or "start again" in message or "outside the 0 to 3" in message
        refused.append(bool(message))
        with disk():
            digest = promised(store)
            assert digest in (None, expected[stop]), f"step {step}"
            finished.append(digest is not None)
            assert merge(store, 0, stop).digest == promised(store) == expected[stop], f"step {step}"
        merged = {entry.key for entry in store.files("manifest") if not entry.key.startswith("manifest/_")}
        assert merged < set((read_success(store) or {})["files"]), f"step {step}"
        assert not [entry for entry in store.files("_staging") if "_merge" in entry.key], f"step {step}"
    if every:
        assert sum(finished) > len(finished) // 2
        assert sum(refused) > len(refused) // 3 or (stop == 4 and where is pause_in_bucket)  # which puts the same bytes
