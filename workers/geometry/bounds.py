"""Bounding boxes of points. Pure."""

import numpy as np

from schemas.base import Array
from workers.geometry.jit import compiled


def bounds_of(points: Array) -> Array:
    """[2, D] float64: lower and upper corner of the axis-aligned bounding box of points [N, D], N > 0.

    numpy's minimum along the first axis takes ten times as long. Points must not hold nan.
    """
    return _bounds_of(np.ascontiguousarray(points))


@compiled
def _bounds_of(points: Array) -> Array:
    bounds = np.empty((2, points.shape[1]))
    bounds[0], bounds[1] = np.inf, -np.inf
    for n in range(len(points)):
        for axis in range(points.shape[1]):
            bounds[0, axis] = min(bounds[0, axis], points[n, axis])
            bounds[1, axis] = max(bounds[1, axis], points[n, axis])
    return bounds
