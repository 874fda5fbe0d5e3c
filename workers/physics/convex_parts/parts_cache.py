"""Convex parts kept in memory, and in files for the next process. A cache: it may be emptied at any time."""

import hashlib
import io
import os
import tempfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import numpy as np

from schemas.base import Array, frozen_array

Answer = tuple[str, tuple[Array, ...]]
"""How parts were made, and their vertices [N, 3] each."""

CAPACITY_BYTES = 64 * 1024 * 1024
"""Of memory that a process keeps: a thousand mugs."""


def _usual_folder() -> Path | None:
    try:
        return Path.home() / ".cache" / "verso" / "parts"
    except RuntimeError:  # a user without a home
        return None


USUAL_FOLDER = _usual_folder()


def key_of(*what: str | bytes) -> str:
    """SHA-256 of all that an answer depends on."""
    whole = hashlib.sha256()
    for one in what:
        data = one.encode() if isinstance(one, str) else one
        whole.update(len(data).to_bytes(8, "little") + data)
    return whole.hexdigest()


class PartsCache:
    """The answers used last, as many as `capacity_bytes` hold, but at least one; each also as a file where there is a folder.

    A file holds the SHA-256 of the rest before it, so that a torn one is seen and made again, and gets its name when it
    is whole. Where the folder cannot be written, nothing is kept in it.
    """

    def __init__(self, capacity_bytes: int = CAPACITY_BYTES) -> None:
        self.capacity_bytes = capacity_bytes
        self.bytes = 0
        self._answers: OrderedDict[str, Answer] = OrderedDict()

    def __len__(self) -> int:
        return len(self._answers)

    def get(self, key: str, folder: Path | None, make: Callable[[], Answer]) -> Answer:
        """The answer of this key: from memory, from the folder, or made; what `make` raises leaves no trace."""
        if key in self._answers:
            self._answers.move_to_end(key)
            return self._answers[key]
        answer = _read(folder / key) if folder is not None else None
        if answer is None:
            answer = make()
            if folder is not None:
                _write(folder, key, answer)
        self._answers[key] = answer
        self.bytes += _bytes_of(answer)
        while self.bytes > self.capacity_bytes and len(self._answers) > 1:
            self.bytes -= _bytes_of(self._answers.popitem(last=False)[1])
        return answer


def _bytes_of(answer: Answer) -> int:
    return sum(cloud.nbytes for cloud in answer[1])


def _read(path: Path) -> Answer | None:
    try:
        data = path.read_bytes()
    except OSError:
        return None
    if hashlib.sha256(data[32:]).digest() != data[:32]:
        return None
    with np.load(io.BytesIO(data[32:])) as stored:
        clouds = np.split(stored["vertices"], np.cumsum(stored["counts"])[:-1])
        return str(stored["way"]), tuple(frozen_array(cloud) for cloud in clouds)


def _write(folder: Path, key: str, answer: Answer) -> None:
    way, clouds = answer
    whole = io.BytesIO()
    np.savez(whole, way=way, vertices=np.concatenate(clouds), counts=np.array([len(cloud) for cloud in clouds]))
    data = whole.getvalue()
    name = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, prefix=f".{key}.", delete=False) as file:
            name = file.name
            file.write(hashlib.sha256(data).digest() + data)
        os.replace(name, folder / key)
    except OSError:
        if name is not None:
            Path(name).unlink(missing_ok=True)
