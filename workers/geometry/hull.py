"""Convex hulls."""

import numpy as np
from scipy.spatial import ConvexHull

from schemas.base import Array, frozen_array
from schemas.shape import Hull

FLAT_M = 1e-9
"""A cloud whose least singular value is below this lies in a plane."""


def convex_hull(vertices: Array) -> Hull:
    """The hull of a vertex cloud [N, 3], metres; a flat cloud is thickened by joggling it (Qhull's QJ)."""
    unique = np.unique(vertices, axis=0)
    flat = float(np.linalg.svd(unique - unique.mean(axis=0), compute_uv=False)[-1]) < FLAT_M
    hull = ConvexHull(unique, qhull_options="QJ" if flat else "Qt")
    return Hull(frozen_array(unique[hull.vertices]), frozen_array(hull.equations[:, :3]))
