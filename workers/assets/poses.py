"""Tables of camera poses that a job names (`cameras.more.poses`): CSV, Parquet or JSON, a row a view.

Columns: `T_world_cam` or `T_obj_cam`, sixteen numbers by rows, as a list or as T00 to T33 (which are `T_world_cam`, as in a
dataset's cameras.csv); by choice `scene_id`, without which every scene has all rows; by choice all of fx, fy, cx, cy, width and
height. Other columns are ignored. Frames are the dataset's own: camera to world or to object, x right, y down, z forward, metres.
"""

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from schemas.base import Array
from schemas.errors import AssetSourceError, plain_line
from schemas.job.cameras import MOST_VIEWS
from schemas.job.job import Job
from schemas.scene.view import Intrinsics

ELEMENTS = tuple(f"T{row}{column}" for row in range(4) for column in range(4))
FRAMES = ("T_world_cam", "T_obj_cam")
PINHOLE = tuple(Intrinsics.model_fields)

BOUNDS: Mapping[str, tuple[float, float, bool]] = {
    **dict.fromkeys(("width", "height"), (1, 4096, True)),
    **dict.fromkeys(("fx", "fy"), (1e-3, 1e6, False)),
    **dict.fromkeys(("cx", "cy"), (-1e6, 1e6, False)),
}
"""Least, most, and whether whole, of each column of a pinhole: as of the job's sensor."""

MOST_M = 1e3
"""Farthest that a camera may be from its frame's origin, along an axis."""

TOLERANCE = 1e-4
"""How far a product R^T R may be from the identity: files of few digits are usual. What is used is the nearest rotation."""


@dataclass(frozen=True)
class PoseFile:
    """A table of poses, or of scenes (scene_tables.py): where it is, and the SHA-256 of its bytes, or of its files'."""

    path: Path
    sha256: str


@dataclass(frozen=True, eq=False)
class Poses:
    """Rows of a table, in order.

    T [N, 4, 4] float64: camera to world, or to the first object with `of_object`; scene_ids [N] int64 or None; pinholes [N, 6]:
    the fields of `Intrinsics`, or None.
    """

    T: Array
    of_object: bool
    scene_ids: np.ndarray | None
    pinholes: Array | None

    def of_scene(self, scene_id: int) -> Iterator[tuple[Array, Intrinsics | None]]:
        """The pose and the intrinsics of each view of a scene."""
        rows = range(len(self.T)) if self.scene_ids is None else np.flatnonzero(self.scene_ids == scene_id)
        for row in rows:
            if self.pinholes is None:
                yield self.T[row], None
            else:
                named = dict(zip(PINHOLE, self.pinholes[row].tolist(), strict=True))
                yield self.T[row], Intrinsics(**named | {"width": int(named["width"]), "height": int(named["height"])})


def open_poses(job: Job, folder: Path) -> Mapping[str, PoseFile]:
    """The tables that the job names, by camera, each read once, some thousand rows at a time, and found sound.

    Raises AssetSourceError naming the key, the row and the value that is wrong.
    """
    opened = {}
    for number, entry in enumerate(job.cameras.more):
        if entry.poses is None:
            continue
        path = (folder / Path(entry.poses).expanduser()).resolve()
        with naming(f"cameras.more.{number}.poses: {path}"):
            if path.exists() and not path.is_file():
                raise ValueError("is no file")
            opened[entry.name] = PoseFile(path, digest_file(path))
            rows, ids = 0, list[np.ndarray]()
            for block in _blocks(path):
                rows += len(block.T)
                ids += [] if block.scene_ids is None else [block.scene_ids]
            if not rows:
                raise ValueError("has no rows")
            require_scenes(np.concatenate(ids) if ids else None, rows, job, MOST_VIEWS, "add theirs")
    return opened


@contextmanager
def naming(what: str) -> Iterator[None]:
    """Raises AssetSourceError, naming the key and the file, for what reading a table raises."""
    try:
        yield
    except OSError as error:
        raise AssetSourceError(f"{what} cannot be read: {error.strerror or error}") from error
    except (ValueError, KeyError, RecursionError, pa.ArrowException) as error:
        words = str(error).rpartition("Invalid: ")[2]  # Arrow says first in which calls it was
        raise AssetSourceError(f"{what}: {plain_line(words, 300)}") from error


