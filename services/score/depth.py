"""Errors of a predicted depth image. Pure.

Truth counts where it is positive and finite. A hole is a pixel with truth where the prediction is 0, negative or not finite.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.base import Array
from workers.geometry.jit import compiled

SLACK_M = 1e-9
"""Keeps rounding from deciding: stored depths are multiples of 0.2 mm, so errors of exactly 1 mm, which is within, are common."""

METRICS = (
    *("mae_m", "rmse_m", "abs_rel", "within_1mm", "within_2mm", "within_5mm", "within_10mm"),
    *("delta1", "delta2", "delta3", "holes", "pixels"),
)


def score_depth(predicted_m: ArrayLike, true_m: ArrayLike, parts: Mapping[str, NDArray[np.bool_]]) -> dict[str, float]:
    """Errors of depth z [H, W], metres, on each part [H, W] of the image, as `part.metric` (Eigen et al. 2014, section 4.1).

    With d predicted and t true:
    mae_m, rmse_m: mean |d - t|, root of mean (d - t)^2, metres; abs_rel: mean |d - t| / t. All without the holes.
    delta1, delta2, delta3: share with max(d / t, t / d) < 1.25, 1.25^2, 1.25^3.
    within_1mm, within_2mm, within_5mm, within_10mm: share with |d - t| at most that (Knapitsch et al. 2017, of points).
    holes: share without prediction; these count as missed in delta and within. pixels: how many have truth.

    A part without truth has nan, and 0 pixels; of one that is all holes mae_m, rmse_m and abs_rel are nan. Raises ValueError
    where sizes differ.
    """
    predicted, true = (np.ascontiguousarray(image, np.float64) for image in (predicted_m, true_m))
    code = np.zeros(true.shape, np.uint16)
    if any(image.shape != true.shape for image in (predicted, *parts.values())) or len(parts) > 16:
        raise ValueError(
            f"depth {predicted.shape} of {true.shape} in {len(parts)} parts: sizes differ, or more than 16"
        )
    for k, part in enumerate(parts.values()):
        code |= part.astype(np.uint16) << k
    sums = np.zeros((1 << len(parts), len(METRICS)))
    _add_up(predicted.ravel(), true.ravel(), code.ravel(), sums)
    scores: dict[str, float] = {}
    for k, name in enumerate(parts):
        row = sums[np.arange(len(sums)) >> k & 1 == 1].sum(axis=0)
        holes, pixels = row[-2:]
        values = row / np.repeat([pixels - holes or np.nan, pixels or np.nan, 1.0], [3, len(row) - 4, 1])
        values[1] = np.sqrt(values[1])
        scores |= {f"{name}.{metric}": float(value) for metric, value in zip(METRICS, values, strict=True)}
    return scores


@compiled
def _add_up(predicted: Array, true: Array, code: NDArray[np.uint16], sums: Array) -> None:
    """Adds each pixel to the sums [2^parts, METRICS] of its combination of parts, in one pass; numpy takes thrice as long."""
    for n in range(len(true)):
        t, d = true[n], predicted[n]
        if code[n] == 0 or not 0.0 < t < np.inf:
            continue
        row = sums[code[n]]
        row[11] += 1.0
        if not 0.0 < d < np.inf:
            row[10] += 1.0
            continue
        error, larger, smaller = abs(d - t), max(d, t), min(d, t)
        row[0] += error
        row[1] += error * error
        row[2] += error / t
        row[3] += error <= 0.001 + SLACK_M
        row[4] += error <= 0.002 + SLACK_M
        row[5] += error <= 0.005 + SLACK_M
        row[6] += error <= 0.01 + SLACK_M
        row[7] += larger < 1.25 * smaller - SLACK_M
        row[8] += larger < 1.25**2 * smaller - SLACK_M
        row[9] += larger < 1.25**3 * smaller - SLACK_M
