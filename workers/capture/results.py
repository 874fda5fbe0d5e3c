"""What a capture's folder holds: its inputs and their digest, what processing writes, and which files are the user's.

    process.json       settings, poses used, depth correction, notes, seconds, and the SHA-256 of every file below
    board_00000.txt  correction_00000.txt  mask_00000.png      where the user gave none
    cloud.ply  mesh.ply  poses.parquet

A file that process.json does not name, or that has other bytes, is the user's: it is read, and never overwritten.
"""

import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from schemas.capture import CaptureListing, Reconstruction
from schemas.errors import AssetSourceError, CaptureError, InputError, command_line
from schemas.job.captures import Captures
from schemas.job.job import Job
from schemas.job.look import OFF, RECOLOUR_VERSION
from workers.assets.catalogue import Catalogue, Watch, ignore, open_catalogue
from workers.assets.look.environment import open_maps
from workers.assets.poses import open_poses
from workers.assets.scene_tables import open_scenes
from workers.capture.folder import BOARD_FILE, CAMERA_FILE, CAPTURE_FILE, FILE_OF_VIEW
from workers.capture.truth import TRUTH
from workers.door.meshes.ply import Element, encode_ply, parse_ply
from workers.door.opening import as_refusal

if TYPE_CHECKING:
    from workers.assets.look.pictures import Pictures

PROCESS_FILE, CLOUD_FILE, MESH_FILE, POSES_FILE = "process.json", "cloud.ply", "mesh.ply", "poses.parquet"

_PLACE, _NORMAL, _COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
_CLOUD = np.dtype([*((name, "<f4") for name in _PLACE + _NORMAL), *((name, "u1") for name in _COLOR), ("views", "<u2")])
_VERTEX = np.dtype([*((name, "<f4") for name in _PLACE), *((name, "u1") for name in _COLOR)])


def read_record(path: Path) -> dict[str, Any] | None:
    """process.json of a folder, None where it was not processed. Raises CaptureError where it cannot be read."""
    try:
        record = json.loads((path / PROCESS_FILE).read_bytes())
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise CaptureError("unreadable", f"{path / PROCESS_FILE} is no JSON: {error}: delete it") from error
    if not isinstance(record, dict) or not isinstance(record.get("files"), dict):
        raise CaptureError("unreadable", f"{path / PROCESS_FILE} does not name what was written: delete it")
    return record


def written_files(path: Path) -> frozenset[str]:
    """Names of the folder's files that processing wrote and nobody changed."""
    record = read_record(path)
    names = record["files"] if record is not None else {}
    return frozenset(name for name, sha256 in names.items() if _digest_of(path / name) == sha256)


def write_results(path: Path, files: Mapping[str, bytes], record: Mapping[str, Any]) -> list[str]:
    """Writes files and process.json, in place of what processing wrote before; returns the names that stayed the user's.

    process.json is written before the files that it names: where the work is cut off, what is there is known as ours.
    """
    for name in written_files(path):
        (path / name).unlink()
    users = sorted(name for name in files if (path / name).exists())
    ours = {name: data for name, data in sorted(files.items()) if name not in users}
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in ours.items()}
    text = json.dumps({**record, "files": digests}, indent=1) + "\n"
    for name, data in ((PROCESS_FILE, text.encode()), *ours.items()):
        scratch = path / f".{name}.part"
        scratch.write_bytes(data)
        os.replace(scratch, path / name)
    return users


def cloud_ply(surface: Reconstruction) -> bytes:
    """A binary PLY of the points with normals, colours and numbers of views."""
    views = np.minimum(surface.views, 65_535)
    return _ply(_CLOUD, *surface.points.T, *surface.normals.T, *surface.colors.T, views)


def mesh_ply(surface: Reconstruction) -> bytes:
    """A binary PLY of the mesh with coloured vertices."""
    faces = {"vertex_indices": surface.faces.astype(np.int32)}
    return _ply(_VERTEX, *surface.vertices.T, *surface.vertex_colors.T, face=faces)


def _ply(kind: np.dtype, *columns: NDArray, **faces: Element) -> bytes:
    names = kind.names or ()
    vertex = {name: np.asarray(column, kind[name]) for name, column in zip(names, columns, strict=True)}
    return encode_ply("board frame, metres", vertex=vertex, **faces)


def read_surface(path: Path) -> Reconstruction:
    """The surface of cloud.ply and mesh.ply. Raises CaptureError where one is not there or another's."""
    cloud, mesh = _read_ply(path / CLOUD_FILE, _CLOUD)["vertex"], _read_ply(path / MESH_FILE, _VERTEX)
    vertices = mesh["vertex"]
    places, normals = (_columns(cloud, names).astype(np.float64) for names in (_PLACE, _NORMAL))
    cloud_columns = places, normals, _columns(cloud, _COLOR), cloud["views"].astype(np.int32)
    corners, faces = _columns(vertices, _PLACE).astype(np.float64), mesh["face"]["vertex_indices"].astype(np.int32)
    return Reconstruction(*cloud_columns, corners, faces, _columns(vertices, _COLOR))


def _columns(rows: Element, names: Sequence[str]) -> NDArray:
    return np.stack([rows[name] for name in names], axis=1)


