"""Tables of camera poses that a job names (`cameras.more.poses`): CSV, Parquet or JSON, a row a view.

Columns: `T_world_cam` or `T_obj_cam`, sixteen numbers by rows, as a list or as T00 to T33 (which are `T_world_cam`, as in a
dataset's cameras.csv); by choice `scene_id`, without which every scene has all rows; by choice all of fx, fy, cx, cy, width and
height. Other columns are ignored. Frames are the dataset's own: camera to world or to object, x right, y down, z forward, metres.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
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

BLOCK = 1 << 16
"""Rows that are judged at once."""

TOLERANCE = 1e-4
"""How far a product R^T R may be from the identity: files of few digits are usual. What is used is the nearest rotation."""


@dataclass(frozen=True)
class PoseFile:
    """A table of poses: where it is, and the SHA-256 of its bytes."""

    path: Path
    sha256: str


@dataclass(frozen=True, eq=False)
class Poses:
    """The rows of a table, in order.

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
    """The tables that the job names, by camera, each read once and found sound.

    Raises AssetSourceError naming the key, the row and the value that is wrong.
    """
    opened = {}
    for number, entry in enumerate(job.cameras.more):
        if entry.poses is None:
            continue
        path = (folder / Path(entry.poses).expanduser()).resolve()
        try:
            if path.exists() and not path.is_file():
                raise ValueError("is no file")
            with open(path, "rb") as file:
                opened[entry.name] = PoseFile(path, hashlib.file_digest(file, "sha256").hexdigest())
            _require_scenes(read_poses(opened[entry.name]), job)
        except OSError as error:
            raise AssetSourceError(
                f"cameras.more.{number}.poses: {path} cannot be read: {error.strerror or error}"
            ) from error
        except (ValueError, KeyError, RecursionError, pa.ArrowException) as error:
            raise AssetSourceError(f"cameras.more.{number}.poses: {path}: {plain_line(str(error), 300)}") from error
    return opened


def _require_scenes(poses: Poses, job: Job) -> None:
    """Raises ValueError where a scene of the job has no row, or more views than there may be."""
    if poses.scene_ids is None:
        count, scene = len(poses.T), "every scene"
    else:
        ids, counts = np.unique(poses.scene_ids, return_counts=True)
        wanted = np.arange(job.first_scene, job.stop_scene)
        if len(lacking := np.setdiff1d(wanted, ids)):
            raise ValueError(
                f"{len(lacking)} of {len(wanted)} scenes have no row, the first is {lacking[0]}: add theirs"
            )
        count, scene = int(counts.max()), f"scene {ids[counts.argmax()]}"
    if not 0 < count <= MOST_VIEWS:
        raise ValueError(f"{scene} has {count} rows, and must have 1 to {MOST_VIEWS}: split them by scene_id")


@lru_cache(maxsize=8)
def read_poses(file: PoseFile) -> Poses:
    """The rows of a table. Raises ValueError where they are none, OSError where it cannot be read."""
    table = _read_table(file.path)
    names = table.column_names
    if not len(table):
        raise ValueError("has no rows")
    frames = [name for name in FRAMES if name in names]
    if len(frames) > 1:
        raise ValueError(f"has the columns {' and '.join(frames)}: give one of them")
    if frames:
        T = _matrices(table.column(frames[0]), frames[0])
    elif set(names).issuperset(ELEMENTS):
        T = np.stack([_numbers(table, name) for name in ELEMENTS], axis=1).reshape(-1, 4, 4)
    else:
        raise ValueError(
            f"has no column {' or '.join(FRAMES)}, and not T00 to T33; its columns are {', '.join(names)[:200]}"
        )
    there = [name for name in PINHOLE if name in names]
    if there and len(there) < len(PINHOLE):
        raise ValueError(f"has the columns {', '.join(there)}: give all of {', '.join(PINHOLE)}, or none")
    pinholes = np.stack([_numbers(table, name, *BOUNDS[name]) for name in PINHOLE], axis=1) if there else None
    scene_ids = _numbers(table, "scene_id", 0, 2**53, True).astype(np.int64) if "scene_id" in names else None
    for start in range(0, len(T), BLOCK):
        T[start : start + BLOCK] = _rigid(T[start : start + BLOCK], start)
    return Poses(T, frames == ["T_obj_cam"], scene_ids, pinholes)


def _read_table(path: Path) -> pa.Table:
    """The table in a file, by the end of its name."""
    kind = path.suffix.lower()
    if kind == ".csv":
        return pa.csv.read_csv(path)
    if kind == ".parquet":
        return pa.parquet.read_table(path)
    if kind == ".json":
        rows: Any = json.loads(path.read_bytes())
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise ValueError("is no list of rows: write [{...}, {...}]")
        return pa.Table.from_pylist(rows)
    raise ValueError(f"its name ends in {kind or 'nothing'}: .csv, .parquet and .json are read")


def _numbers(table: pa.Table, name: str, least: float = -np.inf, most: float = np.inf, whole: bool = False) -> Array:
    """A column [N] float64. Raises ValueError where a value is no finite number, out of bounds, or not whole and must be."""
    try:
        values = np.array(table.column(name).cast(pa.float64()).to_numpy())
    except pa.ArrowException as error:
        raise ValueError(f"column {name} holds something that is no number: {str(error).splitlines()[0]}") from error
    for wrong, what in (
        (~np.isfinite(values), "a finite number"),
        (~((values >= least) & (values <= most)), f"from {least:g} to {most:g}"),
        (values != np.rint(values) if whole else np.zeros(0, bool), "a whole number"),
    ):
        if wrong.any():
            raise ValueError(f"row {np.argmax(wrong)}: {name} is {values[np.argmax(wrong)]:g}, and must be {what}")
    return values


def _matrices(column: pa.ChunkedArray, name: str) -> Array:
    """[N, 4, 4] of a column of lists of sixteen numbers, of four lists of four, or of such lists as text."""
    values = column.combine_chunks()
    if pa.types.is_list(values.type) and pa.types.is_floating(values.type.value_type):
        lengths = values.value_lengths()
        if not values.null_count and (lengths.to_numpy() == 16).all():
            return np.array(values.flatten().cast(pa.float64()).to_numpy(zero_copy_only=False)).reshape(-1, 4, 4)
    T = np.empty((len(values), 4, 4))
    for number, row in enumerate(values):
        try:
            T[number] = np.reshape(json.loads(row.as_py()) if pa.types.is_string(row.type) else row.as_py(), (4, 4))
        except (TypeError, ValueError) as error:
            given = plain_line(str(row.as_py()), 100)
            raise ValueError(f"row {number}: {name} is {given}, and must be sixteen numbers") from error
    return T


def _rigid(T: Array, start: int) -> Array:
    """Poses [N, 4, 4] with the nearest rotations; `start`: the first one's row.

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
            raise ValueError(f"row {start + row}: the pose {what}: {np.round(T[row], 4).tolist()}")
    u, _, v = np.linalg.svd(R)
    rigid = T.copy()
    rigid[:, :3, :3] = np.where(off[:, None, None] > 1e-12, u @ v, R)
    rigid[:, 3] = 0.0, 0.0, 0.0, 1.0
    return rigid
