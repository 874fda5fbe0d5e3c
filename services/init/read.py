"""Edge: reads every mesh of a folder in limited processes, and settles which of them are one and the same."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

from schemas.errors import MeshError
from schemas.job.assets import Assets, FolderSource, MeshLimits
from schemas.plain_line import plain_line
from services.init.model import Candidate, Item, LeftOut, Reading
from services.init.table import PART
from services.init.walk import SUFFIXES
from workers.assets.external.listing import Entry, SourceFile
from workers.assets.external.measured import read_measured
from workers.assets.external.reader import ask_all
from workers.assets.external.reader_tasks import Kind, Request, Task

ANY_SIZE = MeshLimits(min_size_m=1e-12, max_size_m=1e12)
"""Sizes are judged when the unit is known."""

SMALLEST, LARGEST = MeshLimits().min_size_m, MeshLimits().max_size_m

DONE: Mapping[Kind, str] = {"names": "URDFs read", "list": "files listed", "measure": "meshes read"}
"""What progress says."""

Watch = Callable[[str, int, int], None]


def read_folder(folder: Path, candidates: Sequence[Candidate], watch: Watch) -> Reading:
    """What every candidate is, in the order given; `folder` is resolved."""
    source = FolderSource(source="urdf", folder=str(folder))
    request = Request(source, folder, Assets(limits=ANY_SIZE), ())
    parts = _parts_of_urdfs(request, candidates, watch)
    left_out = [LeftOut(path, PART, f"is a part of {urdf}") for path, urdf in parts.items()]
    rest = [one for one in candidates if one.path not in parts]
    entries, refused = _list(request, rest, watch)
    items, more = _measure(request, entries, watch)
    refused += more
    kept, doubled = drop_doubles(items)
    unread = frozenset(one.path for one in refused)
    return Reading(tuple(kept), (*refused, *left_out, *doubled), unread)


def _parts_of_urdfs(request: Request, candidates: Sequence[Candidate], watch: Watch) -> dict[str, str]:
    """Meshes that a URDF of the folder refers to, and the first URDF that does."""
    urdfs = [one for one in candidates if one.path.lower().endswith(".urdf")]
    parts: dict[str, str] = {}
    for task, answer in _ask(request, "names", urdfs, [], watch):
        if not isinstance(answer, MeshError):
            for path in json.loads(bytes(answer).rstrip(b"\0")):
                parts.setdefault(path, task.path.relative_to(request.folder).as_posix())
    return parts


def _list(
    request: Request, candidates: Sequence[Candidate], watch: Watch
) -> tuple[list[tuple[Candidate, Entry]], list[LeftOut]]:
    """The files of each candidate with their digests."""
    entries, left_out = list[tuple[Candidate, Entry]](), list[LeftOut]()
    answers = _ask(request, "list", candidates, [], watch)
    for one, (_, answer) in zip(candidates, answers, strict=True):
        if isinstance(answer, MeshError):
            left_out.append(_refusal(one, request.folder, answer))
        else:
            files = tuple(SourceFile(*file) for file in json.loads(bytes(answer).rstrip(b"\0")))
            entries.append((one, Entry("", files, "")))
    return entries, left_out


def _measure(
    request: Request, entries: Sequence[tuple[Candidate, Entry]], watch: Watch
) -> tuple[list[Item], list[LeftOut]]:
    items, left_out = list[Item](), list[LeftOut]()
    candidates = [one for one, _ in entries]
    answers = _ask(request, "measure", candidates, [entry for _, entry in entries], watch)
    for (one, entry), (_, answer) in zip(entries, answers, strict=True):
        if isinstance(answer, MeshError):
            left_out.append(_refusal(one, request.folder, answer))
        else:
            digest = hashlib.sha256("".join(file.sha256 for file in entry.files).encode()).hexdigest()
            items.append(Item(one.path, one.category, read_measured(bytes(answer).rstrip(b"\0")), digest))
    return items, left_out


def _ask(
    request: Request, kind: Kind, candidates: Sequence[Candidate], entries: Sequence[Entry | None], watch: Watch
) -> Iterator[tuple[Task, memoryview | MeshError]]:
    asked = zip(candidates, entries or [None] * len(candidates), strict=True)
    tasks = tuple(Task(kind, request.folder / one.path, one.category, entry) for one, entry in asked)
    return ask_all(replace(request, tasks=tasks), partial(watch, DONE[kind]))


def _refusal(one: Candidate, folder: Path, error: MeshError) -> LeftOut:
    why = error.detail.replace(f"{folder}/", "").removeprefix(one.path).lstrip(": ")
    return LeftOut(one.path, error.reason, plain_line(why, 300))


def drop_doubles(items: Sequence[Item]) -> tuple[list[Item], list[LeftOut]]:
    """The items without those that are another one again: of the same bytes, or beside it in another format.

    Of one name in one folder, that with pictures stays, then the one whose format comes first in `SUFFIXES`;
    `nontextured` counts as `textured`.
    """
    left_out = dict[str, LeftOut]()
    best = dict[tuple[str, str], Item]()
    for item in sorted(items, key=lambda item: (not item.measured.textures, SUFFIXES.index(item.suffix), item.path)):
        path = PurePosixPath(item.path)
        first = best.setdefault((str(path.parent), path.stem.removeprefix("non").lower()), item)
        if first is not item and first.suffix != item.suffix:
            left_out[item.path] = LeftOut(item.path, "double", f"is {first.path} in another format")
    seen = dict[str, Item]()
    for item in items:
        if item.path not in left_out and (first := seen.setdefault(item.digest, item)) is not item:
            left_out[item.path] = LeftOut(item.path, "double", f"has the content of {first.path}")
    return [item for item in items if item.path not in left_out], list(left_out.values())
