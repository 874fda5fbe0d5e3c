"""Pure: cuts a solid into the parts of a shape, with shading normals and texture coordinates."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Material, Part, Shape
from workers.assets.builtin.solid import TRIG_DIGITS, Indices, Solid, renumber


@dataclass(frozen=True, eq=False)
class Surface:
    """The material of some faces of a solid, and how its texture, if it has one, is mapped onto them.

    `mapping`: `cylinder` runs u once around the z axis and v from `low` to `high` in z; `plane` runs u along `across` and
    v along `up` (vectors [3] from `origin` whose lengths are one texture); `box` projects along the axis that the face
    normal is closest to, u along the axis `grain` wherever that is another one, one texture for `size` metres.
    """

    name: str
    material: Material
    mapping: Literal["cylinder", "plane", "box"] = "cylinder"
    low: float = 0.0
    high: float = 1.0
    origin: Sequence[float] | Array = (0.0, 0.0, 0.0)
    across: Sequence[float] | Array = (1.0, 0.0, 0.0)
    up: Sequence[float] | Array = (0.0, 0.0, 1.0)
    size: float = 1.0
    grain: int = 0


@dataclass(frozen=True, eq=False)
class Model:
    """A built-in shape: a closed solid in metres, z up, standing on its lowest plane, and its surfaces by number."""

    solid: Solid
    surfaces: tuple[Surface, ...]


def over_top(name: str, material: Material, width: float, depth: float) -> Surface:
    """A surface whose texture lies once over a width x depth, metres, about the z axis, seen from above."""
    origin = (-width / 2, -depth / 2, 0.0)
    return Surface(name, material, "plane", origin=origin, across=(width, 0.0, 0.0), up=(0.0, depth, 0.0))


_SIDES = (((1, 2), (0, 2), (0, 1)), ((1, 2), (0, 2), (1, 0)), ((2, 1), (2, 0), (0, 1)))
"""u and v for the axis that the grain runs along and the axis that a face looks along."""


def cut_into_parts(solid: Solid, surfaces: Sequence[Surface], centre: Array, scale: float) -> Shape:
    """One part for each surface of the solid, its points at scale * (point - centre).

    Points on a border between parts are the same doubles in both, so that the parts together are watertight.
    """
    vertices = (solid.vertices - centre) * scale
    across, normals_at = _face_vectors(vertices, solid.faces)
    shaded, point = renumber(solid.smooth[:, None] * len(vertices) + solid.faces)
    point %= len(vertices)
    normals = normals_at(shaded, len(point))
    order = np.argsort(solid.surface, kind="stable")
    stops = np.cumsum(np.bincount(solid.surface, minlength=len(surfaces)))
    parts = []
    for surface, start, stop in zip(surfaces, [0, *stops[:-1]], stops, strict=True):
        if start < stop:
            chosen = order[start:stop]
            corners = shaded[chosen]
            variant, coordinates = _texture_variants(surface, solid.vertices, point[corners], across[:, chosen])
            if coordinates is None:
                index, origin = renumber(corners)
                uv = None
            else:
                index, origin = renumber(corners * 3 + variant)
                origin, which = np.divmod(origin, 3)
                uv = coordinates(point[origin], which)
            parts.append(_part(surface, vertices[point[origin]], index, normals[origin], uv))
    return Shape(tuple(parts), closed=True)


def _part(surface: Surface, vertices: Array, faces: Indices, normals: Array, uv: Array | None) -> Part:
    corners = faces.astype(np.int32)
    for array in (vertices, corners, normals, uv):
        if array is not None:
            array.setflags(write=False)
    return Part(surface.name, vertices, corners, surface.material, normals=normals, uv=uv)


def _face_vectors(vertices: Array, faces: Indices) -> tuple[Array, Callable[[Indices, int], Array]]:
    """The faces' area vectors [3, F], twice their area long, and a function that gives shading normals.

    The function takes the faces [F, 3] as numbers of `count` points, and gives [count, 3]: for each point the unit mean
    of the normals of the faces around it. A face counts by its area vector over the squares of the two sides that meet
    in the point, which is exact on spheres and independent of how a rectangle is cut in two (Max, "Weights for computing
    vertex normals from facet normals", 1999).
    """
    axes = np.ascontiguousarray(vertices.T)
    a, b, c = (np.take(axes, faces[:, k], axis=1) for k in range(3))
    (x, y, z), (u, v, w) = b - a, c - a
    across = np.stack([y * w - z * v, z * u - x * w, x * v - y * u])
    ab, bc, ca = (side[0] * side[0] + side[1] * side[1] + side[2] * side[2] for side in (b - a, c - b, a - c))
    pairs = np.stack([ca * ab, ab * bc, bc * ca])
    weight = 1.0 / np.where(pairs == 0.0, 1.0, pairs)

    def normals(corners: Indices, count: int) -> Array:
        flat = np.ascontiguousarray(corners.T).ravel()
        x, y, z = (np.bincount(flat, (weight * along).ravel(), count) for along in across)
        length = np.sqrt(x * x + y * y + z * z)
        return np.stack([x, y, z], axis=1) / np.where(length == 0.0, 1.0, length)[:, None]

    return across, normals


Coordinates = Callable[[Indices, Indices], Array]
"""Function of point numbers and variants (0, 1 or 2) that gives uv [N, 2]: at a seam or an edge a point has several."""


def _texture_variants(
    surface: Surface, vertices: Array, faces: Indices, across: Array
) -> tuple[Indices, Coordinates | None]:
    """The variant [F, 3] of its points that each face uses, and the texture coordinates of a point's variants.

    across [3, F]: the faces' area vectors.
    """
    if surface.material.texture is None:
        return np.zeros_like(faces), None
    if surface.mapping == "cylinder":
        turn = _turns(vertices, faces)
        beyond = turn[faces]
        wrapped = (beyond.max(axis=1) - beyond.min(axis=1) > 0.5)[:, None] & (beyond < 0.5)
        reach = surface.high - surface.low
        return wrapped.astype(np.int64), lambda point, variant: np.stack(
            [turn[point] + variant, (vertices[point, 2] - surface.low) / reach], axis=1
        )
    if surface.mapping == "plane":
        axes = np.array([surface.across, surface.up])
        axes /= (axes * axes).sum(axis=1)[:, None]
        local = vertices - np.array(surface.origin)
        return np.zeros_like(faces), lambda point, variant: np.stack(
            [(local[point] * axis).sum(axis=1) for axis in axes], axis=1
        )
    axis = np.abs(across).argmax(axis=0)
    low = vertices.min(axis=0)
    sides = np.array(_SIDES[surface.grain])
    return np.repeat(axis[:, None], 3, axis=1), lambda point, variant: np.take_along_axis(
        (vertices[point] - low) / surface.size, sides[variant], axis=1
    )


def _turns(vertices: Array, faces: Indices) -> Array:
    """[V] float64: the angle about the z axis in turns, in [0, 1), of the points that the faces name; 0 for others."""
    turn = np.zeros(len(vertices))
    used = np.zeros(len(vertices), dtype=np.bool_)
    used[faces] = True
    turn[used] = turns_about_z(vertices[used, 0], vertices[used, 1])
    return turn


def turns_about_z(x: Array, y: Array) -> Array:
    """[N] float64: the angle of (x, y) in turns, in [0, 1), to `TRIG_DIGITS` digits; 0 at the origin.

    By +, -, * and / alone, where numpy's atan2 gives other bits with other vector instructions: the tangent t in [0, 1]
    of the angle to the nearest axis, less the nearest k/8, is small enough for a short series:
    atan t = atan k/8 + atan s, s = (t - k/8) / (1 + t k/8).
    """
    wide, high = np.abs(x), np.abs(y)
    steep = high > wide
    long, short = np.where(steep, high, wide), np.where(steep, wide, high)
    t = short / np.where(long == 0.0, 1.0, long)
    step = np.rint(8.0 * t)
    near = step / 8.0
    s = (t - near) / (1.0 + t * near)
    square = s * s
    series = np.zeros_like(s)
    for power in (11.0, 9.0, 7.0, 5.0, 3.0, 1.0):
        series = 1.0 / power - square * series
    turn = (_EIGHTHS[step.astype(np.int64)] + s * series) / (2.0 * math.pi)
    turn = np.where(steep, 0.25 - turn, turn)
    turn = np.where(x < 0.0, 0.5 - turn, turn)
    turned = np.round(np.where(y < 0.0, 1.0 - turn, turn), TRIG_DIGITS)
    return np.where(turned >= 1.0, 0.0, turned).astype(np.float64)


_EIGHTHS = np.array([round(math.atan(k / 8.0), 15) for k in range(9)])
"""[9] float64: the angles with tangents 0, 1/8, ... 1."""
