"""Scenes of a user's that a job names (`scenes_from`): a table, the folder of a finished dataset, or scenes in the BOP layout.

A row of a table is an object, an input camera, or both. Columns of an object: `instance_id`, or `category`, of which an instance
is drawn; `T_world_obj`, sixteen numbers by rows, as a list or as T00 to T33; by choice `settle` (let fall from there), `table_id`
and `sha256` (of the shape, which it then must have). Of a camera: `T_world_cam`, by choice with fx, fy, cx, cy, width and height.
By choice `scene_id`, without which every scene has all rows. Frames are the dataset's own (poses.py).

The rows of a few scenes are read at a time: nothing grows with the table but, where a job is opened, eight bytes a row.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from schemas.base import Array, Pose
from schemas.dataset.layout import MANIFEST, SUCCESS_FILE
from schemas.dataset.tables import SCHEMA_VERSION
from schemas.errors import AssetSourceError, StartError
from schemas.job.job import Job
from schemas.job.physics import MOST_OBJECTS
from schemas.scene.view import Intrinsics
from workers.assets.bop_scenes import GT, bop_files, bop_ids, bop_rows, find_bop_scenes
from workers.assets.poses import (
    BOUNDS,
    ELEMENTS,
    PINHOLE,
    TOGETHER,
    PoseFile,
    digest_file,
    matrix_of,
    naming,
    only_near,
    open_table,
    require_scenes,
    rigid,
)

Row = dict[str, Any]

_CAMERA = ("T_world_cam", *PINHOLE)
_COLUMNS = ("instance_id", "category", "T_world_obj", "settle", "table_id", "sha256", *_CAMERA, *ELEMENTS)

MOST_ROWS = 10_000
"""Of a scene."""


@dataclass(frozen=True, eq=False)
class GivenObject:
    """An object of a table: its instance, or the category that one is drawn of, and `T_world_obj` [4, 4].

    settle: whether it falls from there; sha256: of the shape that it had; of_source: whether the pose is that of the coordinates
    of the shape's source, in metres.
    """

    instance_id: str | None
    category: str | None
    T_world_obj: Pose
    settle: bool
    sha256: str | None
    of_source: bool


@dataclass(frozen=True, eq=False)
class GivenScene:
    """The rows of a scene: its objects, its table (None: drawn), and its cameras, `T_world_cam` with a pinhole if it has one."""

    objects: tuple[GivenObject, ...]
    table_id: str | None
    cameras: tuple[tuple[Pose, Intrinsics | None], ...]
    alone: bool
    """Whether it is of a studio dataset, whose object stands on nothing."""


class _Kind(NamedTuple):
    """A kind of source: the files that its digest covers, its scene of each row (None: every scene has all), a scene's rows."""

    files: Callable[[Path], list[Path]]
    scene_ids: Callable[[Path], Array | None]
    rows: Callable[[PoseFile, int], list[Row]]


def open_scenes(job: Job, folder: Path) -> PoseFile | None:
    """What `scenes_from` names, with its digest; None without it. `folder`: of the job file.

    Every scene that the job asks for must be in it; what its rows hold is judged scene by scene. Raises AssetSourceError.
    """
    if job.scenes_from is None:
        return None
    path = (folder / Path(job.scenes_from).expanduser()).resolve()
    with naming(f"scenes_from: {path}"):
        kind = _kind_of(path)
        ids = kind.scene_ids(path)
        rows = sum(map(len, open_table(path))) if ids is None else len(ids)
        require_scenes(ids, rows, job, MOST_ROWS, "its ids are {}: set first_scene and scenes, or add rows")
        names = {file: file.relative_to(path) if file.is_relative_to(path) else file.name for file in kind.files(path)}
        lines = "".join(f"{name}\n{digest_file(file)}\n" for file, name in names.items())
        return PoseFile(path, hashlib.sha256(lines.encode()).hexdigest())


