"""The records and images of a dataset, read back through its commits."""

from collections.abc import Iterator

from schemas.dataset.commit import CommitRecord
from schemas.dataset.layout import RANGES, is_shape
from workers.store.commit import commit_names, committed_files, read_committed, read_record
from workers.store.store import Store
from workers.store.tars import read_tar


def iter_records(store: Store) -> Iterator[CommitRecord]:
    """Every record, one at a time, each range followed by its retries."""
    for start, retry, key in commit_names(store):
        record = read_record(store, start, retry)
        assert record is not None, f"{key} vanished while it was read"
        yield record


def read_images(store: Store, record: CommitRecord) -> Iterator[tuple[str, bytes]]:
    """(path, bytes) of every image that a commit holds, whatever the layout."""
    for entry in committed_files(store, record):
        if is_shape(entry.path) or entry.path.startswith(f"{RANGES}/"):
            continue
        data = read_committed(store, record, entry.path)
        if record.terms.layout == "tar":
            yield from read_tar(entry.path.split("/")[0], data, entry.path)
        else:
            yield entry.path, data
