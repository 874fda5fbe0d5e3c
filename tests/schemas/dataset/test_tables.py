"""The table of columns: every column has a meaning, every quantity a unit that its name agrees with; schemas follow."""

import pyarrow as pa
import pytest

from schemas.dataset.tables import COLUMNS, FRAMES, SCHEMAS, SORT_KEYS, TABLES

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


def leaves(field: pa.Field, path: str):
    """(path, type, nullable) of a field and of every field inside, by the Arrow schema alone."""
    yield path, field.type, field.nullable
    kind, inside = field.type, f"{path}."
    if pa.types.is_list(kind):
        kind, inside = kind.value_type, f"{path}[]."
    if pa.types.is_struct(kind):
        for one in kind:
            yield from leaves(one, inside + one.name)


@pytest.mark.parametrize("table", TABLES)
def test_the_schema_has_every_column_in_order_and_every_quantity_a_unit(table):
    found = [leaf for field in SCHEMAS[table] for leaf in leaves(field, field.name)]
    assert [path for path, _, _ in found] == [column.path for column in COLUMNS[table]]
    assert set(SORT_KEYS[table]) <= set(SCHEMAS[table].names)
    for column, (_, kind, nullable) in zip(COLUMNS[table], found, strict=True):
        assert nullable == column.nullable, column
        assert column.meaning.endswith(".") and len(column.meaning) > 4 and "|" not in column.meaning, column
        item = kind.value_type if pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) else kind
        is_number = pa.types.is_integer(item) or pa.types.is_floating(item)
        assert column.unit in UNITS if is_number else not column.unit, column
        name = column.path.rpartition(".")[2]
        suffix = next((unit for end, unit in SUFFIXES.items() if name.endswith(end)), None)
        assert not (is_number and suffix) or column.unit == suffix, column
        frames = column.frame.split(", ") if column.frame else []
        assert all(frame in FRAMES for frame in frames), column
        assert len(frames) == 2 if name.startswith("T_") else frames or not pa.types.is_fixed_size_list(kind), column
