"""Errors of a predicted shape, a mesh or a cloud; and its alignment with the truth. Pure.

Points are drawn uniformly by area; their distances to the other surface are exact. So sampling adds an error but no bias.
"""

import math
from typing import Final

import manifold3d
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from trimesh.registration import procrustes

from schemas.base import Array, Pose
from schemas.scene.shape import Mesh
from services.score.images import Alignment
from services.score.pose import box_of
from workers.assets.mass import unite_bodies
from workers.assets.winding import winding_numbers
from workers.door.meshes.mesh import is_solid, merge_points
from workers.geometry.distance import distance_to_mesh
from workers.geometry.frames import transform
from workers.geometry.mesh import face_areas, face_normals, solid_of, weld

ERRORS = 3.0
"""Standard errors in a stated sampling error: about three seeds in a thousand lie farther off."""

METRICS = (
    *("chamfer_l1_m", "chamfer_l2_m2", "accuracy_m", "completeness_m", "hausdorff95_m", "chamfer_l1_rel"),
    *("fscore_1mm", "fscore_2mm", "fscore_5mm", "fscore_1pct", "normal_consistency", "iou"),
)

Estimate = tuple[float, float]
"""A value and its sampling error."""


def score_shape(
    predicted: Mesh | Array, true: Mesh, diagonal_m: float, samples: int = 40_000, seed: int = 0
) -> dict[str, float | None]:
    """Errors of a mesh, or a cloud [N, 3], in the frame of the true mesh, metres. diagonal_m: of the true bounding box.

    accuracy_m, completeness_m: mean distance of the predicted surface's points to the true surface, and of the true surface's
    to the predicted one (Mescheder et al. 2019, section 4 and supplement). A cloud's own points are all taken as they are, and
    the true surface's distances are to the nearest of them.
    chamfer_l1_m, chamfer_l2_m2: mean of the two, and of the two mean squares (ibid.; Fan et al. 2017, eq. 1, adds them up);
    chamfer_l1_rel: chamfer_l1_m by diagonal_m.
    fscore_1mm, fscore_2mm, fscore_5mm, fscore_1pct: harmonic mean of the shares of either that are within that distance of the
    other, 1pct of the diagonal (Knapitsch et al. 2017, section 3.3); 0 where both are 0.
    normal_consistency: mean |n . m| of a point's normal and that of the nearest face (at an edge either's), mean of both
    ways (Mescheder et al. 2019); None of a cloud.
    hausdorff95_m: the larger of the two ways' 95th percentiles (Huttenlocher et al. 1993, section V, the partial distance).
    iou: common volume by that of both together (ibid.). Of closed meshes exact; where one is open, of points uniform in the box
    about both, inside where the winding number is beyond 0.5 either way (Jacobson et al. 2013). None where one has no volume.

    `metric.sampling`: three standard errors, 0 where nothing was sampled: of means by the samples' deviation, of shares by the
    binomial with two points added of either kind (Agresti and Coull 1998), of the percentile by the order statistics at
    three standard errors of its rank. `samples`: of each surface, and of the box.

    All are nan, and iou and normal_consistency None, where a surface is empty or has a number that is not finite, or
    diagonal_m is not positive.
    """
    scores: dict[str, float | None] = {name: math.nan for metric in METRICS for name in (metric, f"{metric}.sampling")}
    scores |= {name: None for name in scores if name.startswith(("iou", "normal"))}
    if not (_is_usable(predicted) and _is_usable(true) and 0.0 < diagonal_m < math.inf):
        return scores
    points, normals = draw_points(true, np.random.default_rng([seed, 0]), samples)
    estimates: dict[str, Estimate | None] = {}
    if isinstance(predicted, Mesh):
        own, own_normals = draw_points(predicted, np.random.default_rng([seed, 1]), samples)
        there, met = _nearest(own, true)
        back, met_back = _nearest(points, predicted)
        dots = [np.abs((a * b).sum(axis=1)) for a, b in ((own_normals, met), (normals, met_back))]
        estimates["normal_consistency"] = _half(_mean(dots[0]), _mean(dots[1]))
        estimates["iou"] = _iou(predicted, true, np.random.default_rng([seed, 2]), samples)
    else:
        there = _nearest(np.asarray(predicted, np.float64), true)[0]
        back = np.asarray(cKDTree(predicted).query(points)[0])
    estimates |= _of_distances(there, back, isinstance(predicted, Mesh), diagonal_m)
    for name, estimate in estimates.items():
        scores[name], scores[f"{name}.sampling"] = estimate or (None, None)
    return scores


def _of_distances(there: Array, back: Array, drawn: bool, diagonal_m: float) -> dict[str, Estimate]:
    """The metrics of distances, metres, from predicted points [N], which were `drawn` or are all, and from true ones [M]."""
    accuracy, completeness = _mean(there, drawn), _mean(back)
    chamfer = _half(accuracy, completeness)
    limits = {"1mm": 0.001, "2mm": 0.002, "5mm": 0.005, "1pct": diagonal_m / 100.0}
    return {
        "accuracy_m": accuracy,
        "completeness_m": completeness,
        "chamfer_l1_m": chamfer,
        "chamfer_l1_rel": (chamfer[0] / diagonal_m, chamfer[1] / diagonal_m),
        "chamfer_l2_m2": _half(_mean(there**2, drawn), _mean(back**2)),
        "hausdorff95_m": _hausdorff95(there, back, drawn),
        **{f"fscore_{name}": _fscore(there <= limit, back <= limit, drawn) for name, limit in limits.items()},
    }


def _mean(values: Array, drawn: bool = True) -> Estimate:
    return float(values.mean()), ERRORS * float(values.std()) / math.sqrt(len(values)) if drawn else 0.0


