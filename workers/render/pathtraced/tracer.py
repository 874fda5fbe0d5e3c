"""The `pathtraced` tier: colour by Mitsuba 3, the only file that imports it; depth and region are the label pass's.

**Variant.** `scalar_rgb`, on one thread. It is deterministic, and needs no compiler: `llvm_ad_rgb` would take Mesa's LLVM, and
with Debian 12's (15) Mitsuba 3.9.1 ends the whole process with "LLVM ERROR: Cannot select: fminimum".

**Camera.** Mitsuba's pinhole with its principal point moved. A box filter, so that a sample counts for its own pixel. Where
fx and fy differ, square pixels at least as fine as either are traced and averaged by area.

**Samples.** Correlated multi-jittered (Kensler 2013): every choice along a path is spread evenly over a pixel's samples. At 16
samples, noise on floor and table is a tenth of what independent ones leave, for an eighth more time.

**Light.** Paths of `render.path_bounces` bounces. The key light and the sky are sampled at every bounce; through glass and
holes straight on, so that both throw tinted shadows.
"""

import ctypes
import importlib
import importlib.util
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
from schemas.scene.scene import Placed
from workers.geometry.srgb import encode_codes
from workers.render.pathtraced.lights import lights_of
from workers.render.pathtraced.materials import make_mesh
from workers.render.raster.lit_shaders import KNEE

VARIANT = "scalar_rgb"

NEAR_M = 0.05
"""As in the other tiers: what is nearer is not seen."""

ROULETTE_DEPTH = 5
"""Bounces after which paths end by chance, the sooner the less they carry."""

SPECK = 1.4
"""Cycles bounds what a sample may add, which Mitsuba cannot; texture at the size of a pixel stays below this."""

SYSTEM_LIBRARY = "libatomic.so.1"
"""Of the compiler's run time; Mitsuba's wheel does not bring it, and small images of Debian lack it."""

REMEDY = "`./verso extra pathtraced` installs it (mitsuba==3.9.1), or set render.tier to raster or flat"


def require_mitsuba() -> None:
    """Raises InputError, with the remedy, where Mitsuba or the system's library that it loads is not there."""
    if importlib.util.find_spec("mitsuba") is None:
        raise InputError(f"render.tier is pathtraced, and Mitsuba is not installed: {REMEDY}")
    try:
        ctypes.CDLL(SYSTEM_LIBRARY)
    except OSError as error:
        remedy = "on Debian or Ubuntu: apt-get install -y libatomic1"
        raise InputError(
            f"render.tier is pathtraced, and Mitsuba needs {SYSTEM_LIBRARY} ({error}): {remedy}"
        ) from error


def load_mitsuba() -> ModuleType:
    """Mitsuba, on one thread. Raises InputError where it is not installed or does not load."""
    require_mitsuba()
    try:
        mi = importlib.import_module("mitsuba")
        mi.set_variant(VARIANT)
        importlib.import_module("drjit").set_thread_count(1)
    except (ImportError, OSError) as error:
        raise InputError(f"render.tier is pathtraced, and Mitsuba does not load ({error}): {REMEDY}") from error
    return mi


@dataclass(frozen=True, eq=False)
class Built:
    """A scene in Mitsuba, and what it was made of: kept, so that its ids are no other's."""

    scene: Any
    clear: bool
    """Whether something in it lets light through."""
    things: Sequence[Placed]
    appearance: Appearance


