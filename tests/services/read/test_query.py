"""SQL over the tables: of a dataset finished and being made, in a folder and in a bucket, and its answers in four formats."""

import csv
import io
import json
import subprocess
import sys
from collections import Counter

import duckdb
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

from schemas.dataset.layout import STAGING
from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import CorruptError, InputError, OutputError
from services.job.record import read_success
from services.merge.merge import merge
from services.read.dataset_reader import StoredTables, file_system_of
from services.read.query import Format, ask, query, write_rows
from tests.datasets import in_a_bucket
from tests.made_up_scenes import attempt_at, failed_scene, fails, scene
from workers.store.commit import publish
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")

STOP = 12


def running(root) -> LocalStore:
    store = LocalStore(root)
    store.prepare()
    for start in range(0, STOP, 4):
        attempt_at(store, start, start + 4).commit()
    return store


@pytest.fixture(scope="module", params=["running", "finished"])
def dataset(request, tmp_path_factory):
    store = running(tmp_path_factory.mktemp(request.param))
    if request.param == "finished":
        merge(store, 0, STOP)
    return store


def test_every_table_has_every_row_and_column_and_asking_writes_nothing(dataset):
    before = {path: path.stat().st_mtime_ns for path in dataset.root.rglob("*")}
    order = lambda row: json.dumps(row, sort_keys=True)  # noqa: E731
    for table in TABLES:
        rows = [row for scene_id in range(STOP) for row in scene(scene_id).rows.get(table, ())]
        if table == "assets":
            rows = list({row["instance_id"]: row for row in rows}.values())
        answer = query(dataset, f"select * from {table}")
        assert answer.column_names == SCHEMAS[table].names and answer.num_rows == len(rows)
        if table != "timings":  # measured anew in every call
            assert sorted(answer.to_pylist(), key=order) == sorted(rows, key=order)
    sql = """select v.role, count(*) as files from views v join scenes s using (scene_id), unnest(v.files)
             where s.redraws = 0 group by v.role order by v.role"""
    kept = [i for i in range(STOP) if not fails(i) and i % 3 == 0]
    expected = Counter(v["role"] for i in kept for v in scene(i).rows["views"] for _ in v["files"])
    assert {row["role"]: row["files"] for row in query(dataset, sql).to_pylist()} == expected
    assert query(dataset, "SHOW TABLES;").column("name").to_pylist() == sorted(TABLES)
    assert {path: path.stat().st_mtime_ns for path in dataset.root.rglob("*")} == before


FORBIDDEN = (
    *("select * from read_text('/etc/hostname')", "select * from '/etc/hostname'", "select getenv('HOME')"),
    *("select * from read_parquet('manifest/*/*/*.parquet')", "copy (select 1) to 'stolen.csv'", "attach 'other.db'"),
    *("install httpfs", "set enable_external_access = true", "reset lock_configuration", "export database 'copy'"),
    *("insert into views select * from views", "set threads = 1"),
)
WRONG = {
    "selec 1": "syntax error at or near",
    "select nope from views": 'column "nope" not found',
    "": "there is no question",
    "select * from scnes": 'Did you mean "scenes',
    # Goes wrong only while the answer comes.
    "select case when i < 90000 then i else cast('x' || i as int) end from range(100000) t(i)": (
        "the query failed: Conversion Error: Could not convert string 'x90000'"
    ),
}


