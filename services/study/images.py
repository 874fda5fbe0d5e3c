"""Errors of the images of a scene with each setting, against rays and against very many paths.

The rays are cast from the scene's own cameras at its own poses: through pixels' centres or, for errors that depend on
the size of pixels, through places that do not depend on it. Views of all pairs count together.
"""

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from typing import Any

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from schemas.base import Array
from schemas.errors import SceneError
from schemas.job.views import Images
from schemas.scene.shape import REGION_FIRST_OBJECT, REGION_TABLE
from schemas.scene.view import Camera, Pair, View
from services.study.measure import Answer, answer_for, context_for, laid_for, own_rest, warm_answer_for
from services.study.model import OWN, Setting, resized
from services.study.truths import (
    ColourTruth,
    Crop,
    Patch,
    Pixels,
    Seen,
    cast_patch,
    cast_pixels,
    colour_truth_missing,
    converged_colour,
    crop_colour,
    crop_of,
    flip_error,
    seen_by_other,
)
from workers.geometry.pixels import dequantise_depth
from workers.scene.context import Stopwatch, WorkerContext
from workers.scene.make_scene import Scene, render_scene
from workers.scene.rows import record_scene

KEPT = 12
"""Casts kept of a scene, some 0.3 MB each: the last ones used. Every setting uses the input camera's; the mirror camera moves
whenever d_z changes."""


class Truth:
    """Casts of rays in one scene. `kept` has the last ones, which serve every setting that leaves its shapes and poses."""

    def __init__(self, scene: Scene, kept: LRUCache[tuple[object, ...], Any]) -> None:
        self.scene_id, self.things, self._kept = scene.plan.scene_id, scene.posed.things, kept
        arrays = [(thing.T_world_shape, thing.shape.vertices, thing.shape.faces) for thing in self.things]
        regions = bytes(thing.region_id for thing in self.things)
        self._geometry = self.scene_id, regions, *(hash(array.tobytes()) for some in arrays for array in some)

    def _cast(self, cast: Callable[[], Any], name: str, *cameras: Camera, pair: int = 0) -> Any:
        views = [part for c in cameras for part in (*c.intrinsics.model_dump().values(), c.T_world_cam.tobytes())]
        key = name, pair, *self._geometry, *views
        if key not in self._kept:
            self._kept[key] = cast()
        return self._kept[key]

    def pixels(self, camera: Camera) -> Pixels:
        """The view at its pixels."""
        return self._cast(lambda: cast_pixels(self.things, camera), "pixels", camera)

    def patch(self, camera: Camera, pair: int) -> Patch:
        """The objects in a pair's input view."""
        return self._cast(lambda: cast_patch(self.things, camera, self.scene_id, pair), "patch", camera, pair=pair)

    def both(self, camera: Camera, other: Camera) -> NDArray[np.bool_]:
        """[N] bool: which pixels of `pixels(camera).box` show an object point that the other camera sees too."""
        seen = self.pixels(camera).box
        return self._cast(lambda: seen_by_other(self.things, camera, seen, other), "both", camera, other)


PERCENTILE = 99.0
"""Percentile of pixels: leaves out the few where a ray grazes an edge."""

HIDDEN_M = 0.005
"""A projected pixel this far behind the surface that the mirror camera sees shows a hidden surface."""


def measure_images(context: WorkerContext, scene: Scene, truth: Truth) -> dict[str, float]:
    """The errors of a made scene by names of `ERRORS`; an error without meaning there is left out.

    Over the input, aligned and mirror views of all pairs, and over pixels of objects unless stated:

    - depth_mm: the 99th percentile of |stored depth - ray's z| of pixels whose mask and ray name the same object. It
      includes quantisation and the sensor's effects. Pixels without depth, stored as 0, are not counted.
    - table_depth_mm: the same for the table, at pixels evenly over the image (`SPREAD_PIXELS`).
    - mask_share: pixels whose mask and ray differ where either names an object, per object pixel by ray. It can exceed 1.
    - between_mm: over `BETWEEN` random rays in the box about the objects' visible part in the input view: the median
      of |stored depth of the pixel that the ray crosses - ray's z|, where mask and ray name the same object.
    - outline_share: the share of these rays whose region differs from that of the pixel they cross.
    - mirror_mm: |d_z - z of the objects' nearest point that the input camera sees|, the largest of all pairs.
      `mirror_pose` sets the mirror camera T_z_m away from the point d_z ahead of the input camera, and turns it by the input
      pose alone. So the camera is off by exactly this, along the input camera's optical axis, and is not turned.
    - agreement_mm: the stored input depth projected into the mirror view against the stored mirror depth, the median
      (workers/scene/labels.py), the largest of all pairs; it needs no rays.
    - unfilled_share: of the mirror view's object pixels by ray whose point the input camera sees too, the share that the
      projected depth leaves empty.
    - hidden_share: of the projected depth's filled pixels, of objects and all else, evenly over the image: the share that
      lies more than 5 mm behind what the mirror camera's ray meets.
    """
    images = context.job.images
    views = [view for pair in scene.pairs for view in pair.views if view.region is not None]
    patches = [truth.patch(pair.input.camera, number) for number, pair in enumerate(scene.pairs)]
    projected = [pair for pair in scene.pairs if pair.projected is not None]
    return (
        _of_labels([(view, truth.pixels(view.camera)) for view in views], images)
        | _of_patches(list(zip(scene.pairs, patches, strict=True)), images)
        | _of_mirrors(list(zip(scene.pairs, patches, strict=True)))
        | _of_projections(projected, truth, images)
    )