@lru_cache(maxsize=8)  # who chooses the shapes asks, and who places them
def read_scene(file: PoseFile, scene_id: int) -> GivenScene:
    """The objects and cameras of a scene, found sound. Raises StartError that names the row and the value."""
    where = f"scene {scene_id} in {file.path}"
    try:
        with naming(f"scenes_from: {file.path}"):
            rows = _kind_of(file.path).rows(file, scene_id)
    except AssetSourceError as error:
        raise StartError("bad_row", str(error)) from error
    objects, cameras, seen = dict[Any, GivenObject](), dict[Any, tuple[Pose, Intrinsics | None]](), dict[Any, int]()
    for number, row in enumerate(rows):
        try:
            body, camera = _object_of(row), _camera_of(row)
        except ValueError as error:
            raise StartError("bad_row", f"row {number} of {where}: {error}") from error
        of_camera = None if camera is None else (camera[0].tobytes(), camera[1])
        if body is not None:
            of_body = body.instance_id, body.category, body.T_world_obj.tobytes()
            if (first := seen.setdefault((of_body, of_camera), number)) != number:
                what = f"rows {first} and {number} of {where} are one {body.instance_id or body.category} at one pose"
                raise StartError("row_twice", f"{what}: leave one of them out")
            objects.setdefault(of_body, body)
        if camera is not None:
            cameras.setdefault(number if body is None else of_camera, camera)
    tables = sorted({row["table_id"] for row in rows if row.get("table_id")})
    if len(tables) > 1:
        raise StartError("bad_row", f"{where} has the tables {', '.join(tables)}: give one")
    if not 0 < len(objects) <= MOST_OBJECTS:
        raise StartError("bad_row", f"{where} has {len(objects)} objects, and must have 1 to {MOST_OBJECTS}")
    alone = any(row.get("alone") for row in rows)
    return GivenScene(tuple(objects.values()), tables[0] if tables else None, tuple(cameras.values()), alone)


def _kind_of(path: Path) -> _Kind:
    """Raises ValueError for a folder of another kind, OSError where there is nothing."""
    path.stat()
    if not path.is_dir():
        return _TABLE
    if (path / MANIFEST).is_dir():
        return _DATASET
    if find_bop_scenes(path):
        return _Kind(bop_files, bop_ids, lambda file, scene_id: bop_rows(file.path, scene_id))
    raise ValueError(f"holds no {MANIFEST} of a finished dataset, and no {GT} of a scene in the BOP layout")


def _object_of(row: Row) -> GivenObject | None:
    """The object of a row; None where it has none. Raises ValueError."""
    elements = [row.get(name) for name in ELEMENTS]
    value = row.get("T_world_obj") or (elements if any(each is not None for each in elements) else None)
    if value is None:
        if row.get("T_world_cam"):
            return None
        raise ValueError("has neither T_world_obj nor T_world_cam: give one")
    instance_id, category = (row.get(name) or None for name in ("instance_id", "category"))
    if not (instance_id or category) or not all(isinstance(name, str | None) for name in (instance_id, category)):
        raise ValueError(f"instance_id is {instance_id!r} and category {category!r}: give one of them as text")
    if (settle := row.get("settle")) not in (None, False, True):
        raise ValueError(f"settle is {settle!r}, and must be true or false")
    T, sha256, of_source = _pose_of(value, "T_world_obj"), row.get("sha256") or None, bool(row.get("of_source"))
    return GivenObject(instance_id, category, T, bool(settle), sha256, of_source)


def _camera_of(row: Row) -> tuple[Pose, Intrinsics | None] | None:
    """The camera of a row; None where it has none. Raises ValueError."""
    if not row.get("T_world_cam"):
        return None
    T, values = _pose_of(row["T_world_cam"], "T_world_cam"), {name: row.get(name) for name in PINHOLE}
    if all(value is None for value in values.values()):
        return T, None
    for name, (least, most, whole) in BOUNDS.items():
        value = values[name]
        if not isinstance(value, int | float) or not least <= value <= most or (whole and value % 1):
            raise ValueError(f"{name} is {value}, and must be from {least:g} to {most:g}{', whole' * whole}")
    return T, Intrinsics.model_validate(values)


def _pose_of(value: Any, name: str) -> Pose:
    """[4, 4] of a value of a column. Raises ValueError where it is no rigid transform."""
    try:
        return rigid(matrix_of(value, name)[None])[0]
    except ValueError as error:
        raise ValueError(str(error).replace("the pose", name, 1)) from error


def _readers(
    path: Path, table: str, columns: tuple[str, ...], near: range | None = None
) -> Iterator[pa.RecordBatchReader]:
    """Those of a file, or of the files of a table of a dataset."""
    files = sorted((path / MANIFEST / table).rglob("*.parquet")) if table else [path]
    return (open_table(file, columns, near) for file in files)


def _scene_ids(path: Path, table: str = "") -> Array:
    """The column `scene_id` [N] int64. Raises ValueError where one is no whole number."""
    parts = [np.zeros(0, np.int64)]
    for batch in chain.from_iterable(_readers(path, table, ("scene_id",))):
        if not pa.types.is_integer(kind := batch.schema.field("scene_id").type) and not pa.types.is_floating(kind):
            raise ValueError(f"scene_id is {kind}, and must be whole numbers")
        try:
            parts.append(batch.column("scene_id").cast(pa.int64()).to_numpy())
        except pa.ArrowException as error:
            raise ValueError(f"scene_id is no whole number after row {sum(map(len, parts))}: {error}") from error
    return np.concatenate(parts)


