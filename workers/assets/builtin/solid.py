"""Pure: closed triangle solids, lofted from rings and joined by manifold3d's exact booleans.

Coordinates here and in `curves` are computed by +, -, *, / and square roots alone, which give the same bits on every
processor. Sines and cosines are rounded to `TRIG_DIGITS`, because C libraries and processors differ in their last bit.
"""

import dataclasses
import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Loft
from workers.geometry.jit import compiled_for
from workers.geometry.mesh import first_equal, hold_to_one_thread, numbers_in

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

SMOOTH_COSINE = 0.8
"""Neighbouring bands that turn by less than about 37 degrees are shaded as one smooth surface."""
TRIG_DIGITS = 14
"""Decimals that sines and cosines are rounded to: an error below 1e-14 of the radius."""
_FAN, _SURFACES = 63, 64
"""_SURFACES: more surfaces than any model has; a face's tag is smoothing group * _SURFACES + surface number.
_FAN: the surface number of faces that only close a solid for a boolean."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed surface, counter-clockwise seen from outside.

    vertices [V, 3] float64 metres; faces [F, 3] int64; surface [F] int64: surface number; smooth [F] int64:
    smoothing group, whose faces share shading normals. lofts: the solid is their union; None where they are not known.
    """

    vertices: Array
    faces: Indices
    surface: Indices
    smooth: Indices
    lofts: tuple[Loft, ...] | None = None

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Solid":
        """The solid shifted, metres."""
        return self.placed(np.eye(3), np.array([x, y, z]))

    def placed(self, axes: Array, origin: Array) -> "Solid":
        """The solid with its x, y, z along the rows of `axes` [3, 3] (a right-handed turn) and its origin at `origin`."""
        x, y, z = self.vertices[:, 0:1], self.vertices[:, 1:2], self.vertices[:, 2:3]
        placed = x * axes[0] + y * axes[1] + z * axes[2] + origin
        return dataclasses.replace(self, vertices=placed, lofts=self.map_lofts(axes, origin))

    def stretched(self, factors: Array) -> "Solid":
        """The solid with its x, y and z times the factors [3]."""
        lofts = self.map_lofts(np.diag(factors), np.zeros(3))
        return dataclasses.replace(self, vertices=self.vertices * factors, lofts=lofts)

    def map_lofts(self, matrix: Array, origin: Array) -> tuple[Loft, ...] | None:
        """The lofts with their x, y, z along the rows of `matrix` [3, 3] and their origin at `origin`; None if unknown."""
        return None if self.lofts is None else tuple(loft.mapped(matrix, origin) for loft in self.lofts)


@functools.cache
def circle(count: int) -> Array:
    """[count, 2] float64: points of the unit circle, counter-clockwise from (1, 0); quarters are exact."""
    points = []
    for k in range(count):
        quarter, rest = divmod(4 * k, count)
        angle = math.pi * rest / (2 * count)
        c, s = round(math.cos(angle), TRIG_DIGITS), round(math.sin(angle), TRIG_DIGITS)
        points.append(((c, s), (-s, c), (-c, -s), (s, -c))[quarter])
    table = np.array(points)
    table.setflags(write=False)
    return table


def level_ring(outline: Array, z: float) -> Array:
    """[n, 3] float64: an outline [n, 2] at a height, metres."""
    return np.concatenate([outline, np.full((len(outline), 1), z)], axis=1)


@functools.cache
def _loft_faces(rings: int, count: int) -> tuple[Indices, Indices]:
    """Faces of a loft and the band [F] of each: 0 the fan at the start, then band by band, last the fan at the end."""
    j = np.arange(count)
    nxt = (j + 1) % count
    base = np.arange(rings - 1)[:, None] * count
    a, b, c, d = base + j, base + nxt, base + count + nxt, base + count + j
    body = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    start, end, top = rings * count, rings * count + 1, (rings - 1) * count
    first = np.stack([np.full(count, start), nxt, j], -1)
    last = np.stack([np.full(count, end), top + j, top + nxt], -1)
    faces = np.concatenate([first, body, last])
    band = np.repeat(np.arange(rings + 1), [count, *[2 * count] * (rings - 1), count])
    faces.setflags(write=False)
    band.setflags(write=False)
    return faces, band


def loft(
    rings: Array,
    start: Array,
    end: Array,
    surface: Sequence[int] | Indices,
    smooth: Sequence[int] | Indices,
    profiles: Array | None = None,
) -> Solid:
    """The loft through rings [L, n, 3] (each counter-clockwise seen from the end), closed by fans to two points.

    surface and smooth have one number for each band [L + 1]: the fan at the start, L - 1 bands, the fan at the end.
    profiles [K, L + 2, 2]: as `Loft` has them.
    """
    levels, count = rings.shape[:2]
    faces, band = _loft_faces(levels, count)
    vertices = np.concatenate([rings.reshape(-1, 3), start[None], end[None]])
    lofts = (Loft(rings, vertices[-2:], profiles),)
    numbers = np.asarray(surface, dtype=np.int64)[band], np.asarray(smooth, dtype=np.int64)[band]
    return Solid(vertices, faces, *numbers, lofts)


