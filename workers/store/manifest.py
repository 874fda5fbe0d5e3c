"""Rows of scenes and ranges: checked against their schema, digested, sorted by key, encoded as Parquet and decoded."""

import hashlib
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from schemas.dataset.commit import FileEntry, Outcome
from schemas.dataset.layout import asset_path, is_glb, is_plain_path
from schemas.dataset.tables import (
    ALWAYS_OF_SCENES,
    DETERMINISTIC_TABLES,
    SCHEMAS,
    SHAPE_FILE_COLUMNS,
    SORT_KEYS,
)
from schemas.errors import CorruptError
from schemas.scene.scene import SceneOutput

_Check = Callable[[Any], None]


def _check_of(where: str, field: pa.Field) -> _Check | None:
    """What raises ValueError for an absent value that must be there, or a number that is not finite; None: any value does.

    Rows are checked as Python values: a scene has few of them, and each call into Arrow costs more than a value.
    """
    kind, inside = field.type, None
    if pa.types.is_floating(kind):
        inside = partial(_check_numbers, where, False)
    elif pa.types.is_struct(kind):
        children = [(child.name, check) for child in kind if (check := _check_of(f"{where}.{child.name}", child))]
        inside = partial(_check_struct, children) if children else None
    elif pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        item = kind.value_field
        if pa.types.is_floating(item.type):
            inside = partial(_check_numbers, where, item.nullable)
        elif check := _check_of(where, item):
            inside = partial(_check_list, check)
    if field.nullable:
        return inside and partial(_check_value, None, inside)
    return partial(_check_value, where, inside)


def _check_value(required: str | None, inside: _Check | None, value: Any) -> None:
    if value is not None:
        if inside is not None:
            inside(value)
    elif required is not None:
        raise ValueError(f"{required} is missing")


def _check_numbers(where: str, may_be_absent: bool, value: Any) -> None:
    numbers = [value] if isinstance(value, float) else np.ravel(value).tolist()
    for number in numbers:
        if number is None:
            if not may_be_absent:
                raise ValueError(f"{where} is missing")
        elif not math.isfinite(number):
            raise ValueError(f"{where} is not finite: {number}")


def _check_struct(children: Sequence[tuple[str, _Check]], value: Any) -> None:
    for name, check in children:
        check(value.get(name))


def _check_list(check: _Check, value: Any) -> None:
    for one in value:
        check(one)


PARQUET_OPTIONS = {"compression": "zstd", "write_page_checksum": True}
"""For every Parquet file that users read: a flipped bit is found when the page is read."""
_ROWS = {table: pa.struct(list(schema)) for table, schema in SCHEMAS.items()}
"""The type of a row, by table: all columns of a table are made in one call."""
_CHECKS = {
    table: [(field.name, check) for field in schema if (check := _check_of(f"{table}.{field.name}", field))]
    for table, schema in SCHEMAS.items()
}
_EMPTY = {table: schema.empty_table() for table, schema in SCHEMAS.items()}
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
        return _EMPTY[table]
    schema = SCHEMAS[table]
    names = set(schema.names)
    for row in rows:
        if row.keys() != names:
            wrong = sorted(names.symmetric_difference(row.keys()))
            raise ValueError(f"{table}: a row has other columns than the schema: {', '.join(wrong)}")
        if table == "scenes" and row["capture"] is None and (absent := [n for n in ALWAYS_OF_SCENES if row[n] is None]):
            raise ValueError(f"scenes.{absent[0]} is missing in scene {row['scene_id']}")
    try:
        arrays = pa.array(rows, _ROWS[table]).flatten()
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
        arrays = [_column(table, field, rows) for field in schema]  # says which column it is
    for row in rows:
        for name, check in _CHECKS[table]:
            check(row[name])
    return pa.Table.from_arrays(arrays, schema=schema)


def _column(table: str, field: pa.Field, rows: Sequence[Mapping[str, object]]) -> pa.Array:
    """One column of the rows. Raises ValueError naming it where a value has the wrong type."""
    try:
        return pa.array([row[field.name] for row in rows], field.type)
    except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError) as error:
        raise ValueError(f"{table}.{field.name}: {error}") from error


def outcome_of(output: SceneOutput) -> Outcome:
    """How the scene ended. Raises ValueError unless its rows give exactly one outcome, of this scene alone."""
    scene_id, tables = output.scene_id, output.rows
    for table, rows in tables.items():
        if any(row.get("scene_id", scene_id) != scene_id for row in rows):
            raise ValueError(f"scene {scene_id} has rows of another scene in {table}")
    made, failed, timed = (len(tables.get(table, ())) for table in ("scenes", "failures", "timings"))
    if made + failed != 1 or timed > 1:
        raise ValueError(
            f"scene {scene_id} has {made} rows in scenes and {failed} in failures, and must have one in all"
        )
    if made:
        return "made"
    if extra := [table for table in ("views", "objects", "assets") if tables.get(table)]:
        raise ValueError(f"scene {scene_id} failed and has rows in {', '.join(extra)}")
    kind = tables["failures"][0]["kind"]
    if kind not in ("intrinsic", "environmental"):
        raise ValueError(f"scene {scene_id} failed with the unknown kind {kind!r}")
    return kind


