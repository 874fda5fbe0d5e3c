"""Which part of which thing is drawn by which program: pure."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from schemas.scene import REGION_FLOOR, Appearance, Placed
from schemas.shape import Shape
from workers.render.buffers import Uploaded, UploadedShape
from workers.render.programs import light_slots
from workers.render.shaders import Variant


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
    labels: bool,
) -> dict[Variant, list[Draw]]:
    """Draws by program, the floor's last, so that what things hide of it is not shaded.

    `top_is_level` tells of a thing whether its top is the level that has a map of its own; None: the flat tier, which has
    no maps.
    """
    lights, raster = light_slots(appearance), top_is_level is not None
    by_variant: dict[Variant, list[Draw]] = {}
    for thing in reversed(things):
        shape, ground = fetch(thing.shape), thing.region_id == REGION_FLOOR
        split = top_is_level is not None and top_is_level(thing)
        for batch in shape.batches:
            # Only a floor is large enough for what a program without highlights saves; each program takes megabytes.
            looks = (batch.texture is not None, batch.few_triangles, batch.matte and ground, lights, raster)
            for first, count, level in _ranges(batch, split, raster and ground):
                variant = Variant(*looks, ground, level, labels, batch.holes and not labels)
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