def test_nothing_else_can_be_read_nothing_written_and_wrong_sql_is_told_in_one_line(dataset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for sql, message in {**dict.fromkeys(FORBIDDEN), **WRONG}.items():
        with pytest.raises(InputError, match=message) as raised:
            query(dataset, sql)
        assert "\n" not in str(raised.value)
    with pytest.raises(OutputError, match="holds no dataset that can be asked"):
        query(LocalStore(tmp_path / "nowhere"), "select 1")
    assert not list(tmp_path.iterdir())


def test_only_what_is_committed_counts_even_before_it_is_published(tmp_path, monkeypatch):
    store = running(tmp_path)
    attempt_at(store, 12, 16)
    with monkeypatch.context() as patch:
        patch.setattr("workers.store.attempt.publish", lambda *_: None)
        attempt_at(store, 16, 20).commit()
    answer = query(store, "select scene_id from scenes union all select scene_id from failures order by all")
    assert answer.column(0).to_pylist() == [*range(12), *range(16, 20)]


def test_a_range_that_is_published_between_two_looks_is_seen_once(tmp_path, monkeypatch):
    store = running(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr("workers.store.attempt.publish", lambda *_: None)
        record = attempt_at(store, 12, 16).commit().record
    real, looked = LocalStore.children, []

    def publish_after(self, prefix):
        found = real(self, prefix)
        if prefix == STAGING and not looked:
            looked.append(prefix)
            publish(store, record)
        return found

    monkeypatch.setattr(LocalStore, "children", publish_after)
    assert query(store, "select count(*) from timings").column(0).to_pylist() == [16]
    assert looked


def test_a_retry_replaces_what_it_tried_again(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    attempt_at(store, 0, 4, make=lambda i: failed_scene(i, "environmental") if i in (1, 2) else scene(i)).commit()
    attempt_at(store, 0, 4, retry=1, scenes=(1, 2), make=lambda i: scene(i) if i == 1 else failed_scene(i)).commit()
    assert query(store, "select scene_id, kind from failures").to_pylist() == [{"scene_id": 2, "kind": "intrinsic"}]
    assert query(store, "select count(*) n from views").to_pylist() == [{"n": 12}]


def test_a_flipped_bit_in_a_merged_file_is_not_read_silently(tmp_path):
    store = running(tmp_path)
    merge(store, 0, STOP)
    path = next((tmp_path / "manifest/views").glob("*/*.parquet"))
    data, caught = path.read_bytes(), 0
    for position in range(8, 2000, 190):
        path.write_bytes(data[:position] + bytes([data[position] ^ 4]) + data[position + 1 :])
        try:
            answer = query(store, "select * from views")
        except CorruptError as error:
            caught += "verso verify" in str(error)
        else:
            assert answer.num_rows == read_success(store)["rows"]["views"]
    assert caught > 5


class Watched(ObjectStore):
    """Notes which files are read."""

    def read(self, key: str) -> bytes:
        self.__dict__.setdefault("keys", []).append(key)
        return super().read(key)


def test_a_bucket_has_the_rows_of_the_folder_and_only_the_tables_asked_are_read(dataset):
    bucket = in_a_bucket(dataset.root, Watched)
    for table in ("scenes", "views", "objects", "failures", "timings"):
        here, there = (
            StoredTables(one).dataset(table).to_table().sort_by("scene_id").combine_chunks()
            for one in (dataset, bucket)
        )
        assert here.equals(there) and here.num_rows and here.column_names == SCHEMAS[table].names
    bucket.keys = []
    query(bucket, "select count(*) from failures")
    read = [key for key in bucket.keys if key.endswith(".parquet")]
    assert read and all("failures" in key for key in read)
    views = sum(len(scene(i).rows.get("views", ())) for i in range(STOP))
    for store in (dataset, bucket):
        with ask(store, "select v.* from views v, range(400)") as answer:
            sizes = [len(batch) for batch in answer]
        assert sum(sizes) == 400 * views and len(sizes) > 1 and max(sizes) <= 4096
    files = file_system_of(bucket)
    with pytest.raises(NotImplementedError, match="only read"):
        files.open_output_stream("t/new")
    with pytest.raises(CorruptError, match=r"9\.parquet is committed and missing"):
        ds.dataset(["t/9.parquet"], pa.schema([("n", pa.int64())]), "parquet", filesystem=files).to_table()


def format_rows(rows: pa.Table, style: Format) -> bytes:
    sink = io.BytesIO()
    write_rows(rows.to_reader(), style, sink)
    return sink.getvalue()


ROWS = pa.table({"n": [1, 2], "name": ["a,b", None], "list": [[1.5, -0.0], []], "flag": [True, False]})


def test_an_answer_in_each_format_reads_back(monkeypatch):
    rows = list(csv.reader(io.StringIO(format_rows(ROWS, "csv").decode())))
    assert rows == [["n", "name", "list", "flag"], ["1", "a,b", "[1.5, -0.0]", "true"], ["2", "", "[]", "false"]]
    assert json.loads(format_rows(ROWS, "json")) == ROWS.to_pylist()
    assert pq.read_table(pa.BufferReader(format_rows(ROWS, "parquet"))).equals(ROWS)
    empty, odd = "select 1 as x where false", "select date '2026-01-01' d, 1.5::decimal(5,2) x, {'a': 1} s, 'x'::blob b"
    for style in ("table", "csv", "json", "parquet"):
        assert all(format_rows(duckdb.sql(sql).to_arrow_table(), style) for sql in (empty, odd))


def test_a_table_for_people_is_a_box_that_says_how_much_of_a_long_answer_it_shows():
    lines = format_rows(ROWS, "table").decode().splitlines()
    assert lines[0].startswith("┌") and "a,b" in "".join(lines) and "[1.5, -0.0]" in "".join(lines)
    told = format_rows(pa.table({"n": range(500)}), "table").decode()
    assert "500 rows" in told and "shown" in told and len(told.splitlines()) < 60
    assert ">9999 rows" in format_rows(pa.table({"n": range(30_000)}), "table").decode()
    sink = io.BytesIO()
    write_rows(pa.table({f"c{n}": [1] for n in range(50)}).to_reader(), "table", sink, wide=80)
    assert max(map(len, sink.getvalue().decode().splitlines())) <= 80


class Pipe(io.RawIOBase):
    """Takes bytes, and can neither tell nor seek, as standard output into another program."""

    def __init__(self) -> None:
        self.data = b""
        self.largest = 0

    def writable(self) -> bool:
        return True

    def write(self, data) -> int:
        self.data += bytes(data)
        self.largest = max(self.largest, len(data))
        return len(data)

    def tell(self) -> int:
        raise OSError("a pipe")


def test_a_long_answer_leaves_in_pieces_before_it_is_whole(monkeypatch):
    monkeypatch.setattr("services.read.query._ROW_GROUP_BYTES", 30_000)
    schema = pa.schema([("n", pa.int64()), ("word", pa.string())])
    for style in ("csv", "json", "parquet"):
        pipe, seen = Pipe(), []

        def batches(pipe=pipe, seen=seen):
            for at in range(0, 20_000, 1000):
                seen.append(len(pipe.data))
                words = [f"word {n}" for n in range(at, at + 1000)]
                yield pa.record_batch([pa.array(range(at, at + 1000)), pa.array(words)], schema)

        write_rows(pa.RecordBatchReader.from_batches(schema, batches()), style, pipe)
        assert seen == sorted(seen) and seen[-1] > len(pipe.data) / 2 and pipe.largest < len(pipe.data) / 4


ASK = """
import json, os, sys
from tests.kit.memory import peak_mib
from services.read.query import ask, write_rows
from workers.store.local import LocalStore
peaks = []
for times in map(int, sys.argv[4:]):
    sql = f"select {sys.argv[3]} from views v, range({times})"
    with ask(LocalStore(sys.argv[1]), sql) as rows, open(os.devnull, "wb") as sink:
        write_rows(rows, sys.argv[2], sink)
    peaks.append(peak_mib())
print(json.dumps(peaks))
"""


@pytest.mark.minute
def test_ten_times_the_rows_take_no_more_memory(tiny, record_figure):
    """As a whole the rows take more than 48 MiB; that of the first answer is what row groups and buffers need."""
    for style, columns, times in (("csv", "v.pose_id, v.T_world_cam", 800), ("parquet", "v.*", 2000)):
        command = [sys.executable, "-c", ASK, tiny.name, style, columns, str(times), str(10 * times)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        few, many = json.loads(done.stdout)
        record_figure(f"query_growth_mib[{style}]", "passed", many - few, 48.0)
        assert many - few < 48.0
