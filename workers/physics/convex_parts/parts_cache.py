"""A cache of convex parts in memory and in files, which may be deleted."""

import hashlib
import io
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cachetools import LRUCache

from schemas.base import Array, frozen_array
from schemas.environment import cache_folder

CAPACITY_BYTES = 64 * 1024 * 1024
"""Memory per process: a thousand mugs."""


class Parts(NamedTuple):
    """Vertices [N, 3] float64, metres, of each convex part of a body, and how they were made.

    convex: every piece of the body is; coacd: by CoACD; pieces: CoACD failed, and they are the hulls of the pieces; lofts:
    from the making of a built-in shape; none: there are none, because CoACD took too long.
    """

    clouds: tuple[Array, ...]
    method: str


USUAL_FOLDER = cache_folder("parts")


def key_of(*inputs: str | bytes) -> str:
    """SHA-256 of everything that an answer depends on."""
    whole = hashlib.sha256()
    for one in inputs:
        data = one.encode() if isinstance(one, str) else one
        whole.update(len(data).to_bytes(8, "little") + data)
    return whole.hexdigest()


class PartsCache:
    """The parts used last that fit `capacity_bytes` together, and files of all parts if a folder is given.

    A file begins with the SHA-256 of its content, by which a torn one is found and made again, and is renamed into place. A
    folder that cannot be written is ignored.
    """

    def __init__(self, capacity_bytes: int = CAPACITY_BYTES) -> None:
        self._kept: LRUCache[str, Parts] = LRUCache(capacity_bytes, lambda parts: sum(c.nbytes for c in parts.clouds))

    def get(self, key: str, folder: Path | None, make: Callable[[], Parts]) -> Parts:
        """The parts of this key: from memory, from the folder, or made. An exception of `make` leaves no trace."""
        if (parts := self._kept.get(key)) is not None:
            return parts
        parts = None if folder is None else _read(folder / key)
        if parts is None:
            parts = make()
            if folder is not None:
                with suppress(OSError):
                    _write(folder, key, parts)
        with suppress(ValueError):  # larger than all that is kept
            self._kept[key] = parts
        return parts


def _read(path: Path) -> Parts | None:
    try:
        data = path.read_bytes()
    except OSError:
        return None
    size = hashlib.sha256().digest_size
    if hashlib.sha256(data[size:]).digest() != data[:size]:
        return None
    with np.load(io.BytesIO(data[size:])) as stored:
        counts = stored["counts"]
        clouds = np.split(stored["vertices"], np.cumsum(counts)[:-1]) if len(counts) else []
        return Parts(tuple(frozen_array(cloud) for cloud in clouds), str(stored["method"]))


def _write(folder: Path, key: str, parts: Parts) -> None:
    content, counts = io.BytesIO(), [len(cloud) for cloud in parts.clouds]
    np.savez(content, method=parts.method, vertices=np.concatenate([np.empty((0, 3)), *parts.clouds]), counts=counts)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=f".{key}.", delete=False) as file:
        try:
            file.write(hashlib.sha256(content.getvalue()).digest() + content.getvalue())
            file.flush()
            os.replace(file.name, folder / key)
        except OSError:
            Path(file.name).unlink(missing_ok=True)
            raise
