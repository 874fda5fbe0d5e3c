"""Errors of predicted values at points of space, and boxes about points. Pure."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.base import Array
from schemas.errors import InputError

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
    the two; it is left out of distance_mae_m. nan where no value is left. Raises ValueError where sizes differ.
    """
    if np.shape(predicted) != np.shape(true):
        raise ValueError(f"{np.shape(predicted)} values of {np.shape(true)} points")
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
            f"values reach {np.abs(predicted).max():.3g}, {times:.3g} times the largest distance: they seem to be logits; write "
            "occupancy from 0 to 1, or distance in metres"
        )
    a, b = predicted - predicted.mean(), true - true.mean()
    norm = float(np.sqrt((a @ a) * (b @ b)))
    if norm > 0.0 and float(a @ b) / norm < INVERTED:
        raise InputError("the distances have the other sign: they are negative inside, positive outside")


def box_of(points: Array) -> tuple[Array, float]:
    """The middle [3] and the diagonal of a box about points."""
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2.0, float(np.linalg.norm(high - low))
