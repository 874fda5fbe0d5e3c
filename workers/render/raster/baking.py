"""Light maps of a scene, made once and used by all of its views: pure functions.

**Shadow map.** The depth of everything but the floor as the key light sees it, `SHADOW_PX` square, fitted to the things.

**Level maps.** A level is a horizontal plane: the floor, with a map around the table, and the plane that objects stand on,
with a map around the objects. Each map is made from elevations on a grid of `LEVEL_PX` square. RGBA8: share of the sky seen from
the level, share seen from the top of what stands there, elevation of that top in units of the box, and share of the key light.
On the floor the last is the table's shadow, with an edge as wide as the lamp makes it from a table's height.

**Sky.** On a square grid, things are columns from `under` to `top` above the level. Seen from a point, in one horizontal
direction, columns hide the sky between two elevation angles a < b, a share sin^2 b - sin^2 a of the cosine-weighted sky (integral
of 2 sin cos). Sky visibility is the mean, over directions, of the remaining share.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array, Pose
from schemas.scene.scene import Placed
from schemas.scene.shape import LAMP_RAD, Mesh
from workers.geometry.frames import transform
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import bounds_of, join_meshes

DIRECTIONS = 8
REACHES = (1.0, 2.0, 3.5, 5.5, 8.5, 12.5, 18.0)
"""Distances of the sampled columns, in steps of the grid."""

_ANGLES = [2.0 * math.pi * (turn + 0.5) / DIRECTIONS for turn in range(DIRECTIONS)]
OFFSETS = np.array([[(round(r * math.cos(a)), round(r * math.sin(a))) for r in REACHES] for a in _ANGLES])
"""[DIRECTIONS, len(REACHES), 2]: steps (dx, dy) of the grid to the sampled columns."""


def column_extents(
    vertices: Array, faces: NDArray[np.integer], low: Array, step_m: float, size: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(top, under), each [size, size] float32 metres above `low[2]`: highest and lowest elevation of the triangles.

    Sampled at the centres of cells of `step_m`, the first of which begins at `low` (x along columns, y along rows). Both are
    0 where nothing is, and points below the level count as on it. Vertices [V, 3] in metres, faces [F, 3].
    """
    top, under = np.zeros((size, size), np.float32), np.full((size, size), np.inf, np.float32)
    local = (vertices - low) / np.array([step_m, step_m, 1.0])
    _fill_columns(local[:, 0] - 0.5, local[:, 1] - 0.5, np.maximum(local[:, 2], 0.0), faces, top, under)
    return top, np.where(np.isinf(under), np.float32(0.0), under)


