"""Draw calls of a pass over a scene: triangles by thing and program, and the depth bias of each region. Pure."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Intrinsics
from schemas.scene.effects import EffectPlan
from schemas.scene.region import REGION_FLOOR, REGION_TABLE
from schemas.scene.scene import Placed
from schemas.scene.shape import Shape
from workers.geometry.frames import transform
from workers.render.raster.batches import is_matte, texture_of
from workers.render.raster.buffers import Uploaded, UploadedShape
from workers.render.raster.covers import Cover, seen_ranges
from workers.render.raster.programs import NEAR_M, PlacedLights, clip_from_cam, place_lights
from workers.render.raster.shaders import Variant

NAMES = {REGION_FLOOR: "floor", REGION_TABLE: "table"}
"""Effects that draw one thing; objects are always drawn."""

DEPTH_BIAS = 2e-6
"""Share of its distance, along its normal, by which each rank of `rank_regions` moves a face back in the depth test: 5
micrometres at 2.5 m. A quarter of it is the least that kept 400 pairs of coplanar squares apart."""

FLOOR_BIAS = 1e-5
"""Share of its distance by which the depth test takes the floor as nearer than it is. The floor is tested by the
rasteriser's depth, exact to 3e-6 of the distance, so that its hidden pixels are not shaded; its stored depth is the plane's."""

NEIGHBOURS_M = 1e-3
"""Things whose bounding boxes are farther apart than this share no face."""


@dataclass(frozen=True, eq=False)
class RenderPass:
    """One pass over all things of a scene: camera, light, and what is drawn."""

    appearance: Appearance
    k: Intrinsics
    T_cam_world: Pose
    effects: EffectPlan
    color: bool
    """Whether colour is drawn, in tier flat or raster."""
    raster: bool
    """Whether that colour is of tier raster."""
    labels: bool = True
    """Whether depth and region are drawn."""
    cut: bool = False
    """Whether clear texels are cut out; in a pass for colour alone."""

    @cached_property
    def clip_from_cam(self) -> NDArray[np.float32]:
        """[4, 4]: from the optical frame to clip space."""
        return clip_from_cam(self.k).astype(np.float32)

    @cached_property
    def lights(self) -> PlacedLights:
        """The lights as the camera sees them. Raises ValueError where there are too many."""
        return place_lights(self.appearance, self.T_cam_world, self.raster)

    def shift(self, x_px: float, y_px: float) -> "RenderPass":
        """The same with every pixel's centre moved by (x_px, y_px)."""
        return replace(self, k=self.k.model_copy(update={"cx": self.k.cx - x_px, "cy": self.k.cy - y_px}))


@dataclass(frozen=True, eq=False)
class Draw:
    """One draw call: `count` indices of a thing's batch from `first` on."""

    thing: Placed
    T_cam_shape: Pose
    batch: Uploaded
    culls: bool
    """Whether back faces are skipped."""
    first: int
    count: int


def is_drawn(effects: EffectPlan, name: str, needed: bool) -> bool:
    """Whether an exact no-op runs for one batch or view, given whether that needs it."""
    return name in effects.forced or (needed and effects.runs(name))


def sort_draws(
    things: Sequence[Placed],
    fetch: Callable[[Shape], UploadedShape],
    view: RenderPass,
    has_level_top: Callable[[Placed], bool],
    ground_z: bool = True,
) -> dict[Variant, list[Draw]]:
    """Draw calls by program. The floor comes last, so that its hidden pixels are not shaded.

    `has_level_top` tells whether the top of a thing has a level map; only tier raster asks. `ground_z`: whether z of the floor
    is drawn. Raises ValueError above six lights.
    """
    lights, raster = len(view.lights.towards) if view.color else 1, view.raster
    by_variant: dict[Variant, list[Draw]] = {}
    for thing in reversed(things):
        name = NAMES.get(thing.region_id)
        if name is not None and not view.effects.runs(name):
            continue
        shape, ground = fetch(thing.shape), thing.region_id == REGION_FLOOR
        split = raster and has_level_top(thing)
        hides = thing.region_id == REGION_TABLE and not view.cut
        T_cam_shape = view.T_cam_world @ thing.T_world_shape
        beyond_near = is_beyond_near(shape, T_cam_shape)
        culls = hides_backs(shape, beyond_near, through_holes=not view.labels)
        cover = shape.cover if hides and beyond_near else None
        for batch in shape.batches:
            textured = view.color and is_drawn(view.effects, "textures", batch.texture is not None)
            cutout = view.cut and textured and is_drawn(view.effects, "transparency", batch.holes)
            for first, count, top in _ranges(batch, split, cover, T_cam_shape):
                level = (split and top) or (raster and ground and not split)
                # Each program takes megabytes; only floors and tops of tables are large enough to gain from their own.
                planar = view.color and batch.few_triangles and (batch.planar_top if top else batch.planar)
                matte = ground and planar and batch.matte
                if matte:
                    matte = level if raster else textured or is_plain(thing.shape, view)
                look = (view.color, textured, batch.few_triangles, matte, lights, raster)
                variant = Variant(*look, ground, level, view.labels, cutout, planar, ground and not ground_z)
                by_variant.setdefault(variant, []).append(Draw(thing, T_cam_shape, batch, culls, first, count))
    return by_variant


