"""The light maps of one scene on the GPU: the shadow map of the key light and two level maps (baking.py).

Views of one scene follow one another, so the maps of one scene are kept; the textures are made once and overwritten.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.scene.scene import Placed
from schemas.scene.shape import LAMP_RAD, REGION_FIRST_OBJECT, REGION_FLOOR, Appearance
from workers.render.raster import baking
from workers.render.raster.baking import SHADOW_PX, Box
from workers.render.raster.buffers import ShapeStore
from workers.render.raster.draw_calls import LEVEL_UNIT, SHADOW_UNIT, MapPlacement, Program, is_floor
from workers.render.raster.lit_shaders import CAST_VERTEX, EMPTY_FRAGMENT

UPRIGHT = 1.0 - 1e-9
"""Least cosine between two directions that count as equal."""

SAME_LEVEL_M = 5e-4
"""Surfaces no farther than this from a level are lit by its map."""

LIT_AND_OPEN = (255, 255, 0, 255)
"""Texel of a level map where nothing stands."""


@dataclass(frozen=True, eq=False)
class Baked:
    """The boxes in the world that the maps cover; `light` is None without shadows, a level's box without its map."""

    light: Box | None = None
    floor: Box | None = None
    stand: Box | None = None
    lamp_rad: float = LAMP_RAD


