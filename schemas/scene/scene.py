"""A scene from rest to output: settled objects, posed geometry, and all that is written of it."""

import hashlib
from dataclasses import dataclass
from typing import Literal

from schemas.base import Array, Pose
from schemas.scene.appearance import Appearance
from schemas.scene.shape import Shape

SupportedBy = Literal["flat_top", "mesh", "placed"]
"""The support of a drop: the table's flat top alone, its whole mesh, or none where the object was set down at rest."""


@dataclass(frozen=True, eq=False)
class ContactForce:
    """A contact of an object at rest with another region, in world coordinates.

    point [3] metres; normal [3], unit, towards the object; force [3] on the object, newtons.
    """

    with_region: int
    point: Array
    normal: Array
    force: Array


@dataclass(frozen=True, eq=False)
class Settled:
    """One object at rest, with the quality of its rest.

    penetration_mm and hover_gap_mm: between the true meshes; support_margin_mm: distance of the projected centre of mass
    inside the hull of the contacts that hold it up; equilibrium_residual: share of the weight, or of weight times size, that
    contact forces cannot balance; contacts: those that carry it, whose forces are the proof of that; residual_speed_mm_s:
    drift of the farthest point over the simulation's last window; recheck_move_mm and recheck_turn_deg: motion when released
    again (None where it was not).
    """

    T_world_obj: Pose
    penetration_mm: float
    hover_gap_mm: float
    support_margin_mm: float
    equilibrium_residual: float
    residual_speed_mm_s: float
    settle_s: float
    support: SupportedBy
    contacts: tuple[ContactForce, ...] = ()
    recheck_move_mm: float | None = None
    recheck_turn_deg: float | None = None


@dataclass(frozen=True, eq=False)
class Placed:
    """One thing to draw: a shape, its pose, and the region id of its pixels."""

    region_id: int
    shape: Shape
    T_world_shape: Pose


@dataclass(frozen=True, eq=False)
class PosedScene:
    """The geometry of a scene at rest: floor, table, objects, in order of region id."""

    things: tuple[Placed, ...]
    appearance: Appearance


@dataclass(frozen=True, eq=False)
class EncodedFile:
    """A file of a scene: its path below the output folder, its bytes, and their SHA-256, hex."""

    path: str
    data: bytes
    sha256: str


def encoded_file(path: str, data: bytes) -> EncodedFile:
    """The file with its digest: the one place where it is computed of bytes that were just encoded."""
    return EncodedFile(path, data, hashlib.sha256(data).hexdigest())


@dataclass(frozen=True, eq=False)
class SceneOutput:
    """All that a scene leaves behind: encoded files, and rows by manifest table.

    A scene that cannot be made has no files and one row in `failures`.
    """

    scene_id: int
    files: tuple[EncodedFile, ...]
    rows: dict[str, list[dict[str, object]]]
