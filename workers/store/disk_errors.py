"""Errors of a disk that a user can mend, explained."""

import contextlib
import errno
from collections.abc import Iterator

from schemas.errors import MachineError

_REMEDIES = {
    errno.ENOSPC: "the disk is full; free some space and start again, nothing finished is lost",
    errno.EDQUOT: "the disk quota is used up; free some space and start again, nothing finished is lost",
    errno.EROFS: "the file system is read-only",
    errno.EACCES: "permission denied",
    errno.EIO: "the disk reports an input/output error; check it before going on",
}


@contextlib.contextmanager
def explain_disk_errors(what: str) -> Iterator[None]:
    """Turns an OSError that a user can mend into a MachineError: `what` happened, why, and what to do."""
    try:
        yield
    except OSError as error:
        if error.errno in _REMEDIES:
            raise MachineError(f"{what}: {_REMEDIES[error.errno]}") from error
        raise
