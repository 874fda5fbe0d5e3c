"""Rows of scenes and ranges: checked against their schema, digested, sorted by key, encoded as Parquet and decoded.

The same rows in the same order give the same digest, however stored. Each column is hashed as a few streams: which values are
present (one byte each), lengths of strings and lists, and the values themselves (doubles as IEEE-754 little-endian, so -0.0 is
not 0.0; integers as 8 bytes little-endian; booleans as one byte; strings as UTF-8). A missing value counts as absent and as
zero or empty; items below an absent list are left out. A column's digest is the hash of its streams' digests, a table's digest
the hash of its name, its number of rows and its columns in the order of the schema, but for those without any value, and for
fields inside them that one kind of dataset alone has: a later column leaves older digests as they are. It does not depend on
how rows were cut into batches.
"""

import hashlib
import io
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, cast, get_args

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from schemas.dataset.commit import FileEntry, Outcome
from schemas.dataset.layout import asset_path, is_glb, is_plain_path
from schemas.dataset.tables import (
    DETERMINISTIC_TABLES,
    OF_SOME,
    SCHEMAS,
    SHAPE_FILE_COLUMNS,
    SORT_KEYS,
    TABLES,
    misplaced_columns,
)
from schemas.errors import CorruptError, plain_line
from schemas.scene.scene import SceneOutput


def _check_values(where: str, field: pa.Field, array: pa.Array) -> None:
    """Raises ValueError where, at any depth, a value is absent that must be there, or a number is not finite."""
    kind = field.type
    if array.null_count:
        if not field.nullable:
            raise ValueError(f"{where} is missing")
        array = array.drop_null()
    if pa.types.is_floating(kind):
        numbers = array.to_numpy()
        if not np.isfinite(numbers).all():
            raise ValueError(f"{where} is not finite: {numbers[~np.isfinite(numbers)][0]}")
    elif pa.types.is_struct(kind):
        for child, values in zip(kind, array.flatten(), strict=True):
            _check_values(f"{where}.{child.name}", child, values)
    elif _is_list(kind):
        _check_values(where, kind.value_field, array.flatten())


PARQUET_OPTIONS = {"compression": "zstd", "write_page_checksum": True}
"""For every Parquet file that users read: a flipped bit is found when the page is read."""
_RANGE_OPTIONS: dict[str, Any] = {
    "compression": "lz4",
    "write_page_checksum": True,
    "use_dictionary": False,
    "write_statistics": False,
    "store_schema": False,
}
"""For the few rows of a range: a third of the bytes and of the time of reading them with the options above."""


def table_of_rows(table: str, rows: Sequence[Mapping[str, object]]) -> pa.Table:
    """Rows as an Arrow table with exactly the schema of `table`.

    Raises ValueError naming the table and the column where a key is unknown or missing, a value has the wrong type, a
    required one is absent or a number is not finite.
    """
    if not rows:
        return SCHEMAS[table].empty_table()
    schema = SCHEMAS[table]
    names = set(schema.names)
    for row in rows:
        if row.keys() != names:
            wrong = sorted(names.symmetric_difference(row.keys()))
            raise ValueError(f"{table}: a row has other columns than the schema: {', '.join(wrong)}")
        if table == "scenes" and (fault := misplaced_columns(row)):
            raise ValueError(f"scene {row['scene_id']}: scenes.{fault}")
    arrays = []
    for field in schema:
        try:
            arrays.append(pa.array([row[field.name] for row in rows], field.type))
        except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError) as error:
            raise ValueError(f"{table}.{field.name}: {error}") from error
        _check_values(f"{table}.{field.name}", field, arrays[-1])
    return pa.Table.from_arrays(arrays, schema=schema)


