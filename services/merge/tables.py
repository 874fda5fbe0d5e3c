"""The merged files: manifest tables by category, and the article's camPoses.csv, cameras.csv and objects.dat.

Tables are written in files of about 100,000 rows, the text files in blocks of lines (dataset.md section 1).
"""

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import IO

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from schemas.dataset.layout import CAM_POSES, CAMERAS, OBJECTS, merged_table_path
from schemas.dataset.tables import SCHEMAS, SORT_KEYS
from schemas.errors import CorruptError
from schemas.scene.view import ROLES
from workers.store.canonical import TableDigest, text_bytes
from workers.store.manifest import PARQUET_OPTIONS

ROWS_PER_FILE = 100_000
ROWS_PER_GROUP = 8_192
"""Rows of a Parquet row group; also how many rows of a table wait before they are split by category."""
WAITING_BYTES = 24 << 20
"""Memory for the rows of one table that wait, before they are split and behind that in all categories together."""


class MergedTable:
    """Writes one table below `folder` as hive partitions, and digests its rows."""

    def __init__(self, table: str, folder: Path) -> None:
        self.table = table
        self.digest = TableDigest(table)
        self._folder = folder
        self._parts: dict[str, _Parts] = {}
        self._unsplit: list[pa.Table] = []
        self._unsplit_bytes = 0
        self._last_row: pa.Table | None = None

    def add(self, rows: pa.Table) -> None:
        """Takes the next rows, best some thousands, sorted by key. Raises CorruptError where a key does not rise."""
        if not rows.num_rows:
            return
        rows = rows.combine_chunks()
        self._check_order(rows)
        self.digest.update(rows)
        self._unsplit.append(rows)
        self._unsplit_bytes += rows.nbytes
        if self._unsplit_bytes >= WAITING_BYTES // 2 or sum(map(len, self._unsplit)) >= ROWS_PER_GROUP:
            self._split()

    def finish(self, categories: list[str]) -> dict[str, Path]:
        """The finished files by key. An empty table gets one empty file under the first of `categories`."""
        self._split()
        if not self._parts:
            self._parts_of(categories[0]).write(SCHEMAS[self.table].empty_table())
        return {key: path for parts in self._parts.values() for key, path in parts.finish().items()}

    @property
    def categories(self) -> set[str]:
        """Those that have rows so far."""
        self._split()
        return set(self._parts)

    def _split(self) -> None:
        """Gives the rows to their categories; where those hold too much then, the largest write theirs."""
        if not self._unsplit:
            return
        rows = pa.concat_tables(self._unsplit)
        self._unsplit, self._unsplit_bytes = [], 0
        column = rows.column("category")
        for category in sorted(column.unique().to_pylist()):
            self._parts_of(category).write(rows.filter(pc.equal(column, category)))
        while sum(parts.waiting_bytes for parts in self._parts.values()) > WAITING_BYTES // 2:
            max(self._parts.values(), key=lambda parts: parts.waiting_bytes).flush()

    def _parts_of(self, category: str) -> "_Parts":
        if category not in self._parts:
            self._parts[category] = _Parts(self.table, category, self._folder)
        return self._parts[category]

    def _check_order(self, rows: pa.Table) -> None:
        """Compares each row with the one before it, column by column of the key."""
        keys = rows.select(SORT_KEYS[self.table])
        if self._last_row is not None:
            keys = pa.concat_tables([self._last_row, keys]).combine_chunks()
        rises = pa.array(np.zeros(len(keys) - 1, bool))
        for column in reversed(keys.columns):
            before, after = column.slice(0, len(keys) - 1), column.slice(1)
            rises = pc.or_(pc.less(before, after), pc.and_(pc.equal(before, after), rises))
        if (at := pc.index(rises, False).as_py()) >= 0:
            before, after = (tuple(keys.slice(at + i, 1).to_pylist()[0].values()) for i in (0, 1))
            raise CorruptError(
                f"{self.table}: the key ({', '.join(keys.column_names)}) = {after} comes after {before}: "
                "the ranges do not join; `verso verify` lists what is damaged"
            )
        self._last_row = keys.take([len(keys) - 1])


