"""Pure: cuts a solid into the parts of a shape, with shading normals and texture coordinates."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from schemas.base import Array
from schemas.scene.shape import Material, Part, Shape
from workers.assets.builtin.solid import TRIG_DIGITS, Indices, Solid, renumber
from workers.geometry.jit import compiled


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
    shaded, point = renumber(solid.smooth[:, None] * len(vertices) + solid.faces)
    point %= len(vertices)
    across, normals = _shade(vertices, solid.faces, shaded, len(point))
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


@compiled
def _shade(vertices: Array, faces: Indices, shaded: Indices, count: int) -> tuple[Array, Array]:
    """The faces' area vectors [3, F], twice their area long, and the shading normals [count, 3] of the points.

    shaded [F, 3]: the faces as numbers of the points to shade. A normal is the unit mean of those of the faces around its
    point. A face counts by its area vector over the squares of the two sides that meet in the point, which is exact on
    spheres and independent of how a rectangle is cut in two (Max, "Weights for computing vertex normals from facet
    normals", 1999). Terms are added corner by corner of all faces.
    """
    across, pairs = np.empty((3, len(faces))), np.empty((3, len(faces)))
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        x, y, z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        u, v, w = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        i, j, k = c[0] - b[0], c[1] - b[1], c[2] - b[2]
        across[0, f], across[1, f], across[2, f] = y * w - z * v, z * u - x * w, x * v - y * u
        ab, ca, bc = x * x + y * y + z * z, u * u + v * v + w * w, i * i + j * j + k * k
        pairs[0, f], pairs[1, f], pairs[2, f] = ca * ab, ab * bc, bc * ca
    normals = np.zeros((count, 3))
    for corner in range(3):
        for f in range(len(faces)):
            pair, point = pairs[corner, f], normals[shaded[f, corner]]
            weight = 1.0 / (pair if pair != 0.0 else 1.0)
            point[0] += weight * across[0, f]
            point[1] += weight * across[1, f]
            point[2] += weight * across[2, f]
    for point in normals:
        length = math.sqrt(point[0] * point[0] + point[1] * point[1] + point[2] * point[2])
        if length != 0.0:
            point /= length
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
        turn, wrapped = _wrap(vertices, faces)
        reach = surface.high - surface.low
        return wrapped, lambda point, variant: np.stack(
            [turn[point] + variant, (vertices[point, 2] - surface.low) / reach], axis=1
        )
    if surface.mapping == "plane":
        axes = np.array([surface.across, surface.up])
        axes /= (axes * axes).sum(axis=1)[:, None]
        local = vertices - np.array(surface.origin)
        return np.zeros_like(faces), lambda point, variant: np.stack(
            [(local[point] * axis).sum(axis=1) for axis in axes], axis=1
        )
    low, sides = vertices.min(axis=0), np.array(_SIDES[surface.grain])
    axis = np.abs(across).argmax(axis=0)
    return np.repeat(axis[:, None], 3, axis=1), lambda point, variant: _lay(
        vertices, low, surface.size, sides, point, variant
    )


_EIGHTHS = np.array([round(math.atan(k / 8.0), 15) for k in range(9)])
"""[9] float64: the angles with tangents 0, 1/8, ... 1."""

_DIGITS = 10.0**TRIG_DIGITS


@compiled
def _lay(vertices: Array, low: Array, size: float, sides: Indices, point: Indices, variant: Indices) -> Array:
    """uv [N, 2] of points by number: the two of their coordinates that `sides` [3, 2] names for the variant."""
    uv = np.empty((len(point), 2))
    for n in range(len(point)):
        for k in range(2):
            side = sides[variant[n], k]
            uv[n, k] = (vertices[point[n], side] - low[side]) / size
    return uv


@compiled
def _wrap(vertices: Array, faces: Indices) -> tuple[Array, Indices]:
    """The turns [V] of `turns_about_z` of the points that the faces [F, 3] name, and 1 for each that is a turn further on."""
    turn = np.zeros(len(vertices))
    known = np.zeros(len(vertices), np.bool_)
    wrapped = np.empty_like(faces)
    for f in range(len(faces)):
        for k in range(3):
            point = faces[f, k]
            if not known[point]:
                turn[point], known[point] = _turn(vertices[point, 0], vertices[point, 1]), True
        a, b, c = turn[faces[f, 0]], turn[faces[f, 1]], turn[faces[f, 2]]
        seam = max(a, b, c) - min(a, b, c) > 0.5
        for k in range(3):
            wrapped[f, k] = seam and turn[faces[f, k]] < 0.5
    return turn, wrapped


@compiled
def turns_about_z(x: Array, y: Array) -> Array:
    """[N] float64: the angle of (x, y) in turns, in [0, 1), to `TRIG_DIGITS` digits; 0 at the origin."""
    turns = np.empty(len(x))
    for n in range(len(x)):
        turns[n] = _turn(x[n], y[n])
    return turns


@compiled
def _turn(x: float, y: float) -> float:
    """One of `turns_about_z`.

    By +, -, * and / alone, where the C library's atan2 gives other bits on other processors: the tangent t in [0, 1] of
    the angle to the nearest axis, less the nearest k/8, is small enough for a short series:
    atan t = atan k/8 + atan s, s = (t - k/8) / (1 + t k/8).
    """
    wide, high = abs(x), abs(y)
    steep = high > wide
    long, short = (high, wide) if steep else (wide, high)
    t = short / (long if long != 0.0 else 1.0)
    step = np.rint(8.0 * t)
    near = step / 8.0
    s = (t - near) / (1.0 + t * near)
    square = s * s
    series = 0.0
    for power in (11.0, 9.0, 7.0, 5.0, 3.0, 1.0):
        series = 1.0 / power - square * series
    turn = (_EIGHTHS[int(step)] + s * series) / (2.0 * math.pi)
    if steep:
        turn = 0.25 - turn
    if x < 0.0:
        turn = 0.5 - turn
    if y < 0.0:
        turn = 1.0 - turn
    turned = np.rint(turn * _DIGITS) / _DIGITS
    return turned if turned < 1.0 else 0.0
