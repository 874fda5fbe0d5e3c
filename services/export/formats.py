"""What is asked of an export (a dataset, a place, a format, a choice of scenes), and what a writer of a format has."""

import copy
import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, ClassVar, Final, Literal

import numpy as np
import trimesh
from numpy.typing import NDArray

from schemas.base import Frozen
from schemas.dataset.layout import MAX_SCENE, asset_path
from schemas.errors import CorruptError, InputError
from schemas.job.job import Job
from services.dataset.pair import Pair
from services.export.folder import ExportFolder, Register
from services.export.shapes import Shapes
from services.export.source import ExportScene
from services.job.record import JobRecord
from services.read.query import query
from services.read.scene_geometry import Sources
from workers.store.store import Store


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


_EXAMPLE: Final = "it is an SQL condition on the columns of scenes, such as 'support_margin_mm > 30'"


def choose_scenes(store: Store, choice: Choice) -> frozenset[int]:
    """The ids of the chosen scenes. Raises InputError where the condition is no SQL that the tables can answer."""
    last = MAX_SCENE if choice.last_scene is None else choice.last_scene
    conditions = [f"scene_id between {choice.first_scene or 0} and {last}"]
    if choice.categories:
        conditions.append(f"category in ({', '.join(map(_quoted, choice.categories))})")
    if choice.where is not None:
        conditions.append(f"({choice.where}\n)")
    try:
        ids = query(store, f"select scene_id from scenes where {' and '.join(conditions)}").column(0)
    except InputError as error:
        raise InputError(f"--where {choice.where!r} cannot be asked: {error}; {_EXAMPLE}") from error
    return frozenset(ids.to_pylist())


def _quoted(text: str) -> str:
    escaped = text.replace("'", "''")
    return f"'{escaped}'"


@dataclass(frozen=True, eq=False)
class ExportRequest:
    """What to export, where to, and how."""

    store: Store
    target: Path
    format: str
    """A key of `services.export.table.FORMATS`."""
    choice: Choice
    shard_mb: int = 256
    """Size that ends a shard, of formats that have shards; 10^6 bytes."""
    points: int = 0
    """Points that formats with shards draw on each shape."""


LeftOut = list[tuple[int, str]]
"""(pose id, reason) of the pairs of a scene that are left out. A reason is the same words for every pair of a kind."""


class Writer:
    """Writes one format into an `ExportFolder`.

    `kept` is what a new writer must know to go on from here, as JSON holds it; FRESH is that of the beginning. HEADS: how the
    lists begin that grow pair by pair. NEEDS: names by branch of the job's `targets`. KEYS: those of the job that must be on.
    """

    FRESH: ClassVar[dict[str, Any]]
    HEADS: ClassVar[dict[str, str]] = {}
    NEEDS: ClassVar[dict[str, Sequence[str]]] = {}
    KEYS: ClassVar[Sequence[str]] = ()

    @classmethod
    def check(cls, name: str, job: Job) -> None:
        """Raises InputError where the job does not ask for the images and targets that the format, called `name`, is made of."""
        if off := [key for key in cls.KEYS if not attrgetter(key)(job)]:
            wanted = ", ".join(f"{key}: true" for key in off)
            raise InputError(f"{name} needs a dataset whose job has {wanted}: make it with that")
        for branch, targets in cls.NEEDS.items():
            if missing := [target for target in targets if target not in getattr(job.targets, branch)]:
                wanted = f"a dataset whose job has targets.{branch}: [{', '.join(targets)}]"
                raise InputError(f"{name} needs {wanted}; this one lacks {', '.join(missing)}: make it with them")

    def __init__(
        self, request: ExportRequest, record: JobRecord, folder: ExportFolder, kept: dict[str, Any] | None
    ) -> None:
        self.request, self.record, self.folder = request, record, folder
        self.kept = copy.deepcopy({"register": 0, **self.FRESH}) if kept is None else kept
        self.register = Register(folder, self.kept["register"])
        self.sources = Sources(record)
        self.shapes = Shapes(self.sources)
        if kept is None:
            for path, head in self.HEADS.items():
                folder.append(path, head.encode())

    def add(self, scene: ExportScene) -> LeftOut:
        """Takes the pairs of the next scene, and then the scene, unless all its pairs are left out."""
        left_out = [(pair.pose_id, reason) for pair in scene.pairs if (reason := self.take(scene, pair))]
        if len(left_out) < len(scene.pairs):
            self.end_scene(scene)
        return left_out

    def take(self, scene: ExportScene, pair: Pair) -> str:
        """Writes a pair; why it is left out, or nothing."""
        raise NotImplementedError

    def end_scene(self, scene: ExportScene) -> None:
        """Writes what a scene has beside its pairs."""

    def state(self) -> dict[str, Any] | None:
        """`kept`; None while something that the writer took is not whole in the folder."""
        return {**self.kept, "register": self.register.state()}

    def finish(self) -> None:
        """Writes what is still waiting. Afterwards `state` is not None."""

    def describe(self) -> dict[str, Any]:
        """What the manifest says of this format: units, frames, counts; none of the keys that docs/export.md reserves."""
        raise NotImplementedError

    def close(self) -> None:
        """Lets go of what is open; what is not in the last state may be lost."""
        self.register.close()

    def count(self, name: str, key: str, more: int = 1) -> None:
        """Adds to the count of `key` in `kept[name]`."""
        self.kept[name][key] = self.kept[name].get(key, 0) + more

    def counts(self, name: str) -> dict[str, int]:
        """The counts in `kept[name]`, sorted by key."""
        return dict(sorted(self.kept[name].items()))


