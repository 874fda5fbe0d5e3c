"""Errors of a predicted pose of a rigid body, and of predicted values at points of space. Pure."""

import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from trimesh.triangles import closest_point

from schemas.base import Array, Pose
from schemas.errors import InputError
from schemas.scene.shape import Mesh
from workers.geometry.frames import angle_between, pose, transform

ROTATION = 1e-3
"""How far the products of a rotation's rows may be from 0 and 1: csv files of poses have as few as four digits."""

SAME = 0.01
"""How far, as a share of the diagonal, a surface may be from itself after a turn that is a symmetry (as facets of a tube are)."""

STEP_DEG = 2.0
LOOKED_AT = 500
"""About how many vertices are looked at for symmetries."""


def score_pose(
    T_predicted: Pose, T_true: Pose, points: Array, symmetries: Sequence[Pose], K: NDArray
) -> dict[str, float]:
    """Errors of a pose, object to camera [4, 4], of a body with points [N, 3] of its surface, metres, in the object's frame.

    symmetries: transforms [4, 4] of the object's frame after which the body looks the same; that it is left as it is counts
    among them always. K [3, 3]: intrinsics.

    add_m: mean distance of a point's two places; add_s_m: of its true place to the nearest predicted place of any point
    (Hinterstoisser et al. 2012, section 4; ADI).
    mssd_m, mspd_px: the largest distance of a point's two places, in space and in the image, least over the symmetries
    (Hodan et al., BOP Challenge 2020, section 2.2).
    rotation_deg: angle between the two rotations, least over the symmetries. translation_m: distance of the two origins.

    All are nan where T_predicted or T_true is not a finite rotation and translation; those of points also without points or
    where one is not finite. mspd_px is inf where a predicted point is behind the camera, else nan where a true one is.
    """
    scores = dict.fromkeys(("add_m", "add_s_m", "rotation_deg", "translation_m", "mssd_m", "mspd_px"), math.nan)
    if not (is_rigid(T_predicted) and is_rigid(T_true)):
        return scores
    same = [T_true, *(T_true @ symmetry for symmetry in symmetries)]
    scores["rotation_deg"] = math.degrees(min(angle_between(T_predicted[:3, :3], T[:3, :3]) for T in same))
    scores["translation_m"] = float(np.linalg.norm(T_predicted[:3, 3] - T_true[:3, 3]))
    if not len(points) or not np.isfinite(points).all():
        return scores
    predicted, true = transform(T_predicted, points), [transform(T, points) for T in same]
    scores["add_m"] = float(np.linalg.norm(predicted - true[0], axis=1).mean())
    scores["add_s_m"] = float(cKDTree(predicted).query(true[0])[0].mean())
    scores["mssd_m"] = min(float(np.linalg.norm(predicted - each, axis=1).max()) for each in true)
    if not (predicted[:, 2] > 0.0).all():
        scores["mspd_px"] = math.inf
    elif all((each[:, 2] > 0.0).all() for each in true):
        pixels = _project(predicted, K)
        scores["mspd_px"] = min(float(np.linalg.norm(pixels - _project(each, K), axis=1).max()) for each in true)
    return scores


