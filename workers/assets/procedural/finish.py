"""Pure: a painted solid becomes the parts of a shape, with shading normals and texture coordinates."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from schemas.base import Array
from schemas.shape import Material, Part, Shape
from workers.assets.procedural.solid import TRIG_DIGITS, Indices, Solid

Wrap = Literal["none", "cylinder", "plane", "grain"]


@dataclass(frozen=True, eq=False)
class Surface:
    """The look of some faces of a solid, and how its texture lies on them.

    `wrap`: `cylinder` turns u once round the z axis and v from `low` to `high` in z; `plane` runs u along `across` and
    v along `up` (vectors [3] from `origin` whose lengths are one texture); `grain` projects along the axis that the
    face looks along, u along the axis `grain` wherever that is not the same one, one texture for `size` metres.
    """

    name: str
    material: Material
    wrap: Wrap = "none"
    low: float = 0.0
    high: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    across: tuple[float, float, float] = (1.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    size: float = 1.0
    grain: int = 0


@dataclass(frozen=True, eq=False)
class Model:
    """What a family makes: a closed solid, true metres, z up, standing on its lowest plane; and its surfaces by number."""

    solid: Solid
    surfaces: tuple[Surface, ...]


_SIDES = (((1, 2), (0, 2), (0, 1)), ((1, 2), (0, 2), (1, 0)), ((2, 1), (2, 0), (0, 1)))
"""u and v for the axis that the grain runs along and the axis that a face looks along."""


def cut_into_parts(solid: Solid, surfaces: Sequence[Surface], centre: Array, scale: float) -> Shape:
    """The solid as one part for each surface, its points at scale * (point - centre).

    Points on a border between parts are the same doubles in both, so that the parts together are watertight.
    """
    vertices = (solid.vertices - centre) * scale
    a, b, c = (vertices[solid.faces[:, k]] for k in range(3))
    sides = (b - a, c - b, a - c)
    across = np.cross(sides[0], -sides[2])
    shaded, point = _dense(solid.smooth[:, None] * len(vertices) + solid.faces)
    point %= len(vertices)
    normals = _shading_normals(shaded, across, sides, len(point))
    parts = []
    for number, surface in enumerate(surfaces):
        chosen = np.flatnonzero(solid.surface == number)
        if len(chosen):
            corners = shaded[chosen]
            variant, coordinates = _texture_variants(surface, solid.vertices, point[corners], across[chosen])
            index, origin = _dense(corners * 3 + variant)
            uv = None if coordinates is None else coordinates(point[origin // 3], origin % 3)
            parts.append(_part(surface, vertices[point[origin // 3]], index, normals[origin // 3], uv))
    return Shape(tuple(parts), closed=True)


def _part(surface: Surface, vertices: Array, faces: Indices, normals: Array, uv: Array | None) -> Part:
    corners = faces.astype(np.int32)
    for array in (vertices, corners, normals, uv):
        if array is not None:
            array.setflags(write=False)
    return Part(surface.name, vertices, corners, surface.material, normals=normals, uv=uv)


def _dense(keys: Indices) -> tuple[Indices, Indices]:
    """Keys [...] int64 renumbered 0, 1, 2, ... in their order, and the key that each number stands for."""
    flat = keys.ravel()
    seen = np.zeros(int(flat.max()) + 1, dtype=np.bool_)
    seen[flat] = True
    number = np.cumsum(seen) - 1
    return number[keys], np.flatnonzero(seen)


def _shading_normals(corners: Indices, across: Array, sides: tuple[Array, Array, Array], count: int) -> Array:
    """[count, 3] float64: for each point the unit mean of the normals of the faces [F, 3] around it.

    A face counts by its area vector over the squares of the two sides that meet in the point, which is exact on
    spheres and does not mind how a rectangle is cut in two (Max, "Weights for computing vertex normals from facet
    normals", 1999).
    """
    square = [side[:, 0] ** 2 + side[:, 1] ** 2 + side[:, 2] ** 2 for side in sides]
    pairs = np.stack([square[2] * square[0], square[0] * square[1], square[1] * square[2]], axis=1)
    weight = 1.0 / np.where(pairs == 0.0, 1.0, pairs)
    flat = corners.ravel()
    summed = np.stack([np.bincount(flat, (across[:, k : k + 1] * weight).ravel(), count) for k in range(3)], axis=1)
    length = np.sqrt(summed[:, 0] ** 2 + summed[:, 1] ** 2 + summed[:, 2] ** 2)
    return summed / np.where(length == 0.0, 1.0, length)[:, None]


Coordinates = Callable[[Indices, Indices], Array]
"""uv [N, 2] of points by number and variant (0, 1 or 2): a seam or an edge gives one point several places."""


def _texture_variants(
    surface: Surface, vertices: Array, faces: Indices, across: Array
) -> tuple[Indices, Coordinates | None]:
    """Which variant [F, 3] of its points each face uses, and the texture coordinates of a point's variants."""
    if surface.wrap == "cylinder":
        turn = _turns(vertices, faces)
        beyond = turn[faces]
        wrapped = (beyond.max(axis=1) - beyond.min(axis=1) > 0.5)[:, None] & (beyond < 0.5)
        reach = surface.high - surface.low
        return wrapped.astype(np.int64), lambda point, variant: np.stack(
            [turn[point] + variant, (vertices[point, 2] - surface.low) / reach], axis=1
        )
    if surface.wrap == "plane":
        axes = np.array([surface.across, surface.up])
        axes /= (axes * axes).sum(axis=1)[:, None]
        local = vertices - np.array(surface.origin)
        return np.zeros_like(faces), lambda point, variant: np.stack(
            [(local[point] * axis).sum(axis=1) for axis in axes], axis=1
        )
    if surface.wrap == "grain":
        axis = np.abs(across).argmax(axis=1)
        low = vertices.min(axis=0)
        sides = np.array(_SIDES[surface.grain])
        return np.repeat(axis[:, None], 3, axis=1), lambda point, variant: np.take_along_axis(
            (vertices[point] - low) / surface.size, sides[variant], axis=1
        )
    return np.zeros_like(faces), None


def _turns(vertices: Array, faces: Indices) -> Array:
    """[V] float64: for the points that the faces name, the angle about the z axis in turns, in [0, 1).

    Python's atan2, rounded, and not numpy's, which gives other bits with other vector instructions.
    """
    turn = np.zeros(len(vertices))
    used = np.unique(faces)
    angles = [round(math.atan2(y, x) / (2.0 * math.pi), TRIG_DIGITS) for x, y in vertices[used, :2].tolist()]
    turn[used] = [angle + 1.0 if angle < 0.0 else angle for angle in angles]
    return turn
