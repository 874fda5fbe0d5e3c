"""Edge: the files of a folder that may be objects: found, read in limited processes, doubles and parts left out."""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from schemas.errors import AssetSourceError, MeshError, plain_line
from schemas.job.assets import Assets, FolderSource, MeshLimits
from services.init.copies import COPY, PART, Item, LeftOut, Reading, find_copies
from workers.assets.external.listing import Entry, SourceFile
from workers.assets.external.placement import read_measured
from workers.assets.external.reader import Kind, Request, Task, ask_all
from workers.door.meshes.formats import FORMATS
from workers.door.meshes.urdf import POSED

SUFFIXES = (*POSED, *FORMATS)
"""What is read; of one mesh in several formats, the first."""

_REMEDIES = {
    "run `assimp export FILE FILE.glb`, or use Blender": ".fbx .3ds .3mf .x3d .wrl .lwo",
    "export it as .glb, such as by Blender": ".blend .usd .usda .usdc .usdz .abc",
    "export it as .glb by the program that wrote it": ".max .mb .ma .c4d .skp",
    "export it as .stl by a CAD program": ".step .stp .iges .igs .fcstd .sldprt",
    "it has points and no faces, so make a mesh of it": ".pcd .las .laz .xyz .e57 .splat .spz",
    "unpack it": ".zip .tar .gz .tgz .bz2 .xz .7z .rar",
    "run `xacro FILE > FILE.urdf`": ".xacro",
}
FOREIGN: Mapping[str, str] = {suffix: remedy for remedy, suffixes in _REMEDIES.items() for suffix in suffixes.split()}
"""Other files that may hold objects, and what to do with them."""

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
            if suffix == ".xml" and not _is_mjcf(path):
                continue
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


def _is_mjcf(path: Path) -> bool:
    """Whether an XML file is one of MuJoCo's: others are of no concern."""
    try:
        with path.open("rb") as stream:
            return b"<mujoco" in stream.read(1 << 16)
    except OSError:
        return False


def _unusable(path: Path, root: Path) -> tuple[str, str] | None:
    """Why a file is left out before it is opened: in a word, and in a sentence."""
    if path.suffix.lower() in FOREIGN:
        return "format", f"{path.suffix.lower()} is not read: {FOREIGN[path.suffix.lower()]}"
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

DONE: Mapping[Kind, str] = {"names": "models read", "list": "files listed", "measure": "meshes read"}
"""What progress says."""

Watch = Callable[[str, int, int], None]


def read_folder(folder: Path, paths: Sequence[str], watch: Watch, beside: Sequence[str] = ()) -> Reading:
    """What every file is, by its path below the folder, in the order given; `folder` is resolved.

    `beside`: meshes that are not read, of which others may be copies.
    """
    request = Request(FolderSource(source="files", folder=str(folder)), folder, Assets(limits=ANY_SIZE), ())

    def ask(kind: Kind, entries: Mapping[str, Entry | None]) -> Iterator[tuple[str, bytes | MeshError]]:
        tasks = tuple(Task(kind, folder / path, "", entry) for path, entry in entries.items())
        answers = ask_all(replace(request, tasks=tasks), partial(watch, DONE[kind]))
        return zip(entries, (answer for _, answer in answers), strict=True)

    left_out, known = dict[str, LeftOut](), set(paths)
    for posed, answer in ask("names", {path: None for path in paths if path.lower().endswith(tuple(POSED))}):
        for part in known & set([] if isinstance(answer, MeshError) else json.loads(answer)):
            left_out.setdefault(part, LeftOut(part, PART, f"part of {posed}"))
    copies = find_copies(paths, [*paths, *beside])
    left_out = {path: LeftOut(path, COPY, why) for path, why in copies.items()} | left_out
    entries, items, refused = dict[str, Entry | None](), list[Item](), list[LeftOut]()
    digests: dict[str, str] = {}
    for path, answer in ask("list", {path: None for path in paths if path not in left_out}):
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
            items.append(Item(path, read_measured(answer), digests[path]))
    return Reading(tuple(items), (*refused, *left_out.values()), frozenset(one.path for one in refused))


def _refusal(path: str, folder: Path, error: MeshError) -> LeftOut:
    why = error.detail.replace(f"{folder}/", "").removeprefix(path).lstrip(": ")
    return LeftOut(path, error.reason, plain_line(why, 1000))
