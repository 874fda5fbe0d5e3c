"""Files of a dataset's pairs, from single files or from tars; the tars that are read are kept, bounded by their bytes."""

from collections.abc import Sequence

import trimesh
from cachetools import LRUCache

from schemas.dataset.codec import Row
from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import tar_path
from schemas.errors import CorruptError
from schemas.job.views import Patch
from services.dataset.shapes import Shapes
from services.job.record import JobRecord
from workers.store.commit import read_committed
from workers.store.store import Store
from workers.store.tars import read_tar

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
        self._files = files
        self._records = records
        self.patch = files.patch

    def image(self, scene_id: int, path: str) -> bytes:
        """The bytes of an image, published or not yet. Raises CorruptError where it is missing."""
        record = next(one for one in reversed(self._records) if scene_id in one.span.scene_ids)
        if record.terms.layout == "files":
            return read_committed(self._files.store, record, path)
        members = self._files.tar(record, path.partition("/")[0])
        if path not in members:
            raise CorruptError(f"{path} is committed and in no tar: `verso verify {self._files.store.name}` tells more")
        return members[path]

    def mesh(self, scene: Row, region_id: int) -> trimesh.Trimesh:
        """The shape of a region in its own frame, as `Shapes.mesh`."""
        return self._files.shapes.mesh(scene, region_id)
