"""The path tracer: colour of tier `pathtraced` by Mitsuba 3, which this file alone imports. Labels are the label pass's.

**Variant.** `scalar_rgb`, on one thread. It is deterministic and needs no compiler: `llvm_ad_rgb` would take Mesa's LLVM, and
with Debian 12's (15) Mitsuba 3.9.1 ends the whole process with "LLVM ERROR: Cannot select: fminimum".

**Camera.** Mitsuba's pinhole with its principal point moved. A box filter, so that a sample counts for its own pixel alone.
Where fx and fy differ, square pixels at least as fine as either are traced and averaged by area.

**Samples.** Correlated multi-jittered (Kensler 2013): every choice along a path is spread evenly over a pixel's samples. At 16
samples, noise on floor and table is a tenth of that of independent samples, for an eighth more time.

**Paths** of `render.path_bounces` bounces; without the effect `global_illumination` of one. The key light and the
environment map are sampled at every bounce, straight through glass and holes, so that both throw tinted shadows. Both sides of
every face are drawn.

**Inherent effects.** Paths start at random points of a pixel and end at lights that they see: the plan cannot withdraw
`antialiasing` or `shadows` here.
"""

import importlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.errors import InputError
from schemas.job.views import Render
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import Appearance, Material, Part
from schemas.scene.view import Camera, GBuffer, Intrinsics
from workers.geometry.camera import NEAR_M
from workers.geometry.colour import HOLE_ALPHA, SRGB_STEPS, decode_srgb, encode_codes, has_holes
from workers.geometry.frames import transform
from workers.geometry.irradiance import LUMINANCE
from workers.geometry.pixels import fill_image
from workers.render.emitters import level_light, lights_of, rgb_of, window_of
from workers.render.raster.batches import MATTE_ROUGHNESS, texture_of
from workers.render.raster.gbuffer import Renderer
from workers.render.raster.lit_shaders import KNEE
from workers.render.tiers import REMEDY, require_mitsuba

Bsdf = dict[str, Any]

GLASS_PALENESS = 0.3
"""Each sheet of glass transmits its opaque colour to this power: a bottle of green (0.03 of the light, opaque) lets an eighth
through two walls, as wine bottles do."""

LEAST_WIDTH = 0.02
"""Least width of a lobe: a sharper mirror is noise at affordable numbers of samples."""

LEAST_METAL_WIDTH = 0.12
"""Least width of a metal's lobe, whose reflections of the key light would leave fireflies on surfaces nearby."""

VERTEX_COLOR = "vertex_color"


def planned_part(part: Part, effects: EffectPlan) -> Part:
    """The part without what the plan leaves out: textures, their holes, glass."""
    transmission = part.material.transmission if effects.runs("glass") else 0.0
    texture = part.material.texture if effects.runs("textures") else None
    if texture is not None and not effects.runs("transparency"):
        texture = texture[..., :3]
    return replace(part, material=replace(part.material, transmission=transmission, texture=texture))


def make_mesh(mi: ModuleType, part: Part, T_world_shape: Pose, name: str) -> Any:
    """A part as a Mitsuba mesh in world coordinates, with its material; `name` is its id."""
    flat = part.normals is None
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf_of(mi, part))
    properties["face_normals"] = flat
    mesh = mi.Mesh(name, len(part.vertices), len(part.faces), properties, not flat, part.uv is not None)
    values = mi.traverse(mesh)
    values["vertex_positions"] = _floats(transform(T_world_shape, part.vertices))
    values["faces"] = part.faces.astype(np.uint32).ravel()
    if part.normals is not None:
        values["vertex_normals"] = _floats(part.normals @ T_world_shape[:3, :3].T)
    if part.uv is not None:
        values["vertex_texcoords"] = _floats(np.stack([part.uv[:, 0], 1.0 - part.uv[:, 1]], axis=1))  # its v runs down
    if _has_vertex_colors(part):
        assert part.colors is not None
        colors = SRGB_STEPS[part.colors[:, :3]] * decode_srgb(np.array(part.material.base_color[:3]))
        mesh.add_attribute(VERTEX_COLOR, 3, _floats(colors))
    values.update()
    return mesh


def bsdf_of(mi: ModuleType, part: Part) -> Bsdf:
    """Diffuse, plastic, rough metal or a blend of them; thin glass where it transmits; a mask where texels are clear."""
    body = _opaque(part.material, _color(mi, part))
    if part.material.transmission > 0.0:
        body = _glass(mi, part, body)
    texture = texture_of(part)
    if texture is not None and has_holes(texture):
        solid = (texture[..., 3] >= HOLE_ALPHA).astype(np.float32)
        body = {"type": "mask", "opacity": _picture(mi, solid), "nested": body}
    return body


def _opaque(material: Material, color: Any) -> Bsdf:
    if material.emission > 0.0:
        return {"type": "conductor", "material": "none"}  # shows the back of the window's lamp
    width = max(material.roughness**2, LEAST_WIDTH)
    metal: Bsdf = {"type": "roughconductor", "material": "none", "specular_reflectance": color}
    metal["alpha"] = max(width, LEAST_METAL_WIDTH)
    if material.roughness >= MATTE_ROUGHNESS:
        body: Bsdf = {"type": "diffuse", "reflectance": color}
    else:
        body = {"type": "roughplastic", "alpha": width, "diffuse_reflectance": color, "int_ior": 1.5}
    if material.metallic >= 1.0:
        body = metal
    elif material.metallic > 0.0:
        body = {"type": "blendbsdf", "weight": material.metallic, "first": body, "second": metal}
    return {"type": "twosided", "nested": body}


