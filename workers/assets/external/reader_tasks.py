"""What the process that reads files from outside is asked: to list an asset's files, to check it, to load it."""

import errno
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter
from scipy.spatial import QhullError

from schemas.errors import MeshError
from schemas.job.assets import TABLE, Assets, FolderSource, ShapeNetSource
from schemas.scene.shape import Asset, Hull
from workers.assets.external.answers import Answer
from workers.assets.external.asset_bytes import pack_asset
from workers.assets.external.caps import describe_error, one_line
from workers.assets.external.listing import Entry, SourceFile, hash_files, list_files
from workers.assets.external.placement import find_doubt, load_entry, measure_asset
from workers.assets.external.urdf import all_mesh_names, find_mesh, parse_urdf
from workers.geometry.hull import convex_hull

ANSWER, REFUSAL = b"+", b"-"
"""The kinds of answers."""

Kind = Literal["list", "check", "load", "measure", "names"]

_SETTINGS: TypeAdapter[ShapeNetSource | FolderSource] = TypeAdapter(ShapeNetSource | FolderSource)


@dataclass(frozen=True)
class Task:
    """One question about one asset of a source.

    By the `path` of its first file: `list`, all its files; `names`, what a URDF refers to. By an `entry`: `check`, whether it
    can be used; `load`, all of it; `measure`, what a person asks about it.
    """

    kind: Kind
    path: Path
    category: str = ""
    entry: Entry | None = None


@dataclass(frozen=True)
class Request:
    """Tasks about one source, whose folder is `folder`; `assets` has the limits and the densities."""

    settings: ShapeNetSource | FolderSource
    folder: Path
    assets: Assets
    tasks: tuple[Task, ...]


def encode_request(request: Request) -> bytes:
    """The request as JSON, with the limits that the process sets."""
    limits = request.assets.limits
    tasks = [{**asdict(task), "path": str(task.path)} for task in request.tasks]
    tree = {
        "memory_mb": limits.max_memory_mb,
        "cpu_s": limits.max_cpu_s,
        "settings": request.settings.model_dump(mode="json"),
        "folder": str(request.folder),
        "assets": Assets(
            limits=limits, density_kg_m3=request.assets.density_kg_m3, shell_kg_m2=request.assets.shell_kg_m2
        ).model_dump(mode="json"),
        "tasks": tasks,
    }
    return json.dumps(tree).encode()


def open_request(tree: dict[str, Any]) -> Request:
    """The request of `encode_request`'s JSON."""
    tasks = []
    for task in tree["tasks"]:
        entry = task["entry"]
        if entry is not None:
            entry = Entry(entry["instance_id"], tuple(SourceFile(**file) for file in entry["files"]), entry["licence"])
        tasks.append(Task(task["kind"], Path(task["path"]), task["category"], entry))
    settings = _SETTINGS.validate_python(tree["settings"])
    return Request(settings, Path(tree["folder"]), Assets.model_validate(tree["assets"]), tuple(tasks))


def answer_task(request: Request, number: int) -> Answer:
    """`ANSWER` with what was asked for, or `REFUSAL` with reason, detail and kind as JSON. Raises MemoryError alone."""
    task = request.tasks[number]
    try:
        return ANSWER, _answer(request, task)
    except MeshError as error:
        return _refusal(error, task.path)
    except MemoryError:
        raise
    except OSError as error:
        if error.errno in (errno.ENOMEM, errno.EFBIG):
            raise MemoryError from error
        return _refusal(MeshError("unreadable", f"{task.path} cannot be read: {describe_error(error)}"), task.path)
    except Exception as error:  # whatever a stranger's bytes made a library raise, it is they that are refused
        return _refusal(MeshError("unreadable", f"{task.path} cannot be read: {describe_error(error)}"), task.path)


def _refusal(error: MeshError, path: Path) -> Answer:
    """The refusal, which names the file."""
    detail = error.detail if path.name in error.detail else f"{path}: {error.detail}"
    return REFUSAL, [json.dumps([error.reason, one_line(detail), error.kind]).encode()]


def _answer(request: Request, task: Task) -> Sequence[bytes | memoryview]:
    if task.kind == "list":
        files = hash_files(
            list_files(request.settings, request.folder, task.path, request.assets.limits), request.folder
        )
        return [json.dumps([[file.path, file.size, file.sha256] for file in files]).encode()]
    if task.kind == "names":
        named = [file.relative_to(request.folder).as_posix() for file in named_files(task.path, request)]
        return [json.dumps(named).encode()]
    assert task.entry is not None
    asset = load_entry(request.settings, request.folder, task.entry, task.category, request.assets)
    if task.kind == "load":
        return pack_asset(asset)
    hull = check_fit(asset, task.path)
    if task.kind == "measure":
        return [measure_asset(asset, hull).encode()]
    doubt = None if hull is None else find_doubt(asset, request.settings, hull.vertices)
    return [(doubt or "").encode()]


def named_files(urdf: Path, request: Request) -> list[Path]:
    """The meshes below the folder that a URDF names, for what is seen and for what collides. MeshError as parse_urdf."""
    found = []
    for name in all_mesh_names(parse_urdf(urdf, request.assets.limits)):
        with suppress(MeshError):
            found.append(find_mesh(name, urdf, request.folder))
    return found


def check_fit(asset: Asset, path: Path) -> Hull | None:
    """The convex hull, which is what an object collides and is placed by; None for a table. MeshError `no_hull`."""
    if asset.category == TABLE:
        return None
    try:
        return convex_hull(asset.shape.vertices)
    except (QhullError, ValueError) as error:
        raise MeshError("no_hull", f"{path} is no body: it needs four points apart that are not in a line") from error
