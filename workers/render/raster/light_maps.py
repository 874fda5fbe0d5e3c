"""The GPU's side of a scene's light: the shadow map and two level maps of the scene drawn last, and no other's.

Views of one scene follow one another, so one scene is all that is kept; the textures are made once and overwritten.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.scene.appearance import Appearance
from schemas.scene.region import REGION_FLOOR
from schemas.scene.scene import Placed
from workers.render.raster import baking
from workers.render.raster.baking import MAP_PX, SHADOW_PX, Box
from workers.render.raster.buffers import ShapeStore
from workers.render.raster.lit_shaders import CAST_FRAGMENT, CAST_VERTEX
from workers.render.raster.programs import Program, ThingMaps

UPRIGHT = 1.0 - 1e-9
"""Cosine between two directions that are one."""

SAME_LEVEL_M = 5e-4
"""What lies this near to a level is lit as if it lay on it."""

LEVEL_UNIT, SHADOW_UNIT = 1, 2
"""Texture units; unit 0 is the albedo's."""


@dataclass(frozen=True, eq=False)
class Baked:
    """Where the maps lie in the world; `light` is None where nothing casts a shadow."""

    light: Box | None
    floor: Box | None
    stand: Box | None


class SceneLight:
    """Makes and holds the maps; `prepare` before drawing a view, `bind` before drawing a thing of it."""

    def __init__(self, gl: ModuleType, shapes: ShapeStore) -> None:
        self._gl, self._shapes = gl, shapes
        self._program = Program(gl, CAST_VERTEX, CAST_FRAGMENT)
        self._shadow = self._depth_texture()
        self._floor, self._stand, self._open = (self._color_texture() for _ in range(3))
        self._upload(self._open, np.full((1, 1, 4), (255, 255, 0, 255), np.uint8))
        self._framebuffer = int(gl.glGenFramebuffers(1))
        gl.glBindFramebuffer(gl.GL_FRAMEBUFFER, self._framebuffer)
        gl.glFramebufferTexture2D(gl.GL_FRAMEBUFFER, gl.GL_DEPTH_ATTACHMENT, gl.GL_TEXTURE_2D, self._shadow, 0)
        gl.glDrawBuffer(gl.GL_NONE)
        self._key: tuple[object, ...] = ()
        self._held: tuple[object, ...] = ()
        self._baked = Baked(None, None, None)
        self._places: dict[int, tuple[Placed, ThingMaps]] = {}
        self.bakes = 0
        """How often maps were made."""

    def prepare(self, things: Sequence[Placed], appearance: Appearance) -> None:
        """Make the scene's maps, unless they are there. Binds a framebuffer of its own where it does."""
        key = (id(appearance), *((id(t.shape), t.T_world_shape.tobytes(), t.region_id) for t in things))
        if key == self._key:
            return
        self._key, self._held = key, (appearance, *(thing.shape for thing in things))
        self._places.clear()
        self._baked = self._bake(things, appearance)
        self.bakes += 1

    def top_is_level(self, thing: Placed) -> bool:
        """Whether a thing's highest points, if its up is the world's, lie on the level that objects stand on."""
        stand, T = self._baked.stand, thing.T_world_shape
        if stand is None or T[2, 2] < UPRIGHT:
            return False
        top = T[2, 3] + float(max(part.vertices[:, 2].max() for part in thing.shape.parts))
        return abs(top - float(stand.bounds[0, 2])) < SAME_LEVEL_M

    def bind(self, program: Program, thing: Placed) -> None:
        """The maps that a thing is lit with, for the program in use."""
        gl, baked = self._gl, self._baked
        ground = thing.region_id == REGION_FLOOR
        level = baked.floor if ground else baked.stand
        texture = self._open if level is None else self._floor if ground else self._stand
        for unit, name in ((LEVEL_UNIT, texture), (SHADOW_UNIT, self._shadow)):
            gl.glActiveTexture(gl.GL_TEXTURE0 + unit)
            gl.glBindTexture(gl.GL_TEXTURE_2D, name)
        gl.glActiveTexture(gl.GL_TEXTURE0)
        if id(thing) not in self._places:
            self._places[id(thing)] = (thing, self._place(thing))
        program.set_maps(self._places[id(thing)][1])

    def free(self) -> None:
        """Give the GPU's memory back."""
        self._gl.glDeleteFramebuffers(1, [self._framebuffer])
        self._gl.glDeleteTextures(4, [self._shadow, self._floor, self._stand, self._open])
        self._program.free()

    def _bake(self, things: Sequence[Placed], appearance: Appearance) -> Baked:
        solid, objects = baking.casters(things), baking.standing(things)
        if not solid or not appearance.lights:
            return Baked(None, None, None)
        towards, triangles = appearance.lights[0].direction, baking.triangles_of(solid)
        light = baking.light_box(triangles[0], towards)
        depth = self._cast(solid, light.clip_from_world)
        floor = baking.level_box(triangles[0], 0.0, towards, baking.FLOOR_REACH_M)
        below = [thing for thing in solid if thing not in objects] or solid
        lit = baking.level_shadow(depth, light, floor, towards)
        self._upload(self._floor, baking.level_pixels(*baking.triangles_of(below), floor, lit, hollow=True))
        if not objects:
            return Baked(light, floor, None)
        upper, faces = baking.triangles_of(objects)
        stand = baking.level_box(upper, baking.level_of(upper), towards, baking.STAND_REACH_M)
        lit = baking.level_shadow(depth, light, stand, towards)
        self._upload(self._stand, baking.level_pixels(upper, faces, stand, lit, hollow=False))
        return Baked(light, floor, stand)

    def _place(self, thing: Placed) -> ThingMaps:
        """Where a thing lies in the maps that light it."""
        baked = self._baked
        level = baked.floor if thing.region_id == REGION_FLOOR else baked.stand
        if baked.light is None:
            return ThingMaps.of(np.zeros((4, 4)), np.diag([0.0, 0.0, 0.0, 1.0]), (0.0, 1.0, 0.0))
        level_from_shape = np.zeros((4, 4)) if level is None else level.unit_from_world @ thing.T_world_shape
        shadow_from_shape = baked.light.unit_from_world @ thing.T_world_shape
        return ThingMaps.of(level_from_shape, shadow_from_shape, baking.soft_radius(baked.light))

    def _cast(self, things: list[Placed], clip_from_world: Pose) -> NDArray[np.float32]:
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
            for batch in self._shapes.fetch(thing.shape).batches:
                gl.glBindVertexArray(batch.vertex_array)
                gl.glDrawElements(gl.GL_TRIANGLES, batch.index_count, gl.GL_UNSIGNED_INT, None)
        depth = np.empty((SHADOW_PX, SHADOW_PX), np.float32)
        gl.glReadPixels(0, 0, SHADOW_PX, SHADOW_PX, gl.GL_DEPTH_COMPONENT, gl.GL_FLOAT, depth)
        gl.glDepthFunc(gl.GL_GREATER)
        return depth

    def _depth_texture(self) -> int:
        gl = self._gl
        name = self._texture(gl.GL_LINEAR, (1.0, 1.0, 1.0, 1.0))
        gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_COMPARE_MODE, gl.GL_COMPARE_REF_TO_TEXTURE)
        gl.glTexParameteri(gl.GL_TEXTURE_2D, gl.GL_TEXTURE_COMPARE_FUNC, gl.GL_LEQUAL)
        form = (gl.GL_DEPTH_COMPONENT32F, SHADOW_PX, SHADOW_PX, 0, gl.GL_DEPTH_COMPONENT, gl.GL_FLOAT, None)
        gl.glTexImage2D(gl.GL_TEXTURE_2D, 0, *form)
        return name

    def _color_texture(self) -> int:
        return self._texture(self._gl.GL_LINEAR, (1.0, 1.0, 0.0, 1.0))

    def _texture(self, filtering: int, border: tuple[float, float, float, float]) -> int:
        """A texture, bound, that shows `border` outside of [0, 1]."""
        gl = self._gl
        name = int(gl.glGenTextures(1))
        gl.glBindTexture(gl.GL_TEXTURE_2D, name)
        for setting in (gl.GL_TEXTURE_MIN_FILTER, gl.GL_TEXTURE_MAG_FILTER):
            gl.glTexParameteri(gl.GL_TEXTURE_2D, setting, filtering)
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


MAP_BYTES = 4 * (SHADOW_PX**2 + 2 * MAP_PX**2 + 1)
"""All that is ever held."""
