import csv
import io
import json

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from services.read.query import format_rows, write_rows

ROWS = pa.table({"n": [1, 2], "name": ["a,b", None], "list": [[1.5, -0.0], []], "flag": [True, False]})


def test_a_table_for_people_is_a_box_that_says_how_much_of_a_long_answer_it_shows():
    lines = format_rows(ROWS, "table").decode().splitlines()
    assert lines[0].startswith("┌") and "a,b" in "".join(lines) and "[1.5, -0.0]" in "".join(lines)
    told = format_rows(pa.table({"n": range(500)}), "table").decode()
    assert "500 rows" in told and "shown" in told and len(told.splitlines()) < 60
    assert ">9999 rows" in format_rows(pa.table({"n": range(30_000)}), "table").decode()
    sink = io.BytesIO()
    write_rows(pa.table({f"c{n}": [1] for n in range(50)}).to_reader(), "table", sink, wide=80)
    assert max(map(len, sink.getvalue().decode().splitlines())) <= 80


def test_csv_json_and_parquet_read_back():
    rows = list(csv.reader(io.StringIO(format_rows(ROWS, "csv").decode())))
    assert rows == [["n", "name", "list", "flag"], ["1", "a,b", "[1.5, -0.0]", "true"], ["2", "", "[]", "false"]]
    assert json.loads(format_rows(ROWS, "json")) == ROWS.to_pylist()
    assert pq.read_table(pa.BufferReader(format_rows(ROWS, "parquet"))).equals(ROWS)


@pytest.mark.parametrize("style", ["table", "csv", "json", "parquet"])
@pytest.mark.parametrize(
    "sql",
    ["select 1 as x where false", "select date '2026-01-01' d, 1.5::decimal(5,2) x, {'a': 1} s, 'x'::blob b"],
    ids=["empty", "odd types"],
)
def test_an_empty_answer_and_odd_types_have_every_format(style, sql):
    assert format_rows(duckdb.sql(sql).to_arrow_table(), style)


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


def batches(count: int, size: int = 1000):
    """So many rows in batches of `size`, each made when it is asked for."""
    schema = pa.schema([("n", pa.int64()), ("word", pa.string())])
    made = (
        pa.record_batch([pa.array(range(at, at + size)), pa.array([f"word {n}" for n in range(at, at + size)])], schema)
        for at in range(0, count, size)
    )
    return pa.RecordBatchReader.from_batches(schema, made)


@pytest.mark.parametrize("style", ["csv", "json", "parquet"])
def test_a_long_answer_leaves_in_pieces_and_is_whole(style, monkeypatch):
    monkeypatch.setattr("services.read.query._ROW_GROUP_BYTES", 30_000)
    pipe = Pipe()
    write_rows(batches(20_000), style, pipe)
    assert pipe.largest < len(pipe.data) / 4
    if style == "parquet":
        read = pq.read_table(pa.BufferReader(pipe.data)).to_pylist()
    elif style == "json":
        read = json.loads(pipe.data)
    else:
        read = [{"n": int(row["n"]), "word": row["word"]} for row in csv.DictReader(io.StringIO(pipe.data.decode()))]
    assert read == batches(20_000).read_all().to_pylist()


def test_rows_are_written_before_the_last_ones_are_made():
    pipe, seen = Pipe(), []

    def watched():
        for batch in batches(5000):
            seen.append(len(pipe.data))
            yield batch

    schema = batches(0).schema
    write_rows(pa.RecordBatchReader.from_batches(schema, watched()), "csv", pipe)
    assert seen == sorted(seen) and seen[-1] > 10_000
