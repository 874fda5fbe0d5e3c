"""Tables of a dataset in a folder and in a bucket, and how much of a bucket is read for a question."""

import obstore
import pytest
from obstore.store import MemoryStore

from schemas.dataset.tables import SCHEMAS
from services.merge.merge import merge
from services.read.query import ask, query
from services.read.stored_tables import StoredTables, read_merged
from tests.made_up_scenes import attempt_at, scene
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")

STOP = 8


class Watched(ObjectStore):
    """Notes which files are read."""

    def read(self, key: str) -> bytes:
        self.__dict__.setdefault("keys", []).append(key)
        return super().read(key)


@pytest.fixture(scope="module", params=["running", "finished"])
def pair(request, tmp_path_factory) -> tuple[LocalStore, Watched]:
    """The same dataset in a folder and in a bucket."""
    store = LocalStore(tmp_path_factory.mktemp("made"))
    store.prepare()
    for start in range(0, STOP, 4):
        attempt_at(store, start, start + 4).commit()
    if request.param == "finished":
        merge(store, 0, STOP)
    bucket = MemoryStore()
    for path in (path for path in store.root.rglob("*") if path.is_file()):
        obstore.put(bucket, path.relative_to(store.root).as_posix(), path)
    return store, Watched(bucket, "memory://bucket")


@pytest.mark.parametrize("table", ["scenes", "views", "objects", "failures", "timings"])
def test_a_bucket_has_the_rows_of_the_folder(pair, table):
    tables = [StoredTables(store).dataset(table).to_table().sort_by("scene_id") for store in pair]
    assert tables[0].equals(tables[1]) and tables[0].num_rows and tables[0].column_names == SCHEMAS[table].names


def test_a_question_to_a_bucket_reads_the_tables_that_it_names_alone(pair):
    bucket = pair[1]
    bucket.keys = []
    query(bucket, "select count(*) from failures")
    read = [key for key in bucket.keys if key.endswith(".parquet")]
    assert read and all("failures" in key for key in read)


def test_an_answer_comes_in_batches(pair):
    for store in pair:
        with ask(store, "select v.* from views v, range(400)") as answer:
            sizes = [len(batch) for batch in answer]
        views = sum(len(scene(i).rows.get("views", ())) for i in range(STOP))
        assert sum(sizes) == 400 * views and len(sizes) > 1 and max(sizes) <= 4096


def test_a_merged_file_alone_has_its_category(pair):
    store = pair[0]
    for path in store.root.glob("manifest/scenes/*/*.parquet"):
        key = path.relative_to(store.root).as_posix()
        rows = read_merged("scenes", key, path.read_bytes())
        assert set(rows["category"].to_pylist()) == {path.parent.name.removeprefix("category=")}
