"""Edge: the files of a folder that may be objects: found, read in limited processes, doubles and parts left out."""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath

from schemas.errors import AssetSourceError, MeshError, plain_line
from schemas.job.assets import Assets, FolderSource, MeshLimits, UpAxis
from workers.assets.external.formats import FORMATS
from workers.assets.external.listing import Entry, SourceFile
from workers.assets.external.placement import URDF, Measured, read_measured
from workers.assets.external.reader import Kind, Request, Task, ask_all

PART = "part"
"""The reason why a mesh that a URDF names is not an object by itself."""


@dataclass(frozen=True)
class Item:
    """A file that can be used, what was measured of it, and one digest over all files that it reads."""

    path: str
    category: str
    measured: Measured
    digest: str

    @property
    def suffix(self) -> str:
        """The end of its name, in small letters."""
        return self.path[self.path.rfind(".") :].lower()

    @property
    def diagonal(self) -> float:
        """Of its bounding box, in units of the file."""
        return float(sum(extent * extent for extent in self.measured.extents) ** 0.5)


@dataclass(frozen=True)
class LeftOut:
    """A file that is not used: why in a word, and in a sentence with the remedy."""

    path: str
    reason: str
    why: str


@dataclass(frozen=True)
class Reading:
    """Everything that a folder has. `refused`: those left out because they cannot be read, which a job leaves out too."""

    items: tuple[Item, ...]
    left_out: tuple[LeftOut, ...]
    refused: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Scale:
    """How the files of some formats are scaled: `factor` to metres, or to `diagonal_m` where sizes are normalised; why."""

    suffixes: tuple[str, ...]
    factor: float
    why: str
    diagonal_m: float | None = None


@dataclass(frozen=True)
class UpRule:
    """The axis that is up in the files that a pattern finds, how far that is to be believed, and why."""

    pattern: str
    axis: UpAxis
    why: str


@dataclass(frozen=True)
class Guess:
    """What a job says of a folder: scales, the axes that are up (the first rule that matches), and patterns of categories."""

    scales: tuple[Scale, ...]
    ups: tuple[UpRule, ...]
    category_map: dict[str, str]
    """Category by pattern; the first match wins."""


SUFFIXES = (URDF, *FORMATS)
"""What is read; of one mesh in several formats, the first."""

FOREIGN = (
    *(".dae", ".fbx", ".blend", ".3ds", ".usd", ".usda", ".usdc", ".usdz", ".off", ".3mf", ".x3d", ".wrl"),
    *(".step", ".stp", ".iges", ".igs", ".max", ".mb", ".abc", ".c4d"),
)
"""3-D files that are not read."""

MOST_FILES = 100_000
"""More files are no folder of meshes that a person looks at."""


def walk_folder(folder: Path) -> tuple[list[str], list[LeftOut]]:
    """Paths of every mesh and URDF below the folder, in order, and what was left out already; hidden names are left aside.

    Links to folders are not followed. AssetSourceError where the folder is none, cannot be listed, or has no mesh.
    """
    name = plain_line(str(folder), 300)
    if not folder.is_dir():
        what = "is a file: name the folder that it lies in" if folder.exists() else "is not there"
        raise AssetSourceError(f"{name} {what}")
    try:
        empty = not any(folder.iterdir())
    except OSError as error:
        raise AssetSourceError(f"{name} cannot be listed: {error.strerror}") from error
    root, paths, left_out = folder.resolve(), dict[str, None](), list[LeftOut]()

    def cannot_list(error: OSError) -> None:
        left_out.append(LeftOut(_relative(error.filename, root), "permission", f"cannot be listed: {error.strerror}"))

    for parent, folders, files in os.walk(root, onerror=cannot_list):
        folders[:] = sorted(one for one in folders if not one.startswith((".", "__MACOSX")))
        for file in sorted(files):
            suffix = os.path.splitext(file)[1].lower()
            if file.startswith(".") or suffix not in (*SUFFIXES, *FOREIGN):
                continue
            path = Path(parent, file)
            if (why := _unusable(path, root)) is not None:
                left_out.append(LeftOut(_relative(str(path), root), *why))
            else:
                paths[path.resolve().relative_to(root).as_posix()] = None
        if len(paths) + len(left_out) > MOST_FILES:
            raise AssetSourceError(f"{name} has over {MOST_FILES} meshes: name a smaller folder")
    if not paths and not left_out:
        what = "is empty" if empty else f"has no mesh ({', '.join(SUFFIXES)})"
        raise AssetSourceError(f"{name} {what}: name a folder that has some")
    return sorted(paths), left_out