def check_files(output: SceneOutput, entries: Mapping[str, FileEntry]) -> None:
    """Raises ValueError unless the files are those that rows of `views` and `assets` list, each once, and GLBs."""
    if len(entries) != len(output.files):
        raise ValueError(f"scene {output.scene_id} writes a path twice")
    for path in entries:
        if not is_plain_path(path) or path[0] in "_.":
            raise ValueError(f"{path!r} is not a path that a scene may write")
    listed = [(file["path"], file["bytes"], file["sha256"]) for file in files_of_rows(output.rows)]
    told = {(path, entry.bytes, entry.sha256) for path, entry in entries.items() if not is_glb(path)}
    if len(listed) != len(told) or set(listed) != told:
        paths = {path for path, _, _ in listed}.symmetric_difference(path for path, _, _ in told)
        wrong = sorted(paths) or ["sizes, digests or repetitions"]
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
    found = [files.get(asset_path(row["category"], row["instance_id"])) for row in assets.to_pylist()]
    for field, name in zip(SHAPE_FILE_COLUMNS, ("bytes", "sha256"), strict=True):
        assets = assets.append_column(field, pa.array([entry and getattr(entry, name) for entry in found], field.type))
    return assets


def files_of_assets(assets: pa.Table) -> list[FileEntry]:
    """The files that rows of a range's `assets` list: GLBs, and samples. Raises KeyError without `SHAPE_FILE_COLUMNS`."""
    sizes, digests = (assets.column(field.name).to_pylist() for field in SHAPE_FILE_COLUMNS)
    entries = []
    names = [name for name in ("category", "instance_id", "samples") if name in assets.column_names]
    for row, size, sha256 in zip(assets.select(names).to_pylist(), sizes, digests, strict=True):
        if sha256 is not None:
            path = asset_path(row["category"], row["instance_id"])
            entries.append(FileEntry(path=path, bytes=size, sha256=sha256))
        if (samples := row.get("samples")) is not None:
            entries.append(FileEntry(**{name: samples[name] for name in FileEntry.model_fields}))
    return entries


def listed_files(table: str, data: bytes, name: str) -> list[FileEntry]:
    """The files that a range's `views` (images) or `assets` (shapes) list. Raises CorruptError as `decode_table`."""
    columns = ["category", "instance_id", "samples", *(field.name for field in SHAPE_FILE_COLUMNS)]
    try:
        with pq.ParquetFile(pa.BufferReader(data), page_checksum_verification=True) as file:
            rows = file.read(columns=["files"] if table == "views" else columns)
        if table == "assets":
            return files_of_assets(rows)
        return [FileEntry.model_validate(entry) for entry in pc.list_flatten(rows.column("files")).to_pylist()]
    except (pa.ArrowException, OSError, ValueError, KeyError) as error:
        raise CorruptError(f"{name} cannot be read: {' '.join(str(error).split())[:300]}") from error


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
        raise CorruptError(f"{name} cannot be read: {error}; `verso verify` lists every damaged file") from error


def conform(table: str, rows: pa.Table, name: str) -> pa.Table:
    """Rows with exactly today's schema of `table`. Raises CorruptError where a required column is missing.

    A schema only grows. So rows that lack a column and have an unknown one have a damaged column name.
    """
    schema = SCHEMAS[table]
    missing = [column for column in schema.names if column not in rows.column_names]
    known = {*schema.names, *(field.name for field in SHAPE_FILE_COLUMNS)}
    foreign = [column for column in rows.column_names if column not in known]
    if missing and foreign:
        raise CorruptError(f"{name} lacks the column {missing[0]} of the table {table}, and has {foreign[0]!r}")
    for column in missing:
        field = schema.field(column)
        if not field.nullable:
            raise CorruptError(f"{name} lacks the column {column} of the table {table}")
        rows = rows.append_column(field, _nulls(rows.num_rows, field.type))
    try:
        return rows.select(schema.names).cast(schema)  # Parquet has other names inside lists
    except (pa.ArrowException, ValueError) as error:
        raise CorruptError(f"{name} cannot be read: {error}; `verso verify` lists every damaged file") from error


def _nulls(count: int, kind: pa.DataType) -> pa.Array:
    """So many missing values. pyarrow's own have missing items below a list of fixed size, and `pa.nulls` below a struct too.

    A schema in which these items may not be missing does not take them.
    """
    if not pa.types.is_fixed_size_list(kind):
        return pa.array([None] * count, kind)
    items = pa.array(np.zeros(count * kind.list_size), kind.value_type)
    return pa.FixedSizeListArray.from_arrays(items, type=kind, mask=pa.array([True] * count, pa.bool_()))


def join_rows(table: str, parts: Sequence[pa.Table]) -> pa.Table:
    """Rows one after another, in today's schema."""
    schema = SCHEMAS[table]
    fitted = [part if part.schema == schema else conform(table, part, table) for part in parts]
    return pa.concat_tables(fitted) if fitted else schema.empty_table()
