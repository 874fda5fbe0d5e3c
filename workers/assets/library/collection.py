"""Edge: the files of a folder that may be objects: found, and read in limited processes, each once for ever."""

import hashlib
import json
import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from schemas.errors import AssetSourceError, MeshError, plain_line
from schemas.job.assets import MeshLimits
from workers.assets.library.copies import COPY, LeftOut
from workers.assets.library.placement import Measured, read_measured
from workers.assets.library.reading import Question, ask, digest_of
from workers.assets.library.table import UNKNOWN, SourceFile
from workers.door.meshes.formats import FORMATS
from workers.door.meshes.urdf import POSED
from workers.door.opening import as_utf8
from workers.pool import Answers

SUFFIXES = (*POSED, *FORMATS)
"""What is read; of one mesh in several formats, the first."""

_REMEDIES = {
    "run `assimp export FILE FILE.glb`, or use Blender": ".fbx .3ds .3mf .x3d .wrl .lwo",
    "export it as .glb, such as by Blender": ".blend .usd .usda .usdc .usdz .abc",
    "export it as .glb by the program that wrote it": ".max .mb .ma .c4d .skp",
    "export it as .stl by a CAD program": ".step .stp .iges .igs .fcstd .sldprt",
    "it has points and no faces, so make a mesh of it": ".pcd .las .laz .xyz .e57 .splat .spz",
    "run `draco_decoder -i FILE -o FILE.ply`": ".drc",
    "run `ctmconv FILE FILE.ply`": ".ctm",
    "it is a GLB, so copy it under a name that ends in .glb": ".vrm",
    "arrays say not which are a mesh, so write it as .ply": ".npz",
    "unpack it": ".zip .tar .gz .tgz .bz2 .xz .7z .rar",
    "run `xacro FILE > FILE.urdf`": ".xacro",
}
FOREIGN: Mapping[str, str] = {suffix: remedy for remedy, suffixes in _REMEDIES.items() for suffix in suffixes.split()}
"""Other files that may hold objects, and what to do with them."""


def walk_folder(folder: Path) -> tuple[list[str], list[LeftOut]]:
    """Paths of every mesh and URDF below the folder, in order, and what was left out already; hidden names are left aside.

    Links to folders are not followed; of links to one file the first is kept, or the file itself. AssetSourceError where the
    folder is none, cannot be listed, or has no mesh.
    """
    name = plain_line(str(folder), 300)
    if not folder.is_dir():
        what = "is a file: name the folder that it lies in" if folder.exists() else "there is no such folder"
        raise AssetSourceError(f"{name}: {what}")
    try:
        empty = not any(folder.iterdir())
    except OSError as error:
        raise AssetSourceError(f"{name} cannot be listed: {error.strerror}") from error
    root, paths, left_out = folder.resolve(), dict[str, str](), list[LeftOut]()

    def cannot_list(error: OSError) -> None:
        left_out.append(LeftOut(_relative(error.filename, root), "permission", f"cannot be listed: {error.strerror}"))

    for parent, folders, files in os.walk(root, onerror=cannot_list):
        folders[:] = sorted(one for one in folders if not one.startswith((".", "__MACOSX")))
        links = [Path(parent, one) for one in folders if os.path.islink(Path(parent, one))]
        left_out += [LeftOut(_relative(str(p), root), "link", OUTSIDE) for p in links if not _is_inside(p, root)]
        current = _current_version(Path(parent, "model.config"), files)
        for file in sorted(files):
            suffix = os.path.splitext(file)[1].lower()
            if file.startswith(".") or suffix not in (*SUFFIXES, *FOREIGN):
                continue
            path = Path(parent, file)
            if suffix == ".xml" and not _is_mjcf(path):
                continue
            if (why := _unusable(path, root)) is not None:
                left_out.append(LeftOut(_relative(str(path), root), *why))
            elif current is not None and suffix == ".sdf" and file != current:
                left_out.append(
                    LeftOut(_relative(str(path), root), COPY, f"other version of {current}, by model.config")
                )
            else:
                paths[path.relative_to(root).as_posix()] = path.resolve().relative_to(root).as_posix()
    if not paths and not left_out:
        what = "is empty" if empty else f"has no mesh ({', '.join(SUFFIXES)})"
        raise AssetSourceError(f"{name} {what}: name a folder that has some")
    first = {target: path for path, target in sorted(paths.items(), reverse=True)}
    return sorted({target if target in paths else first[target] for target in paths.values()}), left_out


_VERSION = re.compile(rb"<sdf(?:\s+version\s*=\s*[\"']([\d.]+)[\"'])?\s*>\s*([^<]+?)\s*</sdf>")


def _current_version(config: Path, files: Sequence[str]) -> str | None:
    """Of the files beside a Gazebo model's `model.config`, the one that it names for the newest version; None without any."""
    if config.name not in files:
        return None
    with suppress(OSError), config.open("rb") as stream:
        text = re.sub(rb"<!--.*?-->", b"", as_utf8(stream.read(1 << 16))[0], flags=re.DOTALL)
        named = [(version.split(b"."), name.decode()) for version, name in _VERSION.findall(text)]
        known = [([int(part or 0) for part in version], name) for version, name in named if name in files]
        return max(known, default=(None, None))[1]
    return None


def _is_mjcf(path: Path) -> bool:
    """Whether an XML file is one of MuJoCo's: others are of no concern."""
    try:
        with path.open("rb") as stream:
            return b"<mujoco" in as_utf8(stream.read(1 << 16))[0]
    except OSError:
        return False


