"""Edge: which assets from outside can be read, kept in memory and in a file, so that each is found out once.

A line for each verdict: the checksum of the rest, and JSON. Lines are appended whole; one that is torn, or was written
by two processes at once, does not match its checksum and is found out again. Without a home, or where it cannot be
written, verdicts are kept in memory alone.
"""

import hashlib
import json
import os
import zlib
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

from schemas.environment import cache_folder
from schemas.errors import MeshError
from schemas.job.assets import Assets, FolderSource, ShapeNetSource, UpAxis
from schemas.job.category import TABLE
from workers.assets import mass
from workers.assets.external.listing import Entry
from workers.geometry import hull

LIBRARIES = ("manifold3d", "numpy", "pillow", "scipy", "trimesh")
"""Libraries whose versions may change a verdict."""

_NOT_ASKED = {"folder", "weight", "licence", "copy_assets"}
"""Settings of a source that change no verdict."""

FOLDER = "{folder}"
"""Stands for the source's folder in a stored detail, because the same files may lie elsewhere."""


USUAL_FOLDER = cache_folder("verdicts")


@cache
def code_version() -> str:
    """Digest of the code that verdicts depend on, and of the versions of libraries."""
    whole = hashlib.sha256(repr([version(name) for name in LIBRARIES]).encode())
    for folder in (Path(__file__).parent, Path(hull.__file__).parent):
        for file in sorted(folder.glob("*.py")):
            whole.update(hashlib.sha256(file.read_bytes()).digest())
    whole.update(hashlib.sha256(Path(mass.__file__).read_bytes()).digest())
    return whole.hexdigest()[:32]


def verdict_key(settings: ShapeNetSource | FolderSource, assets: Assets, category: str, entry: Entry) -> str:
    """SHA-256 of all that a verdict is a function of, but the code: files, settings of their source, limits, densities."""
    plain = settings.model_dump(mode="json", exclude=_NOT_ASKED)
    common = assets.model_dump(mode="json", include={"limits", "density_kg_m3", "shell_kg_m2"})
    files = [(file.path, file.size, file.sha256) for file in entry.files]
    return hashlib.sha256(json.dumps([plain, common, category == TABLE, files], sort_keys=True).encode()).hexdigest()


Verdict = MeshError | UpAxis | None
"""Of an asset: why it cannot be used; the axis on which alone it stands, where `up` names another; None: nothing is wrong."""


class Verdicts:
    """Verdicts by key."""

    def __init__(self, folder: Path | None = USUAL_FOLDER) -> None:
        self._path = None if folder is None else folder / code_version()
        self._kept: dict[str, tuple[str, str] | UpAxis | None] = {}
        if self._path is not None:
            with suppress(OSError):
                self._kept = dict(filter(None, map(_parse, self._path.read_bytes().split(b"\n"))))

    def __contains__(self, key: str) -> bool:
        return key in self._kept

    def get(self, key: str, folder: Path) -> Verdict:
        """The verdict on an asset below `folder`. KeyError where that is not known."""
        found = self._kept[key]
        return MeshError(found[0], found[1].replace(FOLDER, str(folder))) if isinstance(found, tuple) else found

    def put(self, verdicts: Iterable[tuple[str, Verdict]], folder: Path) -> None:
        """Keeps verdicts on assets below `folder`."""
        lines = []
        for key, verdict in verdicts:
            if isinstance(verdict, MeshError):
                self._kept[key] = (verdict.reason, verdict.detail.replace(str(folder), FOLDER))
            else:
                self._kept[key] = verdict
            text = json.dumps([key, self._kept[key]]).encode()
            lines.append(b"%08x %s\n" % (zlib.crc32(text), text))
        if self._path is not None and lines:
            with suppress(OSError):
                self._path.parent.mkdir(parents=True, exist_ok=True)
                _append(self._path, b"\n" + b"".join(lines))


def _append(path: Path, data: bytes) -> None:
    to = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        os.write(to, data)
    finally:
        os.close(to)


def _parse(line: bytes) -> tuple[str, tuple[str, str] | UpAxis | None] | None:
    """Key and verdict of a line; None where it is torn."""
    checksum, _, text = line.partition(b" ")
    if checksum != b"%08x" % zlib.crc32(text):
        return None
    key, found = json.loads(text)
    return key, (found[0], found[1]) if isinstance(found, list) else found