def is_plain(shape: Shape, view: RenderPass) -> bool:
    """Whether a shape is one level plane that is seen in one colour, whatever its distance and direction."""
    part, *others = shape.parts
    if view.raster or others or not is_matte(part):
        return False
    textured = is_drawn(view.effects, "textures", texture_of(part) is not None)
    return not textured and part.vertices[:, 2].min() == part.vertices[:, 2].max()


def hides_backs(shape: UploadedShape, beyond_near: bool, through_holes: bool = False) -> bool:
    """Whether no back face can be seen: of a closed body that the near plane does not cut, nor holes in its texture."""
    cut = through_holes and any(batch.holes for batch in shape.batches)
    return shape.closed and not cut and beyond_near


def is_beyond_near(shape: UploadedShape, T_cam_shape: Pose) -> bool:
    """Whether the near plane cuts nothing off a shape."""
    return bool((shape.corners @ T_cam_shape[2, :3] + T_cam_shape[2, 3] > NEAR_M).all())


def _ranges(batch: Uploaded, split: bool, cover: Cover | None, T_cam_shape: Pose) -> Iterator[tuple[int, int, bool]]:
    """(first index, count, whether it is the top, apart from the rest) of what is drawn of a batch.

    `split`: its top apart from the rest. With a cover also, and without what that hides from the camera.
    """
    hides = cover is not None and len(batch.faces) > 0
    if not split and not hides:
        yield 0, batch.index_count, False
        return
    if batch.top_count:
        yield 0, batch.top_count, True
    if cover is not None and hides:
        lower = batch.faces[batch.top_count // 3 :]
        eye = -T_cam_shape[:3, 3] @ T_cam_shape[:3, :3]
        for first, count in seen_ranges(batch.positions, lower, cover, eye):
            yield batch.top_count + 3 * first, 3 * count, False
    elif batch.top_count < batch.index_count:
        yield batch.top_count, batch.index_count - batch.top_count, False


def rank_regions(things: Sequence[Placed], corners: Sequence[Array]) -> dict[int, int]:
    """The rank of each region in the depth test: one more than that of any of a lower id that it may share a face with.

    By its bias the lowest region id wins among coplanar faces. corners: those of each thing's bounding box [8, 3] in its own
    frame. Only things whose boxes meet can have coplanar faces at one place: twenty objects side by side all have the rank
    of a single one.
    """
    boxes: dict[int, tuple[Array, Array]] = {}
    for thing, box in zip(things, corners, strict=True):
        placed = transform(thing.T_world_shape, box)
        low, high = boxes.get(thing.region_id, (placed[0], placed[0]))
        boxes[thing.region_id] = np.minimum(low, placed.min(axis=0)), np.maximum(high, placed.max(axis=0))
    regions = sorted(boxes)
    low, high = (np.array([boxes[region][k] for region in regions]).reshape(-1, 3) for k in (0, 1))
    before = (low[:, None] < high[None] + NEIGHBOURS_M).all(axis=2)
    meets = np.logical_and(before, before.T)
    ranks = np.zeros(len(regions), np.int64)
    for number in range(1, len(regions)):
        ranks[number] = (1 + ranks[:number][meets[number, :number]]).max(initial=0)
    return dict(zip(regions, ranks.tolist(), strict=True))
