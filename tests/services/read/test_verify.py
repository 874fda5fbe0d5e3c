"""`verso verify`: each file is read once, and damage of each kind is told. Wrong rows: tests/services/run."""

from collections import Counter
from pathlib import Path

import obstore
import pyarrow as pa
import pytest
from obstore.store import MemoryStore

from schemas.dataset.commit import LEDGER_SCHEMA, join_rows
from services.read.verify import verify
from tests.datasets import faults_of, make_dataset
from workers.store.ledger import list_commits, save_rows
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore


@pytest.fixture(params=["files", "tar"])
def store(request, tmp_path) -> LocalStore:
    return make_dataset(tmp_path, output={"layout": request.param})[0]


def test_a_healthy_dataset_is_read_once(store, monkeypatch):
    reads: Counter[str] = Counter()
    original = LocalStore.read

    def counted(self, key):
        reads[key] += 1
        return original(self, key)

    monkeypatch.setattr(LocalStore, "read", counted)
    verdict = verify(store, lambda _: None)
    assert (verdict.faults, verdict.scenes, verdict.pairs) == ([], 2, 2)
    files = {path for path in reads if path.endswith((".png", ".tar", ".glb"))}
    assert len(files) > 3 and {reads[path] for path in files} == {1}
    assert verdict.files >= len(files)
    assert verdict.bytes >= sum(Path(store.root, path).stat().st_size for path in files)


def victim(store: LocalStore) -> Path:
    return sorted([*Path(store.root).glob("*/RGB0*.png"), *Path(store.root).glob("*/*.tar")])[0]


def test_a_flipped_bit_is_told_once_by_its_digest(store):
    path = victim(store)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    faults = faults_of(store)
    assert sum("does not match the SHA-256 in its commit" in fault for fault in faults) == 1


def test_a_missing_file_a_stray_and_a_changed_table_are_told(store):
    path = victim(store)
    path.rename(path.with_name("stray.png"))
    with open(Path(store.root, "cameras.csv"), "a") as file:
        file.write("more\n")
    faults = "\n".join(faults_of(store))
    name = f"{path.parent.name}/{path.name}"
    assert f"{name}: is committed and missing" in faults
    assert f"{path.parent.name}/stray.png: is in no commit" in faults
    assert "cameras.csv: does not match the SHA-256 in _SUCCESS" in faults


def test_a_dataset_in_an_object_store_is_read_back_as_on_a_disk(packed):
    bucket = MemoryStore()
    for path in (path for path in Path(packed.root).rglob("*") if path.is_file() and "_staging" not in path.parts):
        obstore.put(bucket, path.relative_to(packed.root).as_posix(), path)
    store = ObjectStore(bucket, "memory://dataset")
    assert verify(store, lambda _: None).faults == []
    store.put("box/stray.png", b"x")
    store.remove("camPoses.csv")
    store.remove("manifest/_ranges/0000000001/objects.parquet")
    told = verify(store, lambda _: None).faults
    assert [fault.partition(": `verso")[0].partition(": move")[0] for fault in told] == [
        "manifest/_ranges/0000000001/objects.parquet: is committed and missing",
        "camPoses.csv: is merged and missing",
        "box/stray.png: is in no commit",
    ]


def test_the_kept_summary_of_the_commits_belongs_there_and_is_checked(copy):
    store = LocalStore(copy)
    rows = list_commits(store).rows
    save_rows(store, rows)
    assert faults_of(store) == []
    retry = {**rows.to_pylist()[1], "retry": 1, "scenes": [1]}
    save_rows(store, join_rows([rows, pa.Table.from_pylist([retry], LEDGER_SCHEMA)]))
    (fault,) = faults_of(store)
    assert fault.startswith("manifest/_commits/0000000001.retry-1.json: is missing, manifest/_ledger names it: restore")
    (copy / "manifest/_ledger").write_bytes(store.read("manifest/_ledger")[:-1])
    (fault,) = faults_of(store)
    assert fault == "manifest/_ledger is damaged: remove it, the next run writes it again"
