"""Stored rows and images of a dataset, finished or being made, in a folder or a bucket.

Range by range or scene by scene, and as tables: pyarrow datasets.
"""

import io
import itertools
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping, MutableMapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import groupby
from operator import itemgetter
from types import MappingProxyType
from typing import Any, NoReturn, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.fs as fs
from numpy.typing import NDArray

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import (
    COMMITS,
    MANIFEST,
    STAGING,
    SUCCESS_FILE,
    Content,
    PixelKind,
    image_path,
    images_of,
    is_shape,
    patch_path,
    range_name,
    range_table_path,
    view_name,
)
from schemas.dataset.tables import DETERMINISTIC_TABLES, SCHEMAS, TABLES
from schemas.errors import CorruptError, InputError, OutputError, command_line
from schemas.job.assets import TABLE
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_TABLE
from schemas.scene.view import MODALITIES
from services.job.record import read_success
from workers.geometry.camera import spread_evenly
from workers.store.commit import code_of, commit_names, list_codes, read_committed, read_record, split_code
from workers.store.ledger import list_commits, range_rows, read_range
from workers.store.manifest import join_rows
from workers.store.store import Store
from workers.store.tars import read_tar

ReadFile = Callable[[str], bytes]
"""Returns a file's bytes by its path below the output folder."""


@dataclass(frozen=True)
class StoredRange:
    """A committed range: its records, and its rows by table in order, with those of retries in place of the first try's."""

    start: int
    stop: int
    records: tuple[CommitRecord, ...]
    rows: dict[str, list[Row]]

    def scene(self, scene_id: int) -> Row | None:
        """The row of `scenes`, None for a scene that failed."""
        return next((row for row in self.rows["scenes"] if row["scene_id"] == scene_id), None)

    def pairs(self, scene_id: int) -> Iterator[tuple[dict[str, Row], list[Row]]]:
        """(rows of `views` by name, rows of `objects`) of each pair of a scene, by pose id."""
        views = [row for row in self.rows["views"] if row["scene_id"] == scene_id]
        objects = [row for row in self.rows["objects"] if row["scene_id"] == scene_id]
        for parent in sorted({row["parent_id"] for row in views}):
            pair = {view_name(row["role"], row["number"]): row for row in views if row["parent_id"] == parent}
            ids = {row["pose_id"] for row in pair.values()}
            yield pair, [row for row in objects if row["pose_id"] in ids]


def read_stored(store: Store, records: Sequence[CommitRecord]) -> StoredRange:
    """One committed range with its retries. Raises CorruptError where a table does not match its commit."""
    rows = {table: range_rows(store, records, table).to_pylist() for table in DETERMINISTIC_TABLES}
    return StoredRange(records[0].span.start, records[0].span.stop, tuple(records), rows)


def choose_scenes(store: Store, count: int, seed: int) -> list[int]:
    """`count` of the scenes that were made, or all of them, evenly over their ids; the seed sets the first."""
    ledger = list_commits(store)
    sizes = ledger.ranges[:, 1] - ledger.ranges[:, 0]
    scenes = np.arange(sizes.sum()) + np.repeat(ledger.ranges[:, 0] - np.cumsum(sizes) + sizes, sizes)
    made = np.setdiff1d(scenes, ledger.failures.column("scene_id").to_numpy(), assume_unique=True)
    if count < len(made):
        first = float(np.random.default_rng(seed).random())
        made = made[((np.arange(count) + first) * len(made) / count).astype(np.int64)]
    return [int(scene) for scene in made]


def find_scene(store: Store, scene_id: int) -> StoredRange:
    """The range that holds a scene. Raises InputError where it is not committed."""
    return read_stored(store, find_records(store, scene_id))


def find_records(store: Store, scene_id: int) -> list[CommitRecord]:
    """The records of the range that holds a scene. Raises InputError where it is not committed."""
    codes = list_codes(store)
    before = codes[: int(np.searchsorted(codes, code_of(scene_id + 1, 0)))]
    if len(before):
        start, _ = split_code(before[-1])
        retries = [split_code(code)[1] for code in before[np.searchsorted(before, code_of(start, 0)) :]]
        records = read_range(store, start, retries)
        if scene_id < records[0].span.stop:
            return records
    raise InputError(
        f"scene {scene_id} is not in {store.name}: `{command_line('status', store.name)}` tells which scenes are"
    )


def committed_reader(store: Store, records: Sequence[CommitRecord]) -> ReadFile:
    """Reads the files of a range, published or, where a run is at work, not yet. Raises CorruptError for one that is missing."""

    def read(path: str) -> bytes:
        for record in records[:-1]:
            with suppress(CorruptError):
                return read_committed(store, record, path)
        return read_committed(store, records[-1], path)

    return read


Members = Mapping[str, bytes]
"""Images of a tar by path."""


