"""Pairs of patches of the object, seen in two views, that lie on one piece of its surface."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from schemas.base import Array
from workers.capture.poses.observation import Patches
from workers.capture.poses.shared import Shared

REACH_M = 0.012
"""Patches of one surface lie at most so far apart: about their own width."""
MIN_COSINE = 0.87
"""And their normals at most 30 degrees."""
NEIGHBOURS = 10
PARTNERS = 3
"""Of the nearest patches of other views, so many are paired with each."""


@dataclass(frozen=True, eq=False)
class Matches:
    """pairs [N, 2]: indices of patches, of two views, the lower first; normal [N, 3]: unit, their mean, board axes."""

    pairs: NDArray[np.int64]
    normal: Array


def placed(patches: Patches, view: NDArray[np.int64], poses: Array, shared: Shared) -> tuple[Array, Array]:
    """(points [P, 3], normals [P, 3]) of patches in the board frame; the normal of depth that is stretched is kept."""
    R, t = poses[view, :3, :3], poses[view, :3, 3]
    points = np.einsum("pij,pj->pi", R, shared.corrected(patches)) + t
    return points, np.einsum("pij,pj->pi", R, patches.normal @ shared.T_cam_depth[:3, :3].T)


def match_patches(patches: Patches, view: NDArray[np.int64], poses: Array, shared: Shared) -> Matches:
    """The pairs at the present poses, each once, in order of index."""
    if len(patches) < 2:
        return Matches(np.zeros((0, 2), np.int64), np.zeros((0, 3)))
    points, normals = placed(patches, view, poses, shared)
    count = min(NEIGHBOURS + 1, len(points))
    distance, neighbour = cKDTree(points).query(points, k=count, distance_upper_bound=REACH_M)
    found = np.isfinite(distance)
    neighbour = np.where(found, neighbour, 0)
    alike = np.einsum("pi,pki->pk", normals, normals[neighbour]) > MIN_COSINE
    normals = _smoothed(normals, neighbour, found & alike)
    alike = np.einsum("pi,pki->pk", normals, normals[neighbour]) > MIN_COSINE
    good = found & alike & (view[neighbour] != view[:, None])
    good &= np.cumsum(good, axis=1) <= PARTNERS
    first, column = np.nonzero(good)
    pairs = np.sort(np.stack([first, neighbour[first, column]], axis=1), axis=1).astype(np.int64)
    pairs = np.unique(pairs, axis=0)
    normal = normals[pairs[:, 0]] + normals[pairs[:, 1]]
    return Matches(pairs, normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _smoothed(normals: Array, neighbour: NDArray[np.intp], chosen: NDArray[np.bool_]) -> Array:
    """[P, 3]: the mean of the normals around each patch: the surface bends less over a patch than its noise."""
    total = (normals[neighbour] * chosen[..., None]).sum(axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0.5, total / np.maximum(length, 1e-9), normals)
