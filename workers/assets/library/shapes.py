"""Edge: the GLBs of a library, made when they are first asked for, and read as assets; by any process, with the same bytes."""

import hashlib
import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from schemas.base import frozen_array
from schemas.errors import MeshError, OutputError
from schemas.job.assets import TABLE, USUAL_DENSITY, Assets, LibrarySource
from schemas.scene.shape import Asset, MassProperties, Shape
from workers.assets.glb import read_shape
from workers.assets.library.reading import (
    USUAL,
    Question,
    ask,
    describe_refusal,
    refusal_of,
)
from workers.assets.library.table import PLAIN, Library, Row, write_whole
from workers.door.meshes.mesh import transform_shape
from workers.geometry.frames import pose
from workers.pool import Answers

REFUSED = ".refused"
"""Beside the table: why shapes could not be made, so that each is tried once."""


def shape_path(library: Library, row: Row) -> Path:
    """Where the GLB of a row lies."""
    return library.folder / row.glb_path


def is_fit(library: Library, row: Row) -> bool:
    """Whether a row may be drawn: it is used, and its shape can be made."""
    if not row.use:
        return False
    if row.glb_sha256 is not None:
        return True
    try:
        open_shape(library, row)
    except MeshError as error:
        if error.kind == "environmental":
            raise
        return False
    return True


def open_shape(library: Library, row: Row) -> tuple[Shape, dict[str, Any]]:
    """The shape of a row and what its GLB keeps of it; where there is no such GLB, it is made.

    Raises MeshError where it is refused, or where it is gone or damaged and its source is not here.
    """
    if (kept := _read_kept(library, row)) is not None:
        return kept[1]
    if not library.source.is_dir():
        path = shape_path(library, row)
        how = "is not what library.parquet says" if path.exists() else "is missing"
        more = f"and {library.source}, of which it was made, is not here: `verso init` again where it is"
        raise MeshError("missing", f"{path} {how}, {more}", "environmental")
    ((_, answer),) = make_shapes(library, [row])
    if isinstance(answer, MeshError):
        raise answer
    return _open(answer, row)


def _read_kept(library: Library, row: Row) -> tuple[bytes, tuple[Shape, dict[str, Any]]] | None:
    """The GLB of a row, and what is in it; None where there is none, or it is not what the table says."""
    with suppress(OSError, MeshError):
        data = shape_path(library, row).read_bytes()
        if row.glb_sha256 in (None, hashlib.sha256(data).hexdigest()):
            return data, _open(data, row)
    return None


def _open(data: bytes, row: Row) -> tuple[Shape, dict[str, Any]]:
    """MeshError where the bytes are no GLB of this row."""
    try:
        shape, kept = read_shape(data)
        mass_kg, com, inertia, _ = kept["mass"]
        numbers = np.array([mass_kg, *com, *np.ravel(inertia), kept["scale"], *np.ravel(kept["T_source_to_object"])])
        if numbers.shape != (30,) or not np.isfinite(numbers).all() or kept["key"] != row.key:
            raise ValueError("it is another shape's")
    except (ValueError, LookupError, TypeError, OSError, struct.error, MemoryError) as error:
        raise MeshError("unreadable", f"{row.path}: its GLB makes no sense: {error!r:.200}") from error
    return shape, kept


def make_shapes(
    library: Library, rows: Iterable[Row], must_keep: bool = False
) -> Iterator[tuple[Row, bytes | MeshError]]:
    """Rows with their GLBs, as they are made by limited processes and written beside the table, or why they are refused.

    What cannot be written for want of room or rights is made again when it is asked for or, where it `must_keep`, an
    OutputError.
    """
    refused = Answers(library.folder / REFUSED)
    asked = dict[str, Row]()
    for row in rows:
        if (message := refused.get(row.key)) is not None:
            yield row, refusal_of(message)
        elif (kept := _read_kept(library, row)) is not None:
            yield row, kept[0]
        else:
            asked[row.path] = row
    questions = (Question(library.source, row.path, library.limits, row) for row in asked.values())
    for question, answer in ask(questions, library.limits):
        row = asked[question.path]
        if isinstance(answer, MeshError):
            if answer.kind == "intrinsic":
                refused.put(row.key, describe_refusal(answer))
        else:
            if row.glb_sha256 is not None and hashlib.sha256(answer).hexdigest() != row.glb_sha256:
                more = "came out otherwise than library.parquet says: `verso init` again"
                answer = MeshError("changed", f"{shape_path(library, row)} {more}", "environmental")
            else:
                with suppress(*(() if must_keep else (OutputError,))):
                    write_whole(shape_path(library, row), answer)
        yield row, answer


def load_shape(library: Library, row: Row, settings: LibrarySource, assets: Assets, instance_id: str) -> Asset:
    """The asset of a row, of the size and weight that the job says. Raises MeshError as `open_shape`."""
    shape, kept = open_shape(library, row)
    factor = 1.0
    if settings.diagonal_m is not None and row.category != TABLE:
        lower, upper = shape.bounds
        factor = settings.diagonal_m / float(np.linalg.norm(upper - lower))
        shape = transform_shape(shape, pose(factor * np.eye(3), np.zeros(3)))
    density = assets.density_of(row.category)
    mass = _weighed(kept, factor, density, assets.shell_kg_m2)
    T = np.array(kept["T_source_to_object"])
    T[:3, 3] *= factor
    return Asset(
        instance_id=instance_id,
        category=row.category,
        source=settings.source,
        licence=row.licence,
        path=row.path,
        sha256=str(kept["sha256"]),
        shape=shape,
        mass=mass,
        T_source_to_object=frozen_array(T),
        scale=float(kept["scale"]) * factor,
        watertight=mass.solid,
        volume_m3=mass.mass_kg / density if mass.solid else None,
        shareable=settings.copy_assets,
        notes=tuple(str(note) for note in kept["notes"]),
    )


def _weighed(kept: dict[str, Any], factor: float, density_kg_m3: float, shell_kg_m2: float) -> MassProperties:
    """The mass properties of a shape enlarged by a factor: a solid's mass goes with its cube, a shell's with its square."""
    mass_kg, com, inertia, solid = kept["mass"]
    more = density_kg_m3 / USUAL_DENSITY * factor**3 if solid else shell_kg_m2 / USUAL.shell_kg_m2 * factor**2
    return MassProperties(
        mass_kg * more, frozen_array(np.array(com) * factor), frozen_array(np.array(inertia) * more * factor**2), solid
    )


def with_shape(library: Library, row: Row, made: bytes | MeshError) -> Row:
    """The row with what was made of it."""
    if isinstance(made, MeshError):
        why = made.detail.replace(f"{library.source}/", "").removeprefix(row.path).lstrip(": ")
        return replace(row, use=False, reason=made.reason, why=why)
    _, kept = _open(made, row)
    return replace(
        row,
        sha256=kept["sha256"],
        extents_m=tuple(kept["extents_m"]),
        faces=kept["faces"],
        watertight=kept["watertight"],
        pictures=kept["pictures"],
        mended=(*kept["notes"], *(note for note in row.mended if note == PLAIN)),
        scale=kept["scale"],
        mass_kg=kept["mass"][0],
        volume_m3=kept["mass"][0] / USUAL_DENSITY if kept["mass"][3] else None,
        glb=row.glb_path,
        glb_bytes=len(made),
        glb_sha256=hashlib.sha256(made).hexdigest(),
    )
