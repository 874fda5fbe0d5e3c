"""Alignment of a prediction with the truth before it is scored, where that is asked for. Pure.

`none`: as it is. `scale`: one factor. `similarity`: of depth one factor and one offset, of shapes a factor, a rotation and a
translation. RGB, volumes and poses are never aligned.
"""

from typing import Final, Literal, get_args

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.registration import procrustes

from schemas.base import Array, Pose
from schemas.scene.shape import Mesh
from services.score.shape import draw_points, with_area
from workers.geometry.distance import distance_to_mesh
from workers.geometry.frames import transform

Alignment = Literal["none", "scale", "similarity"]
ALIGNMENTS: Final[tuple[Alignment, ...]] = get_args(Alignment)

POINTS: Final = 2_000
"""Drawn on each surface to align them."""

ROUNDS: Final = 200
SETTLED: Final = 1e-7
"""Iteration ends where no point moves by more than this share of the true diagonal."""


def align_depth(predicted_m: Array, true_m: Array, how: Alignment) -> Array:
    """Predicted depth [H, W], metres, times a factor, and with `similarity` plus an offset; holes stay 0.

    `scale`: the median of true by predicted depth (Zhou et al. 2017, section 4.1). `similarity`: factor and offset of least
    squares (Ranftl et al. 2020, eq. 4, there of disparity). Over all pixels with both; as it is where there are none.
    """
    both = (predicted_m > 0.0) & (true_m > 0.0) & np.isfinite(predicted_m)
    if how == "none" or not both.any():
        return predicted_m
    d, t = predicted_m[both], true_m[both]
    factor, offset_m = float(np.median(t / d)), 0.0
    if how == "similarity" and np.ptp(d) > 0.0:
        factor = float(np.cov(d, t, bias=True)[0, 1] / d.var())
        offset_m = float(t.mean() - factor * d.mean())
    return np.where(predicted_m > 0.0, factor * predicted_m + offset_m, 0.0)


def align_shape(predicted: Mesh | Array, true: Mesh, how: Alignment, seed: int = 0) -> tuple[Mesh | Array, Pose]:
    """The mesh or cloud [N, 3] moved by T [4, 4], and T, which has the factor in it. true: metres, in the frame of both.

    Iterated closest points (Besl and McKay 1992), of points of either surface and the nearest of the other, because one way
    alone shrinks a shape to a point; each round has the least squares of Umeyama (1991), for `scale` the factor about the
    frame's origin alone. It begins with the ratio of the boxes' diagonals and, for `similarity`, their centres.
    """
    points = np.asarray(predicted.vertices if isinstance(predicted, Mesh) else predicted, np.float64)
    if how == "none":
        return predicted, np.eye(4)
    rng = np.random.default_rng([seed, 3])
    drawn, there = _draw(predicted, rng), _draw(true, rng)
    (centre, size), (true_centre, true_size) = box_of(points), box_of(np.asarray(true.vertices))
    T = np.diag([true_size / size] * 3 + [1.0])
    if how == "similarity":
        T[:3, 3] = true_centre - T[:3, :3] @ centre
    for _ in range(ROUNDS):
        back = _nearest(transform(np.linalg.inv(T), there), predicted)
        here, target = np.concatenate([drawn, back]), np.concatenate([_nearest(transform(T, drawn), true), there])
        step = _fit(here, target, how)
        moved = np.abs(transform(step, drawn) - transform(T, drawn)).max()
        T = step
        if moved < SETTLED * true_size:
            break
    placed = transform(T, points)
    return (Mesh(placed, predicted.faces) if isinstance(predicted, Mesh) else placed), T


def _fit(here: Array, target: Array, how: Alignment) -> Pose:
    """[4, 4] of the least squares from points here [N, 3] to target [N, 3]."""
    if how == "scale":
        return np.diag([float((here * target).sum() / (here * here).sum())] * 3 + [1.0])
    return np.asarray(procrustes(here, target, reflection=False)[0])


def _draw(shape: Mesh | Array, rng: np.random.Generator) -> Array:
    if not isinstance(shape, Mesh):
        points = np.asarray(shape, np.float64)
        return points[rng.choice(len(points), min(POINTS, len(points)), replace=False)]
    return draw_points(shape, rng, POINTS)[0]


def _nearest(points: Array, shape: Mesh | Array) -> Array:
    """[N, 3]: the nearest point of a surface, or of a cloud, to each of points [N, 3]."""
    if not isinstance(shape, Mesh):
        return np.asarray(shape, np.float64)[cKDTree(shape).query(points)[1]]
    solid = with_area(shape)
    corners = np.asarray(solid.vertices)[solid.faces[distance_to_mesh(points, solid)[1]]]
    return np.asarray(trimesh.triangles.closest_point(corners, points))


def box_of(points: Array) -> tuple[Array, float]:
    """The middle [3] and the diagonal of a box about points."""
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2.0, float(np.linalg.norm(high - low))
