import json
from collections import Counter

import pytest

from schemas.dataset.layout import STAGING
from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import CorruptError, InputError, OutputError
from services.merge.merge import merge, read_success
from services.read.query import query
from tests.made_up_scenes import attempt_at, failed_scene, fails, scene
from workers.store.local import LocalStore

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


@pytest.mark.parametrize("table", [table for table in TABLES if table != "timings"])
def test_a_table_has_every_row_and_column(dataset, table):
    rows = [row for scene_id in range(STOP) for row in scene(scene_id).rows.get(table, ())]
    if table == "assets":
        rows = list({row["instance_id"]: row for row in rows}.values())
    answer = query(dataset, f"select * from {table}")
    assert answer.column_names == SCHEMAS[table].names
    order = lambda row: json.dumps(row, sort_keys=True)  # noqa: E731
    assert sorted(answer.to_pylist(), key=order) == sorted(rows, key=order)


def test_questions_over_several_tables_are_answered(dataset):
    sql = """select v.role, count(*) as files from views v join scenes s using (scene_id), unnest(v.files)
             where s.redraws = 0 group by v.role order by v.role"""
    kept = [i for i in range(STOP) if not fails(i) and i % 3 == 0]
    expected = Counter(v["role"] for i in kept for v in scene(i).rows["views"] for _ in v["files"])
    assert {row["role"]: row["files"] for row in query(dataset, sql).to_pylist()} == expected


@pytest.mark.parametrize(
    "sql",
    [
        "select * from read_text('/etc/hostname')",
        "select * from '/etc/hostname'",
        "select * from read_parquet('manifest/*/*/*.parquet')",
        "copy (select 1) to 'stolen.csv'",
        "attach 'other.db'",
        "install httpfs",
        "set enable_external_access = true",
        "reset lock_configuration",
        "export database 'copy'",
        "select getenv('HOME')",
        "insert into views select * from views",
    ],
)
def test_nothing_else_can_be_read_and_nothing_written(dataset, sql, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError):
        query(dataset, sql)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("sql", "message"),
    [
        ("selec 1", "syntax error at or near"),
        ("select nope from views", 'column "nope" not found'),
        ("", "there is no question"),
    ],
)
def test_wrong_sql_is_told_in_one_line(dataset, sql, message):
    with pytest.raises(InputError, match=message) as raised:
        query(dataset, sql)
    assert "\n" not in str(raised.value)


def test_asking_writes_nothing(dataset):
    before = {path: path.stat().st_mtime_ns for path in dataset.root.rglob("*")}
    query(dataset, "select count(*) from views")
    assert {path: path.stat().st_mtime_ns for path in dataset.root.rglob("*")} == before


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
    real = LocalStore.children
    looked = []

    def publish_after(self, prefix):
        found = real(self, prefix)
        if prefix == STAGING and not looked:
            looked.append(prefix)
            from workers.store.commit import publish

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


def test_a_dataset_without_commits_cannot_be_asked(tmp_path):
    with pytest.raises(OutputError, match="holds no dataset that can be asked"):
        query(LocalStore(tmp_path / "nowhere"), "select 1")
    assert not list(tmp_path.iterdir())


def test_a_flipped_bit_in_a_merged_file_is_not_read_silently(tmp_path):
    store = running(tmp_path)
    merge(store, 0, STOP)
    path = next((tmp_path / "manifest/views").glob("*/*.parquet"))
    whole = path.read_bytes()
    caught = 0
    for position in range(8, 2000, 190):
        damaged = bytearray(whole)
        damaged[position] ^= 4
        path.write_bytes(damaged)
        try:
            answer = query(store, "select * from views")
        except CorruptError as error:
            caught += "verso verify" in str(error)
        else:
            assert answer.num_rows == read_success(store)["rows"]["views"]
    assert caught > 5


def test_what_goes_wrong_while_an_answer_comes_is_told_as_what_is_wrong_at_once(dataset):
    sql = "select case when i < 90000 then i else cast('x' || i as int) end from range(100000) t(i)"
    with pytest.raises(InputError, match=r"the query failed: Conversion Error: Could not convert string 'x90000'"):
        query(dataset, sql)


def test_a_statement_without_an_answer_is_refused(dataset):
    with pytest.raises(InputError):
        query(dataset, "set threads = 1")


def test_the_tables_are_shown_without_what_they_are_made_of_and_a_wrong_name_has_the_right_one_told(dataset):
    assert query(dataset, "SHOW TABLES;").column("name").to_pylist() == sorted(TABLES)
    with pytest.raises(InputError, match='Did you mean "scenes'):
        query(dataset, "select * from scnes")
