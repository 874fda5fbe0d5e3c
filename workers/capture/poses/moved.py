"""Whether the object moved on the board in the middle of a capture, by what views before and after see of it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from schemas.base import Array
from workers.capture.poses.matches import MIN_COSINE, placed
from workers.capture.poses.observation import Patches
from workers.capture.poses.shared import Shared
from workers.geometry.spread import spread_evenly

REACH_M = 0.05
"""Movements up to this are seen."""
PER_VIEW = 40
"""Patches of a view that are looked at."""
NORMAL_M = 0.03
"""A turned normal counts as so many metres a radian in the search for the nearest patch."""
MOVED_M = 0.004
"""A shift of more than this between the views before and after is a move: errors of depth are smaller once corrected."""
ROBUST_M = 0.01
"""Distance at which a pair of patches has half its weight."""
MIN_PAIRS = 40
FLAT = 0.02
"""A shift is known only in directions that this share of the normals tells of."""


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Two patches each, on surface of one direction: the views of both, the first before the second.

    first, second [N]; normal [N, 3]: their mean; distance_m [N]: of the second from the first along it.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    normal: Array
    distance_m: Array


def moved_after(patches: Patches, view: NDArray[np.int64], poses: Array, shared: Shared) -> tuple[int, float] | None:
    """(index of the last view before the move, metres that the object was shifted by), or None where nothing moved.

    Of all cuts of the sequence, the one across which a common shift of the object explains most.
    """
    of_view = [np.flatnonzero(view == number) for number in range(len(poses))]
    chosen = np.concatenate([own[spread_evenly(len(own), PER_VIEW)] for own in of_view])
    points, normals = (values[chosen] for values in placed(patches, view, poses, shared))
    pairs = _pairs(points, normals, view[chosen], len(poses))
    best: tuple[int, float] | None = None
    most = 0.0
    for cut in range(len(poses) - 1):
        across = (pairs.first <= cut) & (pairs.second > cut)
        if across.sum() < MIN_PAIRS:
            continue
        shift, explained = _shift(pairs.normal[across], pairs.distance_m[across])
        if explained > most:
            best, most = (cut, float(np.linalg.norm(shift))), explained
    return best if best is not None and best[1] > MOVED_M else None


def _pairs(points: Array, normals: Array, view: NDArray[np.int64], views: int) -> _Pairs:
    """Each patch with the nearest of every other view, where that lies on surface of the same direction."""
    places = np.column_stack([points, NORMAL_M * normals])
    of_view = [np.flatnonzero(view == number) for number in range(views)]
    trees = [cKDTree(places[own]) if len(own) else None for own in of_view]
    parts = []
    for number, own in enumerate(of_view):
        for other, tree in enumerate(trees):
            if tree is None or other == number or not len(own):
                continue
            distance, nearest = tree.query(places[own])
            there = of_view[other][nearest]
            near = (distance < REACH_M) & ((normals[own] * normals[there]).sum(axis=1) > MIN_COSINE)
            a, b = (own[near], there[near]) if number < other else (there[near], own[near])
            parts.append(np.stack([a, b], axis=1))
    a, b = np.concatenate(parts or [np.zeros((0, 2), np.int64)]).T
    mean = normals[a] + normals[b]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    return _Pairs(view[a], view[b], mean, ((points[b] - points[a]) * mean).sum(axis=1))


def _shift(normal: Array, distance_m: Array) -> tuple[Array, float]:
    """(the shift [3] that explains the distances along the normals best; by how much it lowers their robust cost)."""
    shift = np.zeros(3)
    for _ in range(5):
        weight = 1.0 / (1.0 + ((distance_m - normal @ shift) / ROBUST_M) ** 2)
        matrix = (normal * weight[:, None]).T @ normal
        strength, directions = np.linalg.eigh(matrix)
        known = strength > FLAT * weight.sum()
        along = directions[:, known].T @ ((normal * weight[:, None]).T @ distance_m)
        shift = directions[:, known] @ (along / strength[known])
    return shift, _cost(distance_m) - _cost(distance_m - normal @ shift)


def _cost(distance_m: Array) -> float:
    return float(np.log1p((distance_m / ROBUST_M) ** 2).sum())
