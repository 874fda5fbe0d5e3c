"""Pure: cuts a solid into the parts of a shape, with shading normals and texture coordinates."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Material, Part, Shape
from workers.assets.builtin.solid import TRIG_DIGITS, Indices, Solid, renumber
from workers.geometry.jit import compiled, compiled_for
from workers.geometry.mesh import bounds_of


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


_SIDES = np.array([[[1, 2], [0, 2], [0, 1]], [[1, 2], [0, 2], [1, 0]], [[2, 1], [2, 0], [0, 1]]])
"""u and v for the axis that the grain runs along and the axis that a face looks along."""

_NONE, _CYLINDER, _PLANE, _BOX = range(4)
"""Mappings by number; `_NONE` where there is no texture."""


class _Mapping(NamedTuple):
    """How a texture is laid: `Surface` in numbers.

    origin [3]; reach: over how many metres v of a cylinder, or u and v of a box, grow by 1; axes [2, 3]: the gradients of u
    and v of a plane; sides [3, 2]: of a box.
    """

    kind: int
    origin: Array
    reach: float
    axes: Array
    sides: Indices


_NO_MAPPING = _Mapping(_NONE, np.zeros(3), 1.0, np.zeros((2, 3)), _SIDES[0])


def cut_into_parts(solid: Solid, surfaces: Sequence[Surface], centre: Array, scale: float) -> Shape:
    """One part for each surface of the solid, its points at scale * (point - centre).

    Points on a border between parts are the same doubles in both, so that the parts together are watertight.
    """
    vertices = (solid.vertices - centre) * scale
    corners, place = renumber(solid.smooth[:, None] * len(vertices) + solid.faces)
    place %= len(vertices)
    across, normals = _shade(vertices, solid.faces, corners, len(place))
    low = bounds_of(solid.vertices)[0]
    mappings = [_mapping(surface, low) for surface in surfaces]
    kinds, *how = (np.array(column) for column in zip(*mappings, strict=True))
    keys, turn = _vary(solid.vertices, solid.faces, corners, solid.surface, across, kinds)
    faces, names, stops = _collect(keys, solid.surface, len(place), len(surfaces))
    shaded, variant = np.divmod(names, 3)
    uv = _lay(solid.vertices, place[shaded], variant, turn, stops, kinds, *how)
    arrays = faces, vertices[place[shaded]], normals[shaded], uv
    for array in arrays:
        array.setflags(write=False)
    return Shape(tuple(_parts(surfaces, stops.tolist(), *arrays)), closed=True)


def _parts(
    surfaces: Sequence[Surface],
    stops: list[list[int]],
    faces: NDArray[np.int32],
    points: Array,
    normals: Array,
    uv: Array,
) -> Iterator[Part]:
    """The parts that the arrays hold one after another; stops: where each one's faces and points end, from [0, 0]."""
    for surface, (a, c), (b, d) in zip(surfaces, stops[:-1], stops[1:], strict=True):
        if a < b:
            laid = None if surface.material.texture is None else uv[c:d]
            yield Part(surface.name, points[c:d], faces[a:b], surface.material, normals=normals[c:d], uv=laid)


def _mapping(surface: Surface, low: Array) -> _Mapping:
    """The mapping of a surface; low [3]: the least coordinates of the solid, metres."""
    if surface.material.texture is None:
        return _NO_MAPPING
    if surface.mapping == "cylinder":
        origin = np.array([0.0, 0.0, surface.low])
        return _NO_MAPPING._replace(kind=_CYLINDER, origin=origin, reach=surface.high - surface.low)
    if surface.mapping == "plane":
        axes, origin = np.array([surface.across, surface.up], np.float64), np.array(surface.origin, np.float64)
        axes /= (axes * axes).sum(axis=1)[:, None]
        return _NO_MAPPING._replace(kind=_PLANE, origin=origin, axes=axes)
    return _NO_MAPPING._replace(kind=_BOX, origin=low, reach=surface.size, sides=_SIDES[surface.grain])


