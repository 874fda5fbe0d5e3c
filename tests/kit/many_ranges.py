"""Committed ranges of one scene each, as many as wanted, made by patching the bytes of one: 20 microseconds a table.

A scene has five pairs, so ten rows in `views` and twenty in `objects`, ten images in one tar, and every thousandth one
failed. Its ids, paths and sizes are its own; what does not tell it from others (matrices, digests) is the same in all.
"""

import functools
import hashlib
import struct
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.dataset.commit import COMMIT_VERSION, CommitRecord, FileEntry, SceneMark, Span
from schemas.dataset.layout import COMMITS, RANGES, commit_path, image_path, range_table_path, tar_path
from schemas.dataset.tables import TABLES
from tests.made_up_scenes import failed_scene, made_scene, terms
from workers.store.commit import encode_record
from workers.store.local import LocalStore
from workers.store.manifest import sorted_rows, table_of_rows, with_shape_files
from workers.store.store import Entry

PAIRS = 5
CATEGORY = "mug"
TAR_BYTES = 10_240
TERMS = terms(layout="tar", range_size=1, pairs_per_scene=PAIRS)
_PATTERN = 6
"""A scene of which every id is found in the bytes; others take its place there."""


def fails(scene_id: int) -> bool:
    """Whether a scene failed."""
    return scene_id % 1000 == 500


def files_of(scene_id: int) -> dict[str, bytes]:
    """The tables of a scene's range by path, as Parquet."""
    tables = {}
    for table in TABLES:
        data = _template(table, fails(scene_id), _digits(scene_id))
        for old, new in _marks(scene_id):
            data = data.replace(old, new)
        tables[range_table_path(scene_id, table)] = data
    return tables


def record_of(scene_id: int, tables: dict[str, bytes]) -> CommitRecord:
    """The commit of a scene's range."""
    made = not fails(scene_id)
    files = {path: (len(data), hashlib.sha256(data).hexdigest()) for path, data in tables.items()}
    if made:
        files[tar_path(CATEGORY, scene_id)] = (TAR_BYTES, "0" * 64)
    rows = _rows(not made)
    return CommitRecord(
        schema_version=COMMIT_VERSION,
        span=Span(start=scene_id, stop=scene_id + 1),
        attempt="r0-made-up",
        terms=TERMS,
        files=tuple(FileEntry(path=path, bytes=size, sha256=sha) for path, (size, sha) in sorted(files.items())),
        tables={table: rows[table].num_rows for table in TABLES},
        scenes=(_mark(scene_id, made),),
    )


def _mark(scene_id: int, made: bool) -> SceneMark:
    told = {"outcome": "made"} if made else {"outcome": "intrinsic", "reason": "left_table"}
    return SceneMark(scene_id=scene_id, digest="0" * 16, **told)


def write_ranges(root: Path, scenes: int) -> LocalStore:
    """A folder with so many ranges as files; tars are holes."""
    store = LocalStore(root)
    store.prepare()
    (root / CATEGORY).mkdir()
    for scene_id in range(scenes):
        tables = files_of(scene_id)
        (root / range_table_path(scene_id, "scenes")).parent.mkdir()
        for path, data in tables.items():
            (root / path).write_bytes(data)
        if not fails(scene_id):
            with open(root / tar_path(CATEGORY, scene_id), "wb") as tar:
                tar.truncate(TAR_BYTES)
        (root / commit_path(scene_id)).write_bytes(encode_record(record_of(scene_id, tables)))
    return store


