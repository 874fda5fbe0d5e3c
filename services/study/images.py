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
from schemas.scene.shape import is_object
from schemas.scene.view import Camera, Pair, View
from services.study.measure import Answer, answer_for, context_for, laid_for, own_rest, warm_answer_for
from services.study.model import OWN, Setting, resized
from services.study.truths import (
    Crop,
    Patch,
    Pixels,
    Rgb,
    Seen,
    cast_patch,
    cast_pixels,
    colour_truth_missing,
    converged_colour,
    crop_about,
    crop_colour,
    flip_between,
    seen_by_other,
)
from workers.geometry.pixels import dequantise_depth
from workers.scene.context import WorkerContext
from workers.scene.make_scene import Scene, render_scene
from workers.scene.rows import record_scene
from workers.stopwatch import Stopwatch

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

    def cast(self, cast: Callable[..., Any], *arguments: object) -> Any:
        """What `cast` answers for the scene's things; cameras count by their values."""
        values = [(a.intrinsics, a.T_world_cam.tobytes()) if isinstance(a, Camera) else a for a in arguments]
        key = cast, *self._geometry, *values
        if key not in self._kept:
            self._kept[key] = cast(self.things, *arguments)
        return self._kept[key]

    def pixels(self, camera: Camera) -> Pixels:
        """The view at its pixels."""
        return self.cast(cast_pixels, camera)


PERCENTILE, HIDDEN_M = 99.0, 0.005
"""Of pixels, which leaves out the few where a ray grazes an edge; and how far behind what a camera sees a surface is hidden."""


def measure_images(context: WorkerContext, scene: Scene, truth: Truth) -> dict[str, float]:
    """The errors of a made scene by names of `ERRORS`; an error without meaning there is left out.

    Over the input, aligned and mirror views of all pairs, and over pixels of objects unless stated:

    - depth_mm: the 99th percentile of |stored depth - ray's z| where mask and ray name the same object and there is depth.
    - mask_share: pixels whose mask and ray differ where either names an object, per object pixel by ray. It can exceed 1.
    - between_mm: over `BETWEEN` random rays in the box about the objects' visible part in the input view: the median
      of |stored depth of the pixel that the ray crosses - ray's z|, where mask and ray name the same object.
    - mirror_mm: |d_z - z of the objects' nearest point that the input camera sees|, the largest of all pairs: `mirror_pose`
      sets the mirror camera off by exactly this, along the input camera's optical axis.
    - unfilled_share: the share of object pixels of the mirror view, of points that both cameras see, without projected depth.
    - hidden_share: the share of projected pixels, all over the image, more than `HIDDEN_M` behind what a ray meets there.
    """
    images = context.job.images
    views = [view for pair in scene.pairs for view in pair.views if view.region is not None]
    patches = [truth.cast(cast_patch, pair.input.camera, truth.scene_id, n) for n, pair in enumerate(scene.pairs)]
    projected = [pair for pair in scene.pairs if pair.projected is not None]
    return (
        _of_labels([(view, truth.pixels(view.camera).box) for view in views], images)
        | _of_patches(list(zip(scene.pairs, patches, strict=True)), images)
        | _of_projections(projected, truth, images)
    )


def _of_labels(views: Sequence[tuple[View, Seen]], images: Images) -> dict[str, float]:
    """Stored views against rays at their pixels' centres."""
    off_mm: list[Array] = []
    differ = pixels = 0
    for view, seen in views:
        assert view.region is not None
        mask, by_ray = seen.of(view.region), is_object(seen.region)
        by_mask = is_object(mask)
        outside = np.count_nonzero(is_object(view.region)) - np.count_nonzero(by_mask)
        differ += int(np.count_nonzero((mask != seen.region) & (by_ray | by_mask)) + outside)
        pixels += int(np.count_nonzero(by_ray))
        off_mm.append(_off_mm(seen.of(view.depth), mask, seen, images))
    return _percentile("depth_mm", off_mm, PERCENTILE) | ({"mask_share": differ / pixels} if pixels else {})


def _of_patches(pairs: Sequence[tuple[Pair, Patch]], images: Images) -> dict[str, float]:
    """Stored views between pixels, and the mirror camera, by the objects' patch in the input view."""
    off_mm, mirror_mm = [], []
    for pair, patch in pairs:
        region, k = pair.input.region, pair.input.camera.intrinsics
        assert region is not None
        column, row = np.minimum((patch.at * (k.width, k.height)).astype(np.int64), (k.width - 1, k.height - 1)).T
        off_mm.append(_off_mm(pair.input.depth[row, column], region[row, column], patch, images))
        if pair.mirror is not None and patch.box is not None:
            mirror_mm.append(abs(pair.d_z_m - patch.front_m) * 1e3)
    return _percentile("between_mm", off_mm, 50.0) | ({"mirror_mm": max(mirror_mm)} if mirror_mm else {})


