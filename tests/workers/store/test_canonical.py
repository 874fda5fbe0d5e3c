import hashlib
import io
import struct

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.dataset.tables import SCHEMAS, TABLES
from tests.made_up_scenes import failed_scene, made_scene
from workers.store.canonical import TableDigest, dataset_digest, rows_digest
from workers.store.manifest import table_of_rows

FLOATS = st.floats(allow_nan=False, allow_infinity=False)
INTEGERS = st.integers(-(2**63), 2**63 - 1)
TEXTS = st.text(st.characters(codec="utf-8"), max_size=5)


def values_of(kind, nullable):
    """Values that Arrow can hold in a column of this type."""
    if pa.types.is_struct(kind):
        fields = [kind.field(i) for i in range(kind.num_fields)]
        values = st.fixed_dictionaries({field.name: values_of(field.type, field.nullable) for field in fields})
    elif pa.types.is_fixed_size_list(kind):
        inner = values_of(kind.value_type, kind.value_field.nullable)
        values = st.lists(inner, min_size=kind.list_size, max_size=kind.list_size)
    elif pa.types.is_list(kind):
        values = st.lists(values_of(kind.value_type, kind.value_field.nullable), max_size=3)
    else:
        values = {pa.float64(): FLOATS, pa.int64(): INTEGERS, pa.string(): TEXTS, pa.bool_(): st.booleans()}[kind]
    return st.none() | values if nullable else values


def rows_of(table):
    row = st.fixed_dictionaries({field.name: values_of(field.type, field.nullable) for field in SCHEMAS[table]})
    return st.lists(row, max_size=4)


# A second, plain implementation of what canonical.py's first paragraph promises, from Python values.


def plain_column(kind: pa.DataType, values: list) -> bytes:
    present, lengths, data, children = b"", b"", b"", []
    for value in values:
        present += bytes([value is not None])
    if pa.types.is_struct(kind):
        for i in range(kind.num_fields):
            field = kind.field(i)
            children.append(plain_column(field.type, [None if v is None else v[field.name] for v in values]))
    elif pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        lengths = b"".join(struct.pack("<q", len(value or [])) for value in values)
        children = [plain_column(kind.value_type, [item for value in values if value is not None for item in value])]
    elif pa.types.is_string(kind):
        texts = [(value or "").encode() for value in values]
        lengths, data = b"".join(struct.pack("<q", len(text)) for text in texts), b"".join(texts)
    else:
        code = {pa.float64(): "<d", pa.int64(): "<q", pa.bool_(): "?"}[kind]
        data = b"".join(
            struct.pack(code, value or 0) if value is None else struct.pack(code, value) for value in values
        )
    streams = [hashlib.sha256(stream).digest() for stream in (present, lengths, data)]
    return hashlib.sha256(b"".join([*streams, *children])).digest()


def plain_tag(kind: pa.DataType) -> str:
    if pa.types.is_struct(kind):
        return (
            "{"
            + ",".join(f"{kind.field(i).name}:{plain_tag(kind.field(i).type)}" for i in range(kind.num_fields))
            + "}"
        )
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        return f"[{plain_tag(kind.value_type)}]"
    return {pa.float64(): "<f8", pa.int64(): "<i8", pa.string(): "text", pa.bool_(): "|u1"}[kind]


def plain_digest(table: str, rows: list[dict]) -> str:
    total = hashlib.sha256(f"verso rows 1\n{table}\n{len(rows)}\n".encode())
    for field in SCHEMAS[table]:
        total.update(f"{field.name}\n{plain_tag(field.type)}\n".encode())
        total.update(plain_column(field.type, [row[field.name] for row in rows]))
    return total.hexdigest()


@pytest.mark.parametrize("table", TABLES)
@given(st.data())
def test_a_digest_is_that_of_the_plain_encoding_however_rows_are_cut(table, data):
    rows = data.draw(rows_of(table))
    arrow = pa.Table.from_pylist(rows, schema=SCHEMAS[table])
    cut = data.draw(st.integers(0, len(rows)))
    digest = TableDigest(table)
    digest.update(arrow.slice(0, cut))
    digest.update(arrow.slice(cut))
    assert digest.rows == len(rows)
    assert digest.hexdigest() == plain_digest(table, rows)


@pytest.mark.parametrize("table", TABLES)
def test_a_digest_does_not_change_with_how_parquet_stores_the_rows(table):
    output = failed_scene(5) if table == "failures" else made_scene(3)
    rows = table_of_rows(table, output.rows[table])
    expected = rows_digest(table, rows)
    for options in ({"compression": "none", "use_dictionary": False}, {"compression": "zstd", "row_group_size": 1}):
        file = io.BytesIO()
        pq.write_table(rows, file, **options)
        assert rows_digest(table, pq.read_table(pa.BufferReader(file.getvalue()))) == expected


def different_views():
    base = made_scene(3).rows["views"]
    first, *others = base
    files = first["files"]
    changes = {
        "a path": {"files": [{**files[0], "path": "mug/other.png"}, *files[1:]]},
        "a moved letter": {
            "files": [{**files[0], "path": files[0]["path"][:-1], "sha256": "g" + files[0]["sha256"]}, *files[1:]]
        },
        "a dropped file": {"files": files[1:]},
        "files in another order": {"files": files[::-1]},
        "the last bit of a double": {"yaw_rad": first["yaw_rad"] + 2**-54},
        "the sign of a zero": {"T_world_cam": [-0.0 if x == 0 else x for x in first["T_world_cam"]]},
        "nothing for zero": {"projected_filled_share": 0.0},
        "an agreement of nothing": {"mirror_agreement": {"median_mm": 0.0, "share": 0.0}},
        "an integer": {"object_pixels": 531},
    }
    found = {name: [{**first, **change}, *others] for name, change in changes.items()}
    found["a row less"] = others
    found["rows in another order"] = base[::-1]
    return found


@pytest.mark.parametrize("change", different_views())
def test_a_digest_tells(change):
    base = rows_digest("views", table_of_rows("views", made_scene(3).rows["views"]))
    assert rows_digest("views", table_of_rows("views", different_views()[change])) != base


def test_every_row_counts_even_where_all_columns_are_alike():
    rows = table_of_rows("failures", failed_scene(5).rows["failures"])
    assert rows_digest("failures", rows) != rows_digest("failures", pa.concat_tables([rows, rows]))


DIGESTS = {"scenes": "1", "views": "2", "objects": "3", "assets": "4", "failures": "5", "timings": "6"}


def test_the_digest_of_a_dataset_is_that_of_the_tables_and_the_sorted_files():
    text = "verso dataset 1\nscenes 1\nviews 2\nobjects 3\nassets 4\nfailures 5\na/b\nx\na/ü\ny\n"
    assert dataset_digest(DIGESTS, [("a/b", "x"), ("a/ü", "y")]) == hashlib.sha256(text.encode()).hexdigest()


def test_timings_are_no_part_of_the_digest_of_a_dataset():
    assert dataset_digest({**DIGESTS, "timings": "other"}, []) == dataset_digest(DIGESTS, [])


@pytest.mark.parametrize("paths", [["b", "a"], ["a", "a"], ["ü", "z"]])
def test_paths_out_of_order_or_twice_are_refused(paths):
    with pytest.raises(ValueError, match="sorted and unique"):
        dataset_digest(DIGESTS, [(path, "x") for path in paths])