class _Parts:
    """The files of one category of one table."""

    def __init__(self, table: str, category: str, folder: Path) -> None:
        self._table = table
        self._category = category
        self._folder = folder
        schema = SCHEMAS[table]
        self._schema = schema.remove(schema.get_field_index("category"))
        self._waiting: list[pa.Table] = []
        self.waiting_bytes = 0
        self._writer: pq.ParquetWriter | None = None
        self._sink = _Sink()
        self._file_rows = 0
        self._files: dict[str, Path] = {}

    def write(self, rows: pa.Table) -> None:
        """Takes the next rows."""
        self._waiting.append(rows.drop_columns("category"))
        self.waiting_bytes += self._waiting[-1].nbytes
        if sum(map(len, self._waiting)) >= ROWS_PER_GROUP:
            self.flush()

    def finish(self) -> dict[str, Path]:
        """Ends the last file; the files by key."""
        if self._waiting or not self._files:
            self.flush()
        self._end_file()
        return self._files

    def flush(self) -> None:
        """Writes the rows that wait."""
        assert self._schema is not None
        rows = pa.concat_tables([self._schema.empty_table(), *self._waiting])
        self._waiting, self.waiting_bytes = [], 0
        while rows.num_rows or not self._files:
            piece = rows.slice(0, ROWS_PER_FILE - self._file_rows)
            self._open().write_table(piece, row_group_size=ROWS_PER_GROUP)
            self._store()
            self._file_rows += piece.num_rows
            rows = rows.slice(piece.num_rows)
            if self._file_rows >= ROWS_PER_FILE:
                self._end_file()

    def _open(self) -> pq.ParquetWriter:
        if self._writer is None:
            key = merged_table_path(self._table, self._category, len(self._files))
            self._files[key] = self._folder / key
            self._files[key].parent.mkdir(parents=True, exist_ok=True)
            self._sink = _Sink()
            self._writer = pq.ParquetWriter(pa.PythonFile(self._sink, mode="w"), self._schema, **PARQUET_OPTIONS)
        return self._writer

    def _end_file(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._store()
            self._writer, self._file_rows = None, 0

    def _store(self) -> None:
        """Appends what the writer wrote to the file on the disk, which is open only meanwhile."""
        with open(list(self._files.values())[-1], "ab") as file:
            self._sink.drain(file)


class _Sink(io.BytesIO):
    """Where a Parquet writer writes to: memory, so that it never fails and hundreds of files need not be open at once."""

    def close(self) -> None:
        """Does nothing: what the writer wrote last is still to be drained."""

    def drain(self, file: IO[bytes]) -> None:
        """Moves the bytes since the last call to a file."""
        file.write(self.getvalue())
        self.seek(0)
        self.truncate()


_ELEMENTS = [f"T{row}{column}" for row in range(4) for column in range(4)]
_CAMERA_COLUMNS = [
    *("pose_id", "parent_id", "role", "width", "height", "fx", "fy", "cx", "cy"),
    *("cx_opencv", "cy_opencv", "depth_units_per_m"),
]
_UNSAFE = re.compile(r"[%\s\x00-\x1f\x7f]")
PLAIN_FROM, PLAIN_BELOW = 1e-4, 1e10
"""Sizes of doubles that Arrow writes as Python's repr does, but for `.0`; others have an exponent in one of them."""


class PoseFiles:
    """The three files in `folder`; takes whole ranges in order. A file is open only while it is written."""

    def __init__(self, folder: Path) -> None:
        self.paths = {name: folder / name for name in (CAM_POSES, CAMERAS, OBJECTS)}
        headers = (["id", "parent_id", *_ELEMENTS], [*_CAMERA_COLUMNS, *_ELEMENTS])
        self._append(*((",".join(words) + "\n").encode() for words in headers), b"")

    def add(self, views: pa.Table, objects: pa.Table) -> None:
        """Takes the next ranges' rows of both tables."""
        self._append(cam_pose_lines(views), camera_lines(views), object_lines(objects))

    def _append(self, *lines: bytes) -> None:
        for path, more in zip(self.paths.values(), lines, strict=True):
            with open(path, "ab") as file:
                file.write(more)


def cam_pose_lines(views: pa.Table) -> bytes:
    """`id,parent_id,T00,...,T33` for the input and mirror cameras among rows sorted by pose id."""
    rows = views.select(["pose_id", "parent_id", "T_world_cam"]).filter(_is_pose(views)).combine_chunks()
    return _lines([rows.column("pose_id"), rows.column("parent_id"), _joined(rows.column("T_world_cam"), ",")], ",")


def camera_lines(views: pa.Table) -> bytes:
    """One line for each camera, by pose id and then in the order input, aligned, mirror, projected."""
    rank = pc.index_in(views.column("role"), value_set=pa.array(ROLES))
    order = np.lexsort((rank.to_numpy(), views.column("pose_id").to_numpy()))
    rows = views.select([*_CAMERA_COLUMNS, "T_world_cam"]).take(order).combine_chunks()
    return _lines([*(rows.column(name) for name in _CAMERA_COLUMNS), _joined(rows.column("T_world_cam"), ",")], ",")


def object_lines(objects: pa.Table) -> bytes:
    """`pose_id category instance region u v T00 ... T33` for everything that input and mirror cameras see.

    White space and `%` in names are written as in a URL (`my%20mug`), so every line has 22 words.
    """
    columns = ["pose_id", "category", "instance_id", "region_id", "u", "v", "T_cam_obj"]
    rows = objects.select(columns).filter(_is_pose(objects)).combine_chunks()
    names = []
    for name in ("category", "instance_id"):
        coded = rows.column(name).dictionary_encode().combine_chunks()
        words = pa.array([escaped(text) for text in coded.dictionary.to_pylist()], pa.string())
        names.append(words.take(coded.indices))
    numbers = [rows.column(name) for name in ("region_id", "u", "v")]
    return _lines([rows.column("pose_id"), *names, *numbers, _joined(rows.column("T_cam_obj"), " ")], " ")


def escaped(name: str) -> str:
    """A name as one word; `urllib.parse.unquote` reverses it."""
    return _UNSAFE.sub(lambda found: "".join(f"%{byte:02X}" for byte in found[0].encode()), name)


def shortest(numbers: pa.Array) -> pa.Array:
    """Doubles as Python's repr writes them, the shortest digits that give them back."""
    values = numbers.to_numpy(zero_copy_only=False)
    sizes = np.abs(values)
    plain = (sizes >= PLAIN_FROM) & (sizes < PLAIN_BELOW) | (sizes == 0)
    texts = numbers.cast(pa.string())
    texts = pc.if_else(pa.array(values == np.trunc(values)), pc.binary_join_element_wise(texts, ".0", ""), texts)
    if plain.all():
        return texts
    return pc.replace_with_mask(texts, pa.array(~plain), pa.array(map(repr, values[~plain].tolist()), pa.string()))


def _joined(matrices: pa.ChunkedArray, separator: str) -> pa.Array:
    """[rows] strings: the sixteen numbers of each matrix."""
    numbers = pa.concat_arrays([chunk.flatten() for chunk in matrices.chunks] or [pa.array([], pa.float64())])
    ends = pa.array(np.arange(0, len(numbers) + 1, 16, dtype=np.int32))
    return pc.binary_join(pa.ListArray.from_arrays(ends, shortest(numbers)), separator)


def _lines(columns: Sequence[pa.ChunkedArray | pa.Array], separator: str) -> bytes:
    """The rows as lines of UTF-8."""
    texts = [_text(column) for column in columns]
    lines = pc.binary_join_element_wise(*texts[:-1], pc.binary_join_element_wise(texts[-1], "", "\n"), separator)
    return b"".join(map(text_bytes, lines.chunks if isinstance(lines, pa.ChunkedArray) else [lines]))


def _text(column: pa.ChunkedArray | pa.Array) -> pa.Array:
    whole = pa.concat_arrays(column.chunks) if isinstance(column, pa.ChunkedArray) and column.chunks else column
    if pa.types.is_floating(whole.type):
        return shortest(whole)
    return whole if pa.types.is_string(whole.type) else whole.cast(pa.string())


def _is_pose(rows: pa.Table) -> pa.ChunkedArray:
    """Which rows are of input and mirror cameras; aligned and projected cameras are in cameras.csv alone."""
    return pc.is_in(rows.column("role"), value_set=pa.array(["input", "mirror"]))