class Tracer:
    """Traces views; keeps the scene traced last, because views of one scene follow one another."""

    def __init__(self) -> None:
        self._mi = load_mitsuba()
        self._built: Built | None = None

    def trace(
        self, things: Sequence[Placed], appearance: Appearance, camera: Camera, render: Render, seed: int
    ) -> NDArray[np.uint8]:
        """[H, W, 3] uint8 sRGB, the same bytes for the same arguments; `seed` below 2**32."""
        light = self.radiance(things, appearance, camera, render, seed)
        return encode_codes(compress(without_specks(light)))

    def radiance(
        self, things: Sequence[Placed], appearance: Appearance, camera: Camera, render: Render, seed: int
    ) -> Array:
        """[H, W, 3] float64 linear light, with the background where nothing is."""
        built = self.build(things, appearance)
        kind = "volpath" if built.clear else "path"
        depth = render.path_bounces + 1
        integrator = {"type": kind, "max_depth": depth, "rr_depth": ROULETTE_DEPTH, "hide_emitters": True}
        mi = self._mi
        image = mi.render(
            built.scene,
            sensor=self.sensor(camera),
            integrator=mi.load_dict(integrator),
            spp=whole_grid(render.path_samples),
            seed=seed,
        )
        pixels = np.array(image, np.float64)
        covered = np.clip(pixels[..., 3:], 0.0, 1.0)
        light = pixels[..., :3] + (1.0 - covered) * np.array(appearance.background)
        return average(light, camera.intrinsics)

    def build(self, things: Sequence[Placed], appearance: Appearance) -> Built:
        """The scene in Mitsuba; a mesh's id is region-REGION-THING-PART."""
        if self._built is not None and _same(self._built, things, appearance):
            return self._built
        tree: dict[str, Any] = {"type": "scene", **lights_of(self._mi, appearance)}
        for number, thing in enumerate(things):
            for piece, part in enumerate(thing.shape.parts):
                name = f"region-{thing.region_id}-{number}-{piece}"
                if len(part.faces):
                    tree[name] = make_mesh(self._mi, part, thing.T_world_shape, name)
        clear = any(lets_through(part.material) for thing in things for part in thing.shape.parts)
        self._built = Built(self._mi.load_dict(tree), clear, tuple(things), appearance)
        return self._built

    def forget(self) -> None:
        """Build the next scene anew, whatever it is."""
        self._built = None

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


def without_specks(light: Array) -> Array:
    """Pixels brighter than `SPECK` times the second brightest of their eight neighbours, brought down to that.

    A path that by chance finds the key light in a mirror leaves such a pixel; lines, edges and spots of three stay.
    """
    level = light @ np.array([0.2126, 0.7152, 0.0722])
    height, width = level.shape
    around = np.pad(level, 1, mode="reflect" if min(height, width) > 1 else "edge")
    first, second = np.zeros_like(level), np.zeros_like(level)
    for v, u in ((v, u) for v in range(3) for u in range(3) if (v, u) != (1, 1)):
        other = around[v : v + height, u : u + width]
        np.maximum(second, np.minimum(first, other), out=second)
        np.maximum(first, other, out=first)
    too_bright = level > SPECK * second
    result = light.copy()
    result[too_bright] *= (second[too_bright] / level[too_bright])[:, None]
    return result


def compress(light: Array) -> Array:
    """Light as bright as it is below the knee, running into 1 above it: the raster tier's curve (lighting.py)."""
    over = np.maximum(light - KNEE, 0.0) / (1.0 - KNEE)
    return np.minimum(light, KNEE) + (1.0 - KNEE) * over / (1.0 + over)


def whole_grid(samples: int) -> int:
    """The least number from `samples` on that fills a grid of nearly equal sides, which the sampler needs."""
    side = math.isqrt(samples)
    return side * -(-samples // side)


def lets_through(material: Any) -> bool:
    """Whether light may cross a material straight on: glass, and textures with clear texels."""
    texture = material.texture
    return material.transmission > 0.0 or (texture is not None and texture.shape[2] == 4)


def square_pixels(k: Intrinsics) -> tuple[int, int, float]:
    """(width, height, focal length in pixels) of a film of square pixels no coarser than the image's."""
    f = max(k.fx, k.fy)
    return math.ceil(k.width * (f / k.fx) - 1e-9), math.ceil(k.height * (f / k.fy) - 1e-9), f


def average(light: Array, k: Intrinsics) -> Array:
    """[H, W, 3] of a film of square pixels: the mean of what each of the image's pixels covers of it."""
    f = max(k.fx, k.fy)
    if k.fx != k.fy:
        light = np.einsum("vh,hwc->vwc", _shares(k.height, f / k.fy, light.shape[0]), light)
        light = np.einsum("uw,vwc->vuc", _shares(k.width, f / k.fx, light.shape[1]), light)
    return light


def _shares(count: int, step: float, fine: int) -> Array:
    """[count, fine]: the share of each of the fine pixels in each pixel, which is `step` of them wide."""
    edges, cells = np.arange(count + 1) * step, np.arange(fine)
    overlap = np.minimum(edges[1:, None], cells + 1.0) - np.maximum(edges[:-1, None], cells)
    return np.maximum(overlap, 0.0) / step


def _same(built: Built, things: Sequence[Placed], appearance: Appearance) -> bool:
    if built.appearance is not appearance or len(built.things) != len(things):
        return False
    return all(
        a.shape is b.shape and a.region_id == b.region_id and np.array_equal(a.T_world_shape, b.T_world_shape)
        for a, b in zip(built.things, things, strict=True)
    )
