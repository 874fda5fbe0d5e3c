"""A cache of convex parts in memory and in files, which may be deleted at any time."""

import hashlib
import io
import os
import tempfile
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from schemas.base import Array, frozen_array

Answer = tuple[str, tuple[Array, ...]]
"""The method that made the parts, and the vertices [N, 3] of each."""

CAPACITY_BYTES = 64 * 1024 * 1024
"""Memory per process: a thousand mugs."""

DIGEST_BYTES = 32


def _usual_folder() -> Path | None:
    try:
        return Path.home() / ".cache" / "verso" / "parts"
    except RuntimeError:  # a user without a home
        return None


USUAL_FOLDER = _usual_folder()


def key_of(*inputs: str | bytes) -> str:
    """SHA-256 of everything that an answer depends on."""
    whole = hashlib.sha256()
    for one in inputs:
        data = one.encode() if isinstance(one, str) else one
        whole.update(len(data).to_bytes(8, "little") + data)
    return whole.hexdigest()


class PartsCache:
    """The answers used last that fit `capacity_bytes`, at least one. Each is also kept as a file if a folder is given.

    A file begins with the SHA-256 of its content, so that a torn one is found and made again, and is renamed into place.
    A folder that cannot be written is ignored.
    """

    def __init__(self, capacity_bytes: int = CAPACITY_BYTES) -> None:
        self.capacity_bytes = capacity_bytes
        self.bytes = 0
        self._answers: OrderedDict[str, Answer] = OrderedDict()

    def __len__(self) -> int:
        return len(self._answers)

    def get(self, key: str, folder: Path | None, make: Callable[[], Answer]) -> Answer:
        """The answer of this key: from memory, from the folder, or made. An exception of `make` leaves no trace."""
        if key in self._answers:
            self._answers.move_to_end(key)
            return self._answers[key]
        answer = None if folder is None else _read(folder / key)
        if answer is None:
            answer = make()
            if folder is not None:
                with suppress(OSError):
                    _write(folder, key, answer)
        self._answers[key] = answer
        self.bytes += sum(cloud.nbytes for cloud in answer[1])
        while self.bytes > self.capacity_bytes and len(self._answers) > 1:
            _, (_, clouds) = self._answers.popitem(last=False)
            self.bytes -= sum(cloud.nbytes for cloud in clouds)
        return answer


def _read(path: Path) -> Answer | None:
    try:
        data = path.read_bytes()
    except OSError:
        return None
    if hashlib.sha256(data[DIGEST_BYTES:]).digest() != data[:DIGEST_BYTES]:
        return None
    with np.load(io.BytesIO(data[DIGEST_BYTES:])) as stored:
        clouds = np.split(stored["vertices"], np.cumsum(stored["counts"])[:-1])
        return str(stored["method"]), tuple(frozen_array(cloud) for cloud in clouds)


def _write(folder: Path, key: str, answer: Answer) -> None:
    method, clouds = answer
    content = io.BytesIO()
    np.savez(content, method=method, vertices=np.concatenate(clouds), counts=[len(cloud) for cloud in clouds])
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, prefix=f".{key}.", delete=False) as file:
        try:
            file.write(hashlib.sha256(content.getvalue()).digest() + content.getvalue())
            file.flush()
            os.replace(file.name, folder / key)
        except OSError:
            Path(file.name).unlink(missing_ok=True)
            raise
