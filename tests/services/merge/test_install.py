"""A merge that is paused at any step while a newer one completes: what is there in the end is one of them, or unfinished."""

import hashlib
import io
import json
import shutil

import obstore
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from obstore.store import MemoryStore

from schemas.dataset.layout import SUCCESS_FILE
from schemas.errors import RunError
from services.merge import merge as merge_module
from services.merge import reading
from services.merge.merge import merge, read_success
from tests.kit.faults import disk
from tests.kit.s3_server import Bucket, s3_server
from tests.made_up_scenes import attempt_at, failed_scene, small_scene, terms
from workers.store import ledger, objects
from workers.store import store as store_module
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

VIEWS = {4: 8, 6: 10}
"""Rows of views by the number of scenes, of which number 5 fails."""
SOME = 24
"""Every so many steps by default; `--all` takes each of them."""
_EVERY = pytest.param(1, marks=[pytest.mark.slow, pytest.mark.timeout(1800)], id="every")
some_or_every = pytest.mark.parametrize("stride", [pytest.param(SOME, id="some"), _EVERY])


def first_try(scene_id):
    """The scene, or, of one, an environmental failure: its file of failures has no successor after the retry."""
    return failed_scene(scene_id, "environmental") if scene_id == 1 else small_scene(scene_id)


def begin(store) -> None:
    """Two ranges and a retry committed; the first range was merged before the others came."""
    layout = "tar" if store.root is None else "files"
    settings = terms(layout=layout, range_size=2)
    store.prepare()
    attempt_at(store, 0, 2, settings, first_try).commit()
    merge(store, 0, 2)
    attempt_at(store, 0, 2, settings, small_scene, retry=1, scenes=(1,)).commit()
    attempt_at(store, 2, 4, settings, small_scene).commit()


def extend(store) -> None:
    """What a newer coordinator does: one more range, and the merge of all."""
    layout = "tar" if store.root is None else "files"
    attempt_at(store, 4, 6, terms(layout=layout, range_size=2), small_scene).commit()
    merge(store, 0, 6)


def merge_again(store) -> None:
    """A newer coordinator that finds nothing to make."""
    merge(store, 0, 4)


def promised(store) -> str | None:
    """The digest in `_SUCCESS`, all of which must be so; None where there is none."""
    success = read_success(store)
    if success is None:
        return None
    found = {entry.key for entry in store.files("manifest") if not entry.key.startswith(("manifest/_",))}
    stray = found - set(success["files"])
    assert store.root is None or not stray
    assert not any(pq.read_metadata(io.BytesIO(store.read(key))).num_rows for key in stray)
    for path, file in success["files"].items():
        assert hashlib.sha256(store.read(path)).hexdigest() == file["sha256"], path
    return success["digest"]


