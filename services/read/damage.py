"""Errors of files that are damaged, missing or of the wrong kind, told in one line by every command that reads."""

import contextlib
from collections.abc import Iterator

import pyarrow as pa

from schemas.errors import CorruptError
from services.read.verdict import describe_os_error, printable
from workers.store.store import Store


@contextlib.contextmanager
def explain_damage(store: Store) -> Iterator[None]:
    """Raises CorruptError with one line where the block meets a file that cannot be read as what it should be."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        where = str(error.filename or store.name)
        told = f"{where}: {describe_os_error(error)}"
    except (ValueError, pa.ArrowException) as error:
        told = f"{store.name} holds a damaged file: {(str(error).splitlines() or [type(error).__name__])[0]}"
    else:
        return
    raise CorruptError(f"{printable(told)}; `verso verify {store.name}` lists every damaged file")
