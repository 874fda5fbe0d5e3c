"""Shapes of a dataset's objects as meshes in the object frame, and the files of its pairs, from single files or from tars."""

import io
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import trimesh
from cachetools import LRUCache

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import asset_path, tar_path
from schemas.errors import CorruptError, InputError, MachineError
from schemas.job.assets import TABLE
from schemas.job.views import Patch
from schemas.scene.shape import REGION_TABLE, Asset
from services.job.record import JobRecord
from workers.assets.catalogue import Catalogue
from workers.assets.external.plain import show_colors
from workers.assets.glb import mesh_of_part
from workers.store.commit import read_committed
from workers.store.store import Store
from workers.store.tars import read_tar

ReadShape = Callable[[str], bytes]
"""Returns the bytes of a stored shape by its path. Raises FileNotFoundError."""


class Shapes:
    """Reads shapes of one job."""

    def __init__(self, read: ReadShape, record: JobRecord) -> None:
        self._read = read
        self._record = record
        self._catalogue: Catalogue | None = None
        self._parts = lru_cache(16)(self._load)

    def mesh(self, scene: Mapping[str, Any], region_id: int) -> trimesh.Trimesh:
        """The shape of the table or of an object of a scene, own frame, metres; a copy that the caller may change.

        Raises InputError where it is neither stored nor to be had from the job's sources, CorruptError where it is damaged.
        """
        return self._parts(*_name_of(scene, region_id), scene["scene_id"], region_id).copy()

    def _load(self, category: str, instance_id: str, scene_id: int, region_id: int) -> trimesh.Trimesh:
        path = asset_path(category, instance_id)
        try:
            data = self._read(path)
        except FileNotFoundError:
            return self._from_source(path, scene_id, region_id)
        try:
            loaded = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
            return _join([show_colors(mesh) for mesh in loaded.geometry.values()])
        except Exception as error:  # trimesh raises errors of many kinds for a damaged file
            raise CorruptError(f"{path} cannot be read: {error}; `verso replay OUT --repair` makes it again") from error

    def _from_source(self, path: str, scene_id: int, region_id: int) -> trimesh.Trimesh:
        """The shape of a source whose licence keeps it out of the dataset."""
        if self._record.job.captures is not None:
            raise CorruptError(f"{path} is missing: restore it from a copy")
        from workers.scene.plan import SceneChance, plan_scene  # loads the physics

        plan = plan_scene(self._record.job, self._sources(path), SceneChance(self._record.job.seed, scene_id))
        assets: dict[int, Asset] = {start.region_id: start.asset for start in plan.objects}
        asset = {**assets, REGION_TABLE: plan.table.asset}[region_id]
        return _join([mesh_of_part(part) for part in asset.shape.parts])

    def _sources(self, path: str) -> Catalogue:
        from workers.capture.results import open_sources

        if self._catalogue is None:
            told = f"{path} is not in the dataset (its licence is not free, or assets.copy_assets is off)"
            try:
                self._catalogue = open_sources(self._record.job, Path(self._record.folder))
            except InputError as error:
                raise InputError(f"{told}, and its source cannot be read here: {error}") from error
        if self._catalogue.digest != self._record.catalogue:
            raise MachineError("the files of the asset folders do not hold what they held when this job was run")
        return self._catalogue


def _name_of(scene: Mapping[str, Any], region_id: int) -> tuple[str, str]:
    """(category, instance id) of a region of a row of `scenes`."""
    if region_id == REGION_TABLE:
        return TABLE, scene["table_id"]
    bodies = {body["region_id"]: (body["category"], body["instance_id"]) for body in scene["bodies"] or ()}
    return bodies.get(region_id, (scene["category"], scene["instance_id"]))


def _join(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of all parts."""
    joined = meshes[0] if len(meshes) == 1 else trimesh.util.concatenate(meshes)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


TAR_BYTES = 256 << 20
"""Bytes of images from tars that are kept; always at least one tar."""

Members = dict[str, bytes]


class StoredFiles:
    """Files of a whole dataset."""

    def __init__(self, store: Store, job: JobRecord) -> None:
        self.store = store
        self.shapes = Shapes(store.read, job)
        self.patch: Patch = job.job.images.patch
        self._tars: LRUCache[str, Members] = LRUCache(TAR_BYTES, lambda tar: sum(map(len, tar.values())))

    def tar(self, record: CommitRecord, category: str) -> Members:
        """The images in a commit's tar of one category, by path; none where it has none."""
        path = tar_path(category, record.span.start, record.span.retry)
        if path in self._tars:
            return self._tars[path]
        if path not in {entry.path for entry in record.files}:
            return {}
        members = dict(read_tar(category, read_committed(self.store, record, path), path))
        if sum(map(len, members.values())) <= TAR_BYTES:
            self._tars[path] = members
        return members


class RangeFiles:
    """The files of one committed range."""

    def __init__(self, files: StoredFiles, records: Sequence[CommitRecord]) -> None:
        self._files, self._records = files, records
        self.patch, self.mesh = files.patch, files.shapes.mesh

    def image(self, scene_id: int, path: str) -> bytes:
        """The bytes of an image, published or not yet. Raises CorruptError where it is missing."""
        record = next(one for one in reversed(self._records) if scene_id in one.span.scene_ids)
        if record.terms.layout == "files":
            return read_committed(self._files.store, record, path)
        members = self._files.tar(record, path.partition("/")[0])
        if path not in members:
            raise CorruptError(f"{path} is committed and in no tar: `verso verify {self._files.store.name}` tells more")
        return members[path]