def lathe(profile: Array, surface: Sequence[int] | Indices, count: int = 48, section: Array | None = None) -> Solid:
    """The solid of revolution of a profile [P, 2] of (radius, height), metres, from the axis to the axis.

    Outside lies to the right along the profile: outwards along the bottom, up the wall, back to the axis. `surface`
    has one number for each segment [P - 1]. `section` [P - 2, n, 2] replaces the unit circle ring by ring.
    """
    inner = profile[1:-1]
    outline = circle(count)[None] if section is None else section
    level = np.broadcast_to(inner[:, 1][:, None, None], (len(inner), outline.shape[1], 1))
    rings = np.concatenate([outline * inner[:, 0][:, None, None], level], axis=2)
    start, end = np.array([0.0, 0.0, profile[0, 1]]), np.array([0.0, 0.0, profile[-1, 1]])
    return loft(rings, start, end, surface, smoothing_groups(profile), _profiles(profile, section))


def _profiles(profile: Array, section: Array | None) -> Array:
    """[K, P, 2] float64: the profiles along the widest and narrowest columns of a section; one without a section."""
    if section is None:
        return profile[None]
    reach = np.sqrt(section[..., 0] * section[..., 0] + section[..., 1] * section[..., 1])  # [P - 2, n]
    ring = reach[int((reach.max(axis=1) - reach.min(axis=1)).argmax())]
    profiles = np.array([profile, profile], dtype=np.float64)
    profiles[:, 1:-1, 0] *= reach[:, [int(ring.argmax()), int(ring.argmin())]].T
    return profiles


def smoothing_groups(profile: Array) -> Indices:
    """[P - 1] int64: the smoothing group of each segment of a profile [P, 2]; flat ends have one of their own."""
    return _smoothing_groups(np.ascontiguousarray(profile, dtype=np.float64))


@compiled_for("f8[:,::1]")
def _smoothing_groups(profile: Array) -> Indices:
    """A profile has a few dozen segments: numpy takes longer to begin than to count them."""
    count = len(profile) - 1
    groups = np.zeros(count, np.int64)
    before_x = before_y = 0.0
    for k in range(count):
        x, y = profile[k + 1, 0] - profile[k, 0], profile[k + 1, 1] - profile[k, 1]
        length = math.sqrt(x * x + y * y)
        along_x, along_y = (x / length, y / length) if length != 0.0 else (x, y)
        if k > 0:
            sharp = along_x * before_x + along_y * before_y < SMOOTH_COSINE
            # A flat end is large beside its rounded rim: averaged normals would shade it as a dome.
            sharp |= k == 1 and profile[1, 1] == profile[0, 1]
            sharp |= k == count - 1 and y == 0.0
            groups[k] = groups[k - 1] + int(sharp)
        before_x, before_y = along_x, along_y
    return groups


def combine(solids: Sequence[Solid]) -> Solid:
    """Concatenates solids that do not touch one another, so that a boolean takes them in one step."""
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids[:-1])])
    smooths = np.cumsum([0, *(int(solid.smooth.max()) + 1 for solid in solids[:-1])])
    return Solid(
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate([solid.faces + start for solid, start in zip(solids, starts, strict=True)]),
        np.concatenate([solid.surface for solid in solids]),
        np.concatenate([solid.smooth + first for solid, first in zip(solids, smooths, strict=True)]),
        _lofts_of(solids),
    )


def _lofts_of(solids: Sequence[Solid]) -> tuple[Loft, ...] | None:
    """The lofts of all solids in order; None where those of one are not known."""
    lofts = [solid.lofts for solid in solids if solid.lofts is not None]
    return tuple(itertools.chain.from_iterable(lofts)) if len(lofts) == len(solids) else None


def union(solids: Sequence[Solid]) -> Solid:
    """The union of the solids; ValueError where one is not closed, which is a bug of the caller's."""
    return _from_manifold(manifold3d.Manifold.batch_boolean(_tagged(solids), manifold3d.OpType.Add), _lofts_of(solids))


