"""The tables of a dataset as pyarrow datasets: finished or being made, in a folder or a bucket."""

import itertools
import urllib.parse
from collections.abc import Collection, Iterator, Mapping
from functools import cached_property
from itertools import groupby
from types import MappingProxyType
from typing import Any, NoReturn, TypeAlias

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.fs as fs
import pyarrow.parquet as pq

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import (
    COMMITS,
    IMAGES,
    MANIFEST,
    STAGING,
    SUCCESS_FILE,
    Content,
    PixelKind,
    image_path,
    patch_path,
    range_name,
    range_table_path,
)
from schemas.dataset.tables import SCHEMAS, TABLES
from schemas.errors import CorruptError, OutputError
from schemas.scene.view import MODALITIES
from services.job.record import read_success
from workers.store.commit import commit_names, read_record
from workers.store.ledger import range_rows
from workers.store.manifest import join_rows
from workers.store.store import Store


def view_paths(row: Mapping[str, Any]) -> Mapping[PixelKind, str]:
    """The paths of a view's images that are stored, by kind; `amodal0`, `amodal1` of one that each of several objects has."""
    listed = {file["path"] for file in row["files"]}
    named = {kind: image_path(row["category"], content, row["pose_id"]) for kind, content in _contents(row)}
    for kind, content in _contents(row):
        for n in itertools.count() if MODALITIES[kind].each else ():
            if (path := image_path(row["category"], content, row["pose_id"], n)) not in listed:
                break
            named[f"{kind}{n}"] = path
    return _those(named, listed)


def patch_paths(row: Mapping[str, Any], index: int | None) -> Mapping[PixelKind, str]:
    """The paths of the patches of a view's object that are stored, by kind."""
    named = {kind: patch_path(row["category"], content, row["pose_id"], index) for kind, content in _contents(row)}
    return _those(named, {file["path"] for file in row["files"]})


def _contents(row: Mapping[str, Any]) -> Iterator[tuple[PixelKind, Content]]:
    """Kinds of images that a view may have, with the word in their names."""
    return ((image.pixels, image.content) for image in IMAGES if image.role == row["role"])


def _those(named: Mapping[PixelKind, str], listed: Collection[str]) -> Mapping[PixelKind, str]:
    return MappingProxyType({kind: path for kind, path in named.items() if path in listed})


def file_system_of(store: Store) -> fs.FileSystem:
    """Reads files by their keys: straight from a disk, from a bucket each as a whole when it is scanned."""
    if store.root is not None:
        return fs.SubTreeFileSystem(str(store.root), fs.LocalFileSystem())
    return fs.PyFileSystem(_StoreFiles(store))


class _StoreFiles(fs.FileSystemHandler):
    """Reads whole objects; nothing can be written, and nothing is listed."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def get_type_name(self) -> str:
        """The kind of file system, for messages."""
        return "verso"

    def normalize_path(self, path: str) -> str:
        """The key itself."""
        return path

    def get_file_info(self, paths: list[str]) -> list[fs.FileInfo]:
        """What is known of files without asking for them: the commits or `_SUCCESS` name them."""
        return [fs.FileInfo(path, fs.FileType.File) for path in paths]

    def open_input_file(self, path: str) -> pa.NativeFile:
        """The object's bytes. Raises CorruptError where it is gone."""
        try:
            return pa.BufferReader(self._store.read(path))
        except FileNotFoundError as error:
            raise CorruptError(f"{path} is committed and missing: restore it from a copy") from error

    def open_input_stream(self, path: str) -> pa.NativeFile:
        """The object's bytes."""
        return self.open_input_file(path)

    def _refuse(self, *_: Any, **__: Any) -> NoReturn:
        raise NotImplementedError("a dataset is only read here")

    get_file_info_selector = create_dir = delete_dir = delete_dir_contents = delete_root_dir_contents = _refuse
    delete_file = move = copy_file = open_output_stream = open_append_stream = _refuse


