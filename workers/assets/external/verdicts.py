"""Edge: a source of files from outside, listed, checked and loaded by limited processes; and the cache of what the check found.

The cache (`Verdicts`) is kept in memory and in a file, so that each asset is checked once. The file has a line for each verdict:
the checksum of the rest, and JSON. Lines are appended whole; one that is torn, or was written by two processes at once, does not
match its checksum and is found out again. Without a home, or where it cannot be written, verdicts are kept in memory alone.
"""

import hashlib
import json
import os
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path

from schemas.environment import cache_folder
from schemas.errors import AssetSourceError, MeshError, plain_line
from schemas.job.assets import TABLE, Assets, FolderSource, MeshLimits, ShapeNetSource, UpAxis
from schemas.scene.shape import Asset
from workers.assets import mass
from workers.assets.external.listing import (
    UNKNOWN,
    Entry,
    Listing,
    SourceFile,
    Watch,
    find_licence,
    ignore,
    instance_id_of,
    list_licences,
)
from workers.assets.external.reader import BATCH, Request, Task, ask, ask_all, unpack_asset
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


_AXES: Mapping[bytes, UpAxis] = {b"x": "x", b"y": "y", b"z": "z"}
"""What the check of a file may answer."""

EXAMPLES = 3
"""Refused files that are described in a message."""


def read_listing(
    settings: ShapeNetSource | FolderSource,
    folder: Path,
    candidates: Mapping[str, Iterable[Path]],
    limits: MeshLimits,
    watch: Watch = ignore,
) -> Listing:
    """Hashes every candidate and the files that it refers to; counts and skips those that are refused.

    Takes about two seconds for each gigabyte, where disks allow.
    """
    stated = settings.licence
    licences = list_licences(folder) if stated == UNKNOWN and isinstance(settings, FolderSource) else []
    tasks = tuple(Task("list", path, category) for category, paths in candidates.items() for path in paths)
    entries: dict[str, list[Entry]] = {category: [] for category in candidates}
    skipped, examples = Counter[str](), list[str]()
    for task, answer in ask_all(Request(settings, folder, Assets(limits=limits), tasks), partial(watch, "listed")):
        if isinstance(answer, MeshError):
            skipped[answer.reason] += 1
            examples += [_describe(task.path, folder, answer)][: EXAMPLES - len(examples)]
        else:
            files = tuple(SourceFile(*file) for file in json.loads(answer))
            licence = find_licence(task.path, folder, stated, licences)
            entries[task.category].append(Entry(instance_id_of(settings, files[0]), files, licence))
    found = {category: tuple(listed) for category, listed in entries.items()}
    return Listing(folder, found, dict(sorted(skipped.items())), examples=tuple(examples))


def check_listing(
    settings: ShapeNetSource | FolderSource, listing: Listing, assets: Assets, verdicts: Verdicts, watch: Watch = ignore
) -> Listing:
    """The listing with the entries marked that cannot be read or used; what `verdicts` has is not found out again.

    Raises AssetSourceError where a file changes meanwhile.
    """
    keys = {
        (category, number): verdict_key(settings, assets, category, entry)
        for category, entries in listing.entries.items()
        for number, entry in enumerate(entries)
    }
    unknown = {key: place for place, key in keys.items() if key not in verdicts}
    tasks = []
    for category, number in unknown.values():
        entry = listing.entries[category][number]
        tasks.append(Task("check", listing.folder / entry.files[0].path, category, entry))
    asked = ask_all(Request(settings, listing.folder, assets, tuple(tasks)), partial(watch, "checked"))
    new: list[tuple[str, Verdict]] = []
    for key, (_, answer) in zip(unknown, asked, strict=True):
        verdict = answer if isinstance(answer, MeshError) else _AXES.get(answer)
        if isinstance(verdict, MeshError) and verdict.kind == "environmental":
            raise AssetSourceError(f"{verdict.detail}, while its folder was read: start again when nobody writes there")
        new.append((key, verdict))
        if len(new) == BATCH["check"]:
            verdicts.put(new, listing.folder)
            new = []
    verdicts.put(new, listing.folder)
    return _mark(listing, {place: verdicts.get(key, listing.folder) for place, key in keys.items()})


def _mark(listing: Listing, verdicts: Mapping[tuple[str, int], Verdict]) -> Listing:
    """The listing with those refused that have an error, which are counted and the first of them described, and the doubts."""
    skipped, examples = Counter(listing.skipped), list(listing.examples)
    refused: dict[str, set[int]] = {}
    doubts: dict[str, UpAxis] = {}
    for (category, number), verdict in verdicts.items():
        path = listing.entries[category][number].files[0].path
        if isinstance(verdict, MeshError):
            refused.setdefault(category, set()).add(number)
            skipped[verdict.reason] += 1
            examples += [_describe(listing.folder / path, listing.folder, verdict)][: EXAMPLES - len(examples)]
        elif verdict is not None:
            doubts[path] = verdict
    return replace(
        listing,
        skipped=dict(sorted(skipped.items())),
        refused={category: frozenset(numbers) for category, numbers in refused.items()},
        examples=tuple(examples),
        doubts=doubts,
    )


def _describe(path: Path, folder: Path, error: MeshError) -> str:
    """A refused file, by its name in the folder, and why."""
    name = path.relative_to(folder).as_posix()
    why = error.detail.replace(f"{folder}/", "")
    why = why.removeprefix(name).lstrip(": ")
    return plain_line(f"{name} ({error.reason}: {why:.300})", 1000)


def load_asset_file(
    settings: ShapeNetSource | FolderSource, folder: Path, entry: Entry, category: str, assets: Assets
) -> Asset:
    """One instance, read by a limited process; MeshError where it is refused, is missing or has changed."""
    task = Task("load", folder / entry.files[0].path, category, entry)
    (answer,) = ask(Request(settings, folder, assets, (task,)))
    if isinstance(answer, MeshError):
        raise answer
    return unpack_asset(answer)
