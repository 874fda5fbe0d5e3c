"""The path tracer: colour of tier `pathtraced` by Mitsuba 3, which this file alone imports. Labels are the label pass's.

**Variant.** `scalar_rgb`, on one thread. It is deterministic and needs no compiler: `llvm_ad_rgb` would take Mesa's LLVM, and
with Debian 12's (15) Mitsuba 3.9.1 ends the whole process with "LLVM ERROR: Cannot select: fminimum".

**Camera.** Mitsuba's pinhole with its principal point moved. A box filter, so that a sample counts for its own pixel alone.
Where fx and fy differ, square pixels at least as fine as either are traced and averaged by area.

**Samples.** Correlated multi-jittered (Kensler 2013): every choice along a path is spread evenly over a pixel's samples. At 16
samples, noise on floor and table is a tenth of that of independent samples, for an eighth more time.

**Light.** Paths of `render.path_bounces` bounces; without the effect `global_illumination` of one. The key light and the
environment map are sampled at every bounce, straight through glass and holes, so that both throw tinted shadows.

**Inherent effects.** Paths start at random points of a pixel and end at lights that they see: the plan cannot withdraw
`antialiasing` or `shadows` here.
"""

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.errors import InputError
from schemas.job.render import Render
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Camera, Intrinsics
from schemas.scene.effects import EffectPlan
from schemas.scene.scene import Placed
from workers.geometry.srgb import encode_codes
from workers.render.pathtraced.lights import lights_of
from workers.render.pathtraced.materials import make_mesh, planned_part
from workers.render.raster.lit_shaders import KNEE
from workers.render.tiers import REMEDY, require_mitsuba

NEAR_M = 0.05
"""Nearer surfaces are not seen, as in the other tiers."""

ROULETTE_DEPTH = 5
"""Bounces after which Russian roulette may end a path."""

FIREFLY_RATIO = 1.4
"""Greatest brightness of a pixel relative to the second brightest neighbour; pixel-sized texture stays below it. Cycles clamps
samples instead, which Mitsuba cannot."""


def load_mitsuba() -> ModuleType:
    """Mitsuba, on one thread. Raises InputError where it is not installed or does not load."""
    require_mitsuba()
    try:
        mi = importlib.import_module("mitsuba")
        mi.set_variant("scalar_rgb")
        importlib.import_module("drjit").set_thread_count(1)
    except (ImportError, OSError) as error:
        raise InputError(f"render.tier is pathtraced, and Mitsuba does not load ({error}): {REMEDY}") from error
    return mi


@dataclass(frozen=True, eq=False)
class TracedScene:
    """A scene in Mitsuba, and the key of the models that it was made from."""

    scene: Any
    clear: bool
    """Whether something in it lets light through."""
    key: tuple[object, ...]
    held: tuple[object, ...]
    """The models whose ids the key holds."""


class Tracer:
    """Traces views. It keeps the last scene, because views of one scene follow one another."""

    def __init__(self) -> None:
        self._mi = load_mitsuba()
        self._built: TracedScene | None = None

    def radiance(
        self,
        things: Sequence[Placed],
        appearance: Appearance,
        camera: Camera,
        render: Render,
        effects: EffectPlan,
        seed: int,
    ) -> Array:
        """[H, W, 3] float64 linear light, the same for the same arguments; the background where nothing is. `seed` < 2**32."""
        built = self.build(things, appearance, effects)
        kind = "volpath" if built.clear else "path"
        bounces = render.path_bounces if effects.runs("global_illumination") else 1
        integrator = {"type": kind, "max_depth": bounces + 1, "rr_depth": ROULETTE_DEPTH, "hide_emitters": True}
        traced = {"sensor": self.sensor(camera), "integrator": self._mi.load_dict(integrator), "seed": seed}
        image = self._mi.render(built.scene, spp=round_up_samples(render.path_samples), **traced)
        pixels = np.array(image, np.float64)
        covered = np.clip(pixels[..., 3:], 0.0, 1.0)
        light = pixels[..., :3] + (1.0 - covered) * np.array(appearance.background)
        return average(light, camera.intrinsics)

    def build(self, things: Sequence[Placed], appearance: Appearance, effects: EffectPlan) -> TracedScene:
        """The scene in Mitsuba; a mesh's id is region-REGION-THING-PART."""
        placed = ((id(thing.shape), thing.T_world_shape.tobytes(), thing.region_id) for thing in things)
        key = (id(appearance), effects.ran, *placed)
        if self._built is not None and self._built.key == key:
            return self._built
        tree: dict[str, Any] = {"type": "scene", **lights_of(self._mi, appearance)}
        clear = False
        for number, thing in enumerate(things):
            for piece, part in enumerate(planned_part(part, effects) for part in thing.shape.parts):
                name = f"region-{thing.region_id}-{number}-{piece}"
                texture = part.material.texture
                clear = clear or part.material.transmission > 0.0 or (texture is not None and texture.shape[2] == 4)
                if len(part.faces):
                    tree[name] = make_mesh(self._mi, part, thing.T_world_shape, name)
        self._built = TracedScene(self._mi.load_dict(tree), clear, key, (appearance, *things))
        return self._built

    def sensor(self, camera: Camera) -> Any:
        """Mitsuba's camera, looking along its z with x to the left and y up; ours has x to the right and y down."""
        k = camera.intrinsics
        width, height, f = square_pixels(k)
        film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
        film |= {"pixel_format": "rgba", "component_format": "float32"}
        return self._mi.load_dict(
            {
                "type": "perspective",
                "fov": 2.0 * math.degrees(math.atan(0.5 * width / f)),
                "fov_axis": "x",
                "principal_point_offset_x": 0.5 - k.cx * (f / k.fx) / width,
                "principal_point_offset_y": 0.5 - k.cy * (f / k.fy) / height,
                "near_clip": NEAR_M,
                "far_clip": 1e4,
                "to_world": self._mi.ScalarTransform4f(camera.T_world_cam @ np.diag([-1.0, -1.0, 1.0, 1.0])),
                "film": film,
                "sampler": {"type": "multijitter"},
            }
        )


