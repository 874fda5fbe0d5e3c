"""Rows of a range: checked, sorted, stored as Parquet, and digested as their plain encoding is, however they are stored."""

import hashlib
import struct

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import CorruptError
from tests.made_up_scenes import failed_scene, made_scene
from workers.store.manifest import (
    TableDigest,
    dataset_digest,
    decode_table,
    encode_table,
    scene_digest,
    table_of_rows,
)


def rows_of(table: str) -> list[dict]:
    return (failed_scene(5) if table == "failures" else made_scene(3)).rows[table]


def fields_of(kind: pa.DataType) -> list[pa.Field]:
    return [kind.field(n) for n in range(kind.num_fields)]


def is_list(kind: pa.DataType) -> bool:
    return pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)


def test_a_row_that_breaks_the_schema_is_refused_by_column_and_numpys_values_are_taken_as_plain_ones():
    absent = {"files": [{"path": None, "bytes": 1, "sha256": ""}]}
    body = rows_of("scenes")[0]["bodies"][0]
    for table, change, message in (
        ("scenes", {"colour": "red"}, "other columns than the schema: colour"),
        ("scenes", {"settle_s": None}, "scene 3: scenes.settle_s"),
        ("scenes", {"settle_s": float("nan")}, "scenes.settle_s is not finite: nan"),
        ("scenes", {"T_world_obj": [float("inf")] * 16}, "scenes.T_world_obj is not finite: inf"),
        ("scenes", {"T_world_obj": [0.0] * 15}, "scenes.T_world_obj: .*16"),
        ("scenes", {"scene_id": "three"}, "scenes.scene_id: .*three"),
        ("scenes", {"scene_id": 2**63}, "scenes.scene_id: "),
        ("views", absent, "views.files.path is missing"),
        ("views", {"mirror_agreement": {"median_mm": float("nan"), "share": 1.0}}, "agreement.median_mm is not fin"),
        ("assets", {"volume_m3": float("-inf")}, "assets.volume_m3 is not finite"),
        ("scenes", {"bodies": [{**body, "object_scale": float("nan")}]}, "scenes.bodies.object_scale is not finite"),
        ("scenes", {"bodies": [body, {**body, "category": None}]}, "scenes.bodies.category is missing"),
        ("scenes", {"T_world_obj": None}, "scenes.T_world_obj is missing"),
        ("scenes", {"T_world_obj": [None] * 16}, "scenes.T_world_obj is missing"),
    ):
        with pytest.raises(ValueError, match=message):
            table_of_rows(table, [{**rows_of(table)[0], **change}])
    row = rows_of("scenes")[0]
    with pytest.raises(ValueError, match="recheck_move_mm"):  # a missing column is not taken as null
        table_of_rows("scenes", [{key: value for key, value in row.items() if key != "recheck_move_mm"}])
    other = {**row, "scene_id": np.int64(3), "settle_s": np.float64(0.7), "T_world_obj": np.array(row["T_world_obj"])}
    other["raycast_checked"] = np.bool_(row["raycast_checked"])
    assert table_of_rows("scenes", [other]).equals(table_of_rows("scenes", [row]))


# ---------------------------------------------------------------------------------------------- Parquet


def test_rows_come_back_from_parquet_as_they_went_in_with_the_version_of_their_schema():
    for table in TABLES:
        plain = rows_of(table)
        rows = table_of_rows(table, plain)
        again = decode_table(table, encode_table(rows), "x")
        assert again.equals(rows) and again.to_pylist() == plain
        assert again.schema.equals(SCHEMAS[table], check_metadata=True)
        metadata = pq.ParquetFile(pa.BufferReader(encode_table(rows))).schema_arrow.metadata
        assert (metadata[b"schema_version"], metadata[b"verso_table"]) == (b"1", table.encode())


def test_columns_that_are_younger_than_a_file_are_null_whatever_their_type():
    for table in TABLES:
        rows, younger = table_of_rows(table, rows_of(table)), [one.name for one in SCHEMAS[table] if one.nullable]
        again = decode_table(table, encode_table(rows.drop_columns(younger)), "x")
        again.validate(full=True)
        assert again.schema.equals(SCHEMAS[table]) and decode_table(table, encode_table(again), "x").equals(again)
        assert all(again.column(name).null_count == len(rows) for name in younger)


