"""The plan of a scene: everything that is drawn before anything moves."""

from dataclasses import dataclass

from schemas.base import Array, Pose
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Camera
from schemas.scene.shape import Asset, Hull, Mesh, Shape


@dataclass(frozen=True, eq=False)
class TableTop:
    """The level that objects stand on, in the frame of the mesh that it was found in.

    height_m; centre [2]: the middle of the level's bounding box; outline [N, 2] float64: its convex hull,
    counter-clockwise; convex: whether the level fills that hull and nothing of the mesh rises above it.
    """

    height_m: float
    centre: Array
    outline: Array
    convex: bool


@dataclass(frozen=True, eq=False)
class Table:
    """A table where it stands: `T_world_table` [4, 4], and its mesh and top in world coordinates."""

    asset: Asset
    T_world_table: Pose
    mesh: Mesh
    top: TableTop


@dataclass(frozen=True, eq=False)
class ObjectStart:
    """Where one object begins: `T_world_obj` [4, 4] at release; `redraws` positions were thrown away before it.

    `hull` is the convex hull of the asset's shape, in the object frame.
    """

    asset: Asset
    hull: Hull
    region_id: int
    T_world_obj: Pose
    redraws: int
    placed: bool
    """True where it was set down in a stable pose and needs no drop."""


@dataclass(frozen=True, eq=False)
class ScenePlan:
    """Everything random about a scene, drawn before anything moves."""

    scene_id: int
    category: str
    table: Table
    floor: Shape
    objects: tuple[ObjectStart, ...]
    input_cameras: tuple[Camera, ...]
    """One for each pair, RGB camera."""
    appearance: Appearance
