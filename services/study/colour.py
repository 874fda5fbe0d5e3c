"""Errors of colour: FLIP of the input view against a converged path-traced image.

FLIP (Andersson et al. 2020) by flip-evaluator is the visible difference on flipping between two images, 0 to 1. The
observer is the authors' default: 0.7 m before a screen 0.7 m and 3840 pixels wide, 67 of the image's pixels in a degree.
The package calls `sys.exit` on wrong arguments and misreads integers, so it only gets float32 in [0, 1]. Its map is the
same on one thread (`OMP_NUM_THREADS`) and on several; its mean, summed in float32, is not, so it is not used.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.errors import InputError
from schemas.job.views import Render
from schemas.scene.scene import Placed, ScenePlan
from schemas.scene.shape import REGION_FLOOR
from schemas.scene.view import Camera, Intrinsics
from services.study.rays import Box, cast_patch
from workers.assets.appearance import draw_appearance
from workers.render.pathtraced import draw_view
from workers.render.tiers import require_tier
from workers.scene.chance import SceneChance, Stream
from workers.scene.context import WorkerContext
from workers.scene.effects import Facts, plan_effects
from workers.scene.make_scene import Scene


def flip_between(reference: NDArray[np.uint8], rgb: NDArray[np.uint8]) -> float:
    """The mean of FLIP's map, from 0 for equal images to 1. Both are [H, W, 3] uint8 sRGB of one size. Raises ValueError."""
    import flip_evaluator  # of the extra `study`

    for image in (reference, rgb):
        if image.shape != reference.shape or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"FLIP compares [H, W, 3] uint8 of one size, not {image.shape} {image.dtype}")
    a, b = (np.ascontiguousarray(image, np.float32) / np.float32(255) for image in (reference, rgb))
    seen, _, _ = flip_evaluator.evaluate(a, b, "LDR", applyMagma=False, computeMeanError=False)
    return float(np.asarray(seen, np.float64).mean())


WIDTH, HEIGHT = 640, 480
"""The size of the image that colours are compared at, whatever the size of the image under test. Only a crop is traced."""

MARGIN_SHARE = 0.25
MARGIN_PX = 4
"""Margin about the objects that is compared too, because their contact shadows fall there."""

BOUNCES = 16
"""Bounces of the truth's paths, whatever the job's: glass before glass takes eight."""

TRUTH_SEED = 0xC0107
"""The random stream of the truth's paths, which no job's seed reaches."""


@dataclass(frozen=True)
class Crop:
    """Pixels of an image of `WIDTH` x `HEIGHT`."""

    left: int
    top: int
    right: int
    bottom: int


@dataclass(frozen=True, eq=False)
class ColourTruth:
    """rgb [bottom - top, right - left, 3] uint8 sRGB: the crop of the input view, path-traced."""

    crop: Crop
    rgb: NDArray[np.uint8]


def colour_truth_missing() -> str | None:
    """Why this machine has no truth of colour, with the remedy; None where it has."""
    if importlib.util.find_spec("mitsuba") is None:
        return (
            "errors of colour need the path-traced tier, which is not installed: `./verso extra pathtraced` installs it"
        )
    try:
        require_tier(Render(tier="pathtraced"))
    except InputError as error:
        return str(error)
    return None


def converged_colour(context: WorkerContext, scene: Scene, paths: int, salt: int = 0) -> ColourTruth | None:
    """The objects' crop of the first pair's input view by that many paths a pixel; None where no object is visible.

    It depends on neither tier nor samples, seed of paths, bounces, sensor or size of the scene's own images: it has the look
    that the raster and path-traced tiers share, and a seed of its own. Another `salt` traces other paths.
    """
    crop = crop_of(scene)
    if crop is None:
        return None
    camera = scene.pairs[0].input.camera
    things, plan = _in_studio(context, scene)
    render = Render(tier="pathtraced", path_samples=paths, path_bounces=BOUNCES)
    effects = plan_effects(Facts(context.job.model_copy(update={"render": render}), plan, False))
    rng = np.random.default_rng([TRUTH_SEED, scene.plan.scene_id, salt])
    drawn = draw_view(
        context.renderer, things, plan.appearance, crop_camera(camera, crop), render, lambda: rng, effects
    )
    assert drawn.rgb is not None
    return ColourTruth(crop, drawn.rgb)


def crop_of(scene: Scene) -> Crop | None:
    """The compared crop of the first pair's input view; None where no object is visible."""
    patch = cast_patch(scene.posed.things, scene.pairs[0].input.camera)
    return None if patch.box is None else crop_about(patch.box)


def flip_error(truth: ColourTruth, rgb: NDArray[np.uint8]) -> float:
    """FLIP of a stored input view [H, W, 3] uint8 of any size, with the sensor's effects, in the truth's crop."""
    return flip_between(truth.rgb, crop_colour(rgb, truth.crop))


def crop_about(box: Box) -> Crop:
    """The crop, in whole pixels, of a box in shares of the image (`Patch.box`) and its margin."""
    left, top, right, bottom = np.array(box) * (WIDTH, HEIGHT, WIDTH, HEIGHT)
    margin = MARGIN_PX + MARGIN_SHARE * max(right - left, bottom - top)
    low = np.floor(np.maximum((left - margin, top - margin), 0.0)).astype(int).tolist()
    high = np.ceil(np.minimum((right + margin, bottom + margin), (WIDTH, HEIGHT))).astype(int).tolist()
    return Crop(*low, *high)


def crop_camera(camera: Camera, crop: Crop) -> Camera:
    """The camera whose image is the crop of this camera's image at `WIDTH` x `HEIGHT`."""
    k = camera.intrinsics
    across, down = WIDTH / k.width, HEIGHT / k.height
    size = {"width": crop.right - crop.left, "height": crop.bottom - crop.top}
    focus = {"fx": k.fx * across, "fy": k.fy * down, "cx": k.cx * across - crop.left, "cy": k.cy * down - crop.top}
    return Camera(Intrinsics(**size, **focus), camera.T_world_cam)


def crop_colour(rgb: NDArray[np.uint8], crop: Crop) -> NDArray[np.uint8]:
    """[bottom - top, right - left, 3] uint8: the crop of an image of any size.

    A larger image is averaged by area, a smaller one interpolated linearly, so that its lack of detail counts as error.
    """
    here = (slice(crop.top, crop.bottom), slice(crop.left, crop.right))
    if rgb.shape[:2] == (HEIGHT, WIDTH):
        return rgb[here]
    smaller = rgb.shape[0] < HEIGHT or rgb.shape[1] < WIDTH
    method = cv2.INTER_LINEAR if smaller else cv2.INTER_AREA
    return np.asarray(cv2.resize(rgb, (WIDTH, HEIGHT), interpolation=method), np.uint8)[here]


def _in_studio(context: WorkerContext, scene: Scene) -> tuple[Sequence[Placed], ScenePlan]:
    """The scene's things and plan as the path-traced tier draws them; the flat tier has another floor and other lights."""
    rng = SceneChance(context.job.seed, scene.plan.scene_id).stream(Stream.APPEARANCE)
    floor, appearance = draw_appearance(rng, "pathtraced")
    things = tuple(
        Placed(thing.region_id, floor, thing.T_world_shape) if thing.region_id == REGION_FLOOR else thing
        for thing in scene.posed.things
    )
    return things, replace(scene.plan, floor=floor, appearance=appearance)