def symmetries_of(mesh: Mesh) -> list[Pose]:
    """Rotations [4, 4] of the object's frame after which a mesh, metres, looks the same but for its colours.

    About the axes of the frame through the surface's centroid: a half, third and quarter turn, or, where any turn does, steps
    of `STEP_DEG`; and their products. The same: no vertex moves farther from the surface than `SAME` of the diagonal.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    corners = vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middle = areas @ corners.mean(axis=1) / areas.sum()
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    some, limit = vertices[:: -(-len(vertices) // LOOKED_AT)], SAME * float(np.linalg.norm(high - low))

    def turn(axis: int, degrees: float) -> Pose:
        R = Rotation.from_rotvec(np.eye(3)[axis] * degrees, degrees=True).as_matrix()
        return pose(R, middle - R @ middle)

    def same(axis: int, degrees: float) -> bool:
        return is_near(transform(turn(axis, degrees), some), corners, limit)

    turns: list[list[float]] = []
    for axis in range(3):
        whole = all(same(axis, 180.0 * n * (math.sqrt(5.0) - 1.0)) for n in range(1, 6))  # no two alike by any fold
        folds = [fold for fold in (2, 3, 4) if not whole and same(axis, 360.0 / fold)]
        angles = {0.0} | {360.0 * k / fold for fold in folds for k in range(fold)}
        turns.append(np.arange(0.0, 360.0, STEP_DEG).tolist() if whole else sorted(angles))
    if sum(len(one) > 12 for one in turns) > 1:  # a ball: products would fill all rotations
        return [turn(axis, angle) for axis, some_turns in enumerate(turns) for angle in some_turns]
    products = [turn(2, c) @ turn(1, b) @ turn(0, a) for a, b, c in itertools.product(*turns)]
    return list({(np.round(T, 6) + 0.0).tobytes(): T for T in products}.values())


def is_near(points: Array, corners: Array, limit: float) -> bool:
    """Whether every point [N, 3] is within a distance of a surface, by the corners [F, 3, 3] of its faces.

    Faces are asked by the power of two of their size, so that a large one does not make candidates of all small ones.
    """
    centre = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    size, left = np.frexp(radius)[1], points
    for each in np.unique(size):
        faces = np.flatnonzero(size == each)
        near = cKDTree(centre[faces]).query_ball_point(left, limit + radius[faces].max())
        of = np.repeat(np.arange(len(left)), [len(one) for one in near])
        there = left[of]
        nearest = closest_point(corners[faces[np.concatenate([*near, []]).astype(np.int64)]], there)
        left = np.delete(left, of[np.linalg.norm(nearest - there, axis=1) <= limit], axis=0)
        if not len(left):
            return True
    return False


def is_rigid(T: Pose) -> bool:
    """Whether a matrix is [4, 4] of a rotation, to rounding of its text, and a translation, all finite."""
    T = np.asarray(T)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    if np.abs(R).max() > 1.0 + ROTATION:  # its products may overflow
        return False
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= ROTATION and np.linalg.det(R) > 0.0)


def _project(points: Array, K: NDArray) -> Array:
    """[N, 2]: image coordinates, pixels, of points [N, 3] in front of the camera."""
    image = points @ np.asarray(K, np.float64).T
    return np.asarray(image[:, :2] / image[:, 2:])


INVERTED: Final = -0.8
"""Correlation with the truth below which a prediction is inverted: of disparity, or distance of the other sign, it is near -1,
of a poor guess near 0."""


def score_volume(predicted: NDArray, true: NDArray, is_distance: bool) -> dict[str, float | None]:
    """Errors at the same points of space, as many as [M], of occupancy, or of signed distance, metres, negative inside.

    Inside is a distance below 0, an occupancy above 0.5.
    iou: points inside both by those inside either (Mescheder et al. 2019, section 4); None where none is in either. It is of the
    points, which lie more densely about the surface, not of the volume.
    accuracy: share of points on the right side. distance_mae_m: mean |difference|, metres; None of occupancy.

    A true value that is not finite does not count. A predicted one is wrong: in accuracy, and in iou as a point inside one of
    the two; it is left out of distance_mae_m. nan where no value is left.
    """
    truth, values = (np.asarray(each, np.float64)[np.isfinite(true)] for each in (true, predicted))
    known = np.isfinite(values)
    within, inside = ((each < 0.0 if is_distance else each > 0.5) for each in (truth, values))
    either, error = int((within | inside | ~known).sum()), np.abs(values - truth)[known]
    return {
        "iou": float((within & inside & known).sum() / either) if either else None,
        "accuracy": float(((within == inside) & known).mean()) if len(truth) else math.nan,
        "distance_mae_m": None if not is_distance else float(error.mean()) if len(error) else math.nan,
    }


def check_distance(predicted: Array, true: Array) -> None:
    """Raises InputError where signed distances [N] are no metres, or positive inside."""
    times = float(np.abs(predicted).max() / max(float(np.abs(true).max()), 1e-9))
    if times > 300.0:
        raise InputError(f"distances reach {np.abs(predicted).max():.3g}: they seem to be in millimetres; write metres")
    if times > 10.0:
        raise InputError(
            f"values reach {np.abs(predicted).max():.3g}, {times:.3g} times the largest distance: they seem to be logits: "
            "score them with --volume logits, or write occupancy from 0 to 1, or distance in metres"
        )
    if correlation(predicted, true) < INVERTED:
        raise InputError(
            "the distances have the other sign, positive inside: score them with --volume sdf-positive-inside, or write "
            "them negative inside"
        )


def correlation(a: Array, b: Array) -> float:
    """Pearson's, of values [N]; nan where one does not vary."""
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / norm if norm > 0.0 else math.nan


def box_of(points: Array) -> tuple[Array, float]:
    """The middle [3] and the diagonal of a box about points."""
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2.0, float(np.linalg.norm(high - low))