@lru_cache(maxsize=8)
def _rows_near(file: PoseFile, table: str, columns: tuple[str, ...], first: int) -> list[Row]:
    """The rows of `TOGETHER` scenes from `first` on; all where there are no ids."""
    near, rows = range(first, first + TOGETHER), list[Row]()
    for reader in _readers(file.path, table, ("scene_id", *columns), near):
        there = [name for name in ("scene_id", *columns) if name in reader.schema.names]
        for batch in reader:
            rows += only_near(batch, near).select(there).to_pylist()
    return rows


def _rows(file: PoseFile, table: str, columns: tuple[str, ...], scene_id: int) -> list[Row]:
    near = _rows_near(file, table, columns, scene_id // TOGETHER * TOGETHER)
    return [row for row in near if row.get("scene_id", scene_id) == scene_id]


def _table_ids(path: Path) -> Array | None:
    """As `_Kind` has it. Raises ValueError where a column is missing or an id is no whole number."""
    columns = open_table(path).schema.names
    names = set(columns)
    lacking = [] if names & {"instance_id", "category"} else ["instance_id or category"]
    lacking += [] if "T_world_obj" in names or names.issuperset(ELEMENTS) else ["T_world_obj, nor T00 to T33"]
    if lacking:
        raise ValueError(f"has no column {'; no '.join(lacking)}; its columns are {', '.join(columns)[:200]}")
    return _scene_ids(path) if "scene_id" in names else None


_TABLE = _Kind(lambda path: [path], _table_ids, lambda file, scene_id: _rows(file, "", _COLUMNS, scene_id))


def _dataset_ids(path: Path) -> Array:
    """Scenes that were made, and those that failed, which fail again. Raises ValueError where it is not finished, or newer."""
    if not (path / SUCCESS_FILE).exists():
        raise ValueError(f"is no finished dataset, it has no {SUCCESS_FILE}: run its job to the end first")
    version = json.loads((path / SUCCESS_FILE).read_bytes())["schema_version"]
    if not version <= SCHEMA_VERSION:
        raise ValueError(f"has schema_version {version}, and up to {SCHEMA_VERSION} can be read: use a later Verso")
    return np.concatenate([_scene_ids(path, name) for name in ("scenes", "failures")])


def _dataset_rows(file: PoseFile, scene_id: int) -> list[Row]:
    """Objects, and then the input cameras in order of their pairs."""
    for failure in _rows(file, "failures", ("reason", "detail"), scene_id):
        raise StartError("failed_before", f"it failed in {file.path} ({failure['reason']}): {failure['detail']}")
    scenes = _rows(file, "scenes", ("table_id", "bodies"), scene_id)
    if not all(scene["bodies"] for scene in scenes):
        raise StartError("no_table", f"{file.path} has captures: take a dataset of scenes")
    shapes = _shapes_near(file, scene_id // TOGETHER * TOGETHER)
    views = _rows(file, "views", ("role", "pose_id", *_CAMERA), scene_id)
    inputs = sorted((view for view in views if view["role"] == "input"), key=lambda view: view["pose_id"])
    return [
        {
            **body,
            "table_id": scene["table_id"],
            "alone": scene["table_id"] is None,
            "sha256": shapes[body["instance_id"]],
        }
        for scene in scenes
        for body in scene["bodies"]
    ] + [{name: view[name] for name in _CAMERA} for view in inputs]


@lru_cache(maxsize=4)
def _shapes_near(file: PoseFile, first: int) -> dict[str, str]:
    """The digests of the shapes that `TOGETHER` scenes have, by instance."""
    near = _rows_near(file, "scenes", ("table_id", "bodies"), first)
    names, shapes = pa.array({body["instance_id"] for scene in near for body in scene["bodies"]}), dict[str, str]()
    for batch in chain.from_iterable(_readers(file.path, "assets", ("instance_id", "sha256"))):
        chosen = batch.filter(pc.is_in(batch.column("instance_id"), names))
        shapes |= {row["instance_id"]: row["sha256"] for row in chosen.to_pylist()}
    return shapes


_DATASET = _Kind(
    lambda path: sorted(
        file
        for name in ("scenes", "views", "failures", "assets")
        for file in (path / MANIFEST / name).rglob("*.parquet")
    ),
    _dataset_ids,
    _dataset_rows,
)
