"""A bucket as a file system of pyarrow's: whole files, read when they are scanned, and never written."""

import obstore
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from obstore.store import MemoryStore

from schemas.errors import CorruptError
from services.read.stored_tables import file_system_of
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore


@pytest.fixture(params=["folder", "bucket"])
def store(request, tmp_path):
    for number in range(3):
        (tmp_path / "t").mkdir(exist_ok=True)
        pq.write_table(pa.table({"n": [number, number + 10]}), tmp_path / f"t/{number}.parquet")
    if request.param == "folder":
        return LocalStore(tmp_path)
    bucket = MemoryStore()
    for path in (tmp_path / "t").iterdir():
        obstore.put(bucket, f"t/{path.name}", path)
    return ObjectStore(bucket, "memory://bucket")


def test_a_scan_reads_the_files_that_are_named(store):
    keys = [f"t/{number}.parquet" for number in (0, 2)]
    found = ds.dataset(keys, pa.schema([("n", pa.int64())]), "parquet", filesystem=file_system_of(store))
    assert found.to_table(filter=ds.field("n") > 0).column("n").to_pylist() == [10, 2, 12]


def test_a_file_that_is_gone_is_an_error_of_its_own(store):
    files, schema = file_system_of(store), pa.schema([("n", pa.int64())])
    with pytest.raises((CorruptError, FileNotFoundError), match=r"9\.parquet"):
        ds.dataset(["t/9.parquet"], schema, "parquet", filesystem=files).to_table()


def test_nothing_is_written_into_a_bucket(store):
    if store.root is None:
        with pytest.raises(NotImplementedError, match="only read"):
            file_system_of(store).open_output_stream("t/new")
