"""Edge: what is asked about a file from outside, in limited processes: what it is, and its shape as a clean GLB.

An answer is JSON, or a GLB of this project's own, and never a pickle: it comes from a process that has read a stranger's file.
"""

import errno
import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import QhullError

from schemas.base import Array, frozen_array
from schemas.errors import MachineError, MeshError, plain_line
from schemas.job.assets import TABLE, USUAL_DENSITY, Assets, MeshLimits
from schemas.scene.shape import Asset, Shape
from workers.assets.glb import asset_glb
from workers.assets.library.placement import INFO_FILE, measure_shape, measure_thinness
from workers.assets.library.table import Row, SourceFile
from workers.assets.mass import weigh
from workers.door.meshes.formats import FORMATS, list_mesh_files, load_shape
from workers.door.meshes.mesh import LoadedMesh, transform_shape
from workers.door.meshes.raw import LONGEST_NOTE, MOST_NOTES, find_inside
from workers.door.meshes.urdf import POSED, list_named, list_seen, load_posed
from workers.door.opening import describe_error
from workers.geometry.frames import pose
from workers.geometry.hull import convex_hull
from workers.pool import Ended, Limits, Pool

UP_AXES: Mapping[str, Array] = {
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
"""The rotation [3, 3] that takes a file's upward axis to z."""

THINNEST = 1e-5
"""Least extent, by its diagonal, below which a shape has no thickness."""

USUAL = Assets()
"""Its densities are those at which a library states masses."""


@dataclass(frozen=True)
class Question:
    """A candidate below `folder`: what it is or, with a `row`, its GLB."""

    folder: Path
    path: str
    limits: MeshLimits
    row: Row | None = None


BATCH = 32
"""Questions that one process answers: a new one costs some milliseconds."""

REFUSAL = b"-"
"""Begins the answer of a file that is refused, before its reason, detail and kind as JSON."""


def ask(questions: Iterable[Question], limits: MeshLimits) -> Iterator[tuple[Question, bytes | MeshError]]:
    """Questions with their answers, as they come, or why a file is refused.

    Raises MachineError where no process can be started, or one was killed from outside.
    """
    bounds = Limits(memory_mb=limits.max_memory_mb, cpu_s=limits.max_cpu_s)
    with Pool(answer, limits=bounds, batch=BATCH) as pool:
        for question, message in pool.run(questions):
            if isinstance(message, Ended):
                yield question, _refuse_end(message, question)
            elif message.startswith(REFUSAL):
                yield question, refusal_of(message)
            else:
                yield question, message


def refusal_of(message: bytes) -> MeshError:
    """The error of an answer that begins with `REFUSAL`."""
    return MeshError(*json.loads(message[len(REFUSAL) :]))


def describe_refusal(error: MeshError) -> bytes:
    """The answer of a refused file."""
    return REFUSAL + json.dumps([error.reason, plain_line(error.detail, LONGEST_NOTE), error.kind]).encode()


def _refuse_end(end: Ended, question: Question) -> MeshError:
    """Why a process ended, in terms of the file that it was reading."""
    if end.how in ("killed", "wall"):
        raise MachineError("a process that reads meshes was killed from outside, perhaps for want of memory")
    limit = {"cpu": "max_cpu_s", "memory": "max_memory_mb"}.get(end.how)
    remedy = f": make it simpler, or raise it by `verso init --limit {limit}=N`" if limit else ""
    reason = {"cpu": "too_slow", "memory": "too_large"}.get(end.how, "unreadable")
    return MeshError(reason, f"{question.folder / question.path} {end.detail}{remedy}")


def answer(question: Question) -> bytes:
    """In a limited process: the answer, or a refusal. Raises MemoryError alone."""
    path = question.folder / question.path
    try:
        return survey(question) if question.row is None else make_glb(question, question.row)
    except MeshError as error:
        refusal = error
    except MemoryError:
        raise
    except Exception as error:  # whatever a stranger's bytes made a library raise, it is they that are refused
        if isinstance(error, OSError) and error.errno in (errno.ENOMEM, errno.EFBIG):
            raise MemoryError from error
        refusal = MeshError("unreadable", f"{path} cannot be read: {describe_error(error)}")
    detail = refusal.detail if path.name in refusal.detail else f"{path}: {refusal.detail}"
    reason = [refusal.reason, plain_line(detail, LONGEST_NOTE), refusal.kind]
    if question.row is not None:
        return REFUSAL + json.dumps(reason).encode()
    return json.dumps({"files": _stat_of(path, question.folder), "named": [], "refused": reason}).encode()


def _stat_of(path: Path, folder: Path) -> list[Any]:
    try:
        return [list(vars(file).values()) for file in hash_files([path], folder)]
    except OSError:
        return []


def survey(question: Question) -> bytes:
    """The files of a candidate, the meshes that it names as its parts, and its measures, as JSON."""
    path, folder, limits = question.folder / question.path, question.folder, question.limits
    named = []
    if path.suffix.lower() in POSED:
        named = [file.relative_to(folder).as_posix() for file in list_named(path, folder, limits)]
    files = hash_files(list_files(folder, path, limits), folder)
    loaded = load_file(folder, path, limits)
    hull_vertices = check_body(loaded.shape, path)
    mass, _ = weigh(loaded.shape, 1.0, 1.0)
    notes = tuple(plain_line(note, LONGEST_NOTE) for note in loaded.notes[:MOST_NOTES])
    measured = measure_shape(loaded.shape, mass, hull_vertices, notes, path)
    check_unchanged(folder, files)
    answer = {"files": [list(vars(file).values()) for file in files], "named": named, "measured": asdict(measured)}
    return json.dumps(answer).encode()


def make_glb(question: Question, row: Row) -> bytes:
    """The shape of a row, cleaned, z up, metric, centred on its bounding box, with its mass, as this project's GLB."""
    path, folder = question.folder / question.path, question.folder
    files = hash_files(list_files(folder, path, question.limits), folder)
    known = [(file.path, file.sha256) for file in row.files if file.sha256]
    if known and known != [(file.path, file.sha256) for file in files]:
        why = "has changed since its library was made: run `verso init` again"
        raise MeshError("changed", f"{path} {why}", "environmental")
    loaded = load_file(folder, path, question.limits)
    asset = place_asset(loaded, row, question.limits)
    if row.category != TABLE:
        check_body(asset.shape, path)
    mass = asset.mass
    more = {
        "key": row.key,
        "sha256": files[0].sha256,
        "closed": asset.shape.closed,
        "watertight": asset.watertight,
        "mass": [mass.mass_kg, mass.com.tolist(), mass.inertia.tolist(), mass.solid],
        "T_source_to_object": asset.T_source_to_object.tolist(),
        "scale": asset.scale,
        "notes": list(asset.notes),
        "faces": len(asset.shape.faces),
        "extents_m": asset.extents_m.tolist(),
        "pictures": len({id(p.material.texture) for p in asset.shape.parts if p.material.texture is not None}),
    }
    return asset_glb(replace(asset, sha256=files[0].sha256), library=more)


def load_file(folder: Path, path: Path, limits: MeshLimits) -> LoadedMesh:
    """A candidate's cleaned shape in the frame of its file."""
    return load_posed(path, limits, folder) if path.suffix.lower() in POSED else load_shape(path, limits, folder)


def place_asset(loaded: LoadedMesh, row: Row, limits: MeshLimits) -> Asset:
    """The asset of a cleaned shape in its file's frame; MeshError `no_size` or `size` where its extent is not allowed."""
    axes, scale = UP_AXES[row.up], row.unit
    rotated = transform_shape(loaded.shape, pose(axes, np.zeros(3)))
    lower, upper = rotated.bounds
    diagonal = float(np.linalg.norm(upper - lower))
    if diagonal == 0.0:
        raise MeshError("no_size", f"{row.path} has no extent")
    if not np.isfinite(diagonal):
        raise MeshError("not_finite", f"{row.path} is too large for floating-point numbers")
    _check_size(row.path, scale * diagonal, limits)
    centre = 0.5 * (lower + upper) * scale
    shape = transform_shape(rotated, pose(scale * np.eye(3), -centre))
    mass, common_m3 = weigh(shape, USUAL_DENSITY, USUAL.shell_kg_m2)
    return Asset(
        instance_id=row.instance_id,
        category=row.category,
        source="library",
        licence=row.licence,
        path=row.path,
        sha256=row.sha256,
        shape=shape,
        mass=mass,
        T_source_to_object=frozen_array(pose(axes, -centre)),
        scale=scale,
        watertight=mass.solid,
        volume_m3=None,
        shareable=False,
        notes=tuple(plain_line(n, LONGEST_NOTE) for n in [*_note_shared(common_m3), *loaded.notes][:MOST_NOTES]),
    )


def _note_shared(common_m3: float | None) -> list[str]:
    """What to say of the volume that bodies share (`weigh`)."""
    if common_m3 is None:
        return ["bodies weigh twice what they share, if anything: they are too many to look for it"]
    return [f"bodies overlap: {1e6 * common_m3:.3g} cm^3 that they share weigh once"] if common_m3 else []


def _check_size(name: str, diagonal_m: float, limits: MeshLimits) -> None:
    """MeshError `size` where a body is so small or large that nothing about it could be simulated or seen."""
    if limits.min_size_m <= diagonal_m <= limits.max_size_m:
        return
    small = diagonal_m < limits.min_size_m
    cap = f"under min_size_m = {limits.min_size_m:g}" if small else f"over max_size_m = {limits.max_size_m:g}"
    raise MeshError("size", f"{name} is {diagonal_m:.3g} m across, {cap}: change its `unit` in the library's table")


def check_body(shape: Shape, path: Path) -> Array:
    """Vertices [H, 3] of the convex hull, which an object is placed by. MeshError `no_hull` or `no_size` for no body."""
    try:
        hull = convex_hull(shape.vertices)
    except (QhullError, ValueError) as error:
        raise MeshError("no_hull", f"{path} is no body: it needs four points apart that are not in a line") from error
    if measure_thinness(shape.vertices) < THINNEST:
        more = "it would lie unseen in the table's top: give it a thickness, such as by Blender's Solidify"
        raise MeshError("no_size", f"{path} is flat, without thickness: {more}")
    return hull.vertices


# ---------------------------------------------------------------------------------------------------- files


def list_files(folder: Path, path: Path, limits: MeshLimits) -> tuple[Path, ...]:
    """A candidate and every file that it refers to, each once; MeshError where one of them, or all together, is refused."""
    if path.suffix.lower() in (*POSED, *FORMATS):
        refuse_other(path)
    if path.suffix.lower() in POSED:
        meshes, pictures = list_seen(path, folder, limits)
        files = [path, *(file for mesh in meshes for file in list_mesh_files(mesh, folder, limits)), *pictures]
    else:
        files = list_mesh_files(path, folder, limits)
    if (info := find_inside(folder, path.with_name(INFO_FILE))) is not None and path.stem.startswith("obj_"):
        files.append(info)
    files = list(dict.fromkeys(files))
    size, cap = sum(file.stat().st_size for file in files), limits.max_asset_mb
    if size > cap * 1e6:
        raise MeshError("too_large", f"{path} and its files have {size / 1e6:.1f} MB, over max_asset_mb = {cap:g}")
    for file in files:
        if not str(file).isprintable():
            raise MeshError("name", f"{file!s:.200} has a name that is not printable UTF-8, so no table can hold it")
    return tuple(files)


def hash_files(paths: Iterable[Path], folder: Path) -> tuple[SourceFile, ...]:
    """The files with their sizes, times and digests, in the order given; reads every byte, at about 800 MB/s from cache."""
    files = []
    for path in paths:
        stat = path.stat()
        files.append(SourceFile(path.relative_to(folder).as_posix(), stat.st_size, stat.st_mtime_ns, digest_of(path)))
    return tuple(files)


def digest_of(path: Path) -> str:
    """SHA-256 of a file, hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_unchanged(folder: Path, files: Iterable[SourceFile]) -> None:
    """MeshError `changed`, which is environmental, where size or time of a file is not what it was."""
    for file in files:
        stat = (folder / file.path).stat()
        if (stat.st_size, stat.st_mtime_ns) != (file.bytes, file.mtime_ns):
            why = "changes while it is read: start again when nobody writes"
            raise MeshError("changed", f"{folder / file.path} {why}", "environmental")


HEAD_BYTES = 4096
"""Bytes of a file that are looked at for what it really is."""

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
