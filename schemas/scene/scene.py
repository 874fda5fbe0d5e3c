"""A scene from rest to output: settled objects, posed geometry, and all that is written of it."""

from dataclasses import dataclass
from typing import Literal

from schemas.base import Pose
from schemas.scene.appearance import Appearance
from schemas.scene.shape import Shape

SupportedBy = Literal["flat_top", "mesh", "placed"]
"""What an object was dropped on: the table's flat top alone, its whole mesh, or nothing, where it was set down at rest."""


@dataclass(frozen=True, eq=False)
class Settled:
    """One object at rest, with how well it rests.

    penetration_mm and hover_gap_mm are measured between the meshes after the correction; support_margin_mm is how far
    the centre of mass projects inside the hull of the contact points; equilibrium_residual is the share of its weight that
    contact forces cannot balance (0 on level ground with a margin above 0); residual_speed_mm_s is the speed at which the
    object's farthest point drifted over the last window, before the correction; recheck_move_mm and
    recheck_turn_deg are how far it moved and turned when released again (None where it was not re-released).
    """

    T_world_obj: Pose
    penetration_mm: float
    hover_gap_mm: float
    support_margin_mm: float
    equilibrium_residual: float
    residual_speed_mm_s: float
    settle_s: float
    support: SupportedBy
    recheck_move_mm: float | None = None
    recheck_turn_deg: float | None = None


@dataclass(frozen=True, eq=False)
class Placed:
    """One thing to draw: a shape, where it stands, and the region id that its pixels get."""

    region_id: int
    shape: Shape
    T_world_shape: Pose


@dataclass(frozen=True, eq=False)
class PosedScene:
    """The geometry of a scene at rest: floor, table, objects, in order of region id."""

    things: tuple[Placed, ...]
    appearance: Appearance


@dataclass(frozen=True, eq=False)
class SceneOutput:
    """All that a scene leaves behind: encoded files by path below the output folder, and rows by manifest table.

    A scene that cannot be made has no files and one row in `failures`.
    """

    scene_id: int
    files: tuple[tuple[str, bytes], ...]
    rows: dict[str, list[dict[str, object]]]