NEWER = pytest.mark.parametrize(("newer", "stop"), [(extend, 6), (merge_again, 4)], ids=["extends", "merges again"])


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The digest of each dataset, made by one coordinator."""
    digests = {}
    for stop in (4, 6):
        store = LocalStore(tmp_path_factory.mktemp("alone"))
        with disk():
            store.prepare()
            for start in range(0, stop, 2):
                attempt_at(store, start, start + 2, terms(range_size=2), small_scene).commit()
            digests[stop] = merge(store, 0, stop).digest
    return digests


def check_end(store, newer, stop, expected, step) -> bool:
    """Whether the dataset is finished; if it is not, one more run finishes it."""
    digest = promised(store)
    assert digest in (None, expected[stop]), f"step {step}"
    assert merge(store, 0, stop).digest == expected[stop]
    assert promised(store) == expected[stop], f"step {step}"
    merged = {key for key in (entry.key for entry in store.files("manifest")) if not key.startswith("manifest/_")}
    assert merged < set((read_success(store) or {})["files"]), f"step {step}"
    assert not [entry for entry in store.files("_staging") if "_merge" in entry.key], f"step {step}"
    return digest is not None


@some_or_every
@NEWER
def test_paused_at_a_step_on_a_disk_while_a_newer_merge_completes(newer, stop, stride, expected, tmp_path):
    with disk():
        begin(LocalStore(tmp_path / "seed"))
    ends = []
    step = 0
    while True:
        root = tmp_path / str(step)
        shutil.copytree(tmp_path / "seed", root)
        with disk(at=step, then=lambda root=root: newer(LocalStore(root))) as watched:
            try:
                merge(LocalStore(root), 0, 4)
                told = ""
            except RunError as error:
                told = str(error)
        if watched.steps <= step:
            break
        with disk():
            ends.append((check_end(LocalStore(root), newer, stop, expected, step), told))
            assert ds.dataset(root / "manifest/views", partitioning="hive").count_rows() == VIEWS[stop]
        shutil.rmtree(root)
        step += stride
    assert all("start again" in told or "outside the 0 to 3" in told for finished, told in ends if told)
    assert sum(bool(told) for _, told in ends) > len(ends) // 3  # the paused one mostly refuses
    assert sum(finished for finished, _ in ends) > len(ends) // 2


class Paused:
    """`obstore`, whose calls are counted; just before number `at` another process does something."""

    def __init__(self, at: int, then) -> None:
        self.calls = 0
        self._at, self._then, self._busy = at, then, False

    def __getattr__(self, name):
        real = getattr(obstore, name)

        def call(*arguments, **named):
            if not self._busy and name in ("put", "copy", "delete", "list", "get", "head"):
                self.calls += 1
                if self.calls - 1 == self._at:
                    self._busy = True
                    self._then()
                    self._busy = False
            return real(*arguments, **named)

        return call if callable(real) else real


def copy_of(seed: MemoryStore) -> ObjectStore:
    bucket = MemoryStore()
    for meta in obstore.list(seed).collect():
        obstore.put(bucket, meta["path"], obstore.get(seed, meta["path"]).bytes())
    return ObjectStore(bucket, "memory://")


@some_or_every
@NEWER
def test_paused_at_a_request_to_an_object_store_while_a_newer_merge_completes(
    newer, stop, stride, expected, monkeypatch
):
    for module in (store_module, merge_module, reading, ledger):  # requests in the same order each time
        monkeypatch.setattr(module, "map_ahead", lambda store, function, items, at_once=None: map(function, items))
    seed = MemoryStore()
    begin(ObjectStore(seed, "memory://"))
    finished, refused = [], []
    at = 0
    while True:
        store = copy_of(seed)
        watched = Paused(at, lambda store=store: newer(store))
        with monkeypatch.context() as patch:
            patch.setattr(objects, "obstore", watched)
            try:
                merge(store, 0, 4)
            except RunError as error:
                refused.append(str(error))
        if watched.calls <= at:
            break
        finished.append(check_end(store, newer, stop, expected, at))
        at += stride
    assert all("start again" in told or "outside the 0 to 3" in told for told in refused)
    assert len(refused) > at // stride // 3 or newer is merge_again  # which puts the same bytes
    assert sum(finished) > len(finished) // 2


@pytest.mark.parametrize("question", [1, 2, 3])
def test_a_merge_whose_lock_is_lost_stops_before_it_replaces_anything(question, tmp_path):
    store = LocalStore(tmp_path)
    with disk():
        begin(store)
        before = {path: path.read_bytes() for path in tmp_path.rglob("*.csv")}
        asked = []

        def require_held():
            asked.append(1)
            if len(asked) == question:
                raise RunError("taken over")

        with pytest.raises(RunError, match="taken over"):
            merge(store, 0, 4, require_held)
    replaced = before != {path: path.read_bytes() for path in tmp_path.rglob("*.csv")}
    assert replaced == (question == 3)
    assert not (tmp_path / SUCCESS_FILE).exists()
    assert json.loads((tmp_path / "manifest/_commits/0000000000.json").read_text())


@pytest.mark.parametrize("far", [False, True], ids=["disk", "object store"])
def test_a_commit_that_arrives_during_the_merge_is_noticed(far, tmp_path, monkeypatch):
    store = ObjectStore(MemoryStore(), "memory://") if far else LocalStore(tmp_path)
    begin(store)
    real = merge_module.Installation.put_files

    def late(*arguments):
        attempt_at(store, 4, 6, terms(layout="tar" if far else "files", range_size=2), small_scene).commit()
        return real(*arguments)

    monkeypatch.setattr(merge_module.Installation, "put_files", late)
    with pytest.raises(RunError, match="committed while they were merged"):
        merge(store, 0, 4)
    assert read_success(store) is None


def test_an_object_store_is_asked_for_each_file_of_a_range_once_and_many_at_a_time():
    asked = {}
    for ranges in (4, 16):
        held = Bucket()
        with s3_server(held) as bucket:
            store = ObjectStore(bucket, "s3://mine")
            store.prepare()
            for start in range(0, 2 * ranges, 2):
                attempt_at(store, start, start + 2, terms(layout="tar", range_size=2), small_scene).commit()
            held.requests.clear()
            held.delay_s = 0.02
            merge(store, 0, 2 * ranges)
            asked[ranges] = held.requests.total()
    assert asked[16] - asked[4] <= 12 * 7  # a record and up to six tables
    assert held.most_at_once > 8