def _glass(mi: ModuleType, part: Part, body: Bsdf) -> Bsdf:
    """A tinted sheet that transmits light without refraction and mirrors some of it.

    The surface of a vessel is one such sheet, as if the vessel were empty; so is a wall, whose second side has `ior` 1.
    Samples of the lamps also find light that crosses straight on, so that shadows of glass are tinted and without
    fireflies.
    """
    material = part.material
    if material.ior == 1.0:
        return {"type": "null"}
    sheet = {"type": "thindielectric", "int_ior": material.ior, "specular_transmittance": rgb_of(tint_of(part))}
    if material.transmission_map is not None and part.uv is not None:
        weight: Any = _picture(mi, 1.0 - material.transmission * material.transmission_map.astype(np.float32) / 255.0)
    elif material.transmission >= 1.0:
        return sheet
    else:
        weight = 1.0 - material.transmission
    return {"type": "blendbsdf", "weight": weight, "first": sheet, "second": body}


def tint_of(part: Part) -> Array:
    """[3] share of linear light that crosses a sheet of glass; of a textured one, from the mean of its clearest texels."""
    material, texture = part.material, texture_of(part)
    color = decode_srgb(np.array(material.base_color[:3]))
    if texture is not None:
        clear = np.ones(texture.shape[:2], np.bool_)
        if material.transmission_map is not None and material.transmission_map.shape == texture.shape[:2]:
            clear = material.transmission_map == material.transmission_map.max()
        color = color * SRGB_STEPS[texture[..., :3][clear]].mean(axis=0)
    return np.asarray(color**GLASS_PALENESS, np.float64)


def _color(mi: ModuleType, part: Part) -> Any:
    """The albedo; a texture takes precedence over vertex colours, which Mitsuba cannot multiply it with."""
    factor = decode_srgb(np.array(part.material.base_color[:3]))
    texture = texture_of(part)
    if texture is not None:
        return _picture(mi, (SRGB_STEPS[texture[..., :3]] * factor).astype(np.float32))
    if _has_vertex_colors(part):
        return {"type": "mesh_attribute", "name": VERTEX_COLOR}
    return rgb_of(factor)


def _has_vertex_colors(part: Part) -> bool:
    return part.colors is not None and texture_of(part) is None


def _picture(mi: ModuleType, linear: NDArray[np.float32]) -> Bsdf:
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(linear)), "raw": True}


def _floats(array: NDArray) -> NDArray[np.float32]:
    return np.ascontiguousarray(array, np.float32).ravel()


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
        integrator = {"type": kind, "max_depth": bounces + 1, "rr_depth": ROULETTE_DEPTH}
        shown = appearance.surround is not None and appearance.surround.shown and appearance.backdrop is None
        integrator |= {"hide_emitters": not shown}
        traced = {"sensor": self.sensor(camera), "integrator": self._mi.load_dict(integrator), "seed": seed}
        image = self._mi.render(built.scene, spp=round_up_samples(render.path_samples), **traced)
        pixels = np.array(image, np.float64)
        covered = np.clip(pixels[..., 3:], 0.0, 1.0)
        light = pixels[..., :3] + (1.0 - covered) * _behind(appearance, *covered.shape[:2])
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
                if part.material.emission > 0.0:
                    light, weight = level_light(appearance), tree["sky"]["sampling_weight"]
                    tree |= window_of(self._mi, part, thing.T_world_shape, light, weight)
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


def _behind(appearance: Appearance, height: int, width: int) -> Array:
    """[3] or [height, width, 3] linear light where nothing is."""
    if appearance.backdrop is None:
        return np.array(appearance.background)
    return np.asarray(SRGB_STEPS[fill_image(appearance.backdrop, width, height)], np.float64)


@cache
def shared_tracer() -> Tracer:
    """This process's tracer, made at the first call."""
    return Tracer()


def encode_light(light: Array) -> NDArray[np.uint8]:
    """[H, W, 3] uint8 sRGB of traced light, without fireflies and through the tone curve."""
    return encode_codes(tone_map(clamp_fireflies(light)))


def clamp_fireflies(light: Array) -> Array:
    """Reduces pixels brighter than `FIREFLY_RATIO` times the second brightest of eight neighbours to the latter's level.

    A path that finds the key light in a mirror leaves such a pixel; lines, edges and spots of three pixels stay.
    """
    from scipy.ndimage import rank_filter  # takes 36 ms to load, and every worker loads this file

    level = light @ LUMINANCE
    ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
    border = "mirror" if min(level.shape) > 1 else "nearest"
    second = rank_filter(level, -2, footprint=ring, mode=border)
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


def draw_view(
    renderer: Renderer,
    things: Sequence[Placed],
    appearance: Appearance,
    camera: Camera,
    render: Render,
    rng: Callable[[], np.random.Generator],
    effects: EffectPlan,
) -> GBuffer:
    """What one camera sees in any tier, with the effects of the plan. RGB is None without `rgb`.

    Labels are the label pass's in all tiers; colour is drawn by the same pass or traced. `rng` makes the generator that seeds
    the paths: a tenth of a millisecond, which tiers without paths do without.
    """
    drawn = renderer.draw(things, appearance, camera, render, effects)
    if render.tier != "pathtraced" or not effects.runs("rgb"):
        return drawn
    seed = int(rng().integers(2**32))  # as many as Mitsuba's samplers tell apart
    rgb = encode_light(shared_tracer().radiance(things, appearance, camera, render, effects, seed))
    rgb.setflags(write=False)
    return replace(drawn, rgb=rgb)
