"""What images are held against: rays in float64, and converged path-traced images by FLIP.

FLIP (Andersson et al. 2020) by flip-evaluator is the visible difference on flipping between two images, 0 to 1. The
observer is the authors' default: 0.7 m before a screen 0.7 m and 3840 pixels wide, 67 of the image's pixels in a degree.
The package calls `sys.exit` on wrong arguments and misreads integers, so it only gets float32 in [0, 1]. Its map is the
same on one thread (`OMP_NUM_THREADS`) and on several; its mean, summed in float32, is not, so it is not used.
"""

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.errors import InputError
from schemas.job.views import Render
from schemas.scene.scene import Ground, Placed
from schemas.scene.shape import REGION_FLOOR, is_object
from schemas.scene.view import Camera, Intrinsics
from workers.assets.look.appearance import draw_appearance
from workers.geometry.camera import NEAR_M, project, project_bounds, unproject
from workers.geometry.frames import invert, transform
from workers.geometry.raycast import first_hit
from workers.render.pathtraced import draw_view
from workers.render.tiers import require_tier
from workers.scene.chance import SceneChance, Stream
from workers.scene.context import WorkerContext
from workers.scene.draw.surround import light_scene
from workers.scene.effects import Facts, plan_effects
from workers.scene.make_scene import Scene

Box = tuple[float, float, float, float]
"""(left, top, right, bottom)."""

SAME_M = 1e-4
"""A ray to a point meets it where z is this near: half of a stored unit, and a hundred times the error of Embree's float32
rays at a grazing surface."""

SPREAD_PIXELS, SPREAD_SEED = 19_200, 0x5B4EAD
"""Pixels at random that are cast all over the image, as many as a sixteenth of 640 x 480, and their random stream. A grid would
fall in step with the pattern of pixels that a projection fills."""

DENSE = 256
"""Rays along each side of the box about the objects: 16 in a pixel and more while that box has at most 4,096 of a 640 x 480
image's pixels, as the objects of the built-in jobs have."""

BETWEEN, BETWEEN_SEED = 4096, 0x0B5E55ED
"""Rays at random in the objects' patch, and their random stream. A median of as many is off by 2 % of the spread."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The hits of rays through the centres of some pixels of an image.

    rows [N], columns [N] int64; depth_m [N] float64, z along the optical axis, 0 without a hit; region [N] uint8.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    depth_m: Array
    region: NDArray[np.uint8]

    def of(self, image: NDArray) -> NDArray:
        """[N, ...]: these pixels of an image [H, W, ...]."""
        return image[self.rows, self.columns]


class Pixels(NamedTuple):
    """A view by rays at its own pixels: all in the box that objects can be seen in, and some evenly over the image."""

    box: Seen
    spread: Seen


class Patch(NamedTuple):
    """The objects in a view by rays that do not depend on the image's size.

    front_m: least z of their visible points, inf where none is visible. box: (left, top, right, bottom) of the visible part
    in shares of the image's width and height, None where there is none. at [N, 2] float64: random places in the box,
    (across, down) in shares of the image; depth_m [N] and region [N] of the rays through these.
    """

    front_m: float
    box: Box | None
    at: Array
    depth_m: Array
    region: NDArray[np.uint8]


NOTHING = Patch(math.inf, None, np.empty((0, 2)), np.empty(0), np.empty(0, np.uint8))


class Eye:
    """A camera and the things of a scene in its frame, where Embree's float32 is finest."""

    def __init__(self, things: Sequence[Placed], camera: Camera) -> None:
        self.camera, self.k = camera, camera.intrinsics
        T_cam_world = invert(camera.T_world_cam)
        self.things = [Placed(thing.region_id, thing.shape, T_cam_world @ thing.T_world_shape) for thing in things]

    def cast(self, u: Array, v: Array) -> tuple[Array, NDArray[np.uint8]]:
        """(z [N] float64 metres, region [N] uint8) of the rays through image coordinates; 0 without a hit.

        Like `cast_view`, from the near plane on.
        """
        rays = np.stack([(u - self.k.cx) / self.k.fx, (v - self.k.cy) / self.k.fy, np.ones(len(u))], axis=1)
        hits = first_hit(self.things, NEAR_M * rays, rays)
        return np.where(np.isinf(hits.distance), 0.0, hits.distance + NEAR_M), hits.region

    def sees(self, points: Array) -> NDArray[np.bool_]:
        """[N] bool: whether surface points [N, 3] in the camera's frame, before it, are visible: the rays to them hit them."""
        u, v = project(points, self.k)
        z, region = self.cast(u, v)
        inside = (u >= 0.0) & (u < self.k.width) & (v >= 0.0) & (v < self.k.height)
        return inside & (region > 0) & (np.abs(z - points[:, 2]) <= SAME_M)

    def vertices(self) -> Array:
        """[V, 3] float64: the vertices of the objects, which are all things but floor and table."""
        objects = [thing for thing in self.things if is_object(thing.region_id)]
        vertices = [transform(thing.T_world_shape, thing.shape.vertices) for thing in objects]
        return np.concatenate([np.empty((0, 3)), *vertices])

    def box(self) -> Box | None:
        """The box about the objects' projected vertices, pixels, cut to the image; None where it is outside.

        The whole image where a vertex is not in front of the near plane.
        """
        points = self.vertices()
        if not len(points):
            return None
        bounds = project_bounds(points, self.k, NEAR_M)
        left, top, right, bottom = np.clip(bounds, 0, [self.k.width, self.k.height] * 2).tolist()
        return (left, top, right, bottom) if left < right and top < bottom else None


