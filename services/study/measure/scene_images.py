"""Measures the images of a scene with each setting, against rays and against very many paths."""

from collections.abc import Sequence

from schemas.errors import SceneError
from services.study.knobs import size_value
from services.study.measure.colour_errors import (
    ColourTruth,
    Crop,
    colour_truth_missing,
    converged_colour,
    crop_colour,
    crop_of,
    flip_error,
)
from services.study.measure.image_errors import measure_images
from services.study.measure.settling import context_for
from services.study.measure.truth import truth_of
from services.study.model import Setting
from workers.scene.context import Stopwatch, WorkerContext
from workers.scene.make_scene import Scene, make_scene

CONVERGED_PATHS = 256
"""Two truths with other seeds differ by 0.012 to 0.02 in FLIP, a tenth of what tiers do."""

INPUT_ALONE = dict.fromkeys(("cameras.depth.enabled", "cameras.mirror.enabled", "images.projection.enabled"), False)

FINE_WIDTH = 2560
"""Pixels: 4 times the width that colours are compared at."""


def measure_scene_images(
    context: WorkerContext, settings: Sequence[Setting], scene_id: int
) -> dict[str, dict[str, float]]:
    """Errors of depth, masks, mirror pose and projection by the settings' names, where the scene can be made."""
    truth, answers = None, {}
    for setting in settings:
        found = _make(context_for(context, setting), scene_id)
        if found is not None:
            truth = truth_of(found[1], truth)
            answers[setting.name] = measure_images(*found, truth)
    return answers


def measure_colour(context: WorkerContext, settings: Sequence[Setting], scene_id: int) -> dict[str, dict[str, float]]:
    """FLIP of the input RGB by the settings' names: `flip` and `edge_flip`; nothing where no object is visible.

    `flip` is against a path-traced image, where that tier is installed. `edge_flip`, of tier raster, is against the same
    tier's own light at 64 samples a pixel, because FLIP against other light tells little of edges.
    """
    made = {setting.name: _make(_input_alone(context, setting), scene_id) for setting in settings}
    found = {name: one for name, one in made.items() if one is not None}
    if not found:
        return {}
    first = next(iter(found.values()))
    crop = crop_of(first[1])
    if crop is None:
        return {}
    traced = None if colour_truth_missing() else converged_colour(*first, CONVERGED_PATHS)
    smooth = _smooth(context, scene_id, crop)
    answers = {}
    for name, (worker, scene) in found.items():
        rgb = scene.pairs[0].input.rgb
        truths = {"flip": traced, "edge_flip": smooth if worker.job.render.tier == "raster" else None}
        if rgb is not None:
            answers[name] = {error: flip_error(truth, rgb) for error, truth in truths.items() if truth is not None}
    return answers


def _input_alone(context: WorkerContext, setting: Setting) -> WorkerContext:
    """The setting's job without the views whose colour is not compared."""
    return context_for(context, Setting(setting.parts, {**setting.changes, **INPUT_ALONE}))


def _smooth(context: WorkerContext, scene_id: int, crop: Crop) -> ColourTruth | None:
    """The raster tier's image with 64 samples a pixel: drawn 4 times as wide with 4 samples each, averaged by area."""
    fine = size_value(context.job, FINE_WIDTH).changes
    setting = Setting((("truth", "edges"),), {**fine, "render.tier": "raster", "render.samples": 4})
    made = _make(_input_alone(context, setting), scene_id)
    rgb = None if made is None else made[1].pairs[0].input.rgb
    return None if rgb is None else ColourTruth(crop, crop_colour(rgb, crop))


def _make(context: WorkerContext, scene_id: int) -> tuple[WorkerContext, Scene] | None:
    try:
        return context, make_scene(context, scene_id, Stopwatch())
    except SceneError:
        return None
