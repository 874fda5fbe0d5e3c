"""Draw calls of a pass over a scene, and the GLSL programs that they run.

A program takes cameras, lights and poses as uniforms. A draw call is the triangles of one thing and program, with the depth
bias of its region.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.job.look import MOST_LIGHTS
from schemas.scene.scene import EffectPlan, Placed
from schemas.scene.shape import REGION_FLOOR, REGION_TABLE, Appearance, Shape
from schemas.scene.view import Intrinsics
from workers.geometry.camera import NEAR_M
from workers.geometry.frames import transform
from workers.geometry.irradiance import turn_polynomials
from workers.render.raster.batches import Cover, is_matte, seen_ranges, texture_of
from workers.render.raster.buffers import FEW_OPEN, Uploaded, UploadedShape
from workers.render.raster.shaders import Variant

LEVEL_UNIT, SHADOW_UNIT = 1, 2
"""Texture units of the light maps; unit 0 is the albedo's."""


class MapPlacement(NamedTuple):
    """A thing's pose in the light maps of its scene: matrices in float32, row-major.

    level_from_shape, shadow_from_shape [4, 4]: to (u, v, elevation or depth) in units of the map; shadow_normal [3, 3]: the
    inverse transpose of the latter's linear part; softness: filter radius, depth bias and pixel size of the shadow map.
    """

    level_from_shape: NDArray[np.float32]
    shadow_from_shape: NDArray[np.float32]
    shadow_normal: NDArray[np.float32]
    softness: tuple[float, float, float]


class PlacedLights(NamedTuple):
    """The ambient light [3], and distant lights in a camera's frame, each [N, 3] float32; unused slots are dark."""

    ambient: tuple[float, ...]
    towards: NDArray[np.float32]
    color: NDArray[np.float32]


class Program:
    """A linked program; raises RuntimeError, with the compiler's log, where the driver refuses it."""

    def __init__(self, gl: ModuleType, vertex: str, fragment: str) -> None:
        self._gl = gl
        self._name = _link(gl, vertex, fragment)
        count = gl.glGetProgramiv(self._name, gl.GL_ACTIVE_UNIFORMS)
        names = [gl.glGetActiveUniform(self._name, i)[0].decode().removesuffix("[0]") for i in range(count)]
        self._locations = {name: int(gl.glGetUniformLocation(self._name, name)) for name in names}

    def use(self) -> None:
        """Draw with this program from now on."""
        self._gl.glUseProgram(self._name)

    def set_view(self, k: Intrinsics) -> None:
        """Set the camera's intrinsics, also as the matrix from the optical frame to clip space with x right and y *down*.

        Window x = (x_clip / w + 1) * width / 2 = fx * X / Z + cx, and likewise y. z_clip = 2 near - Z is at most w = Z
        exactly where Z >= near, and always above -w; window depth is near / Z, which falls with distance. There is no far
        plane.
        """
        clip_from_cam = [
            [2.0 * k.fx / k.width, 0.0, 2.0 * k.cx / k.width - 1.0, 0.0],
            [0.0, 2.0 * k.fy / k.height, 2.0 * k.cy / k.height - 1.0, 0.0],
            [0.0, 0.0, -1.0, 2.0 * NEAR_M],
            [0.0, 0.0, 1.0, 0.0],
        ]
        self._gl.glUniformMatrix4fv(self._location("clip_from_cam"), 1, True, clip_from_cam)
        self._gl.glUniform4f(self._location("view"), k.cx, k.cy, 1.0 / k.fx, 1.0 / k.fy)

    def set_light(self, lights: PlacedLights) -> None:
        """Set the ambient and the distant lights."""
        gl, count = self._gl, len(lights.towards)
        gl.glUniform3f(self._location("ambient"), *lights.ambient)
        gl.glUniform3fv(self._location("light_towards"), count, lights.towards)
        gl.glUniform3fv(self._location("light_color"), count, lights.color)

    def set_ambience(self, view: "RenderPass") -> None:
        """Set, for tier raster, the world's up, the light from around, the sheen, and the units of the light maps."""
        gl = self._gl
        gl.glUniform3f(self._location("up"), *view.T_cam_world[:3, 2])
        gl.glUniform3f(self._location("below"), *view.appearance.below)
        gl.glUniform1f(self._location("sheen"), view.appearance.sheen)
        if view.around is not None:
            gl.glUniform3fv(self._location("around"), len(view.around), view.around)
        gl.glUniform1i(self._location("level_map"), LEVEL_UNIT)
        gl.glUniform1i(self._location("shadow_map"), SHADOW_UNIT)

    def set_sky(self, map_from_cam: Array, scale: float) -> None:
        """Set the turn [3, 3] from the optical frame to that of a map, and the factor of its light (sky.py)."""
        self._gl.glUniformMatrix3fv(self._location("map_from_cam"), 1, True, map_from_cam.astype(np.float32))
        self._gl.glUniform1f(self._location("scale"), scale)

    def set_plain(self, srgb: NDArray[np.float32]) -> None:
        """Set the colour [3] of what has one (ground.py)."""
        self._gl.glUniform3f(self._location("plain_srgb"), *srgb.tolist())

    def set_maps(self, maps: MapPlacement) -> None:
        """Set a thing's pose in the light maps."""
        gl = self._gl
        gl.glUniformMatrix4fv(self._location("level_from_shape"), 1, True, maps.level_from_shape)
        gl.glUniformMatrix4fv(self._location("shadow_from_shape"), 1, True, maps.shadow_from_shape)
        gl.glUniformMatrix3fv(self._location("shadow_normal"), 1, True, maps.shadow_normal)
        gl.glUniform3f(self._location("softness"), *maps.softness)

    def set_cast(self, clip_from_shape: Pose) -> None:
        """Set a thing's pose in an orthographic view."""
        self._gl.glUniformMatrix4fv(self._location("clip_from_shape"), 1, True, clip_from_shape.astype(np.float32))

    def set_thing(self, T_cam_shape: Pose, region_id: int, bias: float, nearer: float) -> None:
        """Set a thing's pose, its region id, and its bias in the depth test, as shares of its distance.

        `bias` moves it back where fragments compute their own depth, `nearer` moves it forward where the rasteriser
        interpolates depth.
        """
        matrix = T_cam_shape.astype(np.float32)
        self._gl.glUniformMatrix4fv(self._location("cam_from_shape"), 1, True, matrix)
        self._gl.glUniform2f(self._location("thing"), region_id / 255.0, bias)
        self._gl.glUniform1f(self._location("nearer"), 2.0 * NEAR_M * nearer)

    def _location(self, name: str) -> int:
        """A uniform's location; -1, which OpenGL ignores, where the compiler removed it."""
        return self._locations.get(name, -1)