def _of_projections(pairs: Sequence[Pair], truth: Truth, images: Images) -> dict[str, float]:
    """Projected depth against what the mirror camera's rays meet."""
    empty, hidden = [], []
    for pair in pairs:
        assert pair.projected is not None
        camera, depth = pair.projected.camera, pair.projected.depth
        seen = truth.pixels(camera)
        empty.append(seen.box.of(depth)[truth.cast(seen_by_other, camera, seen.box, pair.input.camera)] == 0)
        drawn, z = seen.spread.of(depth), seen.spread.depth_m
        hidden.append(((z > 0.0) & (dequantise_depth(drawn, images) > z + HIDDEN_M))[drawn > 0])
    flags = {"unfilled_share": empty, "hidden_share": hidden}
    return {name: float(np.concatenate(some).mean()) for name, some in flags.items() if any(map(len, some))}


def _off_mm(stored: NDArray[np.uint16], mask: NDArray[np.uint8], seen: Seen | Patch, images: Images) -> Array:
    """[N] |stored depth - ray's z| of pixels with depth whose mask and ray name the same object."""
    same = is_object(seen.region) & (mask == seen.region) & (stored > 0)
    return np.abs(dequantise_depth(stored[same], images) - seen.depth_m[same]) * 1e3


def _percentile(name: str, errors: Iterable[Array], percent: float) -> dict[str, float]:
    """The figure by its name, or none for no values."""
    values = np.concatenate([np.empty(0), *errors])
    return {name: float(np.percentile(values, percent))} if len(values) else {}


CONVERGED_PATHS, FINE_WIDTH = 256, 2560
"""Two truths of so many paths differ by 0.012 to 0.02 in FLIP, a tenth of what tiers do; and 4 times the compared width."""

INPUT_ALONE = dict.fromkeys(("cameras.depth.enabled", "cameras.mirror.enabled", "images.projection.enabled"), False)


def measure_drawn(context: WorkerContext, settings: Sequence[Setting], scene_id: int) -> dict[str, Answer]:
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

    with suppress(Exception):  # said by what is measured
        own_rest(context, scene_id)
    workers = [(setting, context_for(context, setting)) for setting in settings]
    return {setting.name: warm_answer_for("draw", setting, partial(measure, worker)) for setting, worker in workers}


def measure_colour(context: WorkerContext, settings: Sequence[Setting], scene_id: int) -> dict[str, Answer]:
    """FLIP of the input RGB by the settings' names: `flip` and `edge_flip`; no errors where no object is visible.

    `flip` is against a path-traced image, where that tier is installed. `edge_flip`, of tier raster, is against the same
    tier's own light at 64 samples a pixel, because FLIP against other light tells little of edges.
    """
    truth = colour_truth(context, scene_id)

    def measure(setting: Setting) -> Answer:
        worker, scene = _input_alone(context, setting, scene_id)
        rgb = scene.pairs[0].input.rgb
        if truth is None or rgb is None:
            return {"errors": {}}
        crop, traced, smooth = truth
        images = {"flip": traced, "edge_flip": smooth if worker.job.render.tier == "raster" else None}
        cut = crop_colour(rgb, crop)
        return {"errors": {name: flip_between(image, cut) for name, image in images.items() if image is not None}}

    return {setting.name: answer_for(partial(measure, setting)) for setting in settings}


@lru_cache(maxsize=2)
def colour_truth(context: WorkerContext, scene_id: int) -> tuple[Crop, Rgb | None, Rgb | None] | None:
    """The compared crop of the input view, path-traced and with smooth edges; None where no object is visible."""
    with suppress(SceneError):
        scene = _input_alone(context, OWN, scene_id)[1]
        if (box := cast_patch(scene.posed.things, scene.pairs[0].input.camera).box) is not None:
            crop = crop_about(box)
            traced = None if colour_truth_missing() else converged_colour(context, scene, crop, CONVERGED_PATHS)
            return crop, traced, _smooth(context, scene_id, crop)
    return None


def _input_alone(context: WorkerContext, setting: Setting, scene_id: int) -> tuple[WorkerContext, Scene]:
    """The setting's job without the views whose colour is not compared, and its scene. Raises SceneError."""
    worker = context_for(context, Setting(setting.parts, {**setting.changes, **INPUT_ALONE}))
    return worker, render_scene(worker, laid_for(context, worker, scene_id), Stopwatch())


def _smooth(context: WorkerContext, scene_id: int, crop: Crop) -> Rgb | None:
    """The raster tier's image with 64 samples a pixel: drawn 4 times as wide with 4 samples each, averaged by area."""
    finest = {**resized(context.job, FINE_WIDTH), "render.tier": "raster", "render.samples": 4}
    with suppress(SceneError):
        rgb = _input_alone(context, Setting((("truth", "edges"),), finest), scene_id)[1].pairs[0].input.rgb
        return None if rgb is None else crop_colour(rgb, crop)
    return None
