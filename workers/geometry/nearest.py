"""Nearest points of a mesh's surface."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.scene.shape import Mesh
from workers.geometry.jit import compiled


def nearest_on_mesh(points: Array, mesh: Mesh, within_m: float = np.inf) -> tuple[Array, NDArray[np.int64]]:
    """(nearest point of the surface [N, 3], its face [N]) for each point [N, 3].

    The first face among equals; nan and -1 where no face is within `within_m` (or as near as it).
    """
    corners = np.ascontiguousarray(mesh.vertices[mesh.faces], dtype=np.float64)
    found = np.full((len(points), 3), np.nan)
    faces = np.full(len(points), -1, dtype=np.int64)
    limit2 = np.nextafter(within_m * within_m, np.inf)
    _nearest(np.ascontiguousarray(points), corners, corners.min(axis=1), corners.max(axis=1), limit2, found, faces)
    return found, faces


@compiled
def _nearest(
    points: Array, corners: Array, low: Array, high: Array, limit2: float, found: Array, faces: NDArray[np.int64]
) -> None:
    """Compares each point with every face whose box is nearer than the nearest face so far."""
    here = np.empty(3)
    for n in range(len(points)):
        best = limit2
        for f in range(len(corners)):
            box2 = 0.0
            for k in range(3):
                out = max(low[f, k] - points[n, k], points[n, k] - high[f, k], 0.0)
                box2 += out * out
            if box2 >= best:
                continue
            nearest_on_triangle(points[n], corners[f], here)
            d2 = (here[0] - points[n, 0]) ** 2 + (here[1] - points[n, 1]) ** 2 + (here[2] - points[n, 2]) ** 2
            if d2 < best:
                best = d2
                found[n] = here
                faces[n] = f


@compiled
def nearest_on_triangle(p: Array, corners: Array, nearest: Array) -> None:
    """Writes into `nearest` [3] the point of the triangle `corners` [3, 3] that is nearest to p [3].

    Uses the Voronoi regions of corners and edges (Ericson, Real-Time Collision Detection 2005, 5.1.5).
    """
    a, b, c = corners[0], corners[1], corners[2]
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for k in range(3):
        ab, ac = b[k] - a[k], c[k] - a[k]
        d1 += ab * (p[k] - a[k])
        d2 += ac * (p[k] - a[k])
        d3 += ab * (p[k] - b[k])
        d4 += ac * (p[k] - b[k])
        d5 += ab * (p[k] - c[k])
        d6 += ac * (p[k] - c[k])
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    v = w = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        pass
    elif d3 >= 0.0 and d4 <= d3:
        v = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 > d3:  # an edge without length is left to the others
        v = d1 / (d1 - d3)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 > d6:
        w = d2 / (d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6 and (d4 - d3) + (d5 - d6) > 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    elif va + vb + vc > 0.0:
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
    for k in range(3):
        nearest[k] = a[k] + v * (b[k] - a[k]) + w * (c[k] - a[k])


@compiled
def nearest_on_segments(a: Array, b: Array, c: Array, d: Array, here: Array, there: Array) -> None:
    """Writes the nearest points [3] of the segments from a to b and from c to d into `here` and `there`.

    Ericson, Real-Time Collision Detection 2005, 5.1.9.
    """
    aa = cc = ac = ar = cr = 0.0
    for k in range(3):
        u, v, r = b[k] - a[k], d[k] - c[k], a[k] - c[k]
        aa += u * u
        cc += v * v
        ac += u * v
        ar += u * r
        cr += v * r
    along = aa * cc - ac * ac
    s = min(1.0, max(0.0, (ac * cr - ar * cc) / along)) if along > 0.0 else 0.0
    t = (ac * s + cr) / cc if cc > 0.0 else 0.0
    if t < 0.0 or t > 1.0 or cc == 0.0:
        t = min(1.0, max(0.0, t))
        s = min(1.0, max(0.0, (ac * t - ar) / aa)) if aa > 0.0 else 0.0
    for k in range(3):
        here[k], there[k] = a[k] + s * (b[k] - a[k]), c[k] + t * (d[k] - c[k])
