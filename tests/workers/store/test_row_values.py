"""Absent and infinite values, put one at a time into every place that a row of any table has."""

from collections.abc import Iterator
from typing import Any

import pyarrow as pa
import pytest

from schemas.dataset.tables import SCHEMAS
from workers.store.manifest import buffers_of, check_values, is_sound

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


def raises(rows: pa.StructArray) -> bool:
    try:
        for field, column in zip(rows.type, rows.flatten(), strict=True):
            check_values(field.name, field, column)
    except ValueError:
        return True
    return False


@pytest.mark.parametrize("name", KINDS)
def test_a_look_at_the_buffers_finds_what_a_walk_over_the_columns_finds(name):
    kind = KINDS[name]
    good, places = whole(kind), 0
    assert is_sound(pa.array([good, good], kind), buffers_of(kind))
    for row, allowed in damaged(kind, nullable=True):
        if row is not None:
            rows = pa.array([good, row, good], kind)
            assert is_sound(rows, buffers_of(kind)) == (not raises(rows)) == allowed, row
            places += 1
    assert places >= len(kind)


def test_of_rows_that_have_no_doubles_nothing_is_infinite():
    kind = KINDS["failures"]
    assert not buffers_of(kind).doubles
    assert is_sound(pa.array([whole(kind)], kind), buffers_of(kind))