def _unusable(path: Path, root: Path) -> tuple[str, str] | None:
    """Why a file is left out before it is opened: in a word, and in a sentence."""
    if path.suffix.lower() in FOREIGN:
        return "format", f"{path.suffix} is not read: export it as .glb or .obj"
    if not str(path.relative_to(root)).isprintable():
        return "name", "its name is not printable UTF-8: rename it"
    if not path.resolve().is_relative_to(root):
        return "link", "leads out of the folder: copy it there"
    if not path.is_file():
        return "missing", "is no file, or a link to nothing"
    return None if os.access(path, os.R_OK) else ("permission", "may not be read by this user")


def _relative(path: str, root: Path) -> str:
    return plain_line(os.path.relpath(path, root), 300)


ANY_SIZE = MeshLimits(min_size_m=1e-12, max_size_m=1e12)
"""Sizes are judged when the unit is known."""

SMALLEST, LARGEST = MeshLimits().min_size_m, MeshLimits().max_size_m

DONE: Mapping[Kind, str] = {"names": "URDFs read", "list": "files listed", "measure": "meshes read"}
"""What progress says."""

Watch = Callable[[str, int, int], None]


def read_folder(folder: Path, categories: Mapping[str, str], watch: Watch) -> Reading:
    """What every file is, in the order given, by its path below the folder with its category; `folder` is resolved."""
    source = FolderSource(source="urdf", folder=str(folder))
    request = Request(source, folder, Assets(limits=ANY_SIZE), ())

    def ask(kind: Kind, entries: Mapping[str, Entry | None]) -> Iterator[tuple[str, bytes | MeshError]]:
        tasks = tuple(Task(kind, folder / path, categories[path], entry) for path, entry in entries.items())
        answers = ask_all(replace(request, tasks=tasks), partial(watch, DONE[kind]))
        return zip(entries, (answer for _, answer in answers), strict=True)

    parts: dict[str, str] = {}
    for urdf, answer in ask("names", {path: None for path in categories if path.lower().endswith(URDF)}):
        for part in [] if isinstance(answer, MeshError) else json.loads(answer):
            parts.setdefault(part, urdf)
    entries, items, refused = dict[str, Entry | None](), list[Item](), list[LeftOut]()
    digests: dict[str, str] = {}
    for path, answer in ask("list", {path: None for path in categories if path not in parts}):
        if isinstance(answer, MeshError):
            refused.append(_refusal(path, folder, answer))
        else:
            files = tuple(SourceFile(*file) for file in json.loads(answer))
            entries[path] = Entry("", files, "")
            digests[path] = hashlib.sha256("".join(file.sha256 for file in files).encode()).hexdigest()
    for path, answer in ask("measure", entries):
        if isinstance(answer, MeshError):
            refused.append(_refusal(path, folder, answer))
        else:
            items.append(Item(path, categories[path], read_measured(answer), digests[path]))
    kept, doubled = drop_doubles(items)
    left_out = [LeftOut(path, PART, f"is a part of {urdf}") for path, urdf in parts.items()]
    return Reading(tuple(kept), (*refused, *left_out, *doubled), frozenset(one.path for one in refused))


def _refusal(path: str, folder: Path, error: MeshError) -> LeftOut:
    why = error.detail.replace(f"{folder}/", "").removeprefix(path).lstrip(": ")
    return LeftOut(path, error.reason, plain_line(why, 300))


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