@compiled_for("f8[::1], f8[::1], f8[::1], i4[:,::1], f4[:,::1], f4[:,::1]")
def _fill_columns(
    x: Array, y: Array, z: Array, faces: NDArray[np.integer], top: NDArray[np.float32], under: NDArray[np.float32]
) -> None:
    """Interpolates z by barycentric coordinates at each grid point within a triangle's bounding box."""
    size = len(top)
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        area = (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])
        if area == 0.0:
            continue
        first = max(int(np.ceil(min(x[a], x[b], x[c]))), 0)
        last = min(int(np.floor(max(x[a], x[b], x[c]))), size - 1)
        for row in range(
            max(int(np.ceil(min(y[a], y[b], y[c]))), 0), min(int(np.floor(max(y[a], y[b], y[c]))), size - 1) + 1
        ):
            for column in range(first, last + 1):
                of_c = ((x[b] - x[a]) * (row - y[a]) - (column - x[a]) * (y[b] - y[a])) / area
                of_b = ((column - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (row - y[a])) / area
                if of_b >= 0.0 and of_c >= 0.0 and of_b + of_c <= 1.0:
                    elevation = np.float32(z[a] + of_b * (z[b] - z[a]) + of_c * (z[c] - z[a]))
                    top[row, column] = max(top[row, column], elevation)
                    under[row, column] = min(under[row, column], elevation)


@compiled_for("f4[:,::1], f4[:,::1], f4[:,::1], f8")
def sky_visibility(
    top: NDArray[np.float32], under: NDArray[np.float32], base: NDArray[np.float32], step_m: float
) -> NDArray[np.float32]:
    """[N, N] in [0, 1]: share of the sky seen from points `base` [N, N] metres above the level.

    top, under [N, N] metres above the level, both 0 where there is nothing, as around the grid.
    """
    size, step2 = len(top), np.float32(step_m * step_m)
    one, zero = np.float32(1.0), np.float32(0.0)
    sky = np.empty_like(top)
    hidden, high, low = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    for y in range(size):  # a row at a time, so that the loops over it are vectorised
        here, shown = base[y], sky[y]
        hidden[:] = zero
        for turn in range(OFFSETS.shape[0]):
            high[:], low[:] = zero, one
            for reach in range(OFFSETS.shape[1]):
                dx, dy = OFFSETS[turn, reach, 0], OFFSETS[turn, reach, 1]
                if not 0 <= y + dy < size:
                    break
                first, count = max(-dx, 0), size - abs(dx)
                tops, unders = top[y + dy, first + dx :], under[y + dy, first + dx :]
                bases, highs, lows = here[first:], high[first:], low[first:]
                square = np.float32(dx * dx + dy * dy) * step2
                for x in range(count):
                    rise, foot = tops[x] - bases[x], max(unders[x] - bases[x], zero)
                    to_top, to_foot = rise * rise / (rise * rise + square), foot * foot / (foot * foot + square)
                    highs[x] = max(highs[x], to_top) if rise > zero else highs[x]
                    lows[x] = min(lows[x], to_foot) if rise > zero else lows[x]
            for x in range(size):
                hidden[x] += max(high[x] - low[x], zero)
        for x in range(size):
            shown[x] = one - hidden[x] / np.float32(OFFSETS.shape[0])
    return sky


SHADOW_PX = 768
LEVEL_PX = 56
MAP_PX = 192
"""Side of a level map, fine enough for the edges of shadows: 13 mm a pixel under a large table, 3 mm about an object."""

SOFT_M = 0.1
"""Radius of the shadow's edge on tables and objects by the lamp's angle: half of it over 20 cm."""

WIDEST_RAD = 0.25
"""The edge of a wider lamp's shadow is drawn as this one's: four taps would show as four shadows."""

BIAS_M = 0.0015
"""A surface no deeper than this below the shadow map's depth is lit: half a pixel of the map, seen slantwise."""

STEEP_SINE = 0.6
"""Sine of the key light's elevation below which a level's depth changes by more than `BIAS_M` in a pixel of the map."""

LOWEST_SINE = 0.2
"""Least sine of the key light's elevation for which a level map reaches to the end of the shadows."""

SCENE_MARGIN_M = 0.02
FLOOR_REACH_M = 0.35
"""Margin of the floor's map around the table and its shadow."""
STAND_REACH_M = 0.15
"""Margin of the objects' level map around them and their shadow."""

Triangles = tuple[Array, NDArray[np.int32]]
"""(vertices [V, 3] in the world, faces [F, 3])."""


@dataclass(frozen=True, eq=False)
class Box:
    """An orthographic view: `T_view_world` [4, 4] (a rotation), and its bounds [2, 3], lower and upper, metres."""

    T_view_world: Pose
    bounds: Array

    @cached_property
    def unit_from_world(self) -> Pose:
        """[4, 4]: world to (u, v, depth), each in [0, 1] within the box."""
        size = self.bounds[1] - self.bounds[0]
        scale = np.diag([*(1.0 / size), 1.0])
        scale[:3, 3] = -self.bounds[0] / size
        return scale @ self.T_view_world

    @property
    def clip_from_world(self) -> Pose:
        """[4, 4]: world to (u, v, depth), each in [-1, 1] within the box."""
        spread = np.diag([2.0, 2.0, 2.0, 1.0])
        spread[:3, 3] = -1.0
        return spread @ self.unit_from_world


def light_box(vertices: Array, towards: Array) -> Box:
    """A distant light's view of vertices [N, 3]; depth grows away from it. `towards` [3]: unit, to the light."""
    z = -towards
    x = np.cross([0.0, 1.0, 0.0] if abs(towards[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.stack([x, np.cross(z, x), z])
    low, high = bounds_of(transform(T, vertices))
    return Box(T, np.stack([low - SCENE_MARGIN_M, high + SCENE_MARGIN_M]))


def level_box(vertices: Array, level_m: float, towards: Array, reach_m: float) -> Box:
    """A square on a level around vertices [N, 3] and their shadow, with a margin of `reach_m`; depth is elevation."""
    low, high = bounds_of(vertices)
    top = max(float(high[2]), level_m + 0.01)
    low, high = low[:2], high[:2]
    if towards[2] > LOWEST_SINE:
        shadow_low, shadow_high = bounds_of(_fall_on_level(np.ascontiguousarray(vertices), level_m, towards))
        low, high = np.minimum(low, shadow_low), np.maximum(high, shadow_high)
    centre, half = (low + high) / 2, float((high - low).max()) / 2 + reach_m
    return Box(np.eye(4), np.array([[*(centre - half), level_m], [*(centre + half), top]]))


@compiled_for("f8[:,::1], f8, const(f8[::1])", "f8[:,::1], f8, f8[::1]")
def _fall_on_level(vertices: Array, level_m: float, towards: Array) -> Array:
    """[N, 2]: the shadows of vertices [N, 3] on a level, of vertices below it those vertices."""
    shadows = np.empty((len(vertices), 2))
    for n in range(len(vertices)):
        along = max(vertices[n, 2] - level_m, 0.0) / towards[2]
        shadows[n, 0], shadows[n, 1] = vertices[n, 0] - along * towards[0], vertices[n, 1] - along * towards[1]
    return shadows


def level_pixels(vertices: Array, faces: NDArray[np.int32], box: Box, hollow: bool) -> NDArray[np.uint8]:
    """[MAP_PX, MAP_PX, 4] uint8 of a level map that the key light reaches everywhere.

    vertices [V, 3] in the world and faces [F, 3] of the things on or over the level. `hollow`: light also comes in below
    them, as under a table; otherwise they reach down to the level.
    """
    size = box.bounds[1] - box.bounds[0]
    step_m = float(size[0]) / LEVEL_PX
    top, under = column_extents(vertices, faces, box.bounds[0], step_m, LEVEL_PX)
    nothing = np.zeros_like(top)
    under = under if hollow else nothing
    from_level = sky_visibility(top, under, nothing, step_m)
    from_top = sky_visibility(top, nothing, top, step_m) if not under.any() else from_level
    soft = [cv2.GaussianBlur(image, (0, 0), 0.8) for image in (from_level, from_top)]
    elevation = top / np.float32(size[2])
    image = cv2.resize(cv2.merge([*soft, elevation]), (MAP_PX, MAP_PX), interpolation=cv2.INTER_LINEAR)
    pixels = np.full((MAP_PX, MAP_PX, 4), 255, np.uint8)
    _encode_shares(np.asarray(image, np.float32), pixels)
    return pixels


@compiled_for("f4[:,:,::1], u1[:,:,::1]")
def _encode_shares(shares: NDArray[np.float32], codes: NDArray[np.uint8]) -> None:
    """Shares [H, W, C], clipped to [0, 1], in 255ths into the first C channels of codes [H, W, D]."""
    zero, one, most = np.float32(0.0), np.float32(1.0), np.float32(255.0)
    for row in range(shares.shape[0]):
        for column in range(shares.shape[1]):
            for channel in range(shares.shape[2]):
                share = min(max(shares[row, column, channel], zero), one)
                codes[row, column, channel] = np.uint8(np.int32(np.rint(most * share)))


def level_shadow(
    depth: NDArray[np.float32], light: Box, level: Box, towards: Array, lamp_rad: float = LAMP_RAD
) -> NDArray[np.uint8]:
    """[MAP_PX, MAP_PX] uint8: share of the key light on a level, from the shadow map's depth [S, S].

    A shadow's edge is as wide as the lamp's angle times the distance to the caster: sharp where a thing stands, soft where
    the shadow of its top falls (percentage-closer soft shadows, Fernando 2005, as a blend of a narrow and a wide blur).
    """
    low, high = level.bounds
    step = (high[:2] - low[:2]) / MAP_PX
    columns, rows = (low[axis] + (np.arange(MAP_PX) + 0.5) * step[axis] for axis in (0, 1))
    u, v, z = _place_level(light.unit_from_world, columns, rows, float(low[2]), np.float32(len(depth)))
    nearest = np.asarray(cv2.remap(depth, u, v, cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, 1.0), np.float32)
    away_m = (z - nearest) * np.float32(light.bounds[1, 2] - light.bounds[0, 2])
    pixel_m, sine = float((light.bounds[1] - light.bounds[0])[:2].max()) / len(depth), float(towards[2])
    slant_m = pixel_m * math.sqrt(1.0 - sine**2) / max(sine, 0.01) if sine < STEEP_SINE else 0.0
    dark = ((away_m > np.float32(max(BIAS_M, slant_m))) & (nearest < 1.0)).astype(
        np.float32
    )  # elsewhere the level itself is nearest to it
    farthest_m = float((high[2] - low[2]) / max(float(towards[2]), LOWEST_SINE))
    wide_px = max(0.3 * lamp_rad * farthest_m / float(step[0]), 1.0)
    narrow = cv2.GaussianBlur(dark, (0, 0), 0.8)
    wide = cv2.GaussianBlur(dark, (0, 0), wide_px)
    away = cv2.GaussianBlur(away_m * dark, (0, 0), wide_px)
    narrow, wide, away = (np.asarray(image, np.float32) for image in (narrow, wide, away))
    return _blend_shadows(narrow, wide, away, np.float32(farthest_m))


@compiled_for("f8[:,::1], f8[::1], f8[::1], f8, f4")
def _place_level(
    M: Array, columns: Array, rows: Array, level_m: float, side_px: np.float32
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """(u, v, depth), each [R, C] float32: pixels of a light's map, and depth in units of its box, of points on a level."""
    shape, half = (len(rows), len(columns)), np.float32(0.5)
    u, v, z = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.float32)
    for i in range(shape[0]):
        for j in range(shape[1]):
            x, y = columns[j], rows[i]
            u[i, j] = np.float32(M[0, 0] * x + M[0, 1] * y + M[0, 2] * level_m + M[0, 3]) * side_px - half
            v[i, j] = np.float32(M[1, 0] * x + M[1, 1] * y + M[1, 2] * level_m + M[1, 3]) * side_px - half
            z[i, j] = np.float32(M[2, 0] * x + M[2, 1] * y + M[2, 2] * level_m + M[2, 3])
    return u, v, z


@compiled_for("f4[:,::1], f4[:,::1], f4[:,::1], f4")
def _blend_shadows(
    narrow: NDArray[np.float32], wide: NDArray[np.float32], away_m: NDArray[np.float32], farthest_m: np.float32
) -> NDArray[np.uint8]:
    """[R, C] uint8: the share of light beside a shadow, blended by the mean distance to what casts it."""
    codes = np.empty(narrow.shape, np.uint8)
    zero, one, least = np.float32(0.0), np.float32(1.0), np.float32(1e-4)
    for i in range(narrow.shape[0]):
        for j in range(narrow.shape[1]):
            mean_m = away_m[i, j] / max(wide[i, j], least)
            share = min(max(mean_m / farthest_m, zero), one) * min(wide[i, j] * np.float32(50.0), one)
            shade = min(max(narrow[i, j] + share * (wide[i, j] - narrow[i, j]), zero), one)
            codes[i, j] = np.uint8(np.int32(np.rint(np.float32(255.0) * (one - shade))))
    return codes


def triangles_of(things: Sequence[Placed]) -> Triangles:
    """The triangles of all things together."""
    mesh = join_meshes([Mesh(transform(each.T_world_shape, each.shape.vertices), each.shape.faces) for each in things])
    return mesh.vertices, mesh.faces


def shadow_filter(light: Box, lamp_rad: float = LAMP_RAD) -> tuple[float, float, float]:
    """(filter radius, depth bias, pixel size) of the shadow map, in units of the light's box."""
    size = light.bounds[1] - light.bounds[0]
    return (
        SOFT_M * min(lamp_rad, WIDEST_RAD) / float(math.sqrt(size[0] * size[1])),
        BIAS_M / float(size[2]),
        1.0 / SHADOW_PX,
    )
