"""Edge: a source of files from outside, listed, checked and loaded by limited processes."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits, ShapeNetSource, UpAxis
from schemas.scene.shape import Asset
from workers.assets.external.asset_bytes import unpack_asset
from workers.assets.external.listing import (
    UNKNOWN,
    Entry,
    Listing,
    SourceFile,
    find_licence,
    instance_id_of,
    list_licences,
)
from workers.assets.external.reader import BATCH, ask_all, shared_reader
from workers.assets.external.reader_tasks import Request, Task
from workers.assets.external.verdicts import Verdict, Verdicts, verdict_key
from workers.assets.watch import Watch, ignore

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
            files = tuple(SourceFile(*file) for file in json.loads(bytes(answer).rstrip(b"\0")))
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
        verdict = answer if isinstance(answer, MeshError) else _AXES.get(bytes(answer[:1]))
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
    return f"{name} ({error.reason}: {why:.300})"


def load_asset_file(
    settings: ShapeNetSource | FolderSource, folder: Path, entry: Entry, category: str, assets: Assets
) -> Asset:
    """One instance, read by this process's reader; MeshError where it is refused, is missing or has changed."""
    task = Task("load", folder / entry.files[0].path, category, entry)
    (answer,) = shared_reader().ask(Request(settings, folder, assets, (task,)))
    if isinstance(answer, MeshError):
        raise answer
    return unpack_asset(answer)
