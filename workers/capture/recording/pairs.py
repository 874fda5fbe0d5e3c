"""Which depth frame belongs to which colour frame, and how many frames a recording has lost."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from workers.capture.recording.extent import Extent

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
