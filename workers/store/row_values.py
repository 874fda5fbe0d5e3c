"""Whether values that became Arrow arrays are there and finite, at any depth."""

from typing import NamedTuple

import numpy as np
import pyarrow as pa


class Buffers(NamedTuple):
    """Numbers of the buffers of an array: of validity where values are required, and of doubles."""

    required: tuple[int, ...]
    doubles: tuple[int, ...]


def buffers_of(kind: pa.DataType) -> Buffers:
    """Those of an array of this type."""
    roles = list(enumerate(_roles(kind, nullable=False)))
    return Buffers(*(tuple(at for at, role in roles if role == one) for one in ("required", "doubles")))


def is_sound(rows: pa.StructArray, where: Buffers) -> bool:
    """True where no required value is absent and every double is finite; False also where that is not plain to see.

    Looks at all buffers at once: a walk over the columns, as `check_values` does, takes twenty times as long. Where it is
    False, `check_values` decides.
    """
    buffers = rows.buffers()
    if any(buffers[at] is not None for at in where.required):  # Arrow keeps no validity where nothing is absent
        return False
    values = b"".join([buffers[at] for at in where.doubles if buffers[at] is not None])
    return bool(np.isfinite(np.frombuffer(values)).all())


def _roles(kind: pa.DataType, nullable: bool) -> list[str]:
    """What each buffer of an array of this type holds, in Arrow's order: those of an array before those of its children."""
    validity = "" if nullable else "required"
    fields = [kind.field(n) for n in range(kind.num_fields)]
    below = [role for field in fields for role in _roles(field.type, field.nullable)]
    if pa.types.is_struct(kind) or pa.types.is_fixed_size_list(kind):
        return [validity, *below]
    if pa.types.is_floating(kind):
        return [validity, "doubles"]
    offsets = [""] if pa.types.is_string(kind) else []
    return [validity, *offsets, "", *below]


def check_values(where: str, field: pa.Field, array: pa.Array) -> None:
    """Raises ValueError for an absent value that the schema requires, or a double that is not finite, at any depth."""
    if not field.nullable and array.null_count:
        raise ValueError(f"{where} is missing in {array.null_count} of {len(array)} rows")
    kind, present = field.type, array.drop_null() if array.null_count else array
    if pa.types.is_floating(kind):
        values = present.to_numpy()
        if not np.isfinite(values).all():
            raise ValueError(f"{where} is not finite: {values[~np.isfinite(values)][0]}")
    elif pa.types.is_struct(kind):
        for i in range(kind.num_fields):
            check_values(f"{where}.{kind.field(i).name}", kind.field(i), present.field(i))
    elif pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        check_values(where, kind.value_field, array.flatten())