class LightMaps:
    """Makes and holds the maps: `prepare` before drawing a view, `bind` before drawing a thing of it."""

    def __init__(self, gl: ModuleType, shapes: ShapeStore) -> None:
        self._gl, self._shapes = gl, shapes
        self._program = Program(gl, CAST_VERTEX, EMPTY_FRAGMENT)
        self._shadow = self._depth_texture()
        self._floor, self._stand, self._open = (self._texture((1.0, 1.0, 0.0, 1.0)) for _ in range(3))
        self._upload(self._open, np.full((1, 1, 4), LIT_AND_OPEN, np.uint8))
        self._framebuffer = int(gl.glGenFramebuffers(1))
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._framebuffer)
        gl.glFramebufferTexture2D(gl.GL_FRAMEBUFFER, gl.GL_DEPTH_ATTACHMENT, gl.GL_TEXTURE_2D, self._shadow, 0)
        gl.glDrawBuffer(gl.GL_NONE)
        self._key: tuple[object, ...] = ()
        self._held: tuple[object, ...] = ()
        self._baked = Baked()
        self._placements: dict[int, tuple[Placed, MapPlacement]] = {}

    def prepare(self, things: Sequence[Placed], appearance: Appearance, shadows: bool, occlusion: bool) -> None:
        """Make the scene's maps, unless they are there; where it makes them, it binds a framebuffer of its own.

        Without `shadows` the key light reaches every surface; without `occlusion` the whole sky is seen from everywhere.
        """
        placed = ((id(t.shape), t.T_world_shape.tobytes(), t.region_id) for t in things)
        key = (id(appearance), shadows, occlusion, *placed)
        if key == self._key:
            return
        self._key, self._held = key, (appearance, *(thing.shape for thing in things))  # ids stay theirs while held
        self._placements.clear()
        self._baked = self._bake(things, appearance, shadows, occlusion)

    @property
    def absent(self) -> bool:
        """Whether the scene has none: all light reaches every surface."""
        return self._baked.floor is None

    def has_level_top(self, thing: Placed) -> bool:
        """Whether a thing is upright and its highest points lie on the level that objects stand on."""
        stand, T = self._baked.stand, thing.T_world_shape
        if stand is None or T[2, 2] < UPRIGHT:
            return False
        top = T[2, 3] + float(self._shapes.fetch(thing.shape).corners[:, 2].max())
        return abs(top - float(stand.bounds[0, 2])) < SAME_LEVEL_M

    def bind(self, program: Program, thing: Placed) -> None:
        """Bind the maps that light a thing, for the program in use."""
        gl, baked = self._gl, self._baked
        ground = is_floor(thing)
        level = baked.floor if ground else baked.stand
        texture = self._open if level is None else self._floor if ground else self._stand
        for unit, name in ((LEVEL_UNIT, texture), (SHADOW_UNIT, self._shadow)):
            gl.glActiveTexture(gl.GL_TEXTURE0 + unit)
            gl.glBindTexture(gl.GL_TEXTURE_2D, name)
        gl.glActiveTexture(gl.GL_TEXTURE0)
        if id(thing) not in self._placements:
            self._placements[id(thing)] = (thing, self._place(thing))
        program.set_maps(self._placements[id(thing)][1])

    def _bake(self, things: Sequence[Placed], appearance: Appearance, shadows: bool, occlusion: bool) -> Baked:
        casters = [thing for thing in things if thing.region_id > REGION_FLOOR]
        objects = [thing for thing in things if thing.region_id >= REGION_FIRST_OBJECT]
        if not casters or not appearance.lights or not (shadows or occlusion):
            return Baked()
        key = appearance.lights[0]
        towards, lamp_rad = key.direction, LAMP_RAD if key.size_rad is None else key.size_rad
        below = [thing for thing in casters if thing not in objects]
        lower, upper = baking.triangles_of(below or objects), baking.triangles_of(objects) if objects else None
        vertices = lower[0] if upper is None else np.concatenate([lower[0], upper[0]])
        light = baking.light_box(vertices, towards) if shadows else None
        depth = None if light is None else self._cast(casters, light.clip_from_world)

        def bake_level(texture: int, above: baking.Triangles, level: Box, hollow: bool) -> None:
            pixels = baking.level_pixels(*above, level, hollow)
            if not occlusion:
                pixels[..., :2] = 255
            if light is not None and depth is not None:
                pixels[..., 3] = baking.level_shadow(depth, light, level, towards, lamp_rad)
            self._upload(texture, pixels)

        floor = baking.level_box(vertices, 0.0, towards, baking.FLOOR_REACH_M)
        bake_level(self._floor, lower, floor, True)
        if upper is None:
            return Baked(light, floor, None, lamp_rad)
        stand = baking.level_box(upper[0], float(upper[0][:, 2].min()), towards, baking.STAND_REACH_M)
        bake_level(self._stand, upper, stand, False)
        return Baked(light, floor, stand, lamp_rad)

    def _place(self, thing: Placed) -> MapPlacement:
        """Where a thing lies in the maps that light it."""
        light = self._baked.light
        level = self._baked.floor if is_floor(thing) else self._baked.stand
        level_from_shape = np.zeros((4, 4)) if level is None else level.unit_from_world @ thing.T_world_shape
        # Without shadows all lies before the map, where light arrives.
        shadow_from_shape, softness = np.diag([0.0, 0.0, 0.0, 1.0]), (0.0, 1.0, 0.0)
        linear_inverse: NDArray = np.zeros((3, 3))
        if light is not None:
            shadow_from_shape, softness = (
                light.unit_from_world @ thing.T_world_shape,
                baking.shadow_filter(light, self._baked.lamp_rad),
            )
            linear_inverse = np.linalg.inv(shadow_from_shape[:3, :3])
        matrices = (level_from_shape, shadow_from_shape, linear_inverse.T)
        on_level, on_shadow, normal = (matrix.astype(np.float32) for matrix in matrices)
        return MapPlacement(on_level, on_shadow, normal, softness)

    def _cast(self, things: Sequence[Placed], clip_from_world: Pose) -> NDArray[np.float32]:
        """[SHADOW_PX, SHADOW_PX] float32: least depth of things in an orthographic view; 1 where there is none."""
        gl = self._gl
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._framebuffer)
        gl.glViewport(0, 0, SHADOW_PX, SHADOW_PX)
        gl.glEnable(gl.GL_DEPTH_TEST)
        gl.glDepthFunc(gl.GL_LESS)
        gl.glClearBufferfv(gl.GL_DEPTH, 0, np.ones(1, np.float32))
        self._program.use()
        for thing in things:
            self._program.set_cast(clip_from_world @ thing.T_world_shape)
            shape = self._shapes.fetch(thing.shape)
            # A closed body is nearest to the light where it faces it.
            (gl.glEnable if shape.closed else gl.glDisable)(gl.GL_CULL_FACE)
            for batch in shape.batches:
                gl.glBindVertexArray(batch.vertex_array)
                gl.glDrawElements(gl.GL_TRIANGLES, batch.index_count, gl.GL_UNSIGNED_INT, None)
        gl.glDisable(gl.GL_CULL_FACE)
        depth = np.empty((SHADOW_PX, SHADOW_PX), np.float32)
        gl.glReadPixels(0, 0, SHADOW_PX, SHADOW_PX, gl.GL_DEPTH_COMPONENT, gl.GL_FLOAT, depth)
        gl.glDepthFunc(gl.GL_GREATER)
        return depth

    def _depth_texture(self) -> int:
        gl = self._gl
        name = self._texture((1.0, 1.0, 1.0, 1.0))
        gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_COMPARE_MODE, gl.GL_COMPARE_REF_TO_TEXTURE)
        gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_COMPARE_FUNC, gl.GL_LEQUAL)
        form = (gl.GL_DEPTH_COMPONENT32F, SHADOW_PX, SHADOW_PX, 0, gl.GL_DEPTH_COMPONENT, gl.GL_FLOAT, None)
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, *form)
        return name

    def _texture(self, border: tuple[float, float, float, float]) -> int:
        """A texture, bound, interpolated, that shows `border` outside of [0, 1]."""
        gl = self._gl
        name = int(gl.glGenTextures(1))
        gl.glBindTexture(gl.GL_TEXTURE_2D, name)
        for setting in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, setting, gl.GL_LINEAR)
        for setting in (gl.GL_TEXTURE_WRAP_S, gl.GL_TEXTURE_WRAP_T):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, setting, gl.GL_CLAMP_TO_BORDER)
        gl.glTexParameterfv(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_BORDER_COLOR, np.array(border, np.float32))
        return name

    def _upload(self, texture: int, pixels: NDArray[np.uint8]) -> None:
        gl = self._gl
        gl.glBindTexture(gl.GL_TEXTURE_2D, texture)
        gl.glPixelStorei(gl.GL_UNPACK_ALIGNMENT, 1)
        height, width = pixels.shape[:2]
        form = (gl.GL_RGBA8, width, height, 0, gl.GL_RGBA, gl.GL_UNSIGNED_BYTE, np.ascontiguousarray(pixels))
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, *form)
