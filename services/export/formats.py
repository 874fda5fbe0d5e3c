"""What is asked of an export (a dataset, a place, a format, a choice of scenes), and what a writer of a format has."""

import copy
import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import duckdb
import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.base import Frozen
from schemas.dataset.layout import asset_path
from schemas.dataset.tables import SCHEMAS
from schemas.errors import CorruptError, InputError
from schemas.job.job import Job
from schemas.job.views import ShapeTarget, ViewTarget
from services.export.folder import ExportFolder, Register, Rounds
from services.export.source import ExportPair, ExportScene
from services.job.record import JobRecord
from services.read.dataset_reader import StoredRange
from workers.store.manifest import table_of_rows
from workers.store.store import Store

_TABLES = ("scenes", "views", "objects", "assets")
_LOCKED = {
    "enable_external_access": "false",
    "python_enable_replacements": "false",
    "autoinstall_known_extensions": "false",
    "autoload_known_extensions": "false",
    "threads": "1",
}
"""The condition sees the tables of a range and no file, no network, no variable of this process."""


class Choice(Frozen):
    """What a user asked for; by default every scene that was made."""

    categories: tuple[str, ...] = ()
    """Of the scene, which is that of its first object; none: all."""
    first_scene: int | None = None
    last_scene: int | None = None
    """Included."""
    where: str | None = None
    """An SQL condition on the columns of `scenes`; subqueries may ask the other tables about the same scene."""
    split: Literal["category", "instance"] = "category"
    """Whether the job's shares of train, val and test hold in each category, or over all instances (`assets.split`)."""
    held_out: tuple[str, ...] = ()
    """Categories whose objects are all of `test`."""


EVERYTHING: Final = Choice()
_EXAMPLE: Final = "it is an SQL condition on the columns of scenes, such as 'support_margin_mm > 30'"


class Chooser:
    """Chooses scenes range by range."""

    def __init__(self, choice: Choice) -> None:
        """Raises InputError where the condition is no SQL that these tables can answer."""
        self._choice = choice
        self._db = duckdb.connect(":memory:", config=dict(_LOCKED))
        if choice.where is not None:
            self._ask({table: SCHEMAS[table].empty_table() for table in _TABLES})

    def choose(self, stored: StoredRange) -> Sequence[int]:
        """The ids of the chosen scenes of a range, in order."""
        choice, rows = self._choice, stored.rows
        low, high = choice.first_scene or 0, choice.last_scene
        ids = [
            int(row["scene_id"])
            for row in rows["scenes"]
            if (not choice.categories or row["category"] in choice.categories)
            and low <= row["scene_id"]
            and (high is None or row["scene_id"] <= high)
        ]
        if choice.where is None or not ids:
            return ids
        fit = self._ask({table: table_of_rows(table, rows[table]).select(SCHEMAS[table].names) for table in _TABLES})
        return [scene_id for scene_id in ids if scene_id in fit]

    def _ask(self, tables: dict) -> set[int]:
        """The ids of the scenes in `tables` that the condition holds for."""
        for name, table in tables.items():
            self._db.register(name, table)
        try:
            found = self._db.execute(f"SELECT scene_id FROM scenes WHERE ({self._choice.where}\n)").fetchall()
        except duckdb.Error as error:
            line = str(error).splitlines()[0]
            raise InputError(f"--where {self._choice.where!r} cannot be asked: {line}; {_EXAMPLE}") from error
        return {scene_id for (scene_id,) in found}


@dataclass(frozen=True, eq=False)
class ExportRequest:
    """What to export, where to, and how."""

    store: Store
    target: Path
    format: str
    """A key of `services.export.table.FORMATS`."""
    choice: Choice = EVERYTHING
    shard_mb: int = 256
    """Size that ends a shard, of formats that have shards; 10^6 bytes."""
    points: int = 0
    """Points that formats with shards draw on each shape."""