def light_slots(appearance: Appearance, raster: bool) -> int:
    """Number of lights that the program has: one, two for tier flat, three or `MOST_LIGHTS`, unused ones dark.

    Each number of lights needs programs of its own, of some megabytes each. All scenes of tier flat have two lights; those of
    tier raster have one, two or three. Raises ValueError above `MOST_LIGHTS`.
    """
    for slots in (1, 3, MOST_LIGHTS) if raster else (1, 2, 3, MOST_LIGHTS):
        if len(appearance.lights) <= slots:
            return slots
    raise ValueError(f"{len(appearance.lights)} lights: the renderer takes at most {MOST_LIGHTS}")


def _link(gl: ModuleType, vertex: str, fragment: str) -> int:
    """A linked program; raises RuntimeError with the compiler's log."""
    program = int(gl.glCreateProgram())
    for kind, text in ((gl.GL_VERTEX_SHADER, vertex), (gl.GL_FRAGMENT_SHADER, fragment)):
        shader = gl.glCreateShader(kind)
        gl.glShaderSource(shader, text)
        gl.glCompileShader(shader)
        if not gl.glGetShaderiv(shader, gl.GL_COMPILE_STATUS):
            raise RuntimeError(f"a shader does not compile: {gl.glGetShaderInfoLog(shader).decode()}")
        gl.glAttachShader(program, shader)
        gl.glDeleteShader(shader)
    gl.glLinkProgram(program)
    if not gl.glGetProgramiv(program, gl.GL_LINK_STATUS):
        raise RuntimeError(f"a program does not link: {gl.glGetProgramInfoLog(program).decode()}")
    return program


NAMES = {REGION_FLOOR: "floor", REGION_TABLE: "table"}
"""Effects that draw one thing; objects are always drawn."""

