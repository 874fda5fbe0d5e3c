"""Keeping compiled libraries from writing where a program's messages go."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

STDERR = 2


@contextmanager
def silence_c_stderr() -> Iterator[None]:
    """Drop what C code prints to standard error within the block; an exception is told after it, as ever.

    PyBullet prints its build time when it is imported, which would head every command's messages.
    """
    sys.stderr.flush()
    kept, nowhere = os.dup(STDERR), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, STDERR)
    try:
        yield
    finally:
        os.dup2(kept, STDERR)
        os.close(kept)
        os.close(nowhere)