@dataclass(frozen=True)
class Added:
    """What became of a scene: how many of its pairs were written, and (pose id, reason) of those that were left out.

    A reason is the same words for every pair of a kind.
    """

    pairs: int
    left_out: tuple[tuple[int, str], ...] = ()


class Writer:
    """Writes one format into an `ExportFolder`.

    `kept` is what a new writer must know to go on from here, as JSON holds it; FRESH is that of the beginning.
    """

    FRESH: ClassVar[dict[str, Any]]

    @classmethod
    def check(cls, job: Job) -> None:
        """Raises InputError where a dataset of this job cannot have what the format is made of."""

    def __init__(
        self, request: ExportRequest, record: JobRecord, folder: ExportFolder, kept: dict[str, Any] | None
    ) -> None:
        self.store, self.record, self.folder = request.store, record, folder
        self.kept = copy.deepcopy(self.FRESH) if kept is None else kept
        self.begin(request, fresh=kept is None)

    def begin(self, request: ExportRequest, fresh: bool) -> None:
        """Opens what the writer needs."""

    def add(self, scene: ExportScene) -> Added:
        """Takes the next scene."""
        raise NotImplementedError

    def state(self) -> dict[str, Any] | None:
        """`kept`; None while something that the writer took is not whole in the folder."""
        return self.kept

    def finish(self) -> None:
        """Writes what is still waiting. Afterwards `state` is not None."""

    def describe(self) -> dict[str, Any]:
        """What the manifest says of this format: units, frames, counts; none of the keys that docs/export.md reserves."""
        raise NotImplementedError

    def close(self) -> None:
        """Lets go of what is open; what is not in the last state may be lost."""

    def count(self, name: str, key: str, more: int) -> None:
        """Adds to the count of `key` in `kept[name]`."""
        self.kept[name][key] = self.kept[name].get(key, 0) + more


class ObjectWriter(Writer):
    """A format with a folder for each object, which gets the views of it scene by scene, numbered from 0."""

    FRESH: ClassVar = {"register": 0, "views": {}}

    def begin(self, request: ExportRequest, fresh: bool) -> None:
        """Opens the list of views: an entry for each, whose key is the object's folder."""
        self.register = Register(self.folder, self.kept["register"])

    def add(self, scene: ExportScene) -> Added:
        """Takes every object of every pair; a pair of which nothing is taken is left out."""
        left_out = []
        for pair in scene.pairs:
            reasons = [self.take(scene, pair, region_id) for region_id in scene.instances]
            if all(reasons):
                left_out.append((pair.pose_id, reasons[0]))
        return Added(len(scene.pairs) - len(left_out), tuple(left_out))

    def take(self, scene: ExportScene, pair: ExportPair, region_id: int) -> str:
        """Writes the views of an object in a pair; why there are none, or nothing."""
        raise NotImplementedError

    def state(self) -> dict[str, Any]:
        """The last view, and counts."""
        return {**self.kept, "register": self.register.state()}

    def close(self) -> None:
        """Closes the list."""
        self.register.close()


def require_targets(
    job: Job, format_name: str, views: Sequence[ViewTarget] = (), shape: Sequence[ShapeTarget] = ()
) -> None:
    """Raises InputError where the job does not ask for these targets."""
    for key, wanted, asked in (("views", views, job.targets.views), ("shape", shape, job.targets.shape)):
        if missing := [name for name in wanted if name not in asked]:
            told = f"a dataset whose job has targets.{key}: [{', '.join(wanted)}]"
            raise InputError(f"{format_name} needs {told}; this one lacks {', '.join(missing)}: make it with them")


OF_SCENE: Final = ("scene_id", "category", "instance_id", "source", "table_id", "T_world_obj", "T_world_table")
"""Columns of `scenes` that a pair in a shared file has."""


