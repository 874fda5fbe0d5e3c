"""Absent and infinite values, put one at a time into every place that a row of any table has."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import CorruptError
from tests.made_up_scenes import failed_scene, made_scene
from workers.store.manifest import (
    decode_table,
    encode_table,
    scene_digest,
    sorted_rows,
    table_of_rows,
)

KINDS = {table: pa.struct(list(schema)) for table, schema in SCHEMAS.items()}


def whole(kind: pa.DataType) -> Any:
    """A value of this type in which nothing is absent; lists have two items."""
    if pa.types.is_struct(kind):
        return {kind.field(n).name: whole(kind.field(n).type) for n in range(kind.num_fields)}
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        return [whole(kind.value_type)] * (kind.list_size if pa.types.is_fixed_size_list(kind) else 2)
    return {pa.float64(): 1.5, pa.int64(): 7, pa.string(): "x", pa.bool_(): True}[kind]


def damaged(kind: pa.DataType, nullable: bool) -> Iterator[tuple[Any, bool]]:
    """(a value in which one place holds what it may not or need not, whether it may) for every place within the type."""
    yield None, nullable
    if pa.types.is_struct(kind):
        for n in range(kind.num_fields):
            field = kind.field(n)
            for value, allowed in damaged(field.type, field.nullable):
                yield {**whole(kind), field.name: value}, allowed
    elif pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        for value, allowed in damaged(kind.value_type, kind.value_field.nullable):
            yield [*whole(kind)[:-1], value], allowed
    elif pa.types.is_floating(kind):
        yield float("nan"), False
        yield float("-inf"), False


def raises(table: str, rows: list[dict]) -> bool:
    try:
        table_of_rows(table, rows)
    except ValueError:
        return True
    return False


@pytest.mark.parametrize("name", KINDS)
def test_an_absent_or_infinite_value_is_found_at_every_place_of_a_row(name):
    kind = KINDS[name]
    good, places = whole(kind), 0
    assert not raises(name, [good, good])
    for row, allowed in damaged(kind, nullable=True):
        if row is not None:
            assert raises(name, [good, row, good]) != allowed, row
            places += 1
    assert places >= len(kind)


def rows_of(table: str) -> list[dict]:
    return (failed_scene(5) if table == "failures" else made_scene(3)).rows[table]


@pytest.mark.parametrize("table", TABLES)
def test_rows_come_back_from_parquet_as_they_went_in(table):
    plain = rows_of(table)
    rows = table_of_rows(table, plain)
    again = decode_table(table, encode_table(rows), "x")
    assert again.equals(rows)
    assert again.schema.equals(SCHEMAS[table], check_metadata=True)
    assert again.to_pylist() == plain


def test_numpy_values_are_taken_as_plain_ones():
    row = rows_of("scenes")[0]
    other = {**row, "scene_id": np.int64(3), "settle_s": np.float64(0.7), "T_world_obj": np.array(row["T_world_obj"])}
    other["raycast_checked"] = np.bool_(row["raycast_checked"])
    assert table_of_rows("scenes", [other]).equals(table_of_rows("scenes", [row]))


@pytest.mark.parametrize(
    ("table", "change", "message"),
    [
        ("scenes", {"colour": "red"}, "other columns than the schema: colour"),
        ("scenes", {"settle_s": None}, "scenes.settle_s is missing in scene"),
        ("scenes", {"settle_s": float("nan")}, "scenes.settle_s is not finite: nan"),
        ("scenes", {"T_world_obj": [float("inf")] * 16}, "scenes.T_world_obj is not finite: inf"),
        ("scenes", {"T_world_obj": [0.0] * 15}, "scenes.T_world_obj: .*16"),
        ("scenes", {"scene_id": "three"}, "scenes.scene_id: .*three"),
        ("scenes", {"scene_id": 2**63}, "scenes.scene_id: "),
        ("views", {"files": [{"path": None, "bytes": 1, "sha256": ""}]}, "views.files.path is missing"),
        (
            "views",
            {"mirror_agreement": {"median_mm": float("nan"), "share": 1.0}},
            "mirror_agreement.median_mm is not fin",
        ),
        ("assets", {"volume_m3": float("-inf")}, "assets.volume_m3 is not finite"),
    ],
)
def test_a_row_that_breaks_the_schema_is_refused_by_column(table, change, message):
    with pytest.raises(ValueError, match=message):
        table_of_rows(table, [{**rows_of(table)[0], **change}])


def test_a_missing_column_is_not_taken_as_null():
    row = {key: value for key, value in rows_of("scenes")[0].items() if key != "recheck_move_mm"}
    with pytest.raises(ValueError, match="recheck_move_mm"):
        table_of_rows("scenes", [row])


def test_rows_are_sorted_by_their_key_and_two_of_one_key_are_refused():
    rows = rows_of("objects")
    table = sorted_rows("objects", table_of_rows("objects", rows[::-1]))
    keys = list(zip(*(table.column(name).to_pylist() for name in ("pose_id", "role", "region_id")), strict=True))
    assert keys == sorted(keys)
    with pytest.raises(ValueError, match="objects: two rows have the key pose_id, role, region_id"):
        sorted_rows("objects", table_of_rows("objects", [*rows, rows[3]]))


@pytest.mark.parametrize("table", ["scenes", "failures"])
def test_a_flipped_bit_anywhere_is_found_or_harmless(table):
    """But for a few in the headers of pages, which Parquet's checksums do not cover: a range's record has the file's digest."""
    rows = table_of_rows(table, rows_of(table))
    data = encode_table(rows)
    found = other = 0
    for position in range(0, len(data), 7):
        damaged = bytearray(data)
        damaged[position] ^= 1 << (position % 8)
        try:
            again = decode_table(table, bytes(damaged), "manifest/_ranges/0/x.parquet")
        except CorruptError as error:
            found += "manifest/_ranges/0/x.parquet" in str(error)
        else:
            other += not again.equals(rows)
    assert found > len(data) / 7 / 10
    assert other <= len(data) / 7 / 200


