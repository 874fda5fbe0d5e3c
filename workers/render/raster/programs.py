"""GLSL programs and their uniforms: cameras, lights and poses on their way to the GPU."""

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

    def set_view(self, k: Intrinsics, clip_from_cam: NDArray[np.floating]) -> None:
        """Set the camera's intrinsics, also as the matrix that `clip_from_cam` makes of them."""
        self._gl.glUniformMatrix4fv(self._location("clip_from_cam"), 1, True, clip_from_cam)
        self._gl.glUniform4f(self._location("view"), k.cx, k.cy, 1.0 / k.fx, 1.0 / k.fy)

    def set_light(self, lights: PlacedLights) -> None:
        """Set the ambient and the distant lights."""
        gl, count = self._gl, len(lights.towards)
        gl.glUniform3f(self._location("ambient"), *lights.ambient)
        gl.glUniform3fv(self._location("light_towards"), count, lights.towards)
        gl.glUniform3fv(self._location("light_color"), count, lights.color)

    def set_ambience(self, appearance: Appearance, T_cam_world: Pose) -> None:
        """Set, for tier raster, the world's up, the light from below, and the units of the light maps."""
        gl = self._gl
        gl.glUniform3f(self._location("up"), *T_cam_world[:3, 2])
        gl.glUniform3f(self._location("below"), *appearance.below)
        gl.glUniform1i(self._location("level_map"), LEVEL_UNIT)
        gl.glUniform1i(self._location("shadow_map"), SHADOW_UNIT)

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


def place_lights(appearance: Appearance, T_cam_world: Pose, raster: bool) -> PlacedLights:
    """The lights of a scene as a camera sees them, for programs of tier raster or flat. Raises as `light_slots`."""
    count = light_slots(appearance, raster)
    towards, color = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    for i, light in enumerate(appearance.lights):
        towards[i], color[i] = T_cam_world[:3, :3] @ light.direction, light.color
    return PlacedLights(appearance.ambient, towards, color)


def light_slots(appearance: Appearance, raster: bool) -> int:
    """Number of lights that the program has: one, two for tier flat, three or `MAX_LIGHTS`, unused ones dark.

    Each number of lights needs programs of its own, of some megabytes each. All scenes of tier flat have two lights; those of
    tier raster have one, two or three. Raises ValueError above `MAX_LIGHTS`.
    """
    for slots in (1, 3, MAX_LIGHTS) if raster else (1, 2, 3, MAX_LIGHTS):
        if len(appearance.lights) <= slots:
            return slots
    raise ValueError(f"{len(appearance.lights)} lights: the renderer takes at most {MAX_LIGHTS}")


def clip_from_cam(k: Intrinsics) -> Pose:
    """[4, 4] float64: optical frame to clip space with x right and y *down*; there is no far plane.

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