DEPTH_BIAS = 2e-6
"""Share of its distance, along its normal, by which each rank of `rank_regions` moves a face back in the depth test: 5
micrometres at 2.5 m. A quarter of it is the least that kept 400 pairs of coplanar squares apart."""

FLOOR_BIAS = 1e-5
"""Share of its distance by which the depth test takes the floor as nearer than it is. The floor is tested by the
rasteriser's depth, exact to 3e-6 of the distance, so that its hidden pixels are not shaded; its stored depth is the plane's."""

NEIGHBOURS_M = 1e-3
"""Things whose bounding boxes are farther apart than this share no face."""


@dataclass(frozen=True, eq=False)
class RenderPass:
    """One pass over all things of a scene: camera, light, and what is drawn."""

    appearance: Appearance
    k: Intrinsics
    T_cam_world: Pose
    effects: EffectPlan
    color: bool
    """Whether colour is drawn, in tier flat or raster."""
    raster: bool
    """Whether that colour is of tier raster."""
    labels: bool = True
    """Whether depth and region are drawn."""
    cut: bool = False
    """Whether clear texels are cut out; in a pass for colour alone."""
    open: bool = False
    """Whether the scene has no light maps; in tier raster."""

    @cached_property
    def lights(self) -> PlacedLights:
        """The lights as the camera sees them. Raises ValueError where there are too many."""
        dark = self.open and not any(any(light.color) for light in self.appearance.lights)
        count = 0 if dark else light_slots(self.appearance, self.raster)
        towards, color = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
        for i, light in enumerate(self.appearance.lights[:count]):
            towards[i], color[i] = self.T_cam_world[:3, :3] @ light.direction, light.color
        return PlacedLights(self.appearance.ambient, towards, color)

    @cached_property
    def around(self) -> NDArray[np.float32] | None:
        """[18, 3]: the terms of the surround as the camera sees it; None without one."""
        if not self.raster or self.appearance.surround is None:
            return None
        return turn_polynomials(self.appearance.surround.terms, self.T_cam_world[:3, :3]).astype(np.float32)

    def shift(self, x_px: float, y_px: float) -> "RenderPass":
        """The same with every pixel's centre moved by (x_px, y_px)."""
        return replace(self, k=self.k.model_copy(update={"cx": self.k.cx - x_px, "cy": self.k.cy - y_px}))


@dataclass(frozen=True, eq=False)
class Draw:
    """One draw call: `count` indices of a thing's batch from `first` on."""

    thing: Placed
    T_cam_shape: Pose
    batch: Uploaded
    culls: bool
    """Whether back faces are skipped."""
    first: int
    count: int


def is_drawn(effects: EffectPlan, name: str, needed: bool) -> bool:
    """Whether an exact no-op runs for one batch or view, given whether that needs it."""
    return name in effects.forced or (needed and effects.runs(name))


def sort_draws(
    things: Sequence[Placed],
    fetch: Callable[[Shape], UploadedShape],
    view: RenderPass,
    has_level_top: Callable[[Placed], bool],
    ground_z: bool = True,
) -> dict[Variant, list[Draw]]:
    """Draw calls by program. The floor comes last, so that its hidden pixels are not shaded.

    `has_level_top` tells whether the top of a thing has a level map; only tier raster asks. `ground_z`: whether z of the floor
    is drawn. Raises ValueError above six lights.
    """
    lights, raster = len(view.lights.towards) if view.color else 1, view.raster
    by_variant: dict[Variant, list[Draw]] = {}
    for thing in reversed(things):
        name = NAMES.get(thing.region_id)
        if name is not None and not view.effects.runs(name):
            continue
        shape, ground = fetch(thing.shape), is_floor(thing)
        split = raster and has_level_top(thing)
        has_holes = any(batch.holes for batch in shape.batches)
        hides = thing.region_id == REGION_TABLE and not (view.cut and has_holes)
        T_cam_shape = view.T_cam_world @ thing.T_world_shape
        beyond_near = is_beyond_near(shape, T_cam_shape)
        culls = hides_backs(shape, beyond_near, through_holes=not view.labels)
        cover = shape.cover if hides and beyond_near else None
        for batch in shape.batches:
            textured = view.color and is_drawn(view.effects, "textures", batch.texture is not None)
            cutout = view.cut and textured and is_drawn(view.effects, "transparency", batch.holes)
            for first, count, top in _ranges(batch, split, cover, T_cam_shape):
                level = view.open or (split and top) or (raster and ground and not split)
                # Each program takes megabytes; only floors and tops of tables are large enough to gain from their own.
                planar = view.color and batch.few_triangles and (batch.planar_top if top else batch.planar)
                matte = ground and planar and batch.matte
                if matte:
                    matte = level if raster else textured or is_plain(thing.shape, view)
                few = batch.few_triangles or (view.open and batch.index_count <= 3 * FEW_OPEN)
                look = (view.color, textured, few, matte, lights, raster)
                place = (ground, level, view.open, view.labels)
                variant = Variant(*look, *place, cutout, planar, ground and not ground_z, view.around is not None)
                by_variant.setdefault(variant, []).append(Draw(thing, T_cam_shape, batch, culls, first, count))
    return by_variant