class ObjectWriter(Writer):
    """A format with a folder for each object, which gets the views of it scene by scene, numbered from 0.

    `register` has an entry for each view, whose key is the object's folder.
    """

    FRESH: ClassVar = {"views": {}}

    def take(self, scene: ExportScene, pair: Pair) -> str:
        """Takes every object; a pair of which nothing is taken is left out."""
        reasons = [self.take_object(scene, pair, region_id) for region_id in scene.instances]
        return reasons[0] if all(reasons) else ""

    def take_object(self, scene: ExportScene, pair: Pair, region_id: int) -> str:
        """Writes the views of an object in a pair; why there are none, or nothing."""
        raise NotImplementedError


OF_SCENE: Final = ("scene_id", "category", "instance_id", "source", "table_id", "T_world_obj", "T_world_table")
"""Columns of `scenes` that a pair in a shared file has."""


class ShardedWriter(Writer):
    """A format whose pairs share files, one for each split; all of them end when the largest is full."""

    PATTERN: ClassVar[str]
    """The name of a file, with places for `split` and `number`."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._shards: dict[str, Any] = {}

    def open_shard(self, path: Path) -> Any:
        """A file with `add`, `bytes` and `close`."""
        raise NotImplementedError

    def shard(self, split: str) -> Any:
        """The open file of a split."""
        if split not in self._shards:
            self._shards[split] = self.open_shard(self.folder.temporary(f"{split}.shard"))
        return self._shards[split]

    def end_scene(self, scene: ExportScene) -> None:
        """Writes the scene's shapes, and ends the files where one has its size."""
        self._put_shapes(scene)
        if any(shard.bytes >= 1_000_000 * self.request.shard_mb for shard in self._shards.values()):
            self.end_round()

    def state(self) -> dict[str, Any] | None:
        """None while files are open."""
        return None if self._shards else super().state()

    def end_round(self) -> None:
        """Gives every open file its final name."""
        for split in sorted(self._shards):
            self._shards.pop(split).close()
            path = self.PATTERN.format(split=split, number=self.kept["files"].get(split, 0))
            self.folder.install(self.folder.temporary(f"{split}.shard"), path)
            self.count("files", split)

    def finish(self) -> None:
        """Ends the last files."""
        self.end_round()

    def close(self) -> None:
        """Closes what is open, unfinished."""
        for shard in self._shards.values():
            shard.close()
        super().close()

    def _put_shapes(self, scene: ExportScene) -> None:
        """Writes `shapes/<category>/<instance id>.glb` of all that stands in a scene, and points on it where asked for.

        Samples that the dataset has (`targets.shape`) are copied beside it, as `<instance id>.samples.npz`.
        """
        for instance_id in scene.shown:
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
            if self.request.points:
                mesh = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False).to_mesh()
                self.folder.put(f"{path}.npz", encode_npz(sample_mesh(mesh, self.request.points, instance_id)))
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
    "(0, 0, 0) is none; covisible 255 where the input camera sees the point of an object that the pixel shows; "
    "amodal an image for each object, by region, 255 where it is; layers and back as depth and region"
)


def sample_mesh(mesh: trimesh.Trimesh, count: int, name: str) -> dict[str, NDArray]:
    """points and normals [count, 3] float32, uniform over the surface, metres; `name` seeds the draw."""
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
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), encode_npy(array), zipfile.ZIP_DEFLATED, 1)
    return stream.getvalue()


def encode_npy(array: NDArray) -> bytes:
    """What numpy.load reads as one array."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=False)
    return stream.getvalue()
