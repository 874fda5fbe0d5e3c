"""Edge: the instances that a folder of files offers, with the SHA-256 of every file."""

import hashlib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from schemas.errors import MeshError
from schemas.job.assets import FolderSource, MeshLimits, ShapeNetSource, UpAxis
from workers.assets.external.reading import list_mesh_files
from workers.assets.external.urdf_file import find_mesh, mesh_names, parse_urdf

UNKNOWN = "unknown"
"""The licence of a source whose user states none."""


@dataclass(frozen=True)
class SourceFile:
    """A file as it was when the catalogue was opened: path relative to the source's folder, bytes, SHA-256."""

    path: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Entry:
    """One instance of a source of files. `files`: the mesh or URDF first, then every file that it refers to."""

    instance_id: str
    files: tuple[SourceFile, ...]
    licence: str


@dataclass(frozen=True)
class Listing:
    """What a source of files offers: entries by category in a fixed order.

    refused: the numbers of entries whose content cannot be used, by category: they are never drawn, and their places stay,
    so that leaving them out moves no other draw. skipped: how many candidates are refused or could not be listed, by reason;
    examples: a sentence on the first of them. doubts: by path, the axis on which alone a file stands where `up` names another.
    """

    folder: Path
    entries: Mapping[str, tuple[Entry, ...]]
    skipped: Mapping[str, int] = field(default_factory=dict)
    refused: Mapping[str, frozenset[int]] = field(default_factory=dict)
    examples: tuple[str, ...] = ()
    doubts: Mapping[str, UpAxis] = field(default_factory=dict)

    def count(self, category: str) -> int:
        """How many entries of a category can be used."""
        return len(self.entries.get(category, ())) - len(self.refused.get(category, ()))


def list_files(
    settings: ShapeNetSource | FolderSource, folder: Path, path: Path, limits: MeshLimits
) -> tuple[Path, ...]:
    """A candidate and every file that it refers to, each once; MeshError where one of them, or all together, is refused."""
    if path.suffix.lower() == ".urdf":
        meshes = dict.fromkeys(find_mesh(name, path, folder) for name in mesh_names(parse_urdf(path, limits)))
        files = [path, *(file for mesh in meshes for file in list_mesh_files(mesh, folder, limits))]
    else:
        files = list_mesh_files(path, mesh_root(settings, folder, path), limits)
    files = list(dict.fromkeys(files))
    size, cap = sum(file.stat().st_size for file in files), limits.max_asset_mb
    if size > cap * 1e6:
        raise MeshError("too_large", f"{path} and its files have {size / 1e6:.1f} MB, over max_asset_mb = {cap:g}")
    for file in files:
        if not str(file).isprintable():
            raise MeshError("name", f"{file!s:.200} has a name that is not printable UTF-8, so no table can hold it")
    return tuple(files)


def mesh_root(settings: ShapeNetSource | FolderSource, folder: Path, mesh: Path) -> Path:
    """The folder that a mesh's material files and textures must lie in: its model's in ShapeNetCore."""
    if isinstance(settings, FolderSource):
        return folder
    return mesh.parent.parent if mesh.parent.name == "models" else mesh.parent


def instance_id_of(settings: ShapeNetSource | FolderSource, file: SourceFile) -> str:
    """Synset and model in ShapeNetCore; else the path as one word and eight digits of a digest of file and settings."""
    if isinstance(settings, ShapeNetSource):
        return "-".join(Path(file.path).parts[:2])
    stem = str(Path(file.path).with_suffix(""))
    word = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "-" for c in stem)
    how = (file.path, file.sha256, settings.up_of(file.path), settings.scale, settings.diagonal_m)
    return f"{word}-{hashlib.sha256(repr(how).encode()).hexdigest()[:8]}"


def hash_files(paths: Iterable[Path], folder: Path) -> tuple[SourceFile, ...]:
    """The files with their sizes and digests, in the order given; reads every byte, at about 800 MB/s from cache."""
    return tuple(SourceFile(p.relative_to(folder).as_posix(), p.stat().st_size, _sha256(p)) for p in paths)


def check_unchanged(folder: Path, entry: Entry) -> None:
    """MeshError `missing` or `changed` where a file of the entry is not what it was when the catalogue was opened.

    Both are environmental: the job and its seed are not to blame, and the scene may be tried again.
    """
    for file in entry.files:
        path = folder / file.path
        try:
            digest = _sha256(path)
        except OSError as error:
            raise _environmental("missing", f"{path} cannot be read: {error.strerror}") from error
        if digest != file.sha256:
            raise _environmental("changed", f"{path} has changed since the job was started")


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _environmental(reason: str, detail: str) -> MeshError:
    error = MeshError(reason, detail)
    error.kind = "environmental"
    return error


def describe_folder(folder: Path, most: int = 5) -> str:
    """The first names in a folder, for a message."""
    names = sorted(path.name + ("/" if path.is_dir() else "") for path in folder.iterdir())
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(names[:most]) + more) if names else "nothing"


def list_licences(folder: Path) -> list[Path]:
    """The licence files below a folder."""
    return sorted(path for path in folder.rglob("*") if path.stem.lower() in ("license", "licence", "copying"))


def find_licence(path: Path, folder: Path, stated: str, licences: Collection[Path]) -> str:
    """The stated licence; where none is stated, the nearest licence file from the mesh's folder up to the source's."""
    nearest = (file for parent in path.parents for file in licences if file.parent == parent)
    if stated == UNKNOWN and (file := next(nearest, None)) is not None:
        return f"see {file.relative_to(folder).as_posix()}"
    return stated