class ShardedWriter(Writer):
    """A format whose pairs share files, `rounds`, by split."""

    PATTERN: ClassVar[str]
    """The name of a file, with places for `split` and `number`."""
    rounds: Rounds

    def begin(self, request: ExportRequest, fresh: bool) -> None:
        """Goes on behind the last files that were ended."""
        most_bytes, self._points = 1_000_000 * request.shard_mb, request.points
        self.rounds = Rounds(self.folder, self.open_shard, self.PATTERN, most_bytes, self.kept["rounds"])

    def open_shard(self, path: Path) -> Any:
        """A file with `add`, `bytes` and `close`."""
        raise NotImplementedError

    def state(self) -> dict[str, Any] | None:
        """None within a round."""
        rounds = self.rounds.state()
        return None if rounds is None else {**self.kept, "rounds": rounds}

    def finish(self) -> None:
        """Ends the last files."""
        self.rounds.end()

    def close(self) -> None:
        """Closes open files."""
        self.rounds.close()

    def put_shapes(self, scene: ExportScene) -> None:
        """Writes `shapes/<category>/<instance id>.glb` of all that stands in a scene, and points on it where asked for.

        Samples that the dataset has (`targets.shape`) are copied beside it, as `<instance id>.samples.npz`.
        """
        for instance_id in (scene.row["table_id"], *(name for _, name in scene.instances.values())):
            asset = scene.assets[instance_id]
            category, samples = asset["category"], asset["samples"]
            path = f"shapes/{category}/{instance_id}"
            if (self.folder.root / f"{path}.glb").exists():
                continue
            try:
                data = scene.read(asset_path(category, instance_id))
            except CorruptError:  # it is not stored: only shapes that may be passed on are
                self.kept["without_shape"] = sorted({*self.kept["without_shape"], asset["source"]})
                continue
            if samples is not None:
                self.folder.put(f"{path}.samples.npz", scene.read(samples["path"]))
            if self._points:
                self.folder.put(f"{path}.npz", encode_npz(points_on(data, self._points, instance_id)))
            self.folder.put(f"{path}.glb", data)

    def conventions(self, depth: str) -> dict[str, Any]:
        """What the manifest says of every such format; `depth` describes the encoding of depth."""
        kept_back = [f"shapes of the source {source}, which are not stored" for source in self.kept["without_shape"]]
        return {
            "not_exported": ["patches, the quality figures of scenes", *kept_back],
            "shapes": "shapes/<category>/<instance_id>.glb, object frame, metres, z up; T_world_obj, T_cam_obj place them",
            "depth": f"{depth}, z along the optical axis; divide by depth_units_per_m for metres, 0 is no depth",
            "poses": "T_world_cam camera to world, T_cam_obj object to camera; metres, optical frame, row-major 4 x 4",
            "pixels": "cx, cy have pixel centres at +0.5; cx_opencv, cy_opencv on integers",
            **({"targets": _TARGETS} if self.record.job.targets.views else {}),
        }


_TARGETS: Final = (
    "normals 2 v / 65535 - 1, camera frame; coordinates coordinates_scale_m v / 65535 + coordinates_offset_m, object frame; "
    "(0, 0, 0) is none; amodal an image for each object, by region, 255 where it is; layers and back as depth and region"
)


def points_on(glb: bytes, count: int, name: str) -> dict[str, NDArray]:
    """points and normals [count, 3] float32, uniform over the surface, metres; `name` seeds the draw."""
    return sample_mesh(trimesh.load_scene(io.BytesIO(glb), file_type="glb", process=False).to_mesh(), count, name)


def sample_mesh(mesh: trimesh.Trimesh, count: int, name: str) -> dict[str, NDArray]:
    """The same of a mesh."""
    seed = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)[:2]
    return {"points": points.astype(np.float32), "normals": mesh.face_normals[faces].astype(np.float32)}


def encode_json(tree: object) -> bytes:
    """A JSON file."""
    return (json.dumps(tree, indent=1) + "\n").encode()


def encode_npz(arrays: Mapping[str, NDArray]) -> bytes:
    """What numpy.load reads, the same bytes for the same arrays."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            member = io.BytesIO()
            np.lib.format.write_array(member, array, allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), member.getvalue(), zipfile.ZIP_DEFLATED, 1)
    return stream.getvalue()
