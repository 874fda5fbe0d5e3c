"""Shapes of a dataset's objects as meshes in the object frame, and the files of its pairs, from single files or from tars."""

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

from cachetools import LRUCache
from numpy.typing import NDArray

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import samples_path, tar_path
from schemas.errors import CorruptError
from schemas.job.views import Patch
from services.job.record import JobRecord
from services.read.dataset_reader import decode_samples
from workers.store.commit import read_committed
from workers.store.store import Store
from workers.store.tars import read_tar

if TYPE_CHECKING:
    import trimesh

    from services.read.scene_geometry import ReadShape, Sources


class Shapes:
    """Reads shapes of one job; loads what reads them, trimesh above all, with the first."""

    def __init__(self, read: "ReadShape", record: JobRecord) -> None:
        self._read, self._record = read, record
        self._kept = lru_cache(16)(self._load)

    def mesh(self, scene: Mapping[str, Any], region: int) -> "trimesh.Trimesh":
        """The shape of the table or of an object of a scene, own frame, metres; a copy that the caller may change.

        Raises InputError where it is neither stored nor to be had from the job's sources, CorruptError where it is damaged.
        """
        from services.read.scene_geometry import region_names

        return self._kept(region_names(scene)[region], scene["scene_id"]).copy()

    def samples(self, scene: Mapping[str, Any], region: int) -> Mapping[str, NDArray]:
        """The stored samples of the same shape by name, own frame, metres; none where none are stored.

        Raises CorruptError where they are damaged.
        """
        from services.read.scene_geometry import region_names

        path = samples_path(*region_names(scene)[region])
        try:
            return decode_samples(self._read(path), path)
        except FileNotFoundError:
            return {}

    @cached_property
    def _sources(self) -> "Sources":
        from services.read.scene_geometry import Sources

        return Sources(self._record)

    def _load(self, name: tuple[str, str], scene_id: int) -> "trimesh.Trimesh":
        import trimesh

        from services.read.scene_geometry import read_meshes

        meshes = [mesh for _, mesh in read_meshes(self._read, self._sources, scene_id, name)]
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
        self.patch, self.mesh, self.samples = files.patch, files.shapes.mesh, files.shapes.samples

    def image(self, scene_id: int, path: str) -> bytes:
        """The bytes of an image, published or not yet. Raises CorruptError where it is missing."""
        record = next(one for one in reversed(self._records) if scene_id in one.span.scene_ids)
        if record.terms.layout == "files":
            return read_committed(self._files.store, record, path)
        members = self._files.tar(record, path.partition("/")[0])
        if path not in members:
            raise CorruptError(f"{path} is committed and in no tar: `verso verify OUT` tells more")
        return members[path]
