"""Pure: plane curves for profiles, sections and paths, in +, -, *, / and square roots alone."""

import functools
from collections.abc import Sequence

import numpy as np

from schemas.base import Array
from workers.assets.builtin.solid import circle

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
