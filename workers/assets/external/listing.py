"""Edge: which files a source offers, and their SHA-256: a folder with a map from file patterns to categories, or ShapeNetCore.

ShapeNetCore is a user's own copy, version 1 or 2 (dataset.md section 1, "ShapeNet").
"""

import hashlib
import importlib.util
import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from schemas.errors import AssetSourceError, MeshError
from schemas.job.assets import BUILT_IN, TABLE, FolderSource, ShapeNetSource, UpAxis, matches

UNKNOWN = "unknown"
"""The licence of a source whose user states none."""

Watch = Callable[[str, int, int], None]
"""Is told what is being done, and with how many of how many files."""


def ignore(what: str, done: int, asked: int) -> None:
    """A watch that says nothing."""


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


HEAD_BYTES = 4096
"""Bytes of a file that are looked at for what it really is, or for a remark on its unit."""

_OTHER = (
    (
        re.compile(rb"version https://git-lfs"),
        "missing",
        "is a Git LFS pointer and not the file: run `git lfs pull` there",
    ),
    (re.compile(rb"\s*<(!doctype html|html|head)\b", re.I), "format", "is a web page: download the file itself"),
    (re.compile(rb"PK\x03\x04|\x1f\x8b|7z\xbc\xaf|Rar!"), "format", "is an archive: unpack it"),
    (
        re.compile(rb"glTF\x01\0\0\0"),
        "format",
        "is a glTF of version 1: open it in Blender or gltf-pipeline and write version 2",
    ),
    (
        re.compile(rb"ply\s(?!.*\belement +(?:face|tristrips)\b).*property +float +f_dc_0.*end_header", re.S),
        "no_faces",
        "holds Gaussian splats, a point cloud without faces: make a mesh of it",
    ),
    (
        re.compile(rb"ply\s(?!.*\belement +(?:face|tristrips)\b).*end_header", re.S),
        "no_faces",
        "is a point cloud without faces: make a mesh of it, such as by MeshLab's screened Poisson reconstruction",
    ),
)
"""What a file may be under the name of a mesh, by its first bytes: the reason, and the sentence with the remedy."""


def refuse_other(path: Path) -> None:
    """MeshError for a file that is something else than its name says: empty, a pointer, a web page, points, ..."""
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES)
    except OSError:
        return  # whoever reads it says why
    if not head:
        raise MeshError("no_faces", f"{path} is empty: copy or download it again")
    for pattern, reason, why in _OTHER:
        if pattern.match(head):
            raise MeshError(reason, f"{path} {why}")


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


PYBULLET_DATA = "pybullet_data"
PYBULLET_MAP: Mapping[str, str] = {
    "objects/mug.urdf": "mug",
    "table/table.urdf": TABLE,
    "table_square/table_square.urdf": TABLE,
    "random_urdfs/*/*.urdf": "box",
}
"""The category of each mesh inside the pybullet_data package that has one."""


def locate_folder(name: str, job_folder: Path) -> Path:
    """The folder of a source: relative to the job file, or that of the installed package pybullet_data, not imported."""
    if name == PYBULLET_DATA and not (job_folder / name).is_dir():
        spec = importlib.util.find_spec(PYBULLET_DATA)
        if spec is None or not spec.submodule_search_locations:
            raise AssetSourceError("the package pybullet_data is not installed: `pip install pybullet` brings it")
        return Path(spec.submodule_search_locations[0]).resolve()
    try:
        return (job_folder / Path(name).expanduser()).resolve()
    except RuntimeError as error:
        raise AssetSourceError(f"{name}: there is no such user, or no home folder") from error


def find_files(
    settings: FolderSource, job_folder: Path, categories: Collection[str]
) -> tuple[Path, dict[str, list[Path]]]:
    """The source's folder, and every file that the map names by category, of the categories asked for.

    Raises AssetSourceError where map or folder cannot be used.
    """
    folder = locate_folder(settings.folder, job_folder)
    if not folder.is_dir():
        remedy = f"Set `folder` of the source to one, or to `{PYBULLET_DATA}`."
        raise AssetSourceError(f"{folder} is not a folder. {remedy}")
    category_map = settings.category_map or (PYBULLET_MAP if settings.folder == PYBULLET_DATA else {})
    if not category_map:
        raise AssetSourceError(
            f'{folder} needs a `category_map`, such as {{"mugs/*.obj": mug}}: nothing says what its files are. '
            f"It has {describe_folder(folder)}."
        )
    matched = _match_files(category_map, folder)
    _check_up(settings, folder, matched)
    found: dict[str, list[Path]] = {name: [] for name in sorted(set(category_map.values()) & set(categories))}
    for path, category in sorted(matched.items()):
        if category in found:
            found[category].append(path)
    return folder, found


def _match_files(category_map: Mapping[str, str], folder: Path) -> dict[Path, str]:
    """The category of every file inside the folder that a pattern finds; the first pattern wins."""
    found: dict[Path, str] = {}
    for pattern, category in category_map.items():
        try:
            # From Python 3.13 on, `**` at the end finds files too.
            named = [path for path in folder.glob(pattern) if matches(path.relative_to(folder).as_posix(), pattern)]
            paths = [path.resolve() for path in named if path.is_file()]
        except (ValueError, NotImplementedError) as error:
            raise AssetSourceError(f"category_map: {pattern!r} is not a pattern below the folder: {error}") from error
        found |= {path: found.get(path, category) for path in paths if path.is_relative_to(folder)}
    return found


def _check_up(settings: FolderSource, folder: Path, files: Iterable[Path]) -> None:
    """AssetSourceError for a pattern of `up` that finds none of the files: it is most likely misspelt."""
    names = [path.relative_to(folder).as_posix() for path in files]
    for pattern in () if isinstance(settings.up, str) else settings.up:
        if not any(matches(name, pattern) for name in names):
            such = ", ".join(names[:3])
            raise AssetSourceError(f"up: {pattern!r} finds none of the {len(names)} files of {folder} (such as {such})")


_MESHES = ("models/model_normalized.obj", "model.obj")
"""Where the mesh lies in a model's folder: version 2, version 1."""


def find_models(
    settings: ShapeNetSource, job_folder: Path, categories: Collection[str]
) -> tuple[Path, dict[str, list[Path]]]:
    """The source's folder, and the mesh of every model by category, of the categories that ShapeNetCore has.

    Raises AssetSourceError where the folder is not ShapeNetCore's.
    """
    folder = locate_folder(settings.folder, job_folder)
    if not folder.is_dir():
        raise AssetSourceError(
            f"{folder} is not a folder. Set `folder` of the shapenet source to your copy of ShapeNetCore: the folder "
            "that holds synset folders such as 03797390."
        )
    synsets = {category: BUILT_IN[category].synset for category in sorted(categories) if category in BUILT_IN}
    wanted = {category: folder / synset for category, synset in synsets.items() if synset is not None}
    if wanted and not any(synset.is_dir() for synset in wanted.values()):
        names = ", ".join(f"{synset.name} ({category})" for category, synset in wanted.items())
        raise AssetSourceError(f"{folder} has none of the synset folders {names}; it has {describe_folder(folder)}.")
    return folder, {
        category: [_find_mesh(p) for p in sorted(synset.iterdir()) if p.is_dir()] if synset.is_dir() else []
        for category, synset in wanted.items()
    }


def _find_mesh(model: Path) -> Path:
    """The mesh of a model; a path that does not exist where it has none, so that it is counted as missing."""
    return next((model / name for name in _MESHES if (model / name).is_file()), model / _MESHES[-1])