def encode_light(light: Array) -> NDArray[np.uint8]:
    """[H, W, 3] uint8 sRGB of traced light, without fireflies and through the tone curve."""
    return encode_codes(tone_map(clamp_fireflies(light)))


def clamp_fireflies(light: Array) -> Array:
    """Reduces pixels brighter than `FIREFLY_RATIO` times the second brightest of eight neighbours to the latter's level.

    A path that finds the key light in a mirror leaves such a pixel; lines, edges and spots of three pixels stay.
    """
    level = light @ np.array([0.2126, 0.7152, 0.0722])
    height, width = level.shape
    around = np.pad(level, 1, mode="reflect" if min(height, width) > 1 else "edge")
    first, second = np.zeros_like(level), np.zeros_like(level)
    for v, u in ((v, u) for v in range(3) for u in range(3) if (v, u) != (1, 1)):
        other = around[v : v + height, u : u + width]
        np.maximum(second, np.minimum(first, other), out=second)
        np.maximum(first, other, out=first)
    too_bright = level > FIREFLY_RATIO * second
    result = light.copy()
    result[too_bright] *= (second[too_bright] / level[too_bright])[:, None]
    return result


def tone_map(light: Array) -> Array:
    """The raster tier's tone curve (lit_shaders.py): linear below the knee, approaching 1 above it."""
    over = np.maximum(light - KNEE, 0.0) / (1.0 - KNEE)
    return np.minimum(light, KNEE) + (1.0 - KNEE) * over / (1.0 + over)


def round_up_samples(samples: int) -> int:
    """The least number, not below `samples`, that fills a grid of nearly equal sides, as the sampler needs it."""
    side = math.isqrt(samples)
    return side * -(-samples // side)


def square_pixels(k: Intrinsics) -> tuple[int, int, float]:
    """(width, height, focal length in pixels) of a film of square pixels no coarser than the image's."""
    f = max(k.fx, k.fy)
    return math.ceil(k.width * (f / k.fx) - 1e-9), math.ceil(k.height * (f / k.fy) - 1e-9), f


def average(light: Array, k: Intrinsics) -> Array:
    """[H, W, 3]: the mean of a film of square pixels over each pixel of the image."""
    f = max(k.fx, k.fy)
    if k.fx != k.fy:
        light = np.einsum("vh,hwc->vwc", _shares(k.height, f / k.fy, light.shape[0]), light)
        light = np.einsum("uw,vwc->vuc", _shares(k.width, f / k.fx, light.shape[1]), light)
    return light


def _shares(count: int, step: float, fine: int) -> Array:
    """[count, fine]: the share of each fine pixel in each pixel, which is `step` fine pixels wide."""
    edges, cells = np.arange(count + 1) * step, np.arange(fine)
    overlap = np.minimum(edges[1:, None], cells + 1.0) - np.maximum(edges[:-1, None], cells)
    return np.maximum(overlap, 0.0) / step
