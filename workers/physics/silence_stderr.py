"""A block in which compiled libraries cannot write to standard error."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

STDERR = 2


@contextmanager
def silence_stderr() -> Iterator[None]:
    """Discard what C code prints to standard error; an exception is reported after the block, as usual.

    PyBullet prints its build time on import, at the head of every command's messages.
    """
    sys.stderr.flush()
    with open(os.devnull, "wb") as devnull:
        kept = os.dup(STDERR)
        os.dup2(devnull.fileno(), STDERR)
    try:
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)
