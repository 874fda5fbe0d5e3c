"""Every column has a meaning, and every quantity a unit that its name agrees with."""

import pyarrow as pa
import pytest

from schemas.dataset.columns import EVERYWHERE, FRAMES, MEANINGS, TABLE_MEANINGS, columns_of
from schemas.dataset.tables import CAPTURE_SCHEMAS, SCHEMAS, TABLES

UNITS = {"id", "count", "1", "m", "mm", "m3", "mm/s", "px", "rad", "deg", "s", "kg", "N", "byte", "1/m"}
SUFFIXES = {
    "_mm_s": "mm/s",
    "_mm": "mm",
    "_units_per_m": "1/m",
    "_m3": "m3",
    "_m": "m",
    "_rad": "rad",
    "_deg": "deg",
    "_s": "s",
    "_kg": "kg",
    "_px": "px",
    "_id": "id",
}
COLUMNS = [column for table in TABLES for column in columns_of(table)]


def leaves(kind: pa.DataType, path: str):
    """(path, type) of every field, by the schema alone."""
    yield path, kind
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        inner = kind.value_type
        if pa.types.is_struct(inner):
            for field in inner:
                yield from leaves(field.type, f"{path}[].{field.name}")
    elif pa.types.is_struct(kind):
        for field in kind:
            yield from leaves(field.type, f"{path}.{field.name}")


def is_number(kind: pa.DataType) -> bool:
    if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    return pa.types.is_integer(kind) or pa.types.is_floating(kind)


@pytest.mark.parametrize("table", TABLES)
def test_the_columns_are_those_of_the_schema_with_every_field_inside(table):
    expected = [path for field in CAPTURE_SCHEMAS[table] for path, _ in leaves(field.type, field.name)]
    assert [column.path for column in columns_of(table)] == expected
    assert {one.path for one in columns_of(table) if not one.captures_only and "." not in one.path} == set(
        SCHEMAS[table].names
    )


@pytest.mark.parametrize("column", COLUMNS, ids=lambda one: f"{one.table}.{one.path}")
def test_a_column_has_a_sentence_and_a_quantity_its_unit(column):
    kind = next(
        k for field in CAPTURE_SCHEMAS[column.table] for p, k in leaves(field.type, field.name) if p == column.path
    )
    meaning = column.meaning
    assert len(meaning.text) > 4 and meaning.text.endswith(".") and "|" not in meaning.text
    assert (meaning.unit in UNITS) if is_number(kind) else not meaning.unit
    name = column.path.rpartition(".")[2]
    suffix = next((unit for end, unit in SUFFIXES.items() if name.endswith(end)), None)
    if is_number(kind) and suffix:
        assert meaning.unit == suffix
    assert all(frame in FRAMES for frame in meaning.frame.split(", ") if frame)
    if name.startswith("T_"):
        assert len(meaning.frame.split(", ")) == 2
    elif pa.types.is_fixed_size_list(kind):
        assert meaning.frame


def test_nothing_is_described_that_is_not_there():
    for table in TABLES:
        paths = {column.path for column in columns_of(table)}
        assert set(MEANINGS[table]) <= paths
    names = {column.path.rpartition(".")[2] for column in COLUMNS}
    assert set(EVERYWHERE) <= names and set(TABLE_MEANINGS) == set(TABLES) == set(MEANINGS)


def test_a_column_without_a_meaning_is_an_error(monkeypatch):
    changed = {**CAPTURE_SCHEMAS, "failures": CAPTURE_SCHEMAS["failures"].append(pa.field("new", pa.int64()))}
    monkeypatch.setattr("schemas.dataset.columns.CAPTURE_SCHEMAS", changed)
    with pytest.raises(KeyError, match="new"):
        columns_of("failures")
