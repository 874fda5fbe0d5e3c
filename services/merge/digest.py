"""The dataset digest: one digest of everything that a job and a seed determine."""

import hashlib
from collections.abc import Iterable, Mapping

from schemas.dataset.tables import DETERMINISTIC_TABLES


def dataset_digest(tables: Mapping[str, str], files: Iterable[tuple[str, str]]) -> str:
    """64 hex characters: SHA-256 over the tables' digests, then over the (path, SHA-256) of `files`.

    The tables are scenes, views, objects, assets and failures, by their canonical rows (workers/store/canonical.py);
    the files are images, shapes and merged files. They must come sorted by the UTF-8 bytes of their paths, each path
    once; raises ValueError otherwise. In layout `tar` an image has the path that it would have as a file of its own, so
    the digest does not depend on the layout.
    """
    total = hashlib.sha256(b"verso dataset 1\n")
    for table in DETERMINISTIC_TABLES:
        total.update(f"{table} {tables[table]}\n".encode())
    previous = b""
    for path, sha256 in files:
        name = path.encode()
        if name <= previous:
            raise ValueError(f"{path} comes after {previous.decode()}: paths must be sorted and unique")
        previous = name
        total.update(b"%s\n%s\n" % (name, sha256.encode()))
    return total.hexdigest()