def cast_pixels(things: Sequence[Placed], camera: Camera) -> Pixels:
    """A view at its own pixels' centres."""
    eye = Eye(things, camera)
    left, top, right, bottom = eye.box() or (0.0, 0.0, 0.0, 0.0)
    rows, columns = np.mgrid[math.floor(top) : math.ceil(bottom), math.floor(left) : math.ceil(right)]
    random = np.random.default_rng([SPREAD_SEED, eye.k.width, eye.k.height])
    spread = np.divmod(random.permutation(eye.k.height * eye.k.width)[:SPREAD_PIXELS], eye.k.width)
    places = (rows.ravel(), columns.ravel()), spread
    return Pixels(*(Seen(v, u, *eye.cast(u.astype(float) + 0.5, v.astype(float) + 0.5)) for v, u in places))


def cast_patch(things: Sequence[Placed], camera: Camera, *names: int) -> Patch:
    """The objects in a view; `names` seed the random rays: the scene and the pair."""
    eye = Eye(things, camera)
    reach = eye.box()
    if reach is None:
        return NOTHING
    left, top, right, bottom = reach
    cell = ((right - left) / DENSE, (bottom - top) / DENSE)
    rows, columns = (index.ravel() for index in np.mgrid[0:DENSE, 0:DENSE])
    depth_m, region = eye.cast(left + cell[0] * (columns + 0.5), top + cell[1] * (rows + 0.5))
    mine = is_object(region)
    if not mine.any():
        return NOTHING
    rows, columns, dense_m = rows[mine], columns[mine], float(depth_m[mine].min())
    # A flat face is nearest at a vertex, so the visible vertices before the dense rays' hits are tried as well.
    points = eye.vertices()
    points = points[(points[:, 2] > NEAR_M) & (points[:, 2] < dense_m)]
    front_m = float(points[eye.sees(points), 2].min(initial=dense_m))
    across = (left + cell[0] * np.array([columns.min(), columns.max() + 1])) / eye.k.width
    down = (top + cell[1] * np.array([rows.min(), rows.max() + 1])) / eye.k.height
    rng = np.random.default_rng([BETWEEN_SEED, *names])
    at = rng.uniform((across[0], down[0]), (across[1], down[1]), (BETWEEN, 2))
    box = (float(across[0]), float(down[0]), float(across[1]), float(down[1]))
    return Patch(front_m, box, at, *eye.cast(at[:, 0] * eye.k.width, at[:, 1] * eye.k.height))


def seen_by_other(things: Sequence[Placed], camera: Camera, seen: Seen, other: Camera) -> NDArray[np.bool_]:
    """[N] bool: whether the object point that each ray hits is visible in the other camera's image too."""
    mine = np.flatnonzero(is_object(seen.region))
    points = unproject(seen.rows[mine], seen.columns[mine], seen.depth_m[mine], camera.intrinsics)
    there = transform(invert(other.T_world_cam) @ camera.T_world_cam, points)
    before = there[:, 2] > NEAR_M
    both = np.zeros(len(seen.region), bool)
    both[mine[before]] = Eye(things, other).sees(there[before])
    return both


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

MARGIN_SHARE, MARGIN_PX = 0.25, 4
"""Margin about the objects that is compared too, because their contact shadows fall there."""

BOUNCES, TRUTH_SEED = 16, 0xC0107
"""Bounces of the truth's paths, whatever the job's, as glass before glass takes eight; and their random stream."""


class Crop(NamedTuple):
    """Pixels of an image of `WIDTH` x `HEIGHT`."""

    left: int
    top: int
    right: int
    bottom: int


Rgb = NDArray[np.uint8]
"""[H, W, 3] sRGB."""


def colour_truth_missing() -> str | None:
    """Why this machine has no truth of colour, with the remedy; None where it has."""
    if importlib.util.find_spec("mitsuba") is None:
        return "errors of colour need the path-traced tier: `./verso extra pathtraced` installs it"
    try:
        require_tier(Render(tier="pathtraced"))
    except InputError as error:
        return str(error)
    return None


def converged_colour(context: WorkerContext, scene: Scene, crop: Crop, paths: int) -> Rgb:
    """The crop of the first pair's input view by that many paths a pixel.

    It depends on neither tier nor samples, seed of paths, bounces, sensor or size of the scene's own images: it has the look
    that the raster and path-traced tiers share, and a seed of its own.
    """
    # As the path-traced tier draws it: the flat tier has another floor and other lights.
    chance = SceneChance(context.job.seed, scene.plan.scene_id)
    floor, appearance = draw_appearance(chance.stream(Stream.APPEARANCE), "pathtraced")
    appearance, _ = light_scene(context.job.look, context.catalogue, chance, appearance, True)
    plan = replace(scene.plan, ground=Ground(scene.plan.table, floor), appearance=appearance)
    things = [
        Placed(thing.region_id, floor, thing.T_world_shape) if thing.region_id == REGION_FLOOR else thing
        for thing in scene.posed.things
    ]
    render = Render(tier="pathtraced", path_samples=paths, path_bounces=BOUNCES)
    effects = plan_effects(Facts(context.job.model_copy(update={"render": render}), plan, False))
    camera = crop_camera(scene.pairs[0].input.camera, crop)
    rng = np.random.default_rng([TRUTH_SEED, scene.plan.scene_id])
    drawn = draw_view(context.renderer, things, appearance, camera, render, lambda: rng, effects)
    assert drawn.rgb is not None
    return drawn.rgb


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
