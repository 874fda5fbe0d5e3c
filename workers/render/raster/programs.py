"""GLSL programs and their uniforms: how a camera, its light and a thing's pose reach the GPU."""

from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Pose
from schemas.scene.appearance import Appearance
from schemas.scene.camera import Intrinsics
from workers.render.raster.shaders import MAX_LIGHTS

NEAR_M = 0.05
"""Surfaces nearer than this, along the optical axis, are not seen. There is no far plane."""


class ThingMaps(NamedTuple):
    """Where a thing lies in the maps of its scene's light: matrices in float32, row-major.

    level_from_shape, shadow_from_shape [4, 4]: to (u, v, height or depth) in units of the map; shadow_normal [3, 3]: the
    inverse transpose of the latter's linear part; softness: radius of the filter in the shadow map, what its depths are
    off by, and its pixel.
    """

    level_from_shape: NDArray[np.float32]
    shadow_from_shape: NDArray[np.float32]
    shadow_normal: NDArray[np.float32]
    softness: tuple[float, float, float]

    @staticmethod
    def of(level_from_shape: Pose, shadow_from_shape: Pose, softness: tuple[float, float, float]) -> "ThingMaps":
        """The same from float64."""
        normal = np.linalg.pinv(shadow_from_shape[:3, :3]).T
        return ThingMaps(
            level_from_shape.astype(np.float32),
            shadow_from_shape.astype(np.float32),
            normal.astype(np.float32),
            softness,
        )


class Program:
    """A linked program; raises RuntimeError, with the compiler's log, where the driver refuses it."""

    def __init__(self, gl: ModuleType, vertex: str, fragment: str) -> None:
        self._gl = gl
        self._name = _link(gl, vertex, fragment)
        count = gl.glGetProgramiv(self._name, gl.GL_ACTIVE_UNIFORMS)
        names = [gl.glGetActiveUniform(self._name, i)[0].decode().removesuffix("[0]") for i in range(count)]
        self._places = {name: int(gl.glGetUniformLocation(self._name, name)) for name in names}

    def use(self) -> None:
        """Make it the program that draws."""
        self._gl.glUseProgram(self._name)

    def set_view(self, k: Intrinsics) -> None:
        """The camera's intrinsics."""
        matrix = clip_from_cam(k).astype(np.float32)
        self._gl.glUniformMatrix4fv(self._place("clip_from_cam"), 1, True, matrix)
        self._gl.glUniform4f(self._place("view"), k.cx, k.cy, 1.0 / k.fx, 1.0 / k.fy)

    def set_light(self, appearance: Appearance, T_cam_world: Pose) -> None:
        """Ambient light and distant lights, turned into the camera's frame; a lone dark light where there is none."""
        gl, count = self._gl, light_slots(appearance)
        towards, color = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
        for i, light in enumerate(appearance.lights):
            towards[i], color[i] = T_cam_world[:3, :3] @ light.direction, light.color
        gl.glUniform3f(self._place("ambient"), *appearance.ambient)
        gl.glUniform3fv(self._place("light_towards"), count, towards)
        gl.glUniform3fv(self._place("light_color"), count, color)

    def set_ambience(self, appearance: Appearance, T_cam_world: Pose) -> None:
        """The world's up and the light from below, for the raster tier, and the units of its textures."""
        gl = self._gl
        gl.glUniform3f(self._place("up"), *T_cam_world[:3, 2])
        gl.glUniform3f(self._place("below"), *appearance.below)
        gl.glUniform1i(self._place("level_map"), 1)
        gl.glUniform1i(self._place("shadow_map"), 2)

    def set_maps(self, maps: ThingMaps) -> None:
        """Where a thing lies in the maps of the raster tier."""
        gl = self._gl
        gl.glUniformMatrix4fv(self._place("level_from_shape"), 1, True, maps.level_from_shape)
        gl.glUniformMatrix4fv(self._place("shadow_from_shape"), 1, True, maps.shadow_from_shape)
        gl.glUniformMatrix3fv(self._place("shadow_normal"), 1, True, maps.shadow_normal)
        gl.glUniform3f(self._place("softness"), *maps.softness)

    def set_cast(self, clip_from_shape: Pose) -> None:
        """Where a thing lies in an orthographic view."""
        self._gl.glUniformMatrix4fv(self._place("clip_from_shape"), 1, True, clip_from_shape.astype(np.float32))

    def set_thing(self, T_cam_shape: Pose, region_id: int, stand_back: float, ahead: float) -> None:
        """Where a thing is, its region id, and shares of its distance for the depth test.

        `stand_back` is how far it is pushed back where its fragments make their own depth, `ahead` how much nearer it is
        taken where the rasteriser interpolates it.
        """
        matrix = T_cam_shape.astype(np.float32)
        self._gl.glUniformMatrix4fv(self._place("cam_from_shape"), 1, True, matrix)
        self._gl.glUniform2f(self._place("thing"), region_id / 255.0, stand_back)
        self._gl.glUniform1f(self._place("ahead"), 2.0 * NEAR_M * ahead)

    def free(self) -> None:
        """Give the GPU's memory back."""
        self._gl.glDeleteProgram(self._name)

    def _place(self, name: str) -> int:
        """-1, which OpenGL ignores, for a uniform that the compiler found no use for."""
        return self._places.get(name, -1)


def light_slots(appearance: Appearance) -> int:
    """How many lights the program must have: one, three or `MAX_LIGHTS`, unused ones dark.

    Each number of lights has programs of its own, which take some megabytes each. Raises ValueError above `MAX_LIGHTS`.
    """
    for slots in (1, 3, MAX_LIGHTS):
        if len(appearance.lights) <= slots:
            return slots
    raise ValueError(f"{len(appearance.lights)} lights: the renderer takes at most {MAX_LIGHTS}")


def clip_from_cam(k: Intrinsics) -> Pose:
    """[4, 4] float64: optical frame to clip space with x right and y *down*; nothing is cut off at the far end.

    Window x = (x_clip / w + 1) * width / 2 = fx * X / Z + cx, and likewise y. z_clip = 2 near - Z is at most w = Z exactly
    where Z >= near, and always above -w; window depth is near / Z, which falls with distance.
    """
    return np.array(
        [
            [2.0 * k.fx / k.width, 0.0, 2.0 * k.cx / k.width - 1.0, 0.0],
            [0.0, 2.0 * k.fy / k.height, 2.0 * k.cy / k.height - 1.0, 0.0],
            [0.0, 0.0, -1.0, 2.0 * NEAR_M],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )


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
