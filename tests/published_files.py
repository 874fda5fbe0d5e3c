"""Whether the files of a commit lie in their final places."""

from schemas.dataset.commit import CommitRecord, FileEntry
from schemas.dataset.layout import is_shape
from schemas.errors import CorruptError
from workers.store.commit import committed_files
from workers.store.store import Store


def check_published(store: Store, record: CommitRecord) -> tuple[FileEntry, ...]:
    """Every file of the record.

    Raises CorruptError naming one that is not in its final place with its size. A shape that a mix of stacks shares
    keeps the size of whichever was first.
    """
    files = committed_files(store, record)
    for entry in files:
        final = store.size(entry.path)
        exact = record.terms.fingerprint_mode == "strict" or not is_shape(entry.path)
        if final is None or (exact and final != entry.bytes):
            raise CorruptError(f"{entry.path} has {final} bytes in its final place, and its commit says {entry.bytes}")
    return files
