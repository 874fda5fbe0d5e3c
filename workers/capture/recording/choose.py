"""Choice of a recording's frames: sharp ones, and spread over all that the camera has seen."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

from schemas.base import Array

LOOK = (32, 18)
"""Width and height of the small picture by which frames are compared."""

BLURRED = 0.5
"""A frame with less than this share of the usual sharpness is taken only where there are too few others."""

NEAR = 0.5
"""Two frames whose looks, of length 1, differ by less show much the same: a correlation of 0.875."""


@dataclass(frozen=True, eq=False)
class FrameMeasure:
    """What a frame is chosen by: sharpness, and a small picture [LOOK pixels] without its brightness and contrast."""

    sharpness: float
    look: Array


def measure_frame(gray: NDArray[np.uint8]) -> FrameMeasure:
    """Sharpness is the variance of the Laplacian, which motion blur lowers; grey levels squared."""
    look = cv2.resize(gray, LOOK, interpolation=cv2.INTER_AREA).astype(np.float64).ravel()
    look -= look.mean()
    norm = float(np.sqrt((look * look).sum()))
    return FrameMeasure(float(cv2.Laplacian(gray, cv2.CV_64F).var()), look / norm if norm > 0.0 else look)


def choose_frames(measures: list[FrameMeasure], count: int) -> list[int]:
    """Ascending indices of `count` frames, or of all where there are fewer.

    First each frame must be the sharpest among its neighbours in time, whose content is the same, so that their sharpness can
    be compared. Of those the sharpest is taken, then again and again the one that is the farthest way from all that were
    taken: a camera that stands still or comes back adds no frame while others are left.
    """
    if len(measures) <= count:
        return list(range(len(measures)))
    sharpness = np.array([measure.sharpness for measure in measures])
    reach = max(len(measures) // (8 * count), 1)
    candidates = _sharpest(sharpness, reach)
    while len(candidates) < count and reach > 0:
        reach //= 2
        candidates = _sharpest(sharpness, reach)
    ways = _ways(np.stack([measures[i].look for i in candidates]))
    return sorted(candidates[_spread(ways, int(np.argmax(sharpness[candidates])), count)].tolist())


def _sharpest(sharpness: Array, reach: int) -> NDArray[np.int64]:
    """Frames that are the sharpest of those at most `reach` frames away, and not blurred where enough others are sharp."""
    padded = np.pad(sharpness, reach, constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    best = np.flatnonzero(windows.argmax(axis=1) == reach)
    sharp = best[sharpness[best] >= BLURRED * np.median(sharpness[best])]
    return sharp if reach > 0 else best


def _ways(looks: Array) -> Array:
    """[N, N] float64: how far the camera goes from one frame to another, as a sum of small changes of the look.

    The change between two frames says how far apart they are only while they show much the same; farther on it does not grow.
    So frames are joined to their neighbours in time and to all that look nearly the same, and the shortest way is taken.
    """
    change = np.stack([np.sqrt(((looks - look) ** 2).sum(axis=1)) for look in looks])
    joined = change < NEAR
    after = np.arange(len(looks) - 1)
    joined[after, after + 1] = True
    return np.asarray(shortest_path(np.where(joined, np.maximum(change, 1e-9), 0.0), directed=False), np.float64)


def _spread(ways: Array, first: int, count: int) -> NDArray[np.int64]:
    """Indices of `count` frames: `first`, then each the farthest from those before it; ties go to the earliest."""
    chosen = [first]
    nearest = ways[first].copy()
    nearest[first] = -1.0
    while len(chosen) < count:
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ways[chosen[-1]])
        nearest[chosen] = -1.0
    return np.array(chosen)
