"""A scene from its plan to its output: effects, plan, settled objects, posed geometry."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from schemas.base import Array, Pose
from schemas.scene.shape import REGION_FIRST_CLUTTER, Appearance, Asset, Hull, Mesh, Shape
from schemas.scene.view import Camera, NamedCamera

EffectKind = Literal["asked", "no_op", "approximation"]
"""asked: a switch of the job. no_op: where the scene does not call for it, leaving it out changes no byte. approximation:
leaving it out changes less than a stated tolerance."""


@dataclass(frozen=True, eq=False)
class EffectPlan:
    """The effects that are to run, and why each of the others is not, in the table's order.

    `forced` are those that run everywhere, also in views and on things that do not call for them.
    """

    ran: tuple[str, ...]
    skipped: Mapping[str, str]
    forced: frozenset[str] = frozenset()

    def runs(self, name: str) -> bool:
        """Whether the effect is to run."""
        return name in self.ran

    def without(self, *names: str) -> "EffectPlan":
        """The plan with these effects taken out, whether the scene calls for them or not; for tests and the audit."""
        return replace(
            self,
            ran=tuple(name for name in self.ran if name not in names),
            skipped={**self.skipped, **{name: "withdrawn" for name in self.ran if name in names}},
            forced=self.forced.difference(names),
        )


@dataclass(frozen=True, eq=False)
class TableTop:
    """The level that objects stand on, in its mesh's frame.

    centre [2]: middle of the level's bounding box; outline [N, 2] float64: its convex hull, counter-clockwise; convex:
    whether the level fills that hull and nothing of the mesh rises above it.
    """

    height_m: float
    centre: Array
    outline: Array
    convex: bool


@dataclass(frozen=True, eq=False)
class Table:
    """A table with its pose `T_world_table` [4, 4], and its mesh and top in world coordinates."""

    asset: Asset
    T_world_table: Pose
    mesh: Mesh
    top: TableTop


@dataclass(frozen=True, eq=False)
class Walls:
    """The walls of a room about the world's origin: their shape, and its length along x, width along y, and height, inside."""

    shape: Shape
    size_m: Array


@dataclass(frozen=True, eq=False)
class Ground:
    """What carries the objects of a scene: a table, on a floor, in a room if the job asks for it."""

    table: Table
    floor: Shape
    walls: Walls | None = None
    cover: Shape | None = None
    """The table as it is drawn, where the job gives it another surface: the same faces in the same order."""


@dataclass(frozen=True, eq=False)
class ObjectStart:
    """The start of one object: its pose `T_world_obj` [4, 4] at release, and the number of positions rejected before it.

    `hull` is the convex hull of the asset's shape, in the object frame.
    """

    asset: Asset
    hull: Hull
    region_id: int
    T_world_obj: Pose
    redraws: int
    placed: bool
    """Whether it was set down in a stable pose and needs no drop."""

    @property
    def is_clutter(self) -> bool:
        """Whether it has no rows."""
        return self.region_id >= REGION_FIRST_CLUTTER


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """The plan of one scene."""

    scene_id: int
    category: str
    ground: Ground | None
    """None in a studio scene."""
    objects: tuple[ObjectStart, ...]
    input_cameras: tuple[Camera, ...]
    """One for each pair, RGB camera."""
    appearance: Appearance
    more: tuple[NamedCamera, ...] = ()
    """Further cameras that stand by themselves; known where the objects rest."""
    kept: bool = False
    """Whether objects, those that are `placed`, stay where a table of scenes has them, at rest or not."""
    aimed: bool = False
    """Whether a table of scenes has the input cameras."""
    surroundings: Mapping[str, object] | None = None
    """What was drawn of `look`, by the fields of `scenes.surroundings`; None where nothing was asked for."""

    @property
    def shown(self) -> tuple[ObjectStart, ...]:
        """The objects that have rows; clutter comes after them."""
        return tuple(start for start in self.objects if not start.is_clutter)

    @property
    def table(self) -> Table:
        """The table. Raises ValueError in a studio scene, as `floor`."""
        return self._on_ground.table

    @property
    def floor(self) -> Shape:
        """The floor's shape, at z = 0."""
        return self._on_ground.floor

    @property
    def _on_ground(self) -> Ground:
        if self.ground is None:
            raise ValueError("a studio scene has no table and no floor")
        return self.ground


SupportedBy = Literal["flat_top", "mesh", "placed", "kept", "nothing"]
"""The support of a drop: the table's flat top alone, its whole mesh, or none where the object was set down at rest or is kept
where a table of scenes has it; nothing in a studio scene."""


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
    drift of the farthest point over the simulation's last window, or its speed where that ended with objects in motion, as those
    that `spun` on about the vertical; all of these are nan of an object that nothing carries.
    recheck_move_mm and recheck_turn_deg: motion when released again (None where it was not).
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
    spun: bool = False
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
