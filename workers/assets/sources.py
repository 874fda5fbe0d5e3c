"""What every source of assets hands to the catalogue, and how a cleaned shape becomes an asset."""

import hashlib
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from schemas.base import Array, frozen_array
from schemas.errors import MeshError
from schemas.job.assets import MeshLimits
from schemas.scene.shape import Asset, MassProperties, Shape
from workers.assets.external.mesh import transform_shape
from workers.assets.external.reading import (
    FolderResolver,
    check_counts,
    declared_counts,
    material_files,
    may_be_too_large,
    read_bytes,
)
from workers.assets.mass import mass_properties

TABLE = "table"
"""The category name of tables."""

UNKNOWN = "unknown"
"""The licence of a source whose user states none."""

UP_AXES: Mapping[str, Array] = {
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}
"""The turn [3, 3] that takes a source's upward axis to z."""

_MAP_LINE = re.compile(rb"^[ \t]*map_Kd[ \t]+([^\r\n]+)", re.MULTILINE | re.IGNORECASE)
_PLY_TEXTURE = re.compile(rb"^comment TextureFile[ \t]+([^\r\n]+)", re.MULTILINE)


@dataclass(frozen=True)
class SourceFile:
    """A file as it was when the catalogue was opened: path relative to the source's folder, bytes, SHA-256."""

    path: str
    size: int
    sha256: str


@dataclass(frozen=True)
class Entry:
    """One instance of a source of files: `files` are the mesh or URDF itself, then all that it refers to."""

    instance_id: str
    files: tuple[SourceFile, ...]
    licence: str


@dataclass(frozen=True)
class Listing:
    """What a source of files offers: entries by category in a fixed order; how many were skipped, by reason."""

    folder: Path
    entries: Mapping[str, tuple[Entry, ...]]
    skipped: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Placement:
    """How a source's coordinates become the object frame: turned by `axes` [3, 3], times `scale` or to a diagonal."""

    axes: Array
    scale: float
    diagonal_m: float | None = None


@dataclass(frozen=True, eq=False)
class SourceShape:
    """A cleaned shape in its source's frame and units, and what of it was mended or left out."""

    shape: Shape
    notes: tuple[str, ...]


def hashed(paths: Iterable[Path], root: Path) -> tuple[SourceFile, ...]:
    """The files with their sizes and digests, in the order given; reads every byte, at about 800 MB/s from cache."""
    files = []
    for path in paths:
        with path.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        files.append(SourceFile(path.relative_to(root).as_posix(), path.stat().st_size, digest))
    return tuple(files)


def check_unchanged(folder: Path, entry: Entry) -> None:
    """MeshError `missing` or `changed` where a file of the entry is not what it was when the catalogue was opened.

    These are environmental: the job and its seed are not to blame, and the scene may be tried again.
    """
    for file in entry.files:
        path = folder / file.path
        try:
            with path.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as error:
            raise _environmental("missing", f"{path} cannot be read: {error.strerror}") from error
        if digest != file.sha256:
            raise _environmental("changed", f"{path} has changed since the job was started")


def _environmental(reason: str, detail: str) -> MeshError:
    error = MeshError(reason, detail)
    error.kind = "environmental"
    return error


def mesh_files(path: Path, root: Path, limits: MeshLimits) -> list[Path]:
    """A mesh file, then its material files and textures that exist below `root`; checks what the mesh declares.

    Raises MeshError `missing`, `format`, `too_large` or `unreadable`.
    """
    data = read_bytes(path, limits)
    kind = path.suffix.lower()
    if kind != ".glb" and may_be_too_large(data, limits):
        check_counts(path, *declared_counts(kind, data), limits)
    resolver = FolderResolver(path, root, limits)
    names = material_files(data) if kind == ".obj" else _names(_PLY_TEXTURE, data) if kind == ".ply" else []
    found = [resolver.find(name) for name in names]
    for material in [file for file in found if file is not None and file.suffix.lower() == ".mtl"]:
        found += [resolver.find(name) for name in _names(_MAP_LINE, material.read_bytes())]
    return list(dict.fromkeys([path, *(file for file in found if file is not None)]))


def _names(pattern: re.Pattern[bytes], data: bytes) -> list[str]:
    return [name.decode("utf-8", "replace").strip() for name in pattern.findall(data)]


def placed_asset(
    source_shape: SourceShape,
    placement: Placement,
    *,
    entry: Entry,
    category: str,
    source: str,
    shareable: bool,
    weights: "Weights",
) -> Asset:
    """The asset of a cleaned shape in its source's frame: turned, scaled, centred on its bounding box, weighed."""
    turned = transform_shape(source_shape.shape, placement.axes, np.zeros(3))
    lower, upper = turned.bounds
    diagonal = float(np.linalg.norm(upper - lower))
    if diagonal == 0.0:
        raise MeshError("no_size", f"{entry.files[0].path} has no extent")
    scale = placement.scale if placement.diagonal_m is None else placement.diagonal_m / diagonal
    centre = 0.5 * (lower + upper) * scale
    final = transform_shape(turned, scale * np.eye(3), -centre)
    T_source_to_object = np.eye(4)
    T_source_to_object[:3, :3], T_source_to_object[:3, 3] = placement.axes, -centre
    mass = mass_properties(final, weights.density_kg_m3, weights.shell_kg_m2)
    return Asset(
        instance_id=entry.instance_id,
        category=category,
        source=source,
        licence=entry.licence,
        path=entry.files[0].path,
        sha256=entry.files[0].sha256,
        shape=final,
        mass=mass,
        T_source_to_object=frozen_array(T_source_to_object),
        scale=scale,
        watertight=mass.solid,
        volume_m3=volume(mass, weights.density_kg_m3),
        shareable=shareable,
        notes=source_shape.notes,
    )


@dataclass(frozen=True)
class Weights:
    """Of what things are made: density of solids, surface density of shells."""

    density_kg_m3: float
    shell_kg_m2: float


def volume(mass: MassProperties, density_kg_m3: float) -> float | None:
    """Cubic metres of a solid; None of a shell."""
    return mass.mass_kg / density_kg_m3 if mass.solid else None


def licence_of(path: Path, root: Path, stated: str, files: Collection[Path]) -> str:
    """The stated licence; where none is stated, the nearest licence file from the mesh's folder up to the source's.

    `files`: the licence files in the source, as `licence_files` gives them.
    """
    if stated == UNKNOWN:
        for folder in path.parents:
            for file in files:
                if file.parent == folder:
                    return f"see {file.relative_to(root).as_posix()}"
    return stated


def licence_files(paths: Iterable[Path]) -> list[Path]:
    """Those of the files whose name is a licence's."""
    return sorted(path for path in paths if path.stem.lower() in ("license", "licence", "copying"))


def found_in(folder: Path, most: int = 5) -> str:
    """What a folder holds, for a message: its first names."""
    names = sorted(path.name + ("/" if path.is_dir() else "") for path in folder.iterdir())
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(names[:most]) + more) if names else "nothing"


def tally(reasons: Iterable[str]) -> dict[str, int]:
    """How often each reason occurs, sorted by name."""
    return dict(sorted(Counter(reasons).items()))