def union_at(solid: Solid, touched: Mask, apex: Array, others: Sequence[Solid], beside: Sequence[Solid] = ()) -> Solid:
    """The union of a solid with others that meet it in its faces `touched` [F] alone.

    The cost of a boolean grows with the number of faces. So the boolean gets these faces alone, closed by fans from their
    border to `apex`, an inner point that sees them all. Between the fans and the faces the others must meet what the whole
    solid has there. Afterwards the fans are removed and the rest of the solid is put back. `beside`: solids that meet the
    others but not this one, joined in the same step. Where another solid reaches through the fans, the boolean gets the
    whole solid: the same result, but slower.
    """
    core = solid.faces[touched]
    a, b = core.ravel(), core[:, [1, 2, 0]].ravel()
    size = len(solid.vertices)
    border = ~np.isin(a * size + b, b * size + a)
    fan = np.stack([b[border], a[border], np.full(int(border.sum()), size)], axis=1)
    faces, names = renumber(np.concatenate([core, fan]))
    surface = np.concatenate([solid.surface[touched], np.full(len(fan), _FAN)])
    smooth = np.concatenate([solid.smooth[touched], np.zeros(len(fan), dtype=np.int64)])
    vertices = np.concatenate([solid.vertices, apex[None]])
    joined = union([combine([Solid(vertices[names], faces, surface, smooth), *beside]), *others])
    rim = numbers_in(a[border], size)
    # The sum with 0.0 turns -0.0, whose bits differ, into 0.0.
    points = np.concatenate([joined.vertices, solid.vertices[rim]]) + 0.0
    at = first_equal(points.view(np.int64))[len(joined.vertices) :]
    kept = joined.surface != _FAN
    if int((~kept).sum()) != len(fan) or (at >= len(joined.vertices)).any():
        return union([combine([solid, *beside]), *others])
    target = len(joined.vertices) + np.arange(size)
    target[rim] = at
    faces, names = renumber(np.concatenate([joined.faces[kept], target[solid.faces[~touched]]]))
    return Solid(
        np.concatenate([joined.vertices, solid.vertices])[names],
        faces,
        np.concatenate([joined.surface[kept], solid.surface[~touched]]),
        np.concatenate([joined.smooth[kept], solid.smooth[~touched]]),
        _lofts_of([solid, *beside, *others]),
    )


@compiled_for("i8[:,::1]")
def renumber(keys: Indices) -> tuple[Indices, Indices]:
    """Keys [F, K] int64 renumbered 0, 1, 2, ... in ascending order, and the key of each number."""
    rows, columns = keys.shape
    highest = -1
    for row in range(rows):
        for column in range(columns):
            highest = max(highest, keys[row, column])
    number = np.zeros(highest + 1, np.int64)
    for row in range(rows):
        for column in range(columns):
            number[keys[row, column]] = 1
    names, count = np.empty(highest + 1, np.int64), 0
    for key in range(highest + 1):
        if number[key]:
            names[count] = key
            number[key] = count
            count += 1
    numbers = np.empty((rows, columns), np.int64)
    for row in range(rows):
        for column in range(columns):
            numbers[row, column] = number[keys[row, column]]
    return numbers, names[:count].copy()


def difference(solid: Solid, cutters: Sequence[Solid]) -> Solid:
    """The solid without the cutters; the cuts have the cutters' surfaces."""
    cut, lofts = _lofts_of(cutters), solid.lofts
    if lofts is not None and cut is not None:
        lofts = tuple(dataclasses.replace(loft, cutters=(*loft.cutters, *cut)) for loft in lofts)
    manifold = manifold3d.Manifold.batch_boolean(_tagged([solid, *cutters]), manifold3d.OpType.Subtract)
    return _from_manifold(manifold, None if cut is None else lofts)


def _tagged(solids: Sequence[Solid]) -> list[manifold3d.Manifold]:
    """The solids in manifold3d; face ids hold the surface number and a smoothing group that is unique to the solid."""
    hold_to_one_thread()
    manifolds = []
    first = 0
    for solid in solids:
        tag = (solid.smooth + first) * _SURFACES + solid.surface
        first += int(solid.smooth.max()) + 1
        mesh = manifold3d.Mesh64(
            vert_properties=np.ascontiguousarray(solid.vertices),
            tri_verts=solid.faces.astype(np.uint64),
            face_id=tag.astype(np.uint64),
        )
        manifold = manifold3d.Manifold(mesh)
        if manifold.status() != manifold3d.Error.NoError:
            raise ValueError(f"not a closed solid: {manifold.status()}")
        manifolds.append(manifold)
    return manifolds


def _from_manifold(manifold: manifold3d.Manifold, lofts: tuple[Loft, ...] | None) -> Solid:
    mesh = manifold.to_mesh64()
    tag = np.asarray(mesh.face_id, dtype=np.int64)
    vertices = np.array(mesh.vert_properties[:, :3], dtype=np.float64)
    return Solid(vertices, np.asarray(mesh.tri_verts, dtype=np.int64), tag % _SURFACES, tag // _SURFACES, lofts)
