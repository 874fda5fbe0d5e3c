"""Errors of a predicted pose of a rigid body. Pure."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from schemas.base import Array, Pose
from workers.geometry.frames import angle_between, transform

ROTATION = 1e-3
"""How far the products of a rotation's rows may be from 0 and 1: csv files of poses have as few as four digits."""


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


def is_rigid(T: Pose) -> bool:
    """Whether a matrix is [4, 4] of a rotation, to rounding of its text, and a translation, all finite."""
    T = np.asarray(T)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= ROTATION and np.linalg.det(R) > 0.0)


def _project(points: Array, K: NDArray) -> Array:
    """[N, 2]: image coordinates, pixels, of points [N, 3] in front of the camera."""
    image = points @ np.asarray(K, np.float64).T
    return np.asarray(image[:, :2] / image[:, 2:])