def file_reader(
    read: ReadFile, records: Sequence[CommitRecord], tars: MutableMapping[str, Members] | None = None
) -> ReadFile:
    """Reads images and shapes of a range by path, from their own place or from a tar, of a retry's first.

    `read` gives the bytes of files and tars. A tar is read when it is first needed, and kept in `tars` by its path. What comes
    back raises CorruptError for an image that is in no tar.
    """
    kept = {} if tars is None else tars
    packed = [entry.path for record in reversed(records) for entry in record.files if entry.path.endswith(".tar")]

    def members_of(tar: str) -> Members:
        if (known := kept.get(tar)) is not None:
            return known
        members = dict(read_tar(tar.partition("/")[0], read(tar), tar))
        with suppress(ValueError):  # it is larger than all that is kept
            kept[tar] = members
        return members

    def read_file(path: str) -> bytes:
        if records[0].terms.layout == "files" or is_shape(path):
            return read(path)
        folder = f"{path.partition('/')[0]}/"
        for members in (members_of(tar) for tar in packed if tar.startswith(folder)):
            if path in members:
                return members[path]
        raise CorruptError(f"{path} is committed and in no tar: `verso verify OUT` tells more")

    return read_file


_SAMPLES: Mapping[str, tuple[str, tuple[int, ...]]] = {
    "surface_points": ("<f4", (3,)),
    "surface_normals": ("<f4", (3,)),
    "surface_colors": ("|u1", (3,)),
    "volume_points": ("<f4", (3,)),
    "volume_distance": ("<f4", ()),
    "volume_occupancy": ("|u1", ()),
    "loc": ("<f8", (3,)),
    "scale": ("<f8", ()),
}
"""(dtype, shape) of the arrays of a shape's samples; of surface and volume those of one point."""


def decode_samples(data: bytes, name: str) -> dict[str, NDArray]:
    """The arrays of the file `name` of a shape's samples by key, as docs/targets.md has them, all finite.

    Raises CorruptError where it is damaged or another file. Nothing is unpacked of one that would unpack to more bytes than
    it has: arrays are stored uncompressed.
    """
    with as_damage(name):
        with zipfile.ZipFile(io.BytesIO(data)) as file:
            if (unpacked := sum(member.file_size for member in file.infolist())) > len(data):
                raise ValueError(f"its {len(data):,} bytes would unpack to {unpacked:,}")
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = dict(file)
        _check_samples(arrays)
    return arrays


@contextmanager
def as_damage(path: str) -> Iterator[None]:
    """Around the decoding of a stored file: what libraries raise, errors of many kinds, is CorruptError that names the file."""
    try:
        yield
    except Exception as error:
        raise CorruptError(f"{path} cannot be read: {error}; `verso verify OUT` says what to do") from error


def _check_samples(arrays: Mapping[str, NDArray]) -> None:
    """Raises ValueError for a key, a type, a shape or a number that samples do not have."""
    kinds = {key.partition("_")[0] for key in arrays} & {"surface", "volume"} or {"surface", "volume"}
    wanted = [key for key in _SAMPLES if key.partition("_")[0] in {*kinds, "loc", "scale"}]
    if arrays.keys() != set(wanted):
        raise ValueError(f"it has {', '.join(arrays) or 'no array'}, not {', '.join(wanted)}")
    for key, array in arrays.items():
        (dtype, shape), kind = _SAMPLES[key], key.partition("_")[0]
        shape = (*arrays[f"{kind}_points"].shape[:1], *shape) if kind in kinds else shape
        if (array.dtype.str, array.shape) != (dtype, shape):
            raise ValueError(f"{key} is {array.dtype.str} {array.shape}, not {dtype} {shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{key} has a number that is not finite")


def region_names(scene: Mapping[str, Any]) -> dict[int, tuple[str, str]]:
    """(category, instance id) of the table, where there is one, and of every object, by region id, of a row of `scenes`."""
    bodies = scene["bodies"] or [{**scene, "region_id": REGION_FIRST_OBJECT}]
    objects = {body["region_id"]: (body["category"], body["instance_id"]) for body in bodies}
    table = {} if scene["table_id"] is None else {REGION_TABLE: (TABLE, scene["table_id"])}
    return table | objects


def view_paths(row: Mapping[str, Any]) -> Mapping[PixelKind, str]:
    """The paths of a view's images that are stored, by kind; `amodal0`, `amodal1` of one that each of several objects has."""
    listed, named = {file["path"] for file in row["files"]}, dict[PixelKind, str]()
    for kind, content in _contents(row):
        path_of = partial(image_path, row["category"], content, row["pose_id"], number=row.get("number"))
        named[kind] = path_of()
        if MODALITIES[kind].each:
            each = (path_of(n) for n in itertools.count())
            named |= {f"{kind}{n}": path for n, path in enumerate(itertools.takewhile(listed.__contains__, each))}
    return _those(named, listed)