def outcome_of(output: SceneOutput) -> Outcome:
    """How the scene ended. Raises ValueError unless its rows give exactly one outcome, of this scene alone."""
    tables: dict[str, Sequence[Mapping[str, Any]]] = {table: output.rows.get(table, ()) for table in TABLES}
    counts = {table: len(rows) for table, rows in tables.items() if rows}
    kinds = ["made" for _ in tables["scenes"]] + [row["kind"] for row in tables["failures"]]
    alone = all(row.get("scene_id", output.scene_id) == output.scene_id for rows in tables.values() for row in rows)
    fits = "scenes" in counts or not counts.keys() & {"views", "objects", "assets"}
    if not (alone and fits and len(kinds) == 1 and kinds[0] in get_args(Outcome) and counts.get("timings", 0) <= 1):
        raise ValueError(
            f"scene {output.scene_id} must have one row in scenes, or a failure of a known kind and nothing else, and no row "
            f"of another scene: it ended as {kinds}, with rows {counts}"
        )
    return cast(Outcome, kinds[0])


def check_files(output: SceneOutput, entries: Mapping[str, FileEntry]) -> None:
    """Raises ValueError unless the files are those that rows of `views` and `assets` list, each once, and GLBs."""
    if len(entries) != len(output.files):
        raise ValueError(f"scene {output.scene_id} writes a path twice")
    for path in entries:
        if not is_plain_path(path) or path[0] in "_.":
            raise ValueError(f"{path!r} is not a path that a scene may write")
    listed = [(file["path"], file["bytes"], file["sha256"]) for file in files_of_rows(output.rows)]
    written = [(path, entry.bytes, entry.sha256) for path, entry in entries.items() if not is_glb(path)]
    if sorted(listed) != sorted(written):
        wrong = sorted({path for path, *_ in set(listed) ^ set(written)}) or ["repetitions"]
        raise ValueError(f"scene {output.scene_id}: files and rows disagree about {', '.join(wrong[:5])}")


def files_of_rows(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> Iterator[Mapping[str, Any]]:
    """path, bytes and sha256 of the files that rows of `views` and `assets` list: images and samples."""
    for view in rows.get("views", ()):
        yield from view["files"]
    for asset in rows.get("assets", ()):
        if asset["samples"] is not None:
            yield asset["samples"]


def scene_digest(rows: Mapping[str, Sequence[Mapping[str, Any]]]) -> str:
    """64 hex characters: the digest of a scene's rows in the deterministic tables, except `assets`.

    SHA-256 of canonical JSON, in which a double has the shortest digits that give it back. It is only compared with
    another attempt at the same scene, and costs a tenth of the columns' digest.
    """
    tables = {
        table: sorted(rows[table], key=lambda row, names=SORT_KEYS[table]: [row[name] for name in names])  # type: ignore[misc]
        for table in DETERMINISTIC_TABLES
        if table != "assets" and rows.get(table)
    }
    text = json.dumps(tables, sort_keys=True, separators=(",", ":"), allow_nan=False, default=np.generic.item)
    return hashlib.sha256(text.encode()).hexdigest()


def sorted_rows(table: str, rows: pa.Table) -> pa.Table:
    """Rows in the order of the table's key; equal rows of `assets` once, which scenes that share a shape repeat.

    Raises ValueError where two rows share a key.
    """
    names = SORT_KEYS[table]
    if table == "assets":
        distinct = {json.dumps(row): index for index, row in enumerate(rows.to_pylist())}
        if len(distinct) < rows.num_rows:
            rows = rows.take(pa.array(distinct.values(), pa.int64()))
    keys = row_keys(table, rows)
    if keys != sorted(keys):
        rows = rows.sort_by([(name, "ascending") for name in names])
        keys = row_keys(table, rows)
    for key, following in pairwise(keys):
        if key == following:
            raise ValueError(f"{table}: two rows have the key {', '.join(names)} = {', '.join(map(str, key))}")
    return rows


def row_keys(table: str, rows: pa.Table) -> list[tuple[Any, ...]]:
    """The key of each row."""
    return list(zip(*(rows.column(name).to_pylist() for name in SORT_KEYS[table]), strict=True))


def encode_table(rows: pa.Table) -> bytes:
    """Parquet bytes with a checksum on each page; the file's metadata name the table and the schema version."""
    sink = io.BytesIO()
    with pq.ParquetWriter(sink, rows.schema, **_RANGE_OPTIONS) as writer:
        writer.write_table(rows)
        writer.add_key_value_metadata(rows.schema.metadata)
    return sink.getvalue()


def with_shape_files(assets: pa.Table, files: Mapping[str, FileEntry]) -> pa.Table:
    """Rows of `assets` with the columns `SHAPE_FILE_COLUMNS`, from `files` by path."""
    entries = [files.get(asset_path(row["category"], row["instance_id"])) for row in assets.to_pylist()]
    for field, name in zip(SHAPE_FILE_COLUMNS, ("bytes", "sha256"), strict=True):
        values = [entry and getattr(entry, name) for entry in entries]
        assets = assets.append_column(field, pa.array(values, field.type))
    return assets


def files_of_assets(assets: pa.Table) -> list[FileEntry]:
    """The files that rows of a range's `assets` list: GLBs, and samples. Raises KeyError without `SHAPE_FILE_COLUMNS`."""
    names = [name for name in ("category", "instance_id", "samples") if name in assets.column_names]
    size, sha256 = _SHAPE_FILES
    entries = []
    for row in assets.select([*names, size, sha256]).to_pylist():
        if row[sha256] is not None:
            path = asset_path(row["category"], row["instance_id"])
            entries.append(FileEntry(path=path, bytes=row[size], sha256=row[sha256]))
        if (samples := row.get("samples")) is not None:
            entries.append(FileEntry(**{name: samples[name] for name in FileEntry.model_fields}))
    return entries


def listed_files(table: str, data: bytes, name: str) -> list[FileEntry]:
    """The files that a range's `views` (images) or `assets` (shapes) list. Raises CorruptError as `decode_table`."""
    columns = ["category", "instance_id", "samples", *_SHAPE_FILES]
    try:
        with pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True) as file:
            rows = file.read(columns=["files"] if table == "views" else columns)
        if table == "assets":
            return files_of_assets(rows)
        return [FileEntry.model_validate(entry) for entry in pc.list_flatten(rows.column("files")).to_pylist()]
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        raise _unreadable(name, error) from error