def is_floor(thing: Placed) -> bool:
    """Whether a thing is the level floor, and not the walls, which have its region too."""
    low, high = thing.shape.bounds[:, 2]
    return thing.region_id == REGION_FLOOR and bool(low == high)


def is_plain(shape: Shape, view: RenderPass) -> bool:
    """Whether a shape is one level plane that is seen in one colour, whatever its distance and direction."""
    part, *others = shape.parts
    if view.raster or others or not is_matte(part):
        return False
    textured = is_drawn(view.effects, "textures", texture_of(part) is not None)
    return not textured and part.vertices[:, 2].min() == part.vertices[:, 2].max()


def hides_backs(shape: UploadedShape, beyond_near: bool, through_holes: bool = False) -> bool:
    """Whether no back face can be seen: of a closed body that the near plane does not cut, nor holes in its texture."""
    cut = through_holes and any(batch.holes for batch in shape.batches)
    return shape.closed and not cut and beyond_near


def is_beyond_near(shape: UploadedShape, T_cam_shape: Pose) -> bool:
    """Whether the near plane cuts nothing off a shape."""
    return bool((shape.corners @ T_cam_shape[2, :3] + T_cam_shape[2, 3] > NEAR_M).all())


def _ranges(batch: Uploaded, split: bool, cover: Cover | None, T_cam_shape: Pose) -> Iterator[tuple[int, int, bool]]:
    """(first index, count, whether it is the top, apart from the rest) of what is drawn of a batch.

    `split`: its top apart from the rest. With a cover also, and without what that hides from the camera.
    """
    hides = cover is not None and len(batch.faces) > 0
    if not split and not hides:
        yield 0, batch.index_count, False
        return
    if batch.top_count:
        yield 0, batch.top_count, True
    if cover is not None and hides:
        lower = batch.faces[batch.top_count // 3 :]
        eye = -T_cam_shape[:3, 3] @ T_cam_shape[:3, :3]
        for first, count in seen_ranges(batch.positions, lower, cover, eye):
            yield batch.top_count + 3 * first, 3 * count, False
    elif batch.top_count < batch.index_count:
        yield batch.top_count, batch.index_count - batch.top_count, False


def rank_regions(things: Sequence[Placed], corners: Sequence[Array]) -> dict[int, int]:
    """The rank of each region in the depth test: one more than that of any of a lower id that it may share a face with.

    By its bias the lowest region id wins among coplanar faces. corners: those of each thing's bounding box [8, 3] in its own
    frame. Only things whose boxes meet can have coplanar faces at one place: twenty objects side by side all have the rank
    of a single one.
    """
    boxes: dict[int, tuple[Array, Array]] = {}
    for thing, box in zip(things, corners, strict=True):
        placed = transform(thing.T_world_shape, box)
        low, high = boxes.get(thing.region_id, (placed[0], placed[0]))
        boxes[thing.region_id] = np.minimum(low, placed.min(axis=0)), np.maximum(high, placed.max(axis=0))
    regions = sorted(boxes)
    low, high = (np.array([boxes[region][k] for region in regions]).reshape(-1, 3) for k in (0, 1))
    before = (low[:, None] < high[None] + NEIGHBOURS_M).all(axis=2)
    meets = np.logical_and(before, before.T)
    ranks = np.zeros(len(regions), np.int64)
    for number in range(1, len(regions)):
        ranks[number] = (1 + ranks[:number][meets[number, :number]]).max(initial=0)
    return dict(zip(regions, ranks.tolist(), strict=True))
