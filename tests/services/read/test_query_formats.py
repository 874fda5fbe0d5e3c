import csv
import io
import json

import duckdb
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from services.read.query_formats import format_rows

ROWS = pa.table({"n": [1, 2], "name": ["a,b", None], "list": [[1.5, -0.0], []], "flag": [True, False]})


def test_a_table_for_people_is_aligned_and_counts_its_rows():
    text = format_rows(ROWS, "table").decode()
    assert text.splitlines() == [
        "n  name  list         flag",
        "-  ----  -----------  -----",
        "1  a,b   [1.5, -0.0]  true",
        "2        []           false",
        "(2 rows)",
    ]
    long = format_rows(pa.table({"x": ["y" * 100]}), "table").decode().splitlines()
    assert max(map(len, long)) == 60
    assert long[-1] == "(1 row)"


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