def test_a_torn_file_and_another_table_are_told_by_name():
    data = encode_table(table_of_rows("scenes", rows_of("scenes")))
    for damaged in (data[: len(data) // 2], b"", b"PAR1" + bytes(20) + b"PAR1"):
        with pytest.raises(CorruptError, match=r"here.parquet cannot be read"):
            decode_table("scenes", damaged, "here.parquet")
    with pytest.raises(CorruptError, match="lacks the column pose_id of the table views"):
        decode_table("views", data, "here.parquet")


def test_rows_of_an_older_version_get_null_for_columns_that_came_later():
    rows = table_of_rows("scenes", rows_of("scenes")).drop_columns("recheck_move_mm")
    again = decode_table("scenes", encode_table(rows), "x")
    assert again.schema.equals(SCHEMAS["scenes"])
    assert again.column("recheck_move_mm").to_pylist() == [None]


def test_files_carry_the_schema_version_and_page_checksums():
    metadata = pq.ParquetFile(
        pa.BufferReader(encode_table(table_of_rows("scenes", rows_of("scenes"))))
    ).schema_arrow.metadata
    assert metadata[b"schema_version"] == b"1"
    assert metadata[b"verso_table"] == b"scenes"


def test_the_digest_of_a_scene_knows_no_order_of_rows_or_keys_and_no_type_of_number():
    base = made_scene(3).rows
    turned = {
        table: [dict(reversed(row.items())) for row in reversed(found)] for table, found in reversed(base.items())
    }
    turned["scenes"][0]["penetration_mm"] = np.float64(turned["scenes"][0]["penetration_mm"])
    turned["scenes"][0]["redraws"] = np.int64(turned["scenes"][0]["redraws"])
    assert scene_digest(turned) == scene_digest(base)


@pytest.mark.parametrize("table", ["timings", "assets"])
def test_timings_and_shapes_are_no_part_of_the_digest_of_a_scene(table):
    rows = made_scene(3).rows
    assert scene_digest({**rows, table: []}) == scene_digest(rows)


@pytest.mark.parametrize(("table", "column"), [("scenes", "settle_s"), ("views", "d_z_m"), ("objects", "u")])
def test_the_last_bit_of_any_number_is_part_of_the_digest_of_a_scene(table, column):
    other = made_scene(3).rows
    value = other[table][0][column]
    other[table][0][column] = value + 1 if isinstance(value, int) else float(np.nextafter(value, np.inf))
    assert scene_digest(other) != scene_digest(made_scene(3).rows)