Rows: TypeAlias = ds.Dataset | pa.Table

_FORMAT = ds.ParquetFileFormat(
    default_fragment_scan_options=ds.ParquetFragmentScanOptions(page_checksum_verification=True)
)


class StoredTables:
    """The six tables as they are now; a table is looked up when it is asked for, and its rows are read when scanned.

    A finished dataset is read from its merged tables, an unfinished one through its commits, where a retry's rows replace
    the first try's. Raises OutputError where there is no dataset, CorruptError where `_SUCCESS` or a commit is damaged.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._done = read_success(store)
        self._plain: list[int] = []
        """Of an unfinished dataset, the ranges whose tables are in place, as they were made first."""
        self._other: list[list[CommitRecord]] = []
        """The ranges that are not published or have retries: their rows go through memory."""
        if self._done is None:
            self._find_ranges()

    def _find_ranges(self) -> None:
        names = commit_names(self._store)
        if not names:
            raise OutputError(
                f"{self._store.name} holds no dataset that can be asked: there is nothing in {COMMITS} yet"
            )
        # Listed after the commits: a committed range without staging is published.
        staged = set(self._store.children(STAGING))
        for start, group in groupby(names, key=lambda name: name[0]):
            retries = [retry for _, retry, _ in group]
            if retries == [0] and range_name(start) not in staged:
                self._plain.append(start)
            else:
                records = [
                    record for retry in retries if (record := read_record(self._store, start, retry)) is not None
                ]
                self._other.append(records)

    @cached_property
    def _merged_files(self) -> list[str]:
        """The merged files that `_SUCCESS` names. Raises CorruptError where it does not name a file of each table."""
        files = (self._done or {}).get("files")
        if isinstance(files, dict) and all(
            any(key.startswith(f"{MANIFEST}/{table}/") for key in files) for table in TABLES
        ):
            return list(files)
        told = f"{SUCCESS_FILE} in {self._store.name} does not name its merged files"
        raise CorruptError(f"{told}: remove it, and run the job again")

    def parts(self, table: str) -> list[Rows]:
        """The rows of one table in one or two pieces. In `assets` of an unfinished dataset an instance may be repeated."""
        schema, files = SCHEMAS[table], file_system_of(self._store)
        if self._done is not None:
            folder = f"{MANIFEST}/{table}"
            keys = [key for key in self._merged_files if key.startswith(f"{folder}/")]
            hive: Any = ds.partitioning(pa.schema([("category", pa.string())]), flavor="hive")
            options = {"filesystem": files, "partition_base_dir": folder, "partitioning": hive}
            return [ds.dataset(keys, schema, _FORMAT, **options)]
        rows = [range_rows(self._store, records, table) for records in self._other]
        parts: list[Rows] = [join_rows(table, [schema.empty_table(), *rows])]
        if self._plain:
            paths = [range_table_path(start, table) for start in self._plain]
            parts.append(ds.dataset(paths, schema, _FORMAT, filesystem=files))
        return parts

    def dataset(self, table: str) -> ds.Dataset:
        """The rows of one table as one pyarrow dataset, as `parts`."""
        parts = self.parts(table)
        found = [part if isinstance(part, ds.Dataset) else ds.dataset(part) for part in parts]
        return found[0] if len(found) == 1 else ds.dataset(found)


def category_of(key: str) -> str:
    """The category that a merged file's folder names."""
    return urllib.parse.unquote(key.split("/")[-2].removeprefix("category="))


def read_merged(table: str, key: str, data: bytes) -> pa.Table:
    """The rows in the bytes of one merged file, with the category that its folder names."""
    rows = pq.read_table(pa.BufferReader(data), page_checksum_verification=True)
    column = pa.repeat(pa.scalar(category_of(key)), rows.num_rows)
    schema = SCHEMAS[table]
    return rows.append_column("category", column).select(schema.names).cast(schema)
