"""Edge: lists the files of a folder that may be objects, and the 3-D files in formats that are not read."""

import os
from dataclasses import dataclass
from pathlib import Path

from schemas.errors import AssetSourceError
from schemas.plain_line import plain_line
from services.init.model import LeftOut

SUFFIXES = (".urdf", ".glb", ".gltf", ".obj", ".ply", ".stl")
"""What is read; of one mesh in several formats, the first."""

FOREIGN = (
    *(".dae", ".fbx", ".blend", ".3ds", ".usd", ".usda", ".usdc", ".usdz", ".off", ".3mf", ".x3d", ".wrl"),
    *(".step", ".stp", ".iges", ".igs", ".max", ".mb", ".abc", ".c4d"),
)
"""3-D files that are not read."""

MOST_FILES = 100_000
"""More files are no folder of meshes that a person looks at."""


@dataclass(frozen=True)
class Walk:
    """Paths below the folder of files that may be objects, in order, and what was left out already."""

    paths: tuple[str, ...]
    left_out: tuple[LeftOut, ...]


def walk_folder(folder: Path) -> Walk:
    """Every mesh and URDF below the folder, hidden names left aside. Links to folders are not followed.

    Raises AssetSourceError where the folder is none, cannot be listed, or has nothing that looks like a mesh.
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
            shown = _relative(str(path), root)
            why = _unusable(path, root)
            if why is not None:
                left_out.append(LeftOut(shown, *why))
            else:
                paths[path.resolve().relative_to(root).as_posix()] = None
        if len(paths) + len(left_out) > MOST_FILES:
            raise AssetSourceError(f"{name} has over {MOST_FILES} meshes: name a smaller folder")
    if not paths and not left_out:
        what = "is empty" if empty else f"has no mesh ({', '.join(SUFFIXES)})"
        raise AssetSourceError(f"{name} {what}: name a folder that has some")
    return Walk(tuple(sorted(paths)), tuple(left_out))


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
