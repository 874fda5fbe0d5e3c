"""Shapes of a dataset's objects as meshes in the object frame, and the files of its pairs, from single files or from tars."""

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

from cachetools import LRUCache
from numpy.typing import NDArray

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import samples_path
from schemas.job.views import Patch
from services.job.record import JobRecord
from services.read.dataset_reader import Members, committed_reader, decode_samples, file_reader, region_names
from workers.store.store import Store

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
        return self._kept(region_names(scene)[region]).copy()

    def samples(self, scene: Mapping[str, Any], region: int) -> Mapping[str, NDArray]:
        """The stored samples of the same shape by name, own frame, metres; none where none are stored.

        Raises CorruptError where they are damaged.
        """
        path = samples_path(*region_names(scene)[region])
        try:
            return decode_samples(self._read(path), path)
        except FileNotFoundError:
            return {}

    @cached_property
    def _sources(self) -> "Sources":
        from services.read.scene_geometry import Sources

        return Sources(self._record)

    def _load(self, name: tuple[str, str]) -> "trimesh.Trimesh":
        import trimesh

        from services.read.scene_geometry import read_meshes

        meshes = [mesh for _, mesh in read_meshes(self._read, self._sources, name)]
        joined = meshes[0] if len(meshes) == 1 else trimesh.util.concatenate(meshes)
        assert isinstance(joined, trimesh.Trimesh)
        return joined


TAR_BYTES = 256 << 20
"""Bytes of images from tars that are kept."""


class StoredFiles:
    """Files of a whole dataset."""

    def __init__(self, store: Store, job: JobRecord) -> None:
        self.store = store
        self.shapes = Shapes(store.read, job)
        self.patch: Patch = job.job.images.patch
        self.tars: LRUCache[str, Members] = LRUCache(TAR_BYTES, lambda tar: sum(map(len, tar.values())))


class RangeFiles:
    """The files of one committed range."""

    def __init__(self, files: StoredFiles, records: Sequence[CommitRecord]) -> None:
        self.patch, self.mesh, self.samples = files.patch, files.shapes.mesh, files.shapes.samples
        self.read = committed_reader(files.store, records)
        """The bytes of a file that is not in a tar, published or not yet. Raises CorruptError where it is missing."""
        self.image = file_reader(self.read, records, files.tars)
        """The same of an image."""