def _of_labels(views: Sequence[tuple[View, Pixels]], images: Images) -> dict[str, float]:
    """Stored views against rays at their pixels' centres."""
    objects_mm: list[Array] = []
    table_mm: list[Array] = []
    differ = pixels = 0
    for view, truth in views:
        assert view.region is not None
        mask, by_ray = truth.box.of(view.region), truth.box.region >= REGION_FIRST_OBJECT
        by_mask = mask >= REGION_FIRST_OBJECT
        outside = np.count_nonzero(view.region >= REGION_FIRST_OBJECT) - np.count_nonzero(by_mask)
        differ += int(np.count_nonzero((mask != truth.box.region) & (by_ray | by_mask)) + outside)
        pixels += int(np.count_nonzero(by_ray))
        table = truth.spread.region == REGION_TABLE
        for off_mm, seen, chosen in ((objects_mm, truth.box, by_ray), (table_mm, truth.spread, table)):
            off_mm.append(_off_mm(seen.of(view.depth), seen.of(view.region), seen, chosen, images))
    return {
        **_percentile("depth_mm", objects_mm, PERCENTILE),
        **_percentile("table_depth_mm", table_mm, PERCENTILE),
        **({"mask_share": differ / pixels} if pixels else {}),
    }


def _of_patches(pairs: Sequence[tuple[Pair, Patch]], images: Images) -> dict[str, float]:
    off_mm, wrong = [], []
    for pair, patch in pairs:
        region, k = pair.input.region, pair.input.camera.intrinsics
        assert region is not None
        column, row = np.minimum((patch.at * (k.width, k.height)).astype(np.int64), (k.width - 1, k.height - 1)).T
        mask, objects = region[row, column], patch.region >= REGION_FIRST_OBJECT
        off_mm.append(_off_mm(pair.input.depth[row, column], mask, patch, objects, images))
        wrong.append(mask != patch.region)
    return _percentile("between_mm", off_mm, 50.0) | _mean("outline_share", wrong)


def _of_mirrors(pairs: Sequence[tuple[Pair, Patch]]) -> dict[str, float]:
    off = [
        abs(pair.d_z_m - patch.front_m) * 1e3
        for pair, patch in pairs
        if pair.mirror is not None and patch.box is not None
    ]
    medians = [pair.agreement.median_mm for pair, _ in pairs if pair.agreement is not None]
    known = [median for median in medians if median is not None]
    return {name: max(values) for name, values in (("mirror_mm", off), ("agreement_mm", known)) if values}


def _of_projections(pairs: Sequence[Pair], truth: Truth, images: Images) -> dict[str, float]:
    empty, hidden = [], []
    for pair in pairs:
        assert pair.projected is not None
        camera, depth = pair.projected.camera, pair.projected.depth
        seen = truth.pixels(camera)
        empty.append(seen.box.of(depth)[truth.both(camera, pair.input.camera)] == 0)
        drawn, z = seen.spread.of(depth), seen.spread.depth_m
        hidden.append(((z > 0.0) & (dequantise_depth(drawn, images) > z + HIDDEN_M))[drawn > 0])
    return _mean("unfilled_share", empty) | _mean("hidden_share", hidden)


def _off_mm(
    stored: NDArray[np.uint16], mask: NDArray[np.uint8], seen: Seen | Patch, chosen: NDArray[np.bool_], images: Images
) -> Array:
    """[N] |stored depth - ray's z| of the chosen pixels that have depth and whose mask is the ray's region."""
    same = chosen & (mask == seen.region) & (stored > 0)
    return np.abs(dequantise_depth(stored[same], images) - seen.depth_m[same]) * 1e3


def _percentile(name: str, errors: Iterable[Array], percent: float) -> dict[str, float]:
    """The figure by its name, or none for no values."""
    values = np.concatenate([np.empty(0), *errors])
    return {name: float(np.percentile(values, percent))} if len(values) else {}


