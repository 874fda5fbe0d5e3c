"""Pure: plane curves, the solids swept from them, and the walls of hollow vessels.

Curves are computed by +, -, *, / and square roots alone, which give the same bits on every processor.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.base import Array
from workers.assets.builtin.solid import Indices, Solid, circle, loft, smoothing_groups, union_at

Point = Sequence[float] | Array


def bezier(a: Point, b: Point, c: Point, d: Point, count: int) -> Array:
    """[count, k] float64: points of the cubic Bezier curve from a to d, at even parameters, both ends included."""
    t = np.linspace(0.0, 1.0, count)[:, None]
    s = 1.0 - t
    pa, pb, pc, pd = (np.asarray(p, dtype=np.float64) for p in (a, b, c, d))
    points = s * s * s * pa + 3.0 * s * s * t * pb + 3.0 * s * t * t * pc + t * t * t * pd
    points[0], points[-1] = pa, pd
    return points


def spline(points: Array, count: int) -> Array:
    """[(P - 1) * count + 1, 2] float64: the Catmull-Rom curve through points [P, 2], `count` segments each."""
    before = np.concatenate([[2.0 * points[0] - points[1]], points[:-1]])
    after = np.concatenate([points[1:], [2.0 * points[-1] - points[-2]]])
    slope = 0.5 * (after - before)
    t = (np.arange(count) / count)[None, :, None]
    p, q, m, n = points[:-1, None], points[1:, None], slope[:-1, None], slope[1:, None]
    t2, t3 = t * t, t * t * t
    curve = (2 * t3 - 3 * t2 + 1) * p + (t3 - 2 * t2 + t) * m + (3 * t2 - 2 * t3) * q + (t3 - t2) * n
    return np.concatenate([curve.reshape(-1, points.shape[1]), points[-1:]])


def fillet(points: Array, radii: Sequence[float] | Array, steps: int = 3) -> tuple[Array, Array]:
    """A polyline [P, 2] with its inner corners replaced by quadratic arcs, and the old segment of each new segment.

    `radii` [P] is how far from each corner the arc begins (cut to 45 % of the shorter side; 0 keeps the corner). The
    first half of an arc belongs to the segment before it. Returns [Q, 2] float64 and [Q - 1] int64.
    """
    t = np.arange(steps + 1)[:, None] / steps
    out, owner = [points[:1]], []
    for k in range(1, len(points) - 1):
        before, corner, after = points[k - 1], points[k], points[k + 1]
        back, ahead = before - corner, after - corner
        size_b = float(np.sqrt(back[0] * back[0] + back[1] * back[1]))
        size_a = float(np.sqrt(ahead[0] * ahead[0] + ahead[1] * ahead[1]))
        reach = min(radii[k], 0.45 * size_b, 0.45 * size_a)
        if reach <= 0.0:
            out.append(corner[None])
            owner.append(k - 1)
            continue
        start, stop = corner + back * (reach / size_b), corner + ahead * (reach / size_a)
        out.append((1 - t) * (1 - t) * start + 2 * t * (1 - t) * corner + t * t * stop)
        owner += [k - 1] * (1 + steps // 2) + [k] * (steps - steps // 2)
    out.append(points[-1:])
    owner.append(len(points) - 2)
    return np.concatenate(out), np.array(owner, dtype=np.int64)


def directions(path: Array, ends: tuple[Array, Array] | None = None) -> Array:
    """[K, 2] float64: unit directions along a path [K, 2]; `ends`: those at its first and last point, where known."""
    step = np.empty_like(path)
    step[1:-1] = path[2:] - path[:-2]
    step[0], step[-1] = ends or (path[1] - path[0], path[-1] - path[-2])
    return step / np.sqrt(step[:, 0] ** 2 + step[:, 1] ** 2)[:, None]


def outward_normals(curve: Array) -> Array:
    """[P, 2] float64: unit normals to the right of a polyline [P, 2]: out of a wall that runs upwards."""
    along = directions(curve)
    return np.stack([along[:, 1], -along[:, 0]], axis=1)


def half_circle_points(a: Array, b: Array, count: int) -> Array:
    """[count, 2] float64: inner points of the half circle from a to b that lies to the right of the line from a to b."""
    middle, radius = 0.5 * (a + b), 0.5 * (b - a)
    side = np.array([radius[1], -radius[0]])
    table = circle(2 * (count + 1))[1 : count + 1]
    return middle - table[:, 0:1] * radius + table[:, 1:2] * side


@functools.cache
def squircle(count: int, squareness: int) -> Array:
    """[count, 2] float64: the superellipse |x|^p + |y|^p = 1 with p = 2, 4, 8 for squareness 0, 1, 2."""
    points = circle(count)
    power = points * points
    for _ in range(squareness):
        power = power * power
    root = power.sum(axis=1)
    for _ in range(squareness + 1):
        root = np.sqrt(root)
    table = points / root[:, None]
    table.setflags(write=False)
    return table


def rounded_sections(outline: Array, share: Array) -> Array:
    """[K, n, 2] float64: the unit circle where a share [K] is 0, an outline [n, 2] where it is 1, and between them."""
    share = share[:, None, None]
    return circle(len(outline))[None] * (1.0 - share) + outline[None] * share


def rounded_rectangles(size: Array, radius: Array, steps: int = 3, sides: tuple[int, int] = (1, 1)) -> Array:
    """[L, n, 2] float64: rectangles about the origin with round corners, counter-clockwise, metres.

    size [L, 2]: width along x and depth along y; radius [L]; `sides`: into how many pieces the straight sides along x
    and along y are cut.
    """
    arc = radius[:, None, None] * circle(4 * steps)[: steps + 1]
    half = 0.5 * size[:, None, :] - radius[:, None, None]
    c, s, x, y = arc[..., 0], arc[..., 1], half[..., 0], half[..., 1]
    corners = np.empty((4, len(size), steps + 1, 2))
    corners[0, ..., 0], corners[0, ..., 1] = x + c, y + s
    corners[1, ..., 0], corners[1, ..., 1] = -x - s, y + c
    corners[2, ..., 0], corners[2, ..., 1] = -x - c, -y - s
    corners[3, ..., 0], corners[3, ..., 1] = x + s, -y - c
    pieces = []
    for k in range(4):
        pieces.append(corners[k])
        if (count := sides[k % 2]) > 1:
            t = (np.arange(1, count) / count)[None, :, None]
            pieces.append(corners[k][:, -1:] * (1 - t) + corners[(k + 1) % 4][:, :1] * t)
    return np.concatenate(pieces, axis=1)


def rounded_rectangle(width: float, depth: float, radius: float, steps: int = 3) -> Array:
    """[n, 2] float64: one rectangle of `rounded_rectangles`."""
    return rounded_rectangles(np.array([[width, depth]]), np.array([radius]), steps)[0]


def prism(
    profile: Array,
    size: tuple[float, float],
    radius: float,
    surface: Sequence[int] | Indices,
    steps: int = 3,
    sides: tuple[int, int] = (1, 1),
) -> Solid:
    """A box with round upright edges: `profile` [L, 2] of (inset, height) from its bottom to its top, metres.

    size: width along x and depth along y where the inset is 0; surface: one number for the bottom, each band, the top.
    Raises ValueError where the sides have no room for the round edges: that is a bug of the caller's.
    """
    inset, z = profile[:, 0], profile[:, 1]
    if (0.5 * min(size) - inset < np.maximum(radius - inset, 2e-4)).any():
        raise ValueError(f"a prism of {size} with edges of radius {radius} has no room for an inset of {inset.max()}")
    outline = rounded_rectangles(np.array(size) - 2.0 * inset[:, None], np.maximum(radius - inset, 2e-4), steps, sides)
    rings = np.empty((*outline.shape[:2], 3))
    rings[..., :2], rings[..., 2] = outline, z[:, None]
    ends = np.array([[0.0, 0.0, z[0]], [0.0, 0.0, z[-1]]])
    reach = np.array([[size[1], 0.0]])
    closed = np.concatenate([profile[:1] + reach, profile, profile[-1:] + reach])
    profiles = np.zeros((2, len(profile) + 2, 2))
    profiles[:, 1:-1, 0], profiles[..., 1] = 0.5 * np.array(size)[:, None] - inset, z[[0, *range(len(z)), -1]]
    return loft(rings, ends[0], ends[1], surface, smoothing_groups(closed), profiles)


def straight_prism(
    size: tuple[float, float], low: float, high: float, radius: float, surface: int, steps: int = 1
) -> Solid:
    """A prism of one size and surface number between two heights."""
    return prism(np.array([[0.0, low], [0.0, high]]), size, radius, [surface] * 3, steps)


def bevelled_profile(height: float, bevel: float, bottom: float = 0.0) -> Array:
    """[4, 2] float64: the (inset, height) profile of a slab from `bottom`, with a bevel along its upper and lower edge."""
    top = bottom + height
    return np.array([[bevel, bottom], [0.0, bottom + bevel], [0.0, top - bevel], [bevel, top]])


def bend_radius(path: Array, ends: tuple[Array, Array]) -> float:
    """The largest half thickness, metres, of a rod along a path [K, 2] that does not fold at its tightest bend."""
    step, turn = np.diff(path, axis=0), np.diff(directions(path, ends), axis=0)
    length, bend = (np.sqrt(v[:, 0] ** 2 + v[:, 1] ** 2) for v in (step, turn))
    return float((length / np.maximum(bend, 1e-9)).min())


def rod(path: Array, section: Array, surface: int, ends: tuple[Array, Array], swell: Array | None = None) -> Solid:
    """A rod bent along a path [K, 2] in the xz plane; section [n, 2]: across (along y) and in the plane of the path.

    ends: the unit directions (x, z) in which the path begins and ends; swell [K]: factor on the section.
    """
    tangent = directions(path, ends)
    factor = np.ones(len(path)) if swell is None else swell
    u, v = section[:, 0] * factor[:, None], section[:, 1] * factor[:, None]
    x = path[:, 0:1] - tangent[:, 1:2] * v
    z = path[:, 1:2] + tangent[:, 0:1] * v
    rings = np.stack([x, u, z], axis=2)
    caps = [np.array([path[k, 0], 0.0, path[k, 1]]) for k in (0, -1)]
    smooth = np.array([0, *[1] * (len(path) - 1), 2])
    return loft(rings, caps[0], caps[1], np.full(len(path) + 1, surface), smooth)


def split_sides(solid: Solid, surface: int, numbers: tuple[int, int, int, int]) -> Solid:
    """The solid with one surface split into four by the direction of its faces: front (-y), right (+x), back (+y), left (-x)."""
    a, b, c = (solid.vertices[solid.faces[:, k]] for k in range(3))
    x, y, _ = np.cross(b - a, c - a).T
    side = np.where(np.abs(y) >= np.abs(x), np.where(y < 0, 0, 2), np.where(x > 0, 1, 3))
    chosen = solid.surface == surface
    return replace(solid, surface=np.where(chosen, np.array(numbers)[side], solid.surface))


HANDLE_ROOM_M = 0.002
"""A handle may meet the faces of a vessel that are this near to its bounding box."""

OUTSIDE, INSIDE, BASE = 0, 1, 2
"""Surface numbers of a vessel."""


@dataclass(frozen=True, eq=False)
class Wall:
    """The profile of a hollow vessel and the surface number of each of its segments.

    profile [P, 2] of (radius, height), metres, axis to axis; surface [P - 1]; outer [Q, 2]: the stretch of the profile
    that is the outside of the wall, bottom to rim; thickness_m: of the wall.
    """

    profile: Array
    surface: Indices
    outer: Array
    thickness_m: float

    def radius_at(self, z: float) -> float:
        """Outer radius at a height, metres."""
        return float(np.interp(z, self.outer[:, 1], self.outer[:, 0]))

    def normal_at(self, z: float) -> Array:
        """[2] float64: the unit normal (radius, height) of the outside at a height."""
        low, high = z - 0.002, z + 0.002
        step = np.array([self.radius_at(high) - self.radius_at(low), high - low])
        return np.array([step[1], -step[0]]) / float(np.sqrt(step[0] * step[0] + step[1] * step[1]))

    def middle_at(self, z: float) -> Array:
        """[2] float64: the point (radius, height) midway through the wall that lies behind the outside at a height."""
        return np.array([self.radius_at(z), z]) - 0.5 * self.thickness_m * self.normal_at(z)


def wall_around(hollow: Array, thickness_m: float, foot_radius: float, foot_width: float, recess: float) -> Wall:
    """A wall of even thickness around a hollow [P, 2] from (0, height of the inner bottom) to the rim.

    The vessel stands on a ring from foot_radius - foot_width to foot_radius at height 0; inside the ring the underside lies
    `recess` higher. The rim is round.
    """
    offset = hollow + thickness_m * outward_normals(hollow)
    outer = offset[int(((offset[:, 0] > foot_radius + 2e-4) & (offset[:, 1] > 2e-4)).argmax()) :]
    inner_foot = foot_radius - foot_width
    base = np.array([[0.0, recess], [inner_foot - 0.4 * recess, recess], [inner_foot, 0.0], [foot_radius, 0.0]])
    rim = half_circle_points(outer[-1], hollow[-1], 3)
    profile = np.concatenate([base, outer, rim, hollow[::-1]])
    surface = np.repeat([BASE, OUTSIDE, INSIDE], [len(base) - 1, len(outer) + 2, len(hollow) + 1])
    return Wall(profile, surface, np.concatenate([base[-1:], outer]), thickness_m)


def with_handles(body: Solid, outside: int, handles: Sequence[Solid]) -> Solid:
    """A vessel about the z axis with handles that end inside its wall; `outside`: the surface number of its outside."""
    a, b, c = (body.vertices[body.faces[:, k]] for k in range(3))
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    touched = np.zeros(len(body.faces), dtype=np.bool_)
    for handle in handles:
        start, stop = handle.vertices.min(axis=0) - HANDLE_ROOM_M, handle.vertices.max(axis=0) + HANDLE_ROOM_M
        touched |= ((high >= start) & (low <= stop)).all(axis=1)
    touched &= body.surface == outside
    middle = 0.5 * float(low[touched, 2].min() + high[touched, 2].max())
    return union_at(body, touched, np.array([0.0, 0.0, middle]), handles)