def digest_file(path: Path) -> str:
    """SHA-256, hex, of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def require_scenes(ids: np.ndarray | None, rows: int, job: Job, most: int, remedy: str) -> None:
    """Raises ValueError where a scene of the job has no row, or more than `most`. ids [N]: a row each, None: all have all."""
    count, scene = rows, "every scene"
    if ids is not None:
        there, counts = np.unique(ids, return_counts=True)
        wanted = np.arange(job.first_scene, job.stop_scene)
        if len(lacking := np.setdiff1d(wanted, there)):
            lack = f"{len(lacking)} of {len(wanted)} scenes have no row, the first is {lacking[0]}"
            raise ValueError(f"{lack}: {remedy.format(f'{there[0]} to {there[-1]}' if len(there) else 'none')}")
        count, scene = int(counts.max()), f"scene {there[counts.argmax()]}"
    if not 0 < count <= most:
        raise ValueError(f"{scene} has {count} rows, and must have 1 to {most}: split them by scene_id")


@lru_cache(maxsize=8)
def read_poses(file: PoseFile, first: int) -> Poses:
    """The rows of `TOGETHER` scenes from `first` on, of a table that was found sound; all where it has no scene_id."""
    parts = [part for part in _blocks(file.path, range(first, first + TOGETHER)) if len(part.T)]
    ids, pinholes = ([getattr(part, name) for part in parts] for name in ("scene_ids", "pinholes"))
    return Poses(
        np.concatenate([part.T for part in parts]),
        parts[0].of_object,
        None if ids[0] is None else np.concatenate(ids),
        None if pinholes[0] is None else np.concatenate(pinholes),
    )


def poses_of(file: PoseFile, scene_id: int) -> tuple[bool, Iterator[tuple[Array, Intrinsics | None]]]:
    """(whether poses are of the first object, the pose and the intrinsics of each view) of a scene."""
    poses = read_poses(file, scene_id // TOGETHER * TOGETHER)
    return poses.of_object, poses.of_scene(scene_id)


def _blocks(path: Path, near: range | None = None) -> Iterator[Poses]:
    """The rows of a table, some thousands at a time; those of scenes near. Raises ValueError, OSError, ArrowException."""
    start, reader = 0, open_table(path, near=near)
    if not (names := reader.schema.names):
        raise ValueError("has no rows")
    frames = [name for name in FRAMES if name in names]
    if len(frames) > 1:
        raise ValueError(f"has the columns {' and '.join(frames)}: give one of them")
    if not frames and not set(names).issuperset(ELEMENTS):
        raise ValueError(
            f"has no column {' or '.join(FRAMES)}, and not T00 to T33; its columns are {', '.join(names)[:200]}"
        )
    there = [name for name in PINHOLE if name in names]
    if there and len(there) < len(PINHOLE):
        raise ValueError(f"has the columns {', '.join(there)}: give all of {', '.join(PINHOLE)}, or none")
    for batch in reader:
        batch = batch if near is None else only_near(batch, near)
        if frames:
            T = _matrices(batch.column(frames[0]), frames[0], start)
        else:
            T = np.stack([_numbers(batch, name, start) for name in ELEMENTS], axis=1).reshape(-1, 4, 4)
        ids = _numbers(batch, "scene_id", start, 0, 2**53, True).astype(np.int64) if "scene_id" in names else None
        pinholes = (
            np.stack([_numbers(batch, name, start, *BOUNDS[name]) for name in PINHOLE], axis=1) if there else None
        )
        yield Poses(rigid(T, start), frames == ["T_obj_cam"], ids, pinholes)
        start += len(batch)


TOGETHER = 64
"""Scenes whose rows are read at once: as many as a shard has."""


def only_near(batch: pa.RecordBatch, near: range) -> pa.RecordBatch:
    """The rows of a batch with a `scene_id` near; all where it has none."""
    if "scene_id" not in batch.schema.names:
        return batch
    id_ = batch.column("scene_id")
    return batch.filter(pc.and_(pc.greater_equal(id_, near.start), pc.less(id_, near.stop)))


MOST_JSON = 32 * 2**20
"""Bytes of a table in JSON, which is read whole; the others are read in pieces."""

_FLOATS, _TEXTS = (*ELEMENTS, *PINHOLE), ("instance_id", "category", "table_id", "T_world_obj", *FRAMES)
_CSV_TYPES = {**dict.fromkeys(_FLOATS, pa.float64()), **dict.fromkeys(_TEXTS, pa.string()), "settle": pa.bool_()}
"""Of columns whose first rows may look otherwise: as whole numbers, or empty."""


def open_table(path: Path, columns: Collection[str] = (), near: range | None = None) -> pa.RecordBatchReader:
    """The rows of a file, by the end of its name, some thousands at a time; a JSON file is read whole.

    Of a Parquet file these columns alone, where there are any, and without groups of rows that have no `scene_id` near. Raises
    ValueError, OSError, ArrowException.
    """
    kind = path.suffix.lower()
    if kind == ".csv":
        return pa.csv.open_csv(path, convert_options=pa.csv.ConvertOptions(column_types=_CSV_TYPES))
    if kind == ".parquet":
        file = pa.parquet.ParquetFile(path, buffer_size=2**20, pre_buffer=False)
        names = [name for name in file.schema_arrow.names if name in columns or not columns]
        groups = [n for n in range(file.num_row_groups) if near is None or _may_hold(file.metadata.row_group(n), near)]
        batches = file.iter_batches(BATCH, groups, names, use_threads=False)
        return pa.RecordBatchReader.from_batches(pa.schema([file.schema_arrow.field(name) for name in names]), batches)
    if kind == ".json":
        if (size := path.stat().st_size) > MOST_JSON:
            raise ValueError(
                f"has {size / 2**20:.0f} MiB, and at most {MOST_JSON >> 20} are read of JSON: write .parquet"
            )
        rows: Any = json.loads(path.read_bytes())
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ValueError("is no list of rows: write [{...}, {...}]")
        names = list(dict.fromkeys(name for row in rows for name in row))
        return pa.table({name: [row.get(name) for row in rows] for name in names}).to_reader()
    raise ValueError(f"its name ends in {kind or 'nothing'}: .csv, .parquet and .json are read")


BATCH = 8192
"""Rows that are read of a Parquet file at once."""


def _may_hold(group: Any, near: range) -> bool:
    """Whether a group of rows may have a scene of these, by its statistics."""
    for column in (group.column(n) for n in range(group.num_columns)):
        if column.path_in_schema == "scene_id" and column.statistics is not None and column.statistics.has_min_max:
            return bool(column.statistics.min < near.stop and column.statistics.max >= near.start)
    return True


def _numbers(
    rows: pa.RecordBatch, name: str, start: int, least: float = -np.inf, most: float = np.inf, whole: bool = False
) -> Array:
    """A column [N] float64; `start`: the first row's number.

    Raises ValueError where a value is no finite number, out of bounds, or not whole and must be.
    """
    try:
        values = np.array(rows.column(name).cast(pa.float64()).to_numpy(zero_copy_only=False))
    except pa.ArrowException as error:
        raise ValueError(f"column {name} holds something that is no number: {str(error).splitlines()[0]}") from error
    for wrong, what in (
        (~np.isfinite(values), "a finite number"),
        (~((values >= least) & (values <= most)), f"from {least:g} to {most:g}"),
        (values != np.rint(values) if whole else np.zeros(0, bool), "a whole number"),
    ):
        if wrong.any():
            raise ValueError(
                f"row {start + np.argmax(wrong)}: {name} is {values[np.argmax(wrong)]:g}, and must be {what}"
            )
    return values


def _matrices(values: pa.Array, name: str, start: int) -> Array:
    """[N, 4, 4] of a column of lists of sixteen numbers, of four lists of four, or of such lists as text."""
    if pa.types.is_list(values.type) and pa.types.is_floating(values.type.value_type):
        lengths = values.value_lengths()
        if not values.null_count and (lengths.to_numpy() == 16).all():
            return np.array(values.flatten().cast(pa.float64()).to_numpy(zero_copy_only=False)).reshape(-1, 4, 4)
    T = np.empty((len(values), 4, 4))
    for number, row in enumerate(values):
        T[number] = matrix_of(row.as_py(), f"row {start + number}: {name}")
    return T


def matrix_of(value: Any, where: str) -> Array:
    """[4, 4] float64 of sixteen numbers, of four lists of four, or of such lists as text. Raises ValueError."""
    try:
        return np.reshape(json.loads(value) if isinstance(value, str) else value, (4, 4)).astype(np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} is {plain_line(str(value), 100)}, and must be sixteen numbers") from error


def rigid(T: Array, start: int | None = None) -> Array:
    """Poses [N, 4, 4] with the nearest rotations, those as they are that are rotations to 1e-12; `start`: the first one's row.

    Raises ValueError where one is no rigid transform, with the row and the figure.
    """
    faults = {
        "holds something that is no finite number": ~np.isfinite(T).all(axis=(1, 2)),
        "does not end in the row 0 0 0 1": np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) > TOLERANCE,
        f"is more than {MOST_M:g} m away": np.abs(T[:, :3, 3]).max(axis=1) > MOST_M,
    }
    R = np.nan_to_num(T[:, :3, :3])
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    faults["is no rotation: its columns are not of length 1 at right angles"] = off > TOLERANCE
    faults["mirrors: its determinant is -1, so an axis of its frame points the other way"] = np.linalg.det(R) < 0.0
    for what, wrong in faults.items():
        if wrong.any():
            row = int(np.argmax(wrong))
            where = "" if start is None else f"row {start + row}: "
            raise ValueError(f"{where}the pose {what}: {np.round(T[row], 4).tolist()}")
    u, _, v = np.linalg.svd(R)
    rigid = T.copy()
    rigid[:, :3, :3] = np.where(off[:, None, None] > 1e-12, u @ v, R)
    rigid[:, 3] = 0.0, 0.0, 0.0, 1.0
    return rigid