def _unusable(path: Path, root: Path) -> tuple[str, str] | None:
    """Why a file is left out before it is opened: in a word, and in a sentence."""
    if path.suffix.lower() in FOREIGN:
        return "format", f"{path.suffix.lower()} is not read: {FOREIGN[path.suffix.lower()]}"
    if not str(path.relative_to(root)).isprintable():
        return "name", "its name is not printable UTF-8: rename it"
    if not _is_inside(path, root):
        return "link", OUTSIDE
    if not path.is_file():
        return "missing", "is no file, or a link to nothing"
    return None if os.access(path, os.R_OK) else ("permission", "may not be read by this user")


OUTSIDE = "leads out of the folder: `cp -rL` copies a folder with what its links name"


def _is_inside(path: Path, root: Path) -> bool:
    return path.resolve().is_relative_to(root)


def _relative(path: str, root: Path) -> str:
    return plain_line(os.path.relpath(path, root), 300)


DONE = "meshes read"
"""What progress says."""

Watch = Callable[[str, int, int], None]
"""Is told what is being done, and with how many of how many files."""


def ignore(what: str, done: int, asked: int) -> None:
    """A watch that says nothing."""


@dataclass(frozen=True)
class Survey:
    """What a candidate is: its files, the meshes that it names, and its measures, or why it cannot be used."""

    path: str
    files: tuple[SourceFile, ...]
    named: tuple[str, ...]
    measured: Measured | None
    refused: tuple[str, str] = ("", "")

    @property
    def digest(self) -> str:
        """Of its files' bytes."""
        return hashlib.sha256("".join(file.sha256 for file in self.files).encode()).hexdigest()


def survey_folder(folder: Path, paths: Sequence[str], limits: MeshLimits, kept: Answers, watch: Watch) -> list[Survey]:
    """What every candidate is, in the order given; `folder` is resolved. What `kept` has of unchanged files is not asked again.

    Raises AssetSourceError where a file changes meanwhile.
    """
    names = hashlib.sha256("\n".join(_all_files(folder)).encode(errors="surrogateescape")).hexdigest()[:16]
    surveys = dict[str, Survey]()
    for path in paths:
        message = kept.get(_key(folder, path, limits))
        if message is not None and (survey := _still_true(folder, path, json.loads(message), names)) is not None:
            surveys[path] = survey
    questions = [Question(folder, path, limits) for path in paths if path not in surveys]
    for done, (question, answer) in enumerate(ask(questions, limits), 1):
        path = question.path
        if isinstance(answer, MeshError):
            if answer.kind == "environmental":
                raise AssetSourceError(answer.detail)
            answer = json.dumps(
                {"files": [], "named": [], "refused": [answer.reason, answer.detail, answer.kind]}
            ).encode()
        tree = json.loads(answer)
        if "refused" in tree and tree["refused"][2] == "environmental":
            raise AssetSourceError(tree["refused"][1])
        surveys[path] = _survey(folder, path, tree)
        kept.put(_key(folder, path, limits), json.dumps({**tree, "names": names}).encode())
        watch(DONE, done, len(questions))
    return [surveys[path] for path in paths]


def _key(folder: Path, path: str, limits: MeshLimits) -> str:
    return f"{folder}/{path} {limits.model_dump_json(exclude_defaults=True)}"


def _still_true(folder: Path, path: str, tree: dict[str, Any], names: str) -> Survey | None:
    """A kept survey whose files are as they were: by size and time or, where those moved, by their bytes.

    One that misses a file is true as long as no file came or went.
    """
    survey = _survey(folder, path, tree)
    notes = (survey.refused[1],) if survey.measured is None else survey.measured.notes
    if not survey.files or (tree["names"] != names and any("missing" in note for note in notes)):
        return None
    files = []
    for file in survey.files:
        try:
            stat = (folder / file.path).stat()
            if stat.st_size != file.bytes:
                return None
            if stat.st_mtime_ns != file.mtime_ns and digest_of(folder / file.path) != file.sha256:
                return None
        except OSError:
            return None
        files.append(replace(file, mtime_ns=stat.st_mtime_ns))
    return replace(survey, files=tuple(files))


def _survey(folder: Path, path: str, tree: dict[str, Any]) -> Survey:
    files = tuple(SourceFile(*file) for file in tree["files"])
    if "refused" in tree:
        reason, detail, _ = tree["refused"]
        why = plain_line(detail.replace(f"{folder}/", "").removeprefix(path).lstrip(": "), 1000)
        return Survey(path, files, (), None, (reason, why))
    return Survey(path, files, tuple(tree["named"]), read_measured(tree["measured"]))


def _all_files(folder: Path) -> list[str]:
    return sorted(
        os.path.relpath(os.path.join(parent, file), folder) for parent, _, files in os.walk(folder) for file in files
    )


def list_licences(folder: Path) -> list[Path]:
    """The licence files below a folder."""
    return sorted(path for path in folder.rglob("*") if path.stem.lower() in ("license", "licence", "copying"))


def find_licence(path: Path, folder: Path, licences: Collection[Path]) -> str:
    """The nearest licence file from the mesh's folder up to the source's."""
    nearest = (file for parent in path.parents for file in licences if file.parent == parent)
    file = next(nearest, None)
    return UNKNOWN if file is None else f"see {file.relative_to(folder).as_posix()}"
