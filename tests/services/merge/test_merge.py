"""Merging: what `_SUCCESS` promises, what is refused, what another coordinator may do meanwhile, the dataset digest, and limits
of a machine: a disk that is full at any point (real ones are in tests/chaos), and memory however many ranges.
"""

import dataclasses
import hashlib
import json
import resource
import subprocess
import sys

import numpy as np
import pytest
from obstore.store import MemoryStore

from schemas.dataset.layout import STAGING, SUCCESS_FILE
from schemas.dataset.tables import TABLES
from schemas.errors import CommitConflict, CorruptError, MachineError, RunError
from services.job.record import read_success
from services.merge import merge as merge_module
from services.merge.merge import merge
from tests.kit.faults import disk
from tests.kit.made_up_runs import half_merged
from tests.kit.s3_server import Bucket, s3_server
from tests.made_up_datasets import FIRST, STOP, dataset_at
from tests.made_up_scenes import attempt_at, failed_scene, made_scene, scene, small_scene, terms, with_shapes
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")
SINGLE = ("camPoses.csv", "cameras.csv", "objects.dat")


def test_success_names_the_digest_of_every_merged_file_and_the_dataset_digest_is_as_defined(merged):
    store, result = merged
    success = json.loads((store.root / "_SUCCESS").read_text())
    assert (success["digest"], success["schema_version"]) == (result.digest, 1)
    assert set(SINGLE) < success["files"].keys()
    on_disk = {str(path.relative_to(store.root)) for path in (store.root / "manifest").glob("[a-z]*/*/*.parquet")}
    assert {name for name in success["files"] if name.startswith("manifest/")} == on_disk
    for name, file in success["files"].items():
        data = (store.root / name).read_bytes()
        assert (file["bytes"], file["sha256"]) == (len(data), hashlib.sha256(data).hexdigest())
    assert success["scenes"] == {"made": 24, "intrinsic": 3, "environmental": 0}
    assert success["images"] == 24 * 22
    files = {file.path: file.data for i in range(FIRST, STOP) for file in scene(i).files}
    files |= {name: (store.root / name).read_bytes() for name in SINGLE}
    text = "verso dataset 1\n" + "".join(f"{table} {success['tables'][table]}\n" for table in list(TABLES)[:5])
    for name in sorted(files, key=str.encode):
        text += f"{name}\n{hashlib.sha256(files[name]).hexdigest()}\n"
    assert result.digest == hashlib.sha256(text.encode()).hexdigest()


def test_merging_again_changes_nothing_and_makes_again_what_was_lost_or_torn(tmp_path):
    store = dataset_at(tmp_path)
    stale = tmp_path / "manifest/views/category=old/part-00007.parquet"
    stale.parent.mkdir(parents=True)
    stale.write_bytes(b"torn")
    first = merge(store, FIRST, STOP)
    assert not stale.parent.exists() and not list(store.files(STAGING))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()}
    assert merge(store, FIRST, STOP) == first
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*") if path.is_file()} == before
    for lost in ("camPoses.csv", "manifest/views/category=mug/part-00000.parquet", "_SUCCESS"):
        (tmp_path / lost).unlink()
        assert merge(store, FIRST, STOP) == first
        assert (tmp_path / lost).exists()
    (tmp_path / "_SUCCESS").write_bytes((tmp_path / "_SUCCESS").read_bytes()[:100])
    assert read_success(store) is None
    assert merge(store, FIRST, STOP) == first


def test_a_gap_or_an_image_that_is_missing_or_cut_is_told_and_nothing_is_merged(tmp_path):
    store = dataset_at(tmp_path, 0, 8)
    image = made_scene(1).files[0].path

    def refused(error: type, stop: int, words: str) -> None:
        with pytest.raises(error, match=words):
            merge(store, 0, stop)
        assert not (tmp_path / "camPoses.csv").exists() and not (tmp_path / "manifest/views").exists()
        assert not list(store.files(STAGING))

    refused(RunError, 12, "scenes 8 to 11 are not committed")
    store.put(image, b"cut")
    refused(CorruptError, 8, f"{image} has 3 bytes")
    store.remove(image)
    refused(CorruptError, 8, f"{image} is named by a commit")


def own_description(scene_id):
    output = made_scene(scene_id)
    rows = [{**row, "split": "test" if scene_id >= 4 else "train"} for row in output.rows["assets"]]
    return dataclasses.replace(output, rows={**output.rows, "assets": rows})


def own_shape(scene_id):
    return with_shapes(made_scene(scene_id), lambda data: data[::-1] if scene_id >= 4 else data)


@pytest.mark.parametrize("make", [own_description, own_shape])
def test_an_asset_that_ranges_made_differently_is_a_conflict_of_one_stack_and_merged_where_a_mix_is_allowed(
    tmp_path, make
):
    store = dataset_at(tmp_path / "one", 0, 8, make=make)
    with pytest.raises(CommitConflict, match=r"differently|two digests"):
        merge(store, 0, 8)
    assert read_success(store) is None
    mixed = LocalStore(tmp_path / "mixed")
    mixed.prepare()
    for start, name in ((0, "stack-a"), (4, "stack-b")):
        attempt_at(mixed, start, start + 4, terms(fingerprint=name, fingerprint_mode="record"), make).commit()
    assert merge(mixed, 0, 8).complete
    assert json.loads(mixed.read("_SUCCESS"))["fingerprints"] == ["stack-a", "stack-b"]