def kinds_of(modality: PixelKind, there: Collection[PixelKind]) -> list[PixelKind]:
    """A modality's images among those that are there: itself, or `amodal0`, `amodal1` of one that each object has; or none."""
    each = itertools.takewhile(there.__contains__, (f"{modality}{n}" for n in itertools.count()))
    return [modality] if modality in there else list(each)


def patch_paths(row: Mapping[str, Any], index: int | None) -> Mapping[PixelKind, str]:
    """The paths of the patches of a view's object that are stored, by kind."""
    named = {kind: patch_path(row["category"], content, row["pose_id"], index) for kind, content in _contents(row)}
    return _those(named, {file["path"] for file in row["files"]})


def _contents(row: Mapping[str, Any]) -> Iterator[tuple[PixelKind, Content]]:
    """Kinds of images that a view may have, with the word in their names."""
    return ((image.pixels, image.content) for image in images_of(row["role"]))


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
        return "verso"

    def normalize_path(self, path: str) -> str:
        return path

    def get_file_info(self, paths: list[str]) -> list[fs.FileInfo]:
        # Files are not asked for: the commits or `_SUCCESS` name them.
        return [fs.FileInfo(path, fs.FileType.File) for path in paths]

    def open_input_file(self, path: str) -> pa.NativeFile:
        try:
            return pa.BufferReader(self._store.read(path))
        except FileNotFoundError as error:
            raise CorruptError(f"{path} is committed and missing: restore it from a copy") from error

    open_input_stream = open_input_file

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

    def __init__(self, store: Store, most_ranges: int | None = None) -> None:
        """`most_ranges`: so many of an unfinished dataset are read, evenly chosen; then there may be none yet."""
        self.store = store
        self.sampled = False
        """Whether rows of some ranges only are read."""
        self._done = read_success(store)
        self._plain: list[int] = []
        """Of an unfinished dataset, the ranges whose tables are in place, as they were made first."""
        self._other: list[list[CommitRecord]] = []
        """The ranges that are not published or have retries: their rows go through memory."""
        if self._done is None:
            self._find_ranges(most_ranges)

    def _find_ranges(self, most_ranges: int | None) -> None:
        groups = groupby(commit_names(self.store), key=itemgetter(0))
        ranges = [(start, [retry for _, retry, _ in group]) for start, group in groups]
        if not ranges and most_ranges is None:
            raise OutputError(
                f"{self.store.name} holds no dataset that can be asked: there is nothing in {COMMITS} yet"
            )
        # Listed after the commits: a committed range without staging is published.
        staged = set(self.store.children(STAGING))
        self.sampled = most_ranges is not None and len(ranges) > most_ranges
        for place in spread_evenly(len(ranges), most_ranges or len(ranges)):
            start, retries = ranges[place]
            if retries == [0] and range_name(start) not in staged:
                self._plain.append(start)
            else:
                records = (read_record(self.store, start, retry) for retry in retries)
                self._other.append([record for record in records if record is not None])

    @cached_property
    def _merged_files(self) -> list[str]:
        """The merged files that `_SUCCESS` names. Raises CorruptError where it does not name a file of each table."""
        files = (self._done or {}).get("files")
        if isinstance(files, dict) and all(
            any(key.startswith(f"{MANIFEST}/{table}/") for key in files) for table in TABLES
        ):
            return list(files)
        fault = f"{SUCCESS_FILE} in {self.store.name} does not name its merged files"
        raise CorruptError(f"{fault}: remove it, and run the job again")

    def parts(self, table: str) -> list[Rows]:
        """The rows of one table in one or two pieces. In `assets` of an unfinished dataset an instance may be repeated."""
        schema, files = SCHEMAS[table], file_system_of(self.store)
        if self._done is not None:
            folder = f"{MANIFEST}/{table}"
            keys = [key for key in self._merged_files if key.startswith(f"{folder}/")]
            hive: Any = ds.partitioning(pa.schema([("category", pa.string())]), flavor="hive")
            options = {"filesystem": files, "partition_base_dir": folder, "partitioning": hive}
            return [ds.dataset(keys, schema, _FORMAT, **options)]
        rows = [range_rows(self.store, records, table) for records in self._other]
        parts: list[Rows] = [join_rows(table, [schema.empty_table(), *rows])]
        if self._plain:
            paths = [range_table_path(start, table) for start in self._plain]
            parts.append(ds.dataset(paths, schema, _FORMAT, filesystem=files))
        return parts

    def dataset(self, table: str) -> ds.Dataset:
        """The rows of one table as one pyarrow dataset, as `parts`."""
        parts = [part if isinstance(part, ds.Dataset) else ds.dataset(part) for part in self.parts(table)]
        return parts[0] if len(parts) == 1 else ds.dataset(parts)