def decode_table(table: str, data: bytes, name: str) -> pa.Table:
    """The rows of a range's Parquet bytes, in today's schema: columns added since they were written are null.

    Raises CorruptError naming the file where a page fails its checksum, the file is torn, or it is another table.
    """
    return conform(table, decode_rows(data, name), name)


def decode_rows(data: bytes, name: str) -> pa.Table:
    """The rows of Parquet bytes in the schema that they were written in. Raises CorruptError naming the file."""
    try:
        with pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True) as file:
            return file.read(use_threads=False)  # a pool of threads takes longer than a range's few rows
    except (pa.ArrowException, OSError, ValueError) as error:
        raise _unreadable(name, error) from error


def _unreadable(name: str, error: Exception) -> CorruptError:
    return CorruptError(f"{name} cannot be read: {plain_line(str(error))}; `verso verify OUT` lists every damaged file")


_SHAPE_FILES = [field.name for field in SHAPE_FILE_COLUMNS]


def conform(table: str, rows: pa.Table, name: str) -> pa.Table:
    """Rows with exactly today's schema of `table`. Raises CorruptError where a required column is missing.

    A schema only grows. So rows that lack a column and have an unknown one have a damaged column name.
    """
    schema = SCHEMAS[table]
    present = rows.column_names  # made anew each time
    wanted = schema.names
    missing = [column for column in wanted if column not in present]
    foreign = [column for column in present if column not in wanted and column not in _SHAPE_FILES]
    if missing and foreign:
        raise CorruptError(f"{name} lacks the column {missing[0]} of the table {table}, and has {foreign[0]!r}")
    for column in missing:
        field = schema.field(column)
        if not field.nullable:
            raise CorruptError(f"{name} lacks the column {column} of the table {table}")
        rows = rows.append_column(field, _nulls(rows.num_rows, field.type))
    try:
        return rows.select(wanted).cast(schema)  # Parquet has other names inside lists
    except (pa.ArrowException, ValueError) as error:
        raise _unreadable(name, error) from error