@pytest.mark.parametrize("question", [1, 2, 3])
def test_a_merge_whose_lock_is_lost_stops_before_it_replaces_anything(question, tmp_path):
    store = LocalStore(tmp_path)
    with disk():
        half_merged(store)
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
    half_merged(store, store.layouts[0])
    real = merge_module.put_files

    def late(*arguments):
        attempt_at(store, 4, 6, terms(layout=store.layouts[0], range_size=2), small_scene).commit()
        return real(*arguments)

    monkeypatch.setattr(merge_module, "put_files", late)
    with pytest.raises(RunError, match="committed while they were merged"):
        merge(store, 0, 4)
    assert read_success(store) is None


@pytest.mark.minute
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


def test_the_digest_does_not_depend_on_ranges_order_layout_or_attempts(merged, tmp_path):
    for number, how in enumerate(
        [{"size": 1}, {"size": 7}, {"size": 100}, {"order": -1}, {"layout": "tar", "size": 5, "order": -1}]
    ):
        assert merge(dataset_at(tmp_path / str(number), **how), FIRST, STOP) == merged[1], how


def test_a_dataset_whose_killed_scenes_were_retried_has_the_digest_of_one_without_kills(merged, tmp_path):
    def killed(scene_id):
        return failed_scene(scene_id, "environmental") if scene_id in (7, 8, 20) else scene(scene_id)

    store = dataset_at(tmp_path, make=killed)
    first = merge(store, FIRST, STOP)
    assert (first.complete, first.scenes["environmental"]) == (False, 3)
    assert read_success(store) is None
    assert first.digest != merged[1].digest
    attempt_at(store, 7, 11, retry=1, scenes=(7, 8)).commit()
    attempt_at(store, 19, 23, retry=1, scenes=(20,)).commit()
    assert merge(store, FIRST, STOP) == merged[1]


@pytest.mark.minute
def test_the_digest_tells_of_a_changed_image_row_shape_or_failure(merged, tmp_path):
    def with_row(output, table: str, **changes):
        return dataclasses.replace(output, rows={**output.rows, table: [{**output.rows[table][0], **changes}]})

    margin = np.nextafter(scene(12).rows["scenes"][0]["support_margin_mm"], 99)
    changes = [
        lambda i: made_scene(12, salt="!") if i == 12 else scene(i),
        lambda i: with_row(scene(i), "scenes", support_margin_mm=margin) if i == 12 else scene(i),
        lambda i: with_row(failed_scene(i), "failures", detail="it slid") if i == 16 else scene(i),
        lambda i: with_shapes(scene(i), lambda data: data[::-1]),
    ]
    made = [dataset_at(tmp_path / str(number), make=make) for number, make in enumerate(changes)]
    assert len({merged[1].digest, *(merge(store, FIRST, STOP).digest for store in made)}) == 5


# ---------------------------------------------------------------------------------------------- limits of a machine


def test_a_merge_without_room_at_any_size_of_a_file_says_so_and_can_be_done_again(merged, tmp_path):
    """Writes beyond so many bytes of a file fail, as on a full disk."""
    store = dataset_at(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    limits = [64]
    while True:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limits[-1], before[1]))
        try:
            merge(store, FIRST, STOP)
            break
        except MachineError as error:
            message = str(error)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert "could not write" in message or "could not be written" in message
        assert "\n" not in message and not list(store.files(STAGING))
        limits.append(limits[-1] * 8 // 5)
    assert len(limits) > 12
    assert merge(store, FIRST, STOP) == merged[1]


MANY = """
import json, sys, time
from pathlib import Path
from services.merge import merge, reading, tables
from tests.kit.many_ranges import ManyRanges

folder, ranges, limits = Path(sys.argv[1]), int(sys.argv[2]), json.loads(sys.argv[3])
tables.ROWS_PER_GROUP, merge.ROWS_PER_BLOCK, reading.CACHE_KIB = limits

class Watched(ManyRanges):
    rss_mib = {}

    def _tables(self, scene_id):
        if scene_id * 20 % self.scenes == 0:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.rss_mib[scene_id] = pages * 4096 / 2**20
        return super()._tables(scene_id)

store = Watched(folder, ranges)
begun = time.perf_counter()
result = merge.merge(store, 0, store.scenes)
print(json.dumps([result.rows, list(store.rss_mib.values()), time.perf_counter() - begun]))
"""


@pytest.mark.parametrize(
    ("ranges", "limits", "most_mib"),
    [
        pytest.param(2_000, [512, 512, 2 << 10], 16.0, marks=pytest.mark.minute),
        pytest.param(20_000, [8_192, 4_096, 16 << 10], 48.0, marks=pytest.mark.slow),
    ],
)
def test_a_merge_takes_as_much_memory_at_its_end_as_at_its_beginning(ranges, limits, most_mib, tmp_path, record_figure):
    """Limits of a tenth show with a tenth of the rows what those of the program hold."""
    command = [sys.executable, "-c", MANY, str(tmp_path), str(ranges), json.dumps(limits)]
    rows, rss_mib, seconds = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    assert rows["views"] == 10 * (ranges - ranges // 1000)
    grown = rss_mib[-1] - rss_mib[2]
    record_figure(f"merge_grown_mib_in_{ranges}_ranges", "passed", grown, most_mib)
    record_figure("merge_rows_per_s", "passed", sum(rows.values()) / seconds)
    assert grown < most_mib