def test_a_torn_file_or_another_table_is_told_by_name():
    data = encode_table(table_of_rows("scenes", rows_of("scenes")))
    for torn in (data[: len(data) // 2], b"", b"PAR1" + bytes(20) + b"PAR1"):
        with pytest.raises(CorruptError, match=r"here.parquet cannot be read"):
            decode_table("scenes", torn, "here.parquet")
    with pytest.raises(CorruptError, match="lacks the column pose_id of the table views"):
        decode_table("views", data, "here.parquet")


# ---------------------------------------------------------------------------------------------- digests


def test_the_digest_of_a_scene_knows_no_order_or_type_and_tells_the_last_bit_of_any_number():
    base = made_scene(3).rows
    digest = scene_digest(base)
    turned = {table: [dict(reversed(row.items())) for row in reversed(seen)] for table, seen in reversed(base.items())}
    turned["scenes"][0]["penetration_mm"] = np.float64(turned["scenes"][0]["penetration_mm"])
    turned["scenes"][0]["redraws"] = np.int64(turned["scenes"][0]["redraws"])
    assert scene_digest(turned) == digest
    for table in ("timings", "assets"):
        assert scene_digest({**base, table: []}) == digest
    for table, column in (("scenes", "settle_s"), ("views", "d_z_m"), ("objects", "u")):
        other = made_scene(3).rows
        value = other[table][0][column]
        other[table][0][column] = value + 1 if isinstance(value, int) else float(np.nextafter(value, np.inf))
        assert scene_digest(other) != digest


SIMPLE = {
    pa.float64(): st.floats(allow_nan=False, allow_infinity=False),
    pa.int64(): st.integers(-(2**63), 2**63 - 1),
    pa.string(): st.text(st.characters(codec="utf-8"), max_size=5),
    pa.bool_(): st.booleans(),
}


def values_of(kind, nullable):
    """Values that Arrow can hold in a column of this type."""
    if pa.types.is_struct(kind):
        values = st.fixed_dictionaries({field.name: values_of(field.type, field.nullable) for field in fields_of(kind)})
    elif is_list(kind):
        least, most = (kind.list_size, kind.list_size) if pa.types.is_fixed_size_list(kind) else (0, 3)
        values = st.lists(values_of(kind.value_type, kind.value_field.nullable), min_size=least, max_size=most)
    else:
        values = SIMPLE[kind]
    return st.none() | values if nullable else values


def plain_column(kind: pa.DataType, values: list) -> bytes:
    """A second, plain implementation of what the head of workers/store/manifest.py promises, from Python values."""
    present, lengths, data, children = b"".join(bytes([value is not None]) for value in values), b"", b"", []
    if pa.types.is_struct(kind):
        for field in fields_of(kind):
            children.append(plain_column(field.type, [None if v is None else v[field.name] for v in values]))
    elif is_list(kind):
        lengths = b"".join(struct.pack("<q", len(value or [])) for value in values)
        children = [plain_column(kind.value_type, [item for value in values if value is not None for item in value])]
    elif pa.types.is_string(kind):
        texts = [(value or "").encode() for value in values]
        lengths, data = b"".join(struct.pack("<q", len(text)) for text in texts), b"".join(texts)
    else:
        code = {pa.float64(): "<d", pa.int64(): "<q", pa.bool_(): "?"}[kind]
        data = b"".join(struct.pack(code, 0 if value is None else value) for value in values)
    streams = [hashlib.sha256(stream).digest() for stream in (present, lengths, data)]
    return hashlib.sha256(b"".join([*streams, *children])).digest()


def plain_tag(kind: pa.DataType) -> str:
    if pa.types.is_struct(kind):
        return "{" + ",".join(f"{field.name}:{plain_tag(field.type)}" for field in fields_of(kind)) + "}"
    if is_list(kind):
        return f"[{plain_tag(kind.value_type)}]"
    return {pa.float64(): "<f8", pa.int64(): "<i8", pa.string(): "text", pa.bool_(): "|u1"}[kind]


@pytest.mark.parametrize("table", TABLES)
@settings(max_examples=25)
@given(st.data())
def test_a_digest_is_that_of_the_plain_encoding_however_rows_are_cut(table, data):
    fields = {field.name: values_of(field.type, field.nullable) for field in SCHEMAS[table]}
    rows = data.draw(st.lists(st.fixed_dictionaries(fields), max_size=4))
    plain = hashlib.sha256(f"verso rows 1\n{table}\n{len(rows)}\n".encode())
    for field in SCHEMAS[table]:
        if all(row[field.name] is None for row in rows):
            continue
        kind, values = field.type, [row[field.name] for row in rows]
        if field.name == "bodies" and not any(
            body and body["friction"] is not None for each in values for body in each or ()
        ):
            kind = pa.list_(pa.struct([each for each in fields_of(kind.value_type) if each.name != "friction"]))
        plain.update(f"{field.name}\n{plain_tag(kind)}\n".encode())
        plain.update(plain_column(kind, values))
    arrow = pa.Table.from_pylist(rows, schema=SCHEMAS[table])
    cut = data.draw(st.integers(0, len(rows)))
    digest = TableDigest(table)
    for part in (arrow.slice(0, cut), arrow.slice(cut)):
        digest.update(part)
    assert (digest.rows, digest.hexdigest()) == (len(rows), plain.hexdigest())


def test_the_digest_of_a_dataset_is_that_of_the_tables_but_timings_and_the_sorted_files():
    digests = {"scenes": "1", "views": "2", "objects": "3", "assets": "4", "failures": "5", "timings": "6"}
    text = "verso dataset 1\nscenes 1\nviews 2\nobjects 3\nassets 4\nfailures 5\na/b\nx\na/ü\ny\n"
    expected = hashlib.sha256(text.encode()).hexdigest()
    for timings in ("6", "other"):
        assert dataset_digest({**digests, "timings": timings}, [("a/b", "x"), ("a/ü", "y")]) == expected
    for paths in (["b", "a"], ["a", "a"], ["ü", "z"]):
        with pytest.raises(ValueError, match="sorted and unique"):
            dataset_digest(digests, [(path, "x") for path in paths])