def _nulls(count: int, kind: pa.DataType) -> pa.Array:
    """So many missing values. pyarrow's own have missing items below a list of fixed size, and `pa.nulls` below a struct too.

    A schema in which these items may not be missing does not take them.
    """
    if not pa.types.is_fixed_size_list(kind):
        return pa.array([None] * count, kind)
    items = pa.array(np.zeros(count * kind.list_size), kind.value_type)
    return pa.FixedSizeListArray.from_arrays(items, type=kind, mask=pa.array([True] * count, pa.bool_()))


def join_rows(table: str, parts: Sequence[pa.Table]) -> pa.Table:
    """Rows one after another, in today's schema. Parts are nearly always of one schema, so it is adapted once."""
    if len({part.schema for part in parts}) > 1:
        parts = [part if part.schema == SCHEMAS[table] else conform(table, part, table) for part in parts]
    rows = pa.concat_tables(parts or [SCHEMAS[table].empty_table()])
    return rows if rows.schema == SCHEMAS[table] else conform(table, rows, table)


# ------------------------------------------------------------------------------------------------ digests

_PRIMITIVES: dict[pa.DataType, tuple[str, float | bool]] = {
    pa.float64(): ("<f8", 0.0),
    pa.int64(): ("<i8", 0),
    pa.bool_(): ("|u1", False),
}
"""How a value is written, and what replaces a missing one."""


class _Stream:
    """The running digest of one column, or of one level of a nested column."""

    def __init__(self, kind: pa.DataType, path: str, optional: Collection[str]) -> None:
        self._kind = kind
        self._stays = path not in optional
        self.some = False
        """Whether there was a value."""
        self._present = hashlib.sha256()
        self._lengths = hashlib.sha256()
        self._values = hashlib.sha256()
        self._children = {
            kind.field(i).name: _Stream(
                kind.field(i).type, f"{path}[]" if _is_list(kind) else f"{path}.{kind.field(i).name}", optional
            )
            for i in range(kind.num_fields)
        }

    def update(self, array: pa.Array) -> None:
        """Takes the next values of the column."""
        self.some |= array.null_count < len(array)
        self._present.update(_bytes_of(array.is_valid(), "|u1"))
        if pa.types.is_struct(self._kind):
            for child, part in zip(self._children.values(), array.flatten(), strict=True):
                child.update(part)
        elif _is_list(self._kind):
            self._lengths.update(_bytes_of(pc.fill_null(pc.list_value_length(array), 0), "<i8"))
            next(iter(self._children.values())).update(array.flatten())
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
        return hashlib.sha256(b"".join([*streams, *(child.digest() for child in self._kept().values())])).digest()

    def tag(self) -> str:
        """A name of the type, of what is digested, that does not change with Arrow's version."""
        tags = {name: child.tag() for name, child in self._kept().items()}
        if pa.types.is_struct(self._kind):
            return "{" + ",".join(f"{name}:{tag}" for name, tag in tags.items()) + "}"
        if tags:
            return f"[{''.join(tags.values())}]"
        return "text" if pa.types.is_string(self._kind) else _PRIMITIVES[self._kind][0]

    def _kept(self) -> "dict[str, _Stream]":
        return {name: child for name, child in self._children.items() if child.some or child._stays}


class TableDigest:
    """The digest of one table, fed batch by batch in row order."""

    def __init__(self, table: str) -> None:
        self._name = table
        self._schema = SCHEMAS[table]
        self._streams = [_Stream(field.type, field.name, OF_SOME[table]) for field in self._schema]
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
                total.update(f"{field.name}\n{stream.tag()}\n".encode() + stream.digest())
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


def _bytes_of(array: pa.Array, dtype: str) -> bytes:
    return np.asarray(array.to_numpy(zero_copy_only=False)).astype(dtype, copy=False).tobytes()
