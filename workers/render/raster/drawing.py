"""Which part of which thing is drawn by which program: pure."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from schemas.base import Pose
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Intrinsics
from schemas.scene.region import REGION_FLOOR, REGION_TABLE
from schemas.scene.scene import Placed
from schemas.scene.shape import Shape
from workers.render.overrides import AS_CALLED_FOR, Passes
from workers.render.raster.buffers import Uploaded, UploadedShape
from workers.render.raster.programs import light_slots
from workers.render.raster.shaders import Variant

NAMES = {REGION_FLOOR: "floor", REGION_TABLE: "table"}
"""Effects that are the drawing of a thing; objects are always drawn."""


@dataclass(frozen=True)
class Aim:
    """What a pass over the things is for: labels with colour, or colour alone, then with clear texels `cut` out or not."""

    labels: bool
    cut: bool = False
    passes: Passes = AS_CALLED_FOR


@dataclass(frozen=True, eq=False)
class ViewOf:
    """What a pass over the things of a scene draws them with."""

    appearance: Appearance
    k: Intrinsics
    T_cam_world: Pose
    raster: bool
    passes: Passes = AS_CALLED_FOR

    def moved(self, x: float, y: float) -> "ViewOf":
        """The view that at a pixel's centre sees what this one sees (x, y) pixels beside it."""
        return replace(self, k=self.k.model_copy(update={"cx": self.k.cx - x, "cy": self.k.cy - y}))


@dataclass(frozen=True, eq=False)
class Draw:
    """Some triangles of a thing: `count` indices of the batch from `first` on."""

    thing: Placed
    shape: UploadedShape
    batch: Uploaded
    first: int
    count: int


def sort_draws(
    things: Sequence[Placed],
    fetch: Callable[[Shape], UploadedShape],
    appearance: Appearance,
    top_is_level: Callable[[Placed], bool] | None,
    aim: Aim,
) -> dict[Variant, list[Draw]]:
    """Draws by program, the floor's last, so that what things hide of it is not shaded.

    `top_is_level` tells of a thing whether its top is the level that has a map of its own; None: the flat tier, which has
    no maps.
    """
    lights, raster = light_slots(appearance), top_is_level is not None
    by_variant: dict[Variant, list[Draw]] = {}
    for thing in reversed(things):
        name = NAMES.get(thing.region_id)
        if name is not None and not aim.passes.draw(name):
            continue
        shape, ground = fetch(thing.shape), thing.region_id == REGION_FLOOR
        split = top_is_level is not None and top_is_level(thing)
        for batch in shape.batches:
            # Only a floor is large enough for what a program without highlights saves; each program takes megabytes.
            textured = aim.passes.draw("textures", batch.texture is not None)
            cutout = aim.cut and textured and aim.passes.draw("transparency", batch.holes)
            looks = (textured, batch.few_triangles, batch.matte and ground, lights, raster)
            for first, count, level in _ranges(batch, split, raster and ground):
                variant = Variant(*looks, ground, level, aim.labels, cutout)
                by_variant.setdefault(variant, []).append(Draw(thing, shape, batch, first, count))
    return by_variant


def _ranges(batch: Uploaded, split: bool, level: bool) -> Iterator[tuple[int, int, bool]]:
    """(first index, how many, whether they lie on a level) of a batch; `split`: its top apart from the rest."""
    if not split:
        yield 0, batch.index_count, level
        return
    if batch.top_count:
        yield 0, batch.top_count, True
    if batch.top_count < batch.index_count:
        yield batch.top_count, batch.index_count - batch.top_count, False