def _mean(name: str, flags: Sequence[NDArray[np.bool_]]) -> dict[str, float]:
    """The share of true flags by its name, or none for no flags."""
    return {name: float(np.concatenate(flags).mean())} if any(map(len, flags)) else {}


CONVERGED_PATHS = 256
"""Two truths with other seeds differ by 0.012 to 0.02 in FLIP, a tenth of what tiers do."""

INPUT_ALONE = dict.fromkeys(("cameras.depth.enabled", "cameras.mirror.enabled", "images.projection.enabled"), False)

FINE_WIDTH = 2560
"""Pixels: 4 times the width that colours are compared at."""


def measure_drawn(context: WorkerContext, settings: Sequence[Setting], scene_id: int, number: int) -> dict[str, Answer]:
    """Errors of depth, masks, mirror pose and projection by the settings' names, at the job's own rest.

    `s` is the time from rest to the encoded files, whose `bytes` are those of all files and of no rows.
    """
    kept: LRUCache[tuple[object, ...], Any] = LRUCache(KEPT)

    def measure(worker: WorkerContext) -> Answer:
        laid, began = laid_for(context, worker, scene_id), time.process_time()
        scene = render_scene(worker, laid, Stopwatch())
        files = record_scene(worker, scene, Stopwatch()).files
        s = time.process_time() - began
        return {
            "s": s,
            "errors": measure_images(worker, scene, Truth(scene, kept)),
            "bytes": sum(len(file.data) for file in files),
        }

    began = time.monotonic()
    with suppress(Exception):  # said by what is measured
        own_rest(context, scene_id)
    shared_s = (time.monotonic() - began) / len(settings)
    workers = [(setting, context_for(context, setting)) for setting in settings]
    answers = {setting.name: warm_answer_for("draw", setting, partial(measure, worker)) for setting, worker in workers}
    return _with_shared(answers, shared_s)


def _with_shared(answers: dict[str, Answer], shared_s: float) -> dict[str, Answer]:
    """Answers that each took a share of what was made for all."""
    return {name: {**answer, "took": answer["took"] + shared_s} for name, answer in answers.items()}


def measure_colour(
    context: WorkerContext, settings: Sequence[Setting], scene_id: int, number: int
) -> dict[str, Answer]:
    """FLIP of the input RGB by the settings' names: `flip` and `edge_flip`; no errors where no object is visible.

    `flip` is against a path-traced image, where that tier is installed. `edge_flip`, of tier raster, is against the same
    tier's own light at 64 samples a pixel, because FLIP against other light tells little of edges.
    """
    began = time.monotonic()
    traced, smooth = colour_truths(context, scene_id)
    shared_s = (time.monotonic() - began) / len(settings)

    def measure(setting: Setting) -> Answer:
        worker, scene = _input_alone(context, setting, scene_id)
        truths = {"flip": traced, "edge_flip": smooth if worker.job.render.tier == "raster" else None}
        rgb = scene.pairs[0].input.rgb
        return {"errors": {name: flip_error(truth, rgb) for name, truth in truths.items() if truth and rgb is not None}}

    return _with_shared({setting.name: answer_for(partial(measure, setting)) for setting in settings}, shared_s)


@lru_cache(maxsize=2)
def colour_truths(context: WorkerContext, scene_id: int) -> tuple[ColourTruth | None, ColourTruth | None]:
    """The scene's truths of colour and of edges; None where there is none, or no object is visible."""
    with suppress(SceneError):
        first = _input_alone(context, OWN, scene_id)
        if (crop := crop_of(first[1])) is not None:
            traced = None if colour_truth_missing() else converged_colour(*first, CONVERGED_PATHS)
            return traced, _smooth(context, scene_id, crop)
    return None, None


def _input_alone(context: WorkerContext, setting: Setting, scene_id: int) -> tuple[WorkerContext, Scene]:
    """The setting's job without the views whose colour is not compared, and its scene. Raises SceneError."""
    worker = context_for(context, Setting(setting.parts, {**setting.changes, **INPUT_ALONE}))
    return worker, render_scene(worker, laid_for(context, worker, scene_id), Stopwatch())


def _smooth(context: WorkerContext, scene_id: int, crop: Crop) -> ColourTruth | None:
    """The raster tier's image with 64 samples a pixel: drawn 4 times as wide with 4 samples each, averaged by area."""
    finest = {**resized(context.job, FINE_WIDTH), "render.tier": "raster", "render.samples": 4}
    with suppress(SceneError):
        rgb = _input_alone(context, Setting((("truth", "edges"),), finest), scene_id)[1].pairs[0].input.rgb
        return None if rgb is None else ColourTruth(crop, crop_colour(rgb, crop))
    return None
