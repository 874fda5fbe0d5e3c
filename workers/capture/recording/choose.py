"""Choice of a recording's frames: pairs of colour and depth, sharp, and spread over all that the camera has seen.

- Which depth frame belongs to which colour frame, and how many frames a recording has lost.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import shortest_path

from schemas.base import Array
from workers.capture.recording.tracks import Extent

Stamps = NDArray[np.int64]


@dataclass(frozen=True)
class Losses:
    """What is missing of a recording.

    dropped: colour frames missing between the first and the last that were read; without_depth: colour frames without a depth
    frame; damaged: frames that were cut short; cut: frames missing at the end, or None where the file does not say;
    is_cut: whether the file ends before its end.
    """

    dropped: int
    without_depth: int
    damaged: int
    cut: int | None
    is_cut: bool


def pair_frames(color_us: Stamps, depth_us: Stamps, period_us: float, delay_us: float = 0.0) -> dict[int, int]:
    """Index of the depth frame for colour frames that have one: nearest in time, less than half a period away.

    Depth stamps are `delay_us` later than the colour stamps they belong to. Both ascending.
    """
    pairs: dict[int, int] = {}
    if len(depth_us) == 0:
        return pairs
    shifted = depth_us - delay_us
    after = np.searchsorted(shifted, color_us)
    for i, stamp in enumerate(color_us.tolist()):
        near = [k for k in (int(after[i]) - 1, int(after[i])) if 0 <= k < len(shifted)]
        best = min(near, key=lambda k: abs(float(shifted[k]) - stamp))
        if abs(float(shifted[best]) - stamp) < 0.5 * period_us:
            pairs[i] = best
    return pairs


def count_losses(
    color_us: Stamps, pairs: int, damaged: int, period_us: float, extent: Extent, size_bytes: int
) -> Losses:
    """`pairs` colour frames have depth; `size_bytes` is the size of the file as it is. At least one colour frame."""
    frames = round(float(color_us[-1] - color_us[0]) / period_us) + 1
    dropped = max(frames - len(color_us) - damaged, 0)
    is_cut = extent.size_bytes is None or size_bytes < extent.size_bytes
    cut: int | None = None
    if extent.duration_us is not None:
        cut = max(round((extent.duration_us - float(color_us[-1])) / period_us) - 1, 0)
    elif extent.size_bytes is not None:
        missing = max(extent.size_bytes - size_bytes, 0)
        cut = round(missing * len(color_us) / size_bytes)
    return Losses(dropped, len(color_us) - pairs, damaged, cut if is_cut else 0, is_cut)


def describe_losses(losses: Losses) -> list[str]:
    """Sentences for the user, none where nothing is missing."""
    told = []
    if losses.is_cut:
        lost = "nobody knows how many frames are" if losses.cut is None else f"about {losses.cut} frames are"
        told.append(f"the recording is cut: {lost} lost at its end")
    if losses.dropped:
        told.append(f"{losses.dropped} frames are missing between the first and the last")
    if losses.damaged:
        told.append(f"{losses.damaged} frames are damaged")
    if losses.without_depth:
        told.append(f"{losses.without_depth} colour frames have no depth")
    return told


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