def _half(one: Estimate, other: Estimate) -> Estimate:
    return (one[0] + other[0]) / 2.0, math.hypot(one[1], other[1]) / 2.0


def _hausdorff95(there: Array, back: Array, drawn: bool) -> Estimate:
    ways = []
    for distances, sampled in ((there, drawn), (back, True)):
        spread = ERRORS * math.sqrt(0.95 * 0.05 / len(distances)) if sampled else 0.0
        ways.append(np.quantile(distances, np.clip([0.95, 0.95 - spread, 0.95 + spread], 0.0, 1.0)))
    value, low, high = np.max(ways, axis=0).tolist()
    return value, max(value - low, high - value)


def _fscore(right: NDArray[np.bool_], within: NDArray[np.bool_], drawn: bool) -> Estimate:
    """The harmonic mean of two shares; its error is that of either times the slope 2 r^2 / (p + r)^2 by the other."""
    p, r = float(right.mean()), float(within.mean())
    (p_near, p_error), (r_near, r_error) = _share(right, drawn), _share(within)
    total = p_near + r_near
    error = 2.0 * math.hypot(p_error * r_near**2, r_error * p_near**2) / total**2 if total > 0.0 else 0.0
    return (2.0 * p * r / (p + r) if p + r > 0.0 else 0.0), error


def _share(hits: NDArray[np.bool_], drawn: bool = True) -> Estimate:
    """A share and its error, which is not 0 where all samples agree, as others may not (Agresti and Coull 1998)."""
    share = (float(hits.sum()) + 2.0) / (len(hits) + 4.0)
    return (share, ERRORS * math.sqrt(share * (1.0 - share) / len(hits))) if drawn else (float(hits.mean()), 0.0)


def _is_usable(shape: Mesh | Array) -> bool:
    """Whether a cloud has points, and a mesh an area and faces of its vertices, and all are finite."""
    points = shape.vertices if isinstance(shape, Mesh) else np.asarray(shape)
    finite = len(points) > 0 and bool(np.isfinite(points).all())
    if not finite or not isinstance(shape, Mesh):
        return finite
    known = len(shape.faces) > 0 and shape.faces.min() >= 0 and shape.faces.max() < len(points)
    return bool(known and face_areas(points, shape.faces).any())


def draw_points(mesh: Mesh, rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """(points [N, 3], unit normals of their faces [N, 3]), uniform by area."""
    points, face = trimesh.sample.sample_surface(
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), count, seed=rng
    )
    return np.asarray(points), _normals(mesh)[face]


def _nearest(points: Array, mesh: Mesh) -> tuple[Array, Array]:
    """(distances [N] of points [N, 3] to a mesh, unit normals of the nearest faces [N, 3])."""
    solid = with_area(mesh)
    distance, face = distance_to_mesh(points, solid)
    return distance, _normals(solid)[face]


def with_area(mesh: Mesh) -> Mesh:
    """The mesh without faces that have no area: they have no normal, and nothing is nearest to them alone."""
    return Mesh(mesh.vertices, mesh.faces[face_areas(mesh.vertices, mesh.faces) > 0.0])


def _normals(mesh: Mesh) -> Array:
    return face_normals(np.ascontiguousarray(mesh.vertices, np.float64), np.ascontiguousarray(mesh.faces, np.int32))


def _iou(predicted: Mesh, true: Mesh, rng: np.random.Generator, count: int) -> Estimate | None:
    """The volume IoU of two meshes; None where one of them has no volume."""
    one, other = _solid(predicted), _solid(true)
    if one is not None and other is not None:
        common_m3 = (one ^ other).volume()
        return common_m3 / (one.volume() + other.volume() - common_m3), 0.0
    corners = np.concatenate([mesh.vertices[mesh.faces].reshape(-1, 3) for mesh in (predicted, true)])
    points = rng.uniform(corners.min(axis=0), corners.max(axis=0), (count, 3))
    within, inside = (np.abs(winding_numbers(points, mesh)) > 0.5 for mesh in (predicted, true))
    if not (within.any() and inside.any()):
        return None
    both = (within & inside)[within | inside]
    return float(both.mean()), _share(both)[1]


def _solid(mesh: Mesh) -> manifold3d.Manifold | None:
    """The solid that closed bodies are together, wound either way; None where a mesh is open, or its bodies too many to unite."""
    vertices = np.ascontiguousarray(mesh.vertices, np.float64)
    for faces in (mesh.faces.astype(np.int64), mesh.faces[:, ::-1].astype(np.int64)):
        if not is_solid(vertices, faces):
            continue
        (vertices, faces), common_m3 = unite_bodies(vertices, faces)
        point = merge_points(vertices)
        places = np.empty((int(point.max()) + 1, 3))
        places[point] = vertices
        return None if common_m3 is None else solid_of(weld(Mesh(places, point[faces].astype(np.int32))))
    return None


POINTS: Final = 2_000
"""Drawn on each surface to align them."""

ROUNDS: Final = 200
SETTLED: Final = 1e-7
"""Iteration ends where no point moves by more than this share of the true diagonal."""


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
        back = _nearest_points(transform(np.linalg.inv(T), there), predicted)
        here, target = (
            np.concatenate([drawn, back]),
            np.concatenate([_nearest_points(transform(T, drawn), true), there]),
        )
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


def _nearest_points(points: Array, shape: Mesh | Array) -> Array:
    """[N, 3]: the nearest point of a surface, or of a cloud, to each of points [N, 3]."""
    if not isinstance(shape, Mesh):
        return np.asarray(shape, np.float64)[cKDTree(shape).query(points)[1]]
    solid = with_area(shape)
    corners = np.asarray(solid.vertices)[solid.faces[distance_to_mesh(points, solid)[1]]]
    return np.asarray(trimesh.triangles.closest_point(corners, points))
