"""Digests of table rows and of a dataset: the same rows in the same order give the same digest, however stored.

Each column is hashed as a few streams: which values are present (one byte each), lengths of strings and lists, and the
values themselves (doubles as IEEE-754 little-endian, so -0.0 is not 0.0; integers as 8 bytes little-endian; booleans as
one byte; strings as UTF-8). A missing value counts as absent and as zero or empty; items below an absent list are left
out. A column's digest is the hash of its streams' digests, a table's digest the hash of its name, its number of rows
and its columns in the order of the schema, but for those without any value: a later column leaves older digests as they are. It
does not depend on how rows were cut into batches.
"""

import hashlib
from collections.abc import Iterable, Mapping

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from schemas.dataset.tables import DETERMINISTIC_TABLES, SCHEMAS

_PRIMITIVES: dict[pa.DataType, tuple[str, float | bool]] = {
    pa.float64(): ("<f8", 0.0),
    pa.int64(): ("<i8", 0),
    pa.bool_(): ("|u1", False),
}
"""How a value is written, and what replaces a missing one."""


class _Stream:
    """The running digest of one column, or of one level of a nested column."""

    def __init__(self, kind: pa.DataType) -> None:
        self._kind = kind
        self.some = False
        """Whether there was a value."""
        self._present = hashlib.sha256()
        self._lengths = hashlib.sha256()
        self._values = hashlib.sha256()
        self._children = [_Stream(kind.field(i).type) for i in range(kind.num_fields)]

    def update(self, array: pa.Array) -> None:
        """Takes the next values of the column."""
        self.some |= array.null_count < len(array)
        self._present.update(_bytes_of(array.is_valid(), "|u1"))
        if pa.types.is_struct(self._kind):
            for child, part in zip(self._children, array.flatten(), strict=True):
                child.update(part)
        elif _is_list(self._kind):
            self._lengths.update(_bytes_of(pc.fill_null(pc.list_value_length(array), 0), "<i8"))
            self._children[0].update(array.flatten())
        elif pa.types.is_string(self._kind):
            filled = pc.fill_null(array, "")
            self._lengths.update(_bytes_of(pc.binary_length(filled), "<i8"))
            self._values.update(text_bytes(filled))
        else:
            dtype, nothing = _PRIMITIVES[self._kind]
            self._values.update(_bytes_of(pc.fill_null(array, pa.scalar(nothing, self._kind)), dtype))

    def digest(self) -> bytes:
        """[32] bytes: of all values so far."""
        streams = [stream.digest() for stream in (self._present, self._lengths, self._values)]
        return hashlib.sha256(b"".join([*streams, *(child.digest() for child in self._children)])).digest()


class TableDigest:
    """The digest of one table, fed batch by batch in row order."""

    def __init__(self, table: str) -> None:
        self._name = table
        self._schema = SCHEMAS[table]
        self._streams = [_Stream(field.type) for field in self._schema]
        self.rows = 0

    def update(self, rows: pa.Table | pa.RecordBatch) -> None:
        """Takes the next rows, which must have exactly the table's columns, in any number of chunks."""
        for batch in rows.to_batches() if isinstance(rows, pa.Table) else [rows]:
            self.rows += batch.num_rows
            for stream, name in zip(self._streams, self._schema.names, strict=True):
                stream.update(batch.column(name))

    def hexdigest(self) -> str:
        """64 hex characters: of all rows so far."""
        total = hashlib.sha256(f"verso rows 1\n{self._name}\n{self.rows}\n".encode())
        for stream, field in zip(self._streams, self._schema, strict=True):
            if stream.some:
                total.update(f"{field.name}\n{_tag(field.type)}\n".encode() + stream.digest())
        return total.hexdigest()


def dataset_digest(tables: Mapping[str, str], files: Iterable[tuple[str, str]]) -> str:
    """64 hex characters: SHA-256 over the tables' digests, then over the (path, SHA-256) of `files`.

    The tables are scenes, views, objects, assets and failures, by their canonical rows (`TableDigest`);
    the files are images, shapes and merged files. They must come sorted by the UTF-8 bytes of their paths, each path
    once; raises ValueError otherwise. In layout `tar` an image has the path that it would have as a file of its own, so
    the digest does not depend on the layout.
    """
    total = hashlib.sha256(b"verso dataset 1\n")
    for table in DETERMINISTIC_TABLES:
        total.update(f"{table} {tables[table]}\n".encode())
    previous = b""
    for path, sha256 in files:
        name = path.encode()
        if name <= previous:
            raise ValueError(f"{path} comes after {previous.decode()}: paths must be sorted and unique")
        previous = name
        total.update(b"%s\n%s\n" % (name, sha256.encode()))
    return total.hexdigest()


def text_bytes(array: pa.StringArray) -> bytes:
    """The UTF-8 bytes of all strings, one after another, without a copy for each."""
    if not len(array):
        return b""
    _, offsets, data = array.buffers()
    ends = np.frombuffer(offsets, dtype=np.int32)[array.offset : array.offset + len(array) + 1]
    return b"" if data is None else memoryview(data)[int(ends[0]) : int(ends[-1])].tobytes()


def _is_list(kind: pa.DataType) -> bool:
    return bool(pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind))


def _tag(kind: pa.DataType) -> str:
    """A type's name that does not change with Arrow's version."""
    if pa.types.is_struct(kind):
        return "{" + ",".join(f"{kind.field(i).name}:{_tag(kind.field(i).type)}" for i in range(kind.num_fields)) + "}"
    if _is_list(kind):
        return f"[{_tag(kind.value_type)}]"
    return "text" if pa.types.is_string(kind) else _PRIMITIVES[kind][0]


def _bytes_of(array: pa.Array, dtype: str) -> bytes:
    return np.asarray(array.to_numpy(zero_copy_only=False)).astype(dtype, copy=False).tobytes()