class ManyRanges(LocalStore):
    """A folder in which so many ranges seem to lie: they are made when they are read, the rest is on the disk."""

    def __init__(self, root: Path, scenes: int) -> None:
        super().__init__(root)
        self.scenes = scenes
        self._last: tuple[int, dict[str, bytes]] = (-1, {})

    def read(self, key: str) -> bytes:
        """A record or a table, made now."""
        if key.startswith(f"{COMMITS}/"):
            scene_id = int(key[-15:-5])
            return encode_record(record_of(scene_id, self._tables(scene_id)))
        if key.startswith(f"{RANGES}/"):
            return self._tables(int(key.split("/")[2]))[key]
        return super().read(key)

    def size(self, key: str) -> int | None:
        """Bytes at `key`; a record's is not told exactly."""
        if key.startswith(f"{COMMITS}/"):
            return 1
        if key.startswith(f"{RANGES}/"):
            scene_id, table = int(key.split("/")[2]), key.rpartition("/")[2].removesuffix(".parquet")
            return len(_template(table, fails(scene_id), _digits(scene_id)))
        if key.startswith(f"{CATEGORY}/"):
            return TAR_BYTES
        return super().size(key)

    def files(self, prefix: str, sizes: bool = True) -> Iterator[Entry]:
        """The records, and what is really there in other folders."""
        if prefix != COMMITS:
            return super().files(prefix, sizes)
        return (Entry(commit_path(scene_id), 1, 0.0, None) for scene_id in range(self.scenes))

    def _tables(self, scene_id: int) -> dict[str, bytes]:
        if self._last[0] != scene_id:
            self._last = scene_id, files_of(scene_id)
        return self._last[1]


def _digits(scene_id: int) -> int:
    return max(5, len(str(2 * PAIRS * scene_id)))


def _poses(scene_id: int) -> range:
    return range(2 * PAIRS * scene_id, 2 * PAIRS * (scene_id + 1))


def _marks(scene_id: int) -> list[tuple[bytes, bytes]]:
    """What stands for each id in a template, and what this scene has there."""
    ids = [(_hidden(-1), scene_id), *((_hidden(number), pose) for number, pose in enumerate(_poses(scene_id)))]
    digits = _digits(scene_id)
    names = [
        (f"~{number:0{digits - 1}d}.png".encode(), f"{pose:0{digits}d}.png".encode())
        for number, pose in enumerate(_poses(scene_id))
    ]
    return [(struct.pack("<q", old), struct.pack("<q", new)) for old, new in ids] + names


def _hidden(number: int) -> int:
    """An id that nothing else in a file looks like."""
    return 0x5AC35AC35AC30000 + 256 + number


@functools.cache
def _rows(failed: bool) -> dict[str, pa.Table]:
    """The pattern's rows with hidden ids."""
    output = failed_scene(_PATTERN) if failed else made_scene(_PATTERN, images=(), shapes=False)
    rows = {table: [dict(row) for row in output.rows.get(table, ())] for table in TABLES}
    if not failed:
        full = made_scene(_PATTERN)
        view, thing = full.rows["views"][0], full.rows["objects"][0]
        poses = [(_hidden(n), _hidden(n - n % 2), "mirror" if n % 2 else "input", n) for n in range(2 * PAIRS)]
        rows["views"] = [
            {**view, "pose_id": pose, "parent_id": parent, "role": role, "files": [_file(n)]}
            for pose, parent, role, n in poses
        ]
        rows["objects"] = [
            {**thing, "pose_id": pose, "role": role, "region_id": region, "category": category}
            for pose, _, role, _ in poses
            for region, category in ((2, "table"), (3, CATEGORY))
        ]
    for table in TABLES:
        own = {"scene_id": _hidden(-1), **({} if table in ("objects", "assets") else {"category": CATEGORY})}
        for row in rows[table]:
            row.update({name: value for name, value in own.items() if name in row})
    tables = {table: sorted_rows(table, table_of_rows(table, rows[table])) for table in TABLES}
    return tables | {"assets": with_shape_files(tables["assets"], {})}


def _file(number: int) -> dict[str, object]:
    return {"path": f"~{number}", "bytes": 1000, "sha256": f"{number:064x}"}


@functools.cache
def _template(table: str, failed: bool, digits: int) -> bytes:
    """Parquet in which values are plain, so that each has its own fixed place."""
    rows = _rows(failed)[table]
    if table == "views" and not failed:
        files = rows.column("files").combine_chunks()
        items = files.flatten()
        paths = [image_path(CATEGORY, "RGB", 0).replace("00000", f"~{n:0{digits - 1}d}") for n in range(2 * PAIRS)]
        struct_ = pa.StructArray.from_arrays([pa.array(paths), items.field(1), items.field(2)], fields=list(items.type))
        at = rows.schema.get_field_index("files")
        rows = rows.set_column(at, rows.schema.field(at), pa.ListArray.from_arrays(files.offsets, struct_))
    sink = pa.BufferOutputStream()
    pq.write_table(rows, sink, compression="none", use_dictionary=False, write_statistics=False, store_schema=False)
    return sink.getvalue().to_pybytes()