def _read_ply(file: Path, kind: np.dtype) -> dict[str, Element]:
    if not file.exists():
        raise CaptureError(
            "not_processed", f"{file} is not there: run `{command_line('capture', 'process', file.parent)}`"
        )
    with suppress(InputError), as_refusal(file):
        elements = parse_ply(file.read_bytes())
        types = {name: column.dtype for name, column in elements["vertex"].items()}
        if types == {name: kind[name] for name in kind.names or ()}:
            return elements
    raise CaptureError("unreadable", f"{file} is not what `verso capture process` wrote, or ends early: delete it")


def _digest_of(file: Path) -> str | None:
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError:
        return None


def digest_inputs(path: Path) -> str:
    """64 hex characters: SHA-256 over the name and the SHA-256 of every file that decides the result, sorted by name.

    Those are descriptions, images, corrections, truth, a dictionary of markers; results that processing wrote beside them are
    none. Raises CaptureError naming the folder.
    """
    total = hashlib.sha256(b"verso capture 1\n")
    try:
        for file in _list_inputs(path):
            with open(file, "rb") as stream:
                content = hashlib.file_digest(stream, "sha256").hexdigest()
            total.update(f"{file.relative_to(path).as_posix()}\n{content}\n".encode())
    except OSError as error:
        raise CaptureError(
            "unreadable", f"{error.filename or path} cannot be read: {error.strerror or error}"
        ) from error
    return total.hexdigest()


def _list_inputs(path: Path) -> list[Path]:
    top = [file for file in path.iterdir() if file.is_file()]
    described = CAMERA_FILE, BOARD_FILE, CAPTURE_FILE
    inputs = {file.name for file in top if file.name in described or FILE_OF_VIEW.fullmatch(file.name)} - written_files(
        path
    )
    if BOARD_FILE in inputs:  # it may name a file of markers beside it
        named = re.search(rb'"dictionary"\s*:\s*"([^"/\\]+)"', (path / BOARD_FILE).read_bytes())
        inputs |= {named[1].decode(errors="replace")} if named else set()
    truth = [file for file in (path / TRUTH).rglob("*") if file.is_file()]
    return sorted([*(file for file in top if file.name in inputs), *truth])


SMALL = 0.1
"""Size of the pictures in which a lens is looked at: whether it folds over depends on angles alone."""


def _check_virtual(captures: Captures) -> None:
    """Raises AssetSourceError where no virtual capture can be made: of this board, or with this lens."""
    from workers.capture.board import open_dictionary  # of virtual captures alone
    from workers.capture.simulate.studio import make_rig, pinhole_lookup

    try:
        open_dictionary(captures.printed_board)
        if captures.simulate.distortion is not None:
            pinhole_lookup(captures.simulate.distortion, make_rig(min(SMALL, captures.simulate.image_scale)).color)
    except CaptureError as error:
        raise AssetSourceError(f"captures: {error.detail}") from error


def open_sources(job: Job, job_folder: Path, watch: Watch = ignore) -> Catalogue:
    """The job's catalogue; its digest covers every file that the job names.

    `watch` is told now and then how far it is. Raises AssetSourceError that names the key of a folder that cannot be used.
    """
    look, categories = job.drawn_look, {*job.categories, *((job.look.clutter and job.look.clutter.categories) or ())}
    catalogue = open_catalogue(job.assets, job_folder, tuple(categories), watch)
    if unknown := job.describe_unknown(name for library in catalogue.libraries() for name in library.entries):
        raise AssetSourceError(unknown)
    poses, scenes = open_poses(job, job_folder), open_scenes(job, job_folder)
    pictures: Pictures = {}
    further = [file.sha256 for file in (*poses.values(), scenes) if file is not None]
    if look.folders:
        from workers.assets.look.pictures import open_pictures

        pictures = open_pictures(look, job_folder)
        further += [f"{key} {file.name} {file.sha256}" for key, files in pictures.items() for file in files]
    around = job.look.environment  # also of tier flat: a study compares it with the path-traced tier
    maps = () if around is None else open_maps(around.folder, job_folder)
    further += [f"{source.name} {source.sha256}" for source in maps]
    if look.recolour != OFF["recolour"]:
        further.append(f"recolour {look.model_dump_json(include={'recolour'})} {RECOLOUR_VERSION}")
    if further:
        whole = "\n".join([catalogue.digest, *further])
        digest = hashlib.sha256(whole.encode()).hexdigest()
        catalogue = replace(
            catalogue, poses=poses, scenes=scenes, pictures=pictures, maps=maps, recolour=look.recolour, digest=digest
        )
    if job.captures is None:
        return catalogue
    if not job.captures.folders:
        _check_virtual(job.captures)
        return catalogue
    listings, folders = [], job.captures.folders
    for number, name in enumerate(folders):
        watch("captures", number, len(folders))
        folder, key = (job_folder / Path(name).expanduser()).resolve(), f"captures.folders.{number}"
        if not folder.is_dir():
            raise AssetSourceError(f"{key}: {folder}: there is no such folder")
        try:
            listings.append(CaptureListing(folder, digest_inputs(folder)))
        except CaptureError as error:
            raise AssetSourceError(f"{key}: {error.detail}") from error
    watch("captures", len(folders), len(folders))
    whole = "\n".join([catalogue.digest, *(listing.sha256 for listing in listings)])
    return replace(catalogue, captures=tuple(listings), digest=hashlib.sha256(whole.encode()).hexdigest())