@compiled_for(
    "f8[:,::1], i8[:,::1], i8[:,::1], i8[::1], f8[:,::1], i8[::1]",
    "f8[:,::1], const(i8[:,::1]), i8[:,::1], i8[::1], f8[:,::1], i8[::1]",
)
def _vary(
    laid: Array, faces: Indices, corners: Indices, surface: Indices, across: Array, kinds: Indices
) -> tuple[Indices, Array]:
    """A key [F, 3] for each face's use of a shaded point: 3 * point + variant; and the turns [V] of points of cylinders.

    corners [F, 3]: the shaded points of faces [F, 3] into `laid` [V, 3]. The variant is, on a cylinder, 1 for a point that is
    a turn further on, in a box the axis that the face's area vector (across [3, F]) is nearest to, else 0.
    """
    keys, turn = np.empty((len(faces), 3), np.int64), np.full(len(laid), -1.0)
    for f in range(len(faces)):
        kind, a, b, c = kinds[surface[f]], faces[f, 0], faces[f, 1], faces[f, 2]
        u = v = w = 0
        if kind == _CYLINDER:
            for k in range(3):
                point = faces[f, k]
                if turn[point] < 0.0:
                    turn[point] = turn_about_z(laid[point, 0], laid[point, 1])
            if max(turn[a], turn[b], turn[c]) - min(turn[a], turn[b], turn[c]) > 0.5:
                u, v, w = int(turn[a] < 0.5), int(turn[b] < 0.5), int(turn[c] < 0.5)
        elif kind == _BOX:
            x, y, z = abs(across[0, f]), abs(across[1, f]), abs(across[2, f])
            u = v = w = (1 if z <= y else 2) if y > x else (2 if z > x else 0)
        keys[f, 0], keys[f, 1], keys[f, 2] = 3 * corners[f, 0] + u, 3 * corners[f, 1] + v, 3 * corners[f, 2] + w
    return keys, turn


@compiled_for("i8[:,::1], i8[::1], i8, i8")
def _collect(
    keys: Indices, surface: Indices, points: int, surfaces: int
) -> tuple[NDArray[np.int32], Indices, NDArray[np.int64]]:
    """The faces [F, 3] of each surface after the other, into its points, the keys [P] of these, ascending, and the stops.

    stops [surfaces + 1, 2]: where each surface's faces and points end, from 0, 0.
    """
    faces, names = np.empty((len(keys), 3), np.int32), np.empty(3 * len(keys), np.int64)
    stops = np.zeros((surfaces + 1, 2), np.int64)
    number = np.zeros(3 * points, np.int32)
    row = count = 0
    for s in range(surfaces):
        start, first, least, most = row, count, 3 * points, -1
        for f in range(len(keys)):
            if surface[f] == s:
                for k in range(3):
                    key = keys[f, k]
                    faces[row, k], number[key] = key, 1
                    least, most = min(least, key), max(most, key)
                row += 1
        for key in range(least, most + 1):
            if number[key]:
                number[key], names[count] = count - first, key
                count += 1
        for f in range(start, row):
            for k in range(3):
                faces[f, k] = number[faces[f, k]]
        for key in range(least, most + 1):
            number[key] = 0
        stops[s + 1, 0], stops[s + 1, 1] = row, count
    return faces, names[:count].copy(), stops


@compiled_for("f8[:,::1], i8[::1], i8[::1], f8[::1], i8[:,::1], i8[::1], f8[:,::1], f8[::1], f8[:,:,::1], i8[:,:,::1]")
def _lay(
    laid: Array,
    place: Indices,
    variant: Indices,
    turn: Array,
    stops: Indices,
    kinds: Indices,
    origins: Array,
    reaches: Array,
    axes: Array,
    sides: Indices,
) -> Array:
    """uv [P, 2] of variants [P] of the points of `laid` [V, 3] at `place` [P]; the rest: the mappings' fields, [S, ...]."""
    uv = np.zeros((len(place), 2))
    for s in range(len(kinds)):
        for n in range(stops[s, 1], stops[s + 1, 1]):
            point = place[n]
            if kinds[s] == _CYLINDER:
                uv[n, 0] = turn[point] + variant[n]
                uv[n, 1] = (laid[point, 2] - origins[s, 2]) / reaches[s]
            elif kinds[s] == _BOX:
                for k in range(2):
                    side = sides[s, variant[n], k]
                    uv[n, k] = (laid[point, side] - origins[s, side]) / reaches[s]
            elif kinds[s] == _PLANE:
                for k in range(2):
                    for axis in range(3):
                        uv[n, k] += (laid[point, axis] - origins[s, axis]) * axes[s, k, axis]
    return uv


@compiled_for("f8[:,::1], i8[:,::1], i8[:,::1], i8", "f8[:,::1], const(i8[:,::1]), i8[:,::1], i8")
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


_EIGHTHS = np.array([round(math.atan(k / 8.0), 15) for k in range(9)])
"""[9] float64: the angles with tangents 0, 1/8, ... 1."""

_DIGITS = 10.0**TRIG_DIGITS


@compiled
def turn_about_z(x: float, y: float) -> float:
    """The angle of (x, y) in turns, in [0, 1), to `TRIG_DIGITS` digits; 0 at the origin.

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
