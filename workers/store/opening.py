"""The store that a user's --out means."""

import re

from workers.store.local import LocalStore
from workers.store.store import Store

_URL = re.compile(r"[a-z][a-z0-9+.-]+://")


def open_store(out: str) -> Store:
    """An object store where `out` is a URL such as s3://bucket/path, otherwise a folder. Reads and writes nothing yet.

    Raises OutputError for a URL of an unknown kind.
    """
    if not _URL.match(out):
        return LocalStore(out)
    from workers.store.objects import open_object_store  # obstore loads only where it is needed

    return open_object_store(out)
