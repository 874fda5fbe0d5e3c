"""What the steps of a scene hand to one another: frozen, arrays read-only, units and frames in the names."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.camera import Camera, Role
from schemas.scene.shape import Asset, Hull, Mesh, Shape

SupportedBy = Literal["flat_top", "mesh", "placed"]
"""What an object was dropped on: the table's flat top alone, its whole mesh, or nothing, where it was set down at rest."""

REGION_NOTHING = 0
REGION_FLOOR = 1
REGION_TABLE = 2
REGION_FIRST_OBJECT = 3


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
class Light:
    """A distant light: `direction` [3] unit, from the surface towards the light, world; `color` linear RGB radiance."""

    direction: Array
    color: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Appearance:
    """What only RGB depends on, beside the floor's surface, which is in its `Placed` shape; linear RGB radiance.

    `ambient` comes from everywhere in the flat tier, from above in the raster tier, where `below` comes from below. The
    first light is the key light: in the raster tier it throws shadows.
    """

    ambient: tuple[float, float, float]
    lights: tuple[Light, ...]
    background: tuple[float, float, float]
    """Linear RGB where nothing is hit."""
    below: tuple[float, float, float] = (0.0, 0.0, 0.0)


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
class GBuffer:
    """What one camera sees at the centre of every pixel.

    rgb [H, W, 3] uint8 sRGB, None where no colour was drawn; depth_m [H, W] float32, z along the optical axis, 0 where
    nothing was hit (not yet clipped to the stored range); region [H, W] uint8.
    """

    rgb: NDArray[np.uint8] | None
    depth_m: NDArray[np.float32]
    region: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class ObjectLabel:
    """What one view says of one region.

    `T_cam_obj` [4, 4], the pixel (u, v) of the object's origin or (-1, -1), the bounding box and count of its pixels,
    and the share of its own unoccluded pixels (also outside the frame) that is seen.
    """

    region_id: int
    category: str
    instance_id: str
    T_cam_obj: Pose
    u: int
    v: int
    bbox_xywh: tuple[int, int, int, int]
    pixels: int
    visible_fraction: float


@dataclass(frozen=True, eq=False)
class View:
    """One camera's images as they are stored, and its labels (none for a projected view).

    rgb [H, W, 3] uint8, or None where the job asks for no colour; depth [H, W] uint16 in units of
    `Images.depth_units_per_m`; region [H, W] uint8, or None where the images were projected and not rendered. `pose_id` is
    the view's own; `parent_id` the input pose's.
    """

    role: Role
    pose_id: int
    parent_id: int
    camera: Camera
    rgb: NDArray[np.uint8] | None
    depth: NDArray[np.uint16]
    region: NDArray[np.uint8] | None
    labels: tuple[ObjectLabel, ...]


@dataclass(frozen=True, eq=False)
class Agreement:
    """Input depth carried into the mirror view against mirror depth, where both cameras see the surface.

    Of the object: median_mm, share within the bound, points compared; median and share are None below 50 points.
    `scene_median_mm` is over every region.
    """

    median_mm: float | None
    share: float | None
    points: int
    scene_median_mm: float | None


@dataclass(frozen=True, eq=False)
class Pair:
    """An input pose and its mirror pose with all their views; None is what the job has switched off.

    filled_share: of the mirror image's pixels, those that the projection fills; hidden_share: of the filled ones,
    those that show a surface behind what the mirror camera sees. `agreement` is of the stored images;
    `exact_agreement` of what they were before the sensors' effects, and the same where there are none.
    """

    d_z_m: float
    input: View
    aligned: View | None
    mirror: View | None = None
    projected: View | None = None
    agreement: Agreement | None = None
    exact_agreement: Agreement | None = None
    filled_share: float | None = None
    hidden_share: float | None = None

    @property
    def views(self) -> tuple[View, ...]:
        """Those that there are, in the order of `ROLES`."""
        return tuple(view for view in (self.input, self.aligned, self.mirror, self.projected) if view is not None)


@dataclass(frozen=True, eq=False)
class SceneOutput:
    """All that a scene leaves behind: encoded files by path below the output folder, and rows by manifest table.

    A scene that cannot be made has no files and one row in `failures`.
    """

    scene_id: int
    files: tuple[tuple[str, bytes], ...]
    rows: dict[str, list[dict[str, object]]]
