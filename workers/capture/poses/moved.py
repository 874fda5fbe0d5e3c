"""Whether the object moved on the board in the middle of a capture, by what views before and after see of it."""

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from workers.capture.poses.matches import MIN_COSINE, placed
from workers.capture.poses.observation import Patches
from workers.capture.poses.shared import Shared

REACH_M = 0.05
"""Movements up to this are seen."""
PER_VIEW = 25
"""Patches of a view that are looked at."""
QUANTILE = 0.85
"""A slide along a face leaves that face where it was: the surfaces that disagree most tell."""
MOVED_M = 0.004
MOVED_TIMES = 3.0
"""The object moved where views of different sides of a cut see its surface so far apart, and so many times farther than
views of one side."""
MIN_PATCHES = 40


def moved_after(patches: Patches, view: NDArray[np.int64], poses: Array, shared: Shared) -> tuple[int, float] | None:
    """(index of the last view before the move, metres between the surfaces), or None where nothing moved.

    Of all cuts of the sequence, the one across which the surfaces disagree most against those of one side.
    """
    chosen = np.concatenate(
        [_evenly(np.flatnonzero(view == number)) for number in np.unique(view)] or [np.zeros(0, np.int64)]
    )
    if len(chosen) < MIN_PATCHES:
        return None
    points, normals = (values[chosen] for values in placed(patches, view, poses, shared))
    distance, plane = _distances(points, normals)
    side_of = view[chosen]
    best: tuple[int, float] | None = None
    most = MOVED_TIMES
    for cut in np.unique(side_of)[:-1]:
        after = side_of > cut
        other = after[:, None] != after[None, :]
        same = ~other & (side_of[:, None] != side_of[None, :])
        apart, together = _disagreement(distance, plane, other), _disagreement(distance, plane, same)
        if apart is None or together is None:
            continue
        if apart > max(MOVED_M, most * together):
            best, most = (int(cut), apart), apart / max(together, 1e-6)
    return best


def _evenly(index: NDArray[np.int64]) -> NDArray[np.int64]:
    if len(index) <= PER_VIEW:
        return index
    return index[np.linspace(0, len(index) - 1, PER_VIEW).round().astype(np.int64)]


def _distances(points: Array, normals: Array) -> tuple[Array, Array]:
    """([N, N] metres, inf where normals differ or beyond reach; [N, N] metres along the mean normal) of each two patches."""
    apart = points[:, None] - points[None]
    distance = np.linalg.norm(apart, axis=2)
    alike = normals @ normals.T > MIN_COSINE
    mean = normals[:, None] + normals[None]
    mean /= np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), 1e-9)
    return np.where(alike & (distance < REACH_M), distance, np.inf), np.abs((apart * mean).sum(axis=2))


def _disagreement(distance: Array, plane: Array, allowed: NDArray[np.bool_]) -> float | None:
    """The upper quantile of the distances along the normal of each patch to its nearest that is allowed; None for few."""
    masked = np.where(allowed, distance, np.inf)
    nearest = masked.argmin(axis=1)
    rows = np.flatnonzero(np.isfinite(masked[range(len(masked)), nearest]))
    return float(np.quantile(plane[rows, nearest[rows]], QUANTILE)) if len(rows) >= MIN_PATCHES else None
